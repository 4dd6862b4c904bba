"""White noise of an IMU by its samples, and what it decides."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.trajectory.imu import NO_GAPS, Inertial
from caliv_graph.trajectory.noise import ImuNoise
from caliv_graph.trajectory.sample_noise import levels_of_samples
from caliv_graph.trajectory.variances import NoiseLikelihood, contradicted

STATED = ImuNoise(
    gyro_density=np.diag([1e-4, 1e-4, 1e-4]) ** 2,
    force_density=np.diag([1e-3, 1e-3, 1e-3]) ** 2,
    gyro_walk=np.zeros(3),
    force_walk=np.zeros(3),
    gyro_bias=np.zeros(3),
    force_bias=np.zeros(3),
    sources={},
)
FOREVER = 10**18


def samples(
    rate_hz: float, seconds: float, gyro: float = 1.0, force: float = 1.0, seed: int = 7
) -> Inertial:
    """White noise on a vehicle that turns, `gyro` and `force` times what is stated."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    rng = np.random.default_rng(seed)
    turns = 0.3 * np.sin(2.0 * t)[:, None] + np.zeros(3)
    white = np.sqrt(rate_hz) * rng.normal(size=(2, len(t), 3))
    return Inertial(
        np.round(1e9 * t).astype(np.int64),
        turns + gyro * 1e-4 * white[0],
        np.array([0.0, 0.0, 9.81]) + turns + force * 1e-3 * white[1],
        NO_GAPS,
    )


def added(inertial: Inertial, gyro: Array) -> Inertial:
    return Inertial(inertial.stamps_ns, inertial.gyro + gyro, inertial.force, NO_GAPS)


def waves(inertial: Inertial, hertz: Array, size: float) -> Array:
    """(n, 3) of sines of these frequencies, whose phases are random."""
    t = 1e-9 * inertial.stamps_ns[:, None]
    phases = np.random.default_rng(3).uniform(0.0, 2.0 * np.pi, len(hertz))
    return np.asarray(size * np.sin(2.0 * np.pi * hertz * t + phases).sum(axis=1)[:, None])


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 400.0])
def test_white_noise_is_measured_beside_motion(rate_hz: float) -> None:
    found = levels_of_samples(samples(rate_hz, 40.0, 5.0, 0.5), STATED, FOREVER)

    assert found == pytest.approx({"gyroscope": 5.0, "accelerometer": 0.5}, rel=0.06)


def test_lines_and_loud_octaves_are_no_white_noise() -> None:
    inertial = samples(200.0, 40.0)
    engine = waves(inertial, np.array([27.3, 54.6, 81.9]), 0.05)
    road = waves(inertial, np.linspace(12.5, 50.0, 400), 1e-3)

    found = levels_of_samples(added(inertial, engine + road), STATED, FOREVER)

    # 400 sines of 1e-3 in 37.5 Hz: 16 times as loud as what is stated.
    assert found["gyroscope"] == pytest.approx(1.0, rel=0.06)


def test_bumps_and_glitches_are_no_white_noise() -> None:
    """They are as loud in all octaves, but for an instant only."""
    inertial = samples(100.0, 60.0)
    knock = np.zeros((6000, 3))
    knock[1000] = 1.0
    knock[3000:3002] = 0.3
    knock[4000:4100] = 0.03 * np.random.default_rng(1).normal(size=(100, 3))

    found = levels_of_samples(added(inertial, knock), STATED, FOREVER)

    assert found["gyroscope"] == pytest.approx(1.0, rel=0.08)


def test_ten_segments_tell_a_level() -> None:
    levels = [
        levels_of_samples(samples(100.0, 11.0, seed=seed), STATED, FOREVER)["gyroscope"]
        for seed in range(10)
    ]

    assert np.mean(levels) == pytest.approx(1.0, abs=0.08)
    assert np.max(levels) < 1.1


@pytest.mark.parametrize("rate_hz", [19.99, 20.0, 20.01])
def test_one_octave_of_a_slow_imu_is_asked(rate_hz: float) -> None:
    found = levels_of_samples(samples(rate_hz, 60.0, 4.0), STATED, FOREVER)

    assert found["gyroscope"] == pytest.approx(4.0, rel=0.1)


