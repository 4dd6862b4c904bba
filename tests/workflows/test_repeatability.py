from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.conventions import AXES
from caliv_graph.products import TargetCloud, TargetObservation
from caliv_graph.simulation.writer import config_of
from caliv_graph.validation.clouds import Clouds
from caliv_graph.validation.findings import Validation, Verdict
from caliv_graph.workflows.repeatability import (
    _tells_what_level_ground_does_not,
    alternate,
    split,
    split_halves,
    with_halves,
)
from scripts.benchmark_clocks import Late
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive
from tests.workflows.test_survey import QUICK, scenario_of

SECOND = 1_000_000_000


def observation(**stamps_s: list[float]) -> TargetObservation:
    clouds = tuple(
        TargetCloud(name, 0, round(stamp * SECOND), np.zeros((1, 3)), "")
        for name, stamps in stamps_s.items()
        for stamp in stamps
    )
    return TargetObservation(0, "target", np.zeros(3), clouds)


def seconds(half: tuple[TargetCloud, ...], lidar: str) -> list[float]:
    return [cloud.stamp_ns / SECOND for cloud in half if cloud.lidar == lidar]


def test_passes_are_what_is_between_long_gaps() -> None:
    halves = split(observation(front=[0, 1, 2, 20, 21], rear=[8, 9, 30, 31, 32]), 2)

    assert halves is not None
    first, second = halves
    assert (seconds(first, "front"), seconds(second, "front")) == ([0, 1, 2], [20, 21])
    assert (seconds(first, "rear"), seconds(second, "rear")) == ([8, 9], [30, 31, 32])


def test_of_many_passes_the_halves_are_about_as_large() -> None:
    halves = split(observation(front=[0, 10, 20, 20.1, 20.2, 20.3, 30, 40]), 1)

    assert halves is not None
    assert [len(half) for half in halves] in ([2, 6], [6, 2])


def test_one_pass_is_not_split_by_passes() -> None:
    assert split(observation(front=[0, 1, 20, 21], rear=[0, 1, 2, 3]), 2) is None
    # A glimpse of it is no pass.
    assert split(observation(front=[0, 1, 20], rear=[0, 1, 20, 21]), 2) is None


def test_scans_in_turns() -> None:
    first, second = alternate(observation(front=[0, 1, 2], rear=[0.5, 1.5]))

    assert (seconds(first, "front"), seconds(second, "front")) == ([0, 2], [1])
    assert (seconds(first, "rear"), seconds(second, "rear")) == ([0.5], [1.5])


def test_halves_of_a_drive_agree() -> None:
    recording = KeptDrive(scenario_of("arc"), 2)
    config = parse_config(config_of(recording, has_bag=False), "arc", Path())
    config = without_structure(config.model_copy(update={"registration": QUICK}))
    # By given poses: which sensors tell the motion is another subject.
    found = split_halves(Late(recording, {"poses": 0.0}), config, SilentProgress(), 0.01)

    assert not found.by_passes
    assert found.comparison is not None
    assert found.halves == ("every other scan", "the scans in between")
    assert not found.comparison.moved
    (pair,) = found.comparison.pairs
    assert all(pair.determined)
    assert 0.0 < pair.chi2 < 20.0
    # An arc leaves the turn about its centre open: that is no axis to compare.
    assert not found.comparison.lidars["front"].determined[2]

    # A file of the same drive agrees with both; one in which a LiDAR stands elsewhere with none.
    file = found.results[0]
    right = with_halves(VALIDATION, file, found).verdict
    assert (right.word, right.contradicts) == ("good", False)
    assert "agrees with that of this drive by every other scan (p " in right.sentences[-1]
    # It tells what level structure leaves open, but no more than that; nothing of it where yaw
    # stays open.
    assert _tells_what_level_ground_does_not(pair)
    open_yaw = tuple(axis != "yaw" for axis in AXES)
    assert not _tells_what_level_ground_does_not(replace(pair, determined=open_yaw))
    alone = found.comparison.lidars["front"]
    assert not _tells_what_level_ground_does_not(replace(alone, determined=(True,) * 6))
    for only_level, word in ((True, "good"), (False, "unclear")):
        before = replace(VALIDATION.verdict, word="unclear", only_level=only_level)
        assert with_halves(replace(VALIDATION, verdict=before), file, found).verdict.word == word
    front = file.lidars["front"]
    aside = front.T_vehicle_lidar.translation() + np.array([0.0, 0.1, 0.0])
    moved = gtsam.Pose3(front.T_vehicle_lidar.rotation(), aside)
    lidars = {**file.lidars, "front": replace(front, T_vehicle_lidar=moved)}
    wrong = with_halves(VALIDATION, replace(file, lidars=lidars), found).verdict
    assert (wrong.word, wrong.contradicts) == ("contradicted", True)
    said = re.search(
        r"S2S of 'front' to 'rear' is elsewhere, y \+(.+) mm at a sigma of (.+)\. A", wrong.reason
    )
    assert said
    off_mm, sigma_mm = map(float, said.groups())
    assert off_mm == pytest.approx(100.0, abs=3.0 * sigma_mm)
    assert sigma_mm < 25.0
    # A half that contradicts itself tests nothing.
    doubted = tuple(replace(r, contradictions=("it does",)) for r in found.results)
    assert with_halves(VALIDATION, file, replace(found, results=doubted)) is VALIDATION


VALIDATION = Validation(
    drive="drive",
    lidars=("front", "rear"),
    scans={},
    surfaces=(),
    things=(),
    pairs=(),
    thickness_m={},
    alone_m={},
    expected_thickness_m=0.0,
    expected_alone_m={},
    verdict=Verdict("good", 2.0, "distance", 1.0, 1.0, 1, 0.5, False, ("It is better.",)),
    clouds=cast(Clouds, None),
    best=(),
    warnings=(),
)
"""Nothing of it but the verdict matters here."""
