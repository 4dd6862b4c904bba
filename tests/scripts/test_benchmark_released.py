"""The benchmark's verdicts, on outcomes made up here: they must be able to fail."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.config.load import load_config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import AXES
from scripts import benchmark_released as benchmark
from scripts.benchmark_released import Outcome, Runs, Timing, Verdict

ROOT = Path(__file__).resolve().parents[2]

ERROR = np.array([1e-3, -2e-3, 1e-3, 4e-3, -5e-3, 6e-3])
"""roll, pitch, yaw, x, y, z."""

SIGMA = np.array([1e-3, 1e-3, 4.3e-3, 40e-3, 10e-3, 41e-3])

GOOD = Outcome(
    "auto",
    "huber",
    0,
    errors=dict.fromkeys(benchmark.QUANTITIES, ERROR),
    sigmas=dict.fromkeys(benchmark.QUANTITIES, SIGMA),
    nees=dict.fromkeys(benchmark.QUANTITIES, 6.0),
    undetermined=(
        "height of all LiDARs together",
        "rotation of all LiDARs about the turn centre: x and yaw together, 9.14 m per rad",
    ),
    lost=frozenset({"x", "yaw", "z"}),
)


def failed(*outcomes: Outcome) -> list[str]:
    runs = Runs(outcomes[0].mode, outcomes[0].kernel, outcomes)
    return [v.what for v in benchmark.accuracy_verdicts(runs) if not v.kept]


def shifted(outcome: Outcome, quantity: str, axis: str, by: float) -> Outcome:
    assert outcome.errors
    error = outcome.errors[quantity].copy()
    error[AXES.index(axis)] += by
    return replace(outcome, errors={**outcome.errors, quantity: error})


def test_statistics_are_of_absolute_errors_in_mm_and_mrad() -> None:
    runs = Runs("auto", "huber", (GOOD, shifted(GOOD, "S2S", "x", -10e-3)))

    s = runs.statistics("S2S")

    np.testing.assert_allclose(s.mean_abs, [5.0, 5.0, 6.0, 1.0, 2.0, 1.0])
    np.testing.assert_allclose(s.std, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(s.sigma, [40.0, 10.0, 41.0, 1.0, 1.0, 4.3])
    assert s.nees == 6.0


def test_auto_is_held_to_what_it_must_show() -> None:
    assert failed(GOOD) == []
    assert failed(GOOD, replace(GOOD, failure="TargetError: none")) == ["failed calibrations"]
    assert failed(shifted(GOOD, "S2V L2", "yaw", 5e-3)) == ["S2V L2 yaw, mean absolute"]
    assert failed(GOOD, shifted(GOOD, "S2S", "pitch", 2e-3)) == ["S2S pitch, std over guesses"]


def test_one_run_that_does_not_name_a_direction_is_enough() -> None:
    height, turn = GOOD.undetermined
    silent = replace(GOOD, undetermined=(turn,))
    apart = replace(GOOD, undetermined=(height, "shift of all LiDARs forward: x", "yaw"))

    assert failed(GOOD, silent) == ["runs without z undetermined"]
    assert failed(GOOD, apart) == ["runs without x/yaw undetermined"]
    assert failed(GOOD, replace(GOOD, lost=frozenset({"x", "z"}))) == [
        "runs without x/yaw undetermined"
    ]


def test_a_small_sigma_of_one_lidar_in_one_run_is_enough() -> None:
    assert GOOD.sigmas
    small = SIGMA.copy()
    small[3] = 19e-3
    proud = replace(GOOD, sigmas={**GOOD.sigmas, "S2V L2": small})

    assert failed(GOOD, proud) == ["S2V x, smallest sigma"]
    # That of S2S is the data's.
    assert failed(replace(GOOD, sigmas={**GOOD.sigmas, "S2S": small})) == []


def test_staged_is_held_to_the_figures_to_beat() -> None:
    staged = replace(GOOD, mode="staged", undetermined=(), lost=frozenset())

    assert failed(staged) == []
    assert failed(shifted(staged, "S2S", "yaw", -5e-3)) == ["S2S yaw, mean absolute"]
    assert failed(shifted(staged, "S2V L2", "roll", 1e-3)) == ["S2V L2 roll, mean absolute"]


def test_time_and_memory_are_limited() -> None:
    timing = Timing("auto", "huber", 15.1, 14.0, 1100.0, 2.5, {})

    assert [v.what for v in benchmark.timing_verdicts(timing) if not v.kept] == [
        "one calibration, wall time",
        "all graph solves",
        "peak memory",
    ]


def test_verdicts_are_shown_as_pass_or_fail() -> None:
    shown = benchmark.verdict_text(
        [
            Verdict("auto, huber", "S2V x, smallest sigma", 19.0, 20.0, "mm", at_least=True),
            Verdict("auto, huber", "failed calibrations", 0, 0),
        ]
    )

    assert shown.splitlines()[2].split()[-5:] == ["19.00", ">=", "20", "mm", "FAIL"]
    assert shown.splitlines()[3].split()[-1] == "pass"
    assert shown.endswith("1 of 2 limits kept")


def test_guesses_are_drawn_as_in_the_paper() -> None:
    config = load_config(benchmark.CONFIG)
    drawn = [benchmark.guessed(config, config, ROOT, 1, guess) for guess in range(50)]

    for name, lidar in config.lidars.items():
        true = lidar.guess()
        guesses = [c.lidars[name].guess() for c in drawn]
        shift = np.array([g.translation() - true.translation() for g in guesses])
        turn = np.array([true.rotation().between(g.rotation()).rpy() for g in guesses])
        assert 0.09 < np.abs(shift).max() < 0.1 + 1e-5
        assert np.radians(2.7) < np.abs(turn).max() < np.radians(3.0) + 1e-5
        assert np.abs(shift.mean(axis=0)).max() < 0.03
    again = benchmark.guessed(config, config, ROOT, 1, 7)
    assert again.lidars == drawn[7].lidars
    assert len({c.lidars["sensor_1"].initial for c in drawn}) == 50
    assert isinstance(again.lidars["sensor_1"].initial, PoseConfig)


@pytest.mark.parametrize("json", [[], ["--json"]])
def test_without_the_drive_it_says_so_in_one_line(
    tmp_path: Path,
    json: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark", "--data", str(tmp_path / "nowhere"), *json])

    assert benchmark.main() == 2

    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == (
        f"error: {tmp_path}/nowhere: the drive that the CaLiV authors published is not there "
        "(input/ and original_config.yaml). Give --data the folder that holds it\n"
    )