def test_samples_of_another_rate_are_left_out() -> None:
    slow, fast = samples(100.0, 40.0), samples(200.0, 18.0)
    end_ns = int(slow.stamps_ns[-1]) + 10_000_000
    both = Inertial(
        np.concatenate([slow.stamps_ns, end_ns + fast.stamps_ns]),
        np.concatenate([slow.gyro, fast.gyro]),
        np.concatenate([slow.force, fast.force]),
        NO_GAPS,
    )

    assert levels_of_samples(both, STATED, FOREVER)["gyroscope"] == pytest.approx(1.0, rel=0.06)


def test_only_samples_up_to_the_last_stamp_count() -> None:
    inertial = samples(100.0, 40.0)
    gyro = inertial.gyro.copy()
    gyro[2000:] += np.random.default_rng(1).normal(size=(2000, 3))
    loud = Inertial(inertial.stamps_ns, gyro, inertial.force, NO_GAPS)

    assert levels_of_samples(loud, STATED, 20 * 10**9)["gyroscope"] < 1.1
    assert levels_of_samples(loud, STATED, FOREVER)["gyroscope"] > 100.0


def test_segments_with_a_gap_are_left_out() -> None:
    inertial = samples(100.0, 40.0)
    # The vehicle turns the other way after half a second without samples.
    steps = np.where(np.arange(4000) < 2000, 0.0, 5.0)[:, None]
    stamps = inertial.stamps_ns + np.where(steps[:, 0] > 0.0, 500_000_000, 0)
    beside = Inertial(stamps, inertial.gyro + steps, inertial.force, NO_GAPS)

    assert levels_of_samples(beside, STATED, FOREVER)["gyroscope"] == pytest.approx(1.0, rel=0.06)


@pytest.mark.parametrize(
    ("rate_hz", "seconds"), [(100.0, 5.0), (15.0, 60.0), (100.0, 0.01), (0.2, 600.0)]
)
def test_few_or_slow_samples_tell_nothing(rate_hz: float, seconds: float) -> None:
    assert levels_of_samples(samples(rate_hz, seconds), STATED, FOREVER) == {}


class _Bowl:
    """A likelihood whose optimum is at given scales, as well told as given."""

    def __init__(self, scales: dict[str, float], curvatures: dict[str, float]) -> None:
        self.names = list(scales)
        self.curvatures = np.array([curvatures[name] for name in self.names])
        self._optimum = np.log(list(scales.values()))

    def at(self, scales: Array) -> tuple[float, Array]:
        away = np.log(scales) - self._optimum
        return 0.5 * float(self.curvatures @ away**2), self.curvatures * away

    @property
    def as_stated(self) -> tuple[float, Array]:
        return self.at(np.ones(len(self.names)))


def scales(likelihood: _Bowl, shown: dict[str, float]) -> dict[str, float]:
    return contradicted(cast(NoiseLikelihood, likelihood), shown)


def test_loud_samples_let_weak_residuals_speak_up_to_what_they_show() -> None:
    # Chi-square of the stated level 3.9: residuals alone do not contradict it.
    weak = _Bowl({"gnss_vertical": 1.0, "gyroscope": 4.0}, {"gnss_vertical": 900.0, "gyroscope": 4})

    assert scales(weak, {}) == {}
    assert scales(weak, {"gyroscope": 1.05}) == {}
    assert scales(weak, {"gyroscope": 2.0})["gyroscope"] == pytest.approx(2.0, rel=0.01)
    # The prior pulls: 4 ln 4 / (4 + 2 / ln(3)^2) in logarithms.
    assert scales(weak, {"gyroscope": 9.0})["gyroscope"] == pytest.approx(2.665, rel=0.01)


def test_loud_samples_do_not_speak_against_residuals() -> None:
    quiet = _Bowl(
        {"gnss_vertical": 1.0, "gyroscope": 0.9}, {"gnss_vertical": 900.0, "gyroscope": 9}
    )
    clear = _Bowl(
        {"gnss_vertical": 1.0, "gyroscope": 4.0}, {"gnss_vertical": 9.0, "gyroscope": 900}
    )

    assert scales(quiet, {"gyroscope": 20.0}) == {}
    # Rocking of the body that no octave above shows.
    assert scales(clear, {"gyroscope": 2.0})["gyroscope"] == pytest.approx(4.0, rel=0.01)
