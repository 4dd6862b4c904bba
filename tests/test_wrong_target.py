"""What the search takes for the target is none: the drive is calibrated without one."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, SolveError, TargetError
from caliv_graph.pipeline import run as pipeline
from caliv_graph.pipeline.preparation import Prepared
from caliv_graph.pipeline.run import calibrate
from caliv_graph.products import Surface, TargetCloud, TargetObservation
from caliv_graph.uncertainty.consistency import CloudCount

LIDAR = {"topic": "/a", "initial": {"xyz": [0, 0, 1], "rpy_deg": [0, 0, 0]}}


def config_of(**more: object) -> Config:
    return Config.model_validate({"lidars": {"a": LIDAR}, **more})


@dataclass
class Solves:
    """Stands in for a run; the first one is inconsistent."""

    second: str | CalivError = "ok"
    structure: tuple[object, ...] = ("walls",)
    named: bool = False
    count: CloudCount = field(
        default_factory=lambda: CloudCount(
            "a", 16, 16, (8, 8), (8, 8), (8, 8), (8, 8), np.array([-0.94, 2.38, 0.26])
        )
    )
    surface: Surface | None = None
    beside: CloudCount | None = None
    walls: frozenset[str] = frozenset({"a", "b"})
    scale: float = 1.0
    contradictions: tuple[str, ...] = ("clouds",)
    suspects: tuple[float, ...] = (0.2,)
    left_out: list[list[str]] = field(default_factory=list)
    refused: list[TargetError | None] = field(default_factory=list)

    def __call__(self, *arguments: Any) -> Any:
        self.refused.append(arguments[5] if len(arguments) > 5 else None)
        self.left_out.append([of.lidar for of in arguments[6]] if len(arguments) > 6 else [])
        first = self.refused[-1] is None and not self.left_out[-1]
        if not first and isinstance(self.second, CalivError):
            raise self.second
        seen = SimpleNamespace(
            observation=SimpleNamespace(name="found at (1, 2) m"), surface=self.surface
        )
        run = SimpleNamespace(
            calibration=SimpleNamespace(
                status="inconsistent" if first else self.second,
                contradictions=self.contradictions,
                suspects=tuple(SimpleNamespace(sigmas=s) for s in self.suspects),
            ),
            solution=SimpleNamespace(
                structure=self.structure, registrations=(seen,), registration_scale=self.scale
            ),
            record=SimpleNamespace(trajectories=()),
        )
        return run, self.named

    def status(self, config: Config) -> str:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pipeline, "_calibrated", self)
            patch.setattr(pipeline, "motions_of", lambda *_: ({}, config, ()))
            counts = (self.count,) if self.beside is None else (self.count, self.beside)
            patch.setattr(pipeline, "cloud_counts", lambda *_: counts)
            patch.setattr(pipeline, "lidars_with_structure", lambda _: self.walls)
            return calibrate([], config, SilentProgress()).calibration.status


def test_clouds_on_another_object_are_no_end_of_a_calibration_by_walls() -> None:
    solves = Solves()
    assert solves.status(config_of()) == "ok"
    first, second = solves.refused
    assert first is None
    assert "found for a target is none: lidar 'a': 16 of its 16 target clouds" in str(second)
    assert "median offset 2.57 m" in str(second)


def test_a_bush_is_no_end_of_a_calibration_by_walls() -> None:
    bush = Surface({"a": 0.05}, {"a": 0.015})
    solves = Solves(count=counted(0, 0.0), surface=bush)
    assert solves.status(config_of()) == "ok"
    assert "is none: the clouds of found at (1, 2) m show no surface" in str(solves.refused[1])


def test_a_walker_whose_clouds_do_not_fit_each_other_is_none_either() -> None:
    solves = Solves(count=counted(0, 0.0), scale=6.2)
    assert solves.status(config_of()) == "ok"
    assert "is none: its clouds fit only with registration errors 6 times" in str(solves.refused[1])


@pytest.mark.parametrize("second", ["inconsistent", SolveError("nothing to solve")])
def test_what_contradicts_walls_too_is_said_as_before(second: str | CalivError) -> None:
    solves = Solves(second)
    assert solves.status(config_of()) == "inconsistent"
    assert len(solves.refused) == 2


def counted(outliers: int, offset_m: float) -> CloudCount:
    return CloudCount("a", 16, outliers, (8, 4), (8, 4), (8, 4), (8, 4), np.array([offset_m, 0, 0]))


@pytest.mark.parametrize(
    ("solves", "config"),
    [
        (Solves(), config_of(target=[{"min": [0, 0, 0], "max": [1, 1, 1]}])),
        (Solves(structure=()), config_of()),
        (Solves(named=True), config_of()),
        (Solves(count=counted(16, 0.1)), config_of()),
        (Solves(count=counted(6, 2.0)), config_of()),
        (Solves(count=counted(0, 0.0), scale=4.9), config_of()),
        (Solves(count=counted(0, 0.0), scale=6.2, suspects=(8.0, 1.0)), config_of()),
        (Solves(count=counted(0, 0.0), scale=6.2, contradictions=("clouds", "walls")), config_of()),
    ],
    ids=[
        "a region is given",
        "no walls",
        "a mistake is named",
        "the same object",
        "a few clouds",
        "clouds fit",
        "a clock explains it",
        "walls contradict, too",
    ],
)
def test_else_a_contradiction_is_one(solves: Solves, config: Config) -> None:
    assert solves.status(config) == "inconsistent"
    assert solves.refused == [None]


GIVEN = config_of(target=[{"min": [0, 0, 0], "max": [1, 1, 1]}])


def other(outliers: int) -> CloudCount:
    return CloudCount("b", 20, outliers, (8, 0), (8, 0), (8, 0), (8, 0), np.zeros(3))


@pytest.mark.parametrize("named", [False, True])
def test_a_lidar_whose_clouds_all_lie_elsewhere_is_calibrated_by_walls(named: bool) -> None:
    """And what was taken for a mistake of it (left-handed clouds) is none then."""
    solves = Solves(named=named, beside=other(0))
    assert solves.status(GIVEN) == "ok"
    assert solves.left_out == [[], ["a"]]
    assert solves.refused == [None, None]


@pytest.mark.parametrize(
    "solves",
    [
        Solves("inconsistent", beside=other(0)),
        Solves(beside=other(20)),
        Solves(beside=other(0), walls=frozenset({"b"})),
        Solves(beside=other(0), count=counted(15, 2.0)),
        Solves(SolveError("nothing to solve"), beside=other(0)),
    ],
    ids=["walls contradict it, too", "of all", "no walls", "a cloud fits", "no solution"],
)
def test_else_its_clouds_contradict_the_others(solves: Solves) -> None:
    assert solves.status(GIVEN) == "inconsistent"
    assert solves.left_out[0] == []


def test_a_target_of_which_one_cloud_is_left_is_none() -> None:
    def seen(*lidars: str) -> TargetObservation:
        clouds = tuple(TargetCloud(of, 0, i, np.zeros((9, 3)), "") for i, of in enumerate(lidars))
        return TargetObservation(0, "target", np.zeros(3), clouds)

    prepared = Prepared((), (seen("a", "b", "b"), seen("a", "a", "b")), (), (), (), GIVEN)
    (left,) = prepared.without_clouds({"a"}).observations
    assert [cloud.lidar for cloud in left.clouds] == ["b", "b"]
