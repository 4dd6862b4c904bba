"""What the checks of a solution find, and what remains once the first suspect is named."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration import check as checks
from caliv_graph.calibration.check import _creeping, strains, unexplained
from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.vehicle_parameters import KEYS
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES, key_vehicle
from caliv_graph.geometry.chart import PoseChart
from caliv_graph.products import (
    Calibration,
    Iteration,
    LidarResult,
    Solution,
    Surface,
    Suspect,
    VehicleParameter,
)
from caliv_graph.trajectory.factors import Gaussian
from caliv_graph.trajectory.parameters import LEVER_ARM
from caliv_graph.uncertainty import consistency
from caliv_graph.uncertainty.consistency import (
    CloudCount,
    CoarseRegistrations,
    Contradiction,
    Creeping,
    GuessesTogether,
    Heading,
    Strain,
)

TURNED = Heading("drive", 0.04, 0.002, told_apart=True)


@pytest.mark.parametrize(
    ("first", "left"),
    [
        ("gnss.drift", ()),
        ("imu.yaw_bias", ()),
        ("lidars.front.initial", (TURNED,)),
        ("ground.vehicle_height", (TURNED,)),
    ],
)
def test_a_heading_is_no_finding_of_its_own_where_the_motion_is_wrong(
    first: str, left: tuple[Heading, ...]
) -> None:
    suspect = Suspect(first, (1.0,), (0.1,), (1.0,), ("m",), 0.9, 65.0, 65.0)
    assert unexplained([TURNED], [suspect]) == left


def test_strains_are_those_of_the_poses_of_each_drive() -> None:
    """Two poses of one drive, the second 3 sigmas off along each axis; one of another, 2 off."""
    sigma = np.array([1e-3] * 3 + [0.01] * 3)
    poses = [gtsam.Pose3.Expmap(np.full(6, 0.1 * i)) for i in range(3)]
    arm = np.array([0.1, 0.2, 0.3])
    graph, values = CalibrationGraph(), gtsam.Values()
    chart = PoseChart()
    keys = (key_vehicle(0), key_vehicle(1), KEYS[LEVER_ARM.name])
    H = np.diag(np.concatenate([sigma**-2.0, sigma**-2.0, np.full(3, 1e4)]))
    first = Gaussian(keys, (*poses[:2], arm), H, np.zeros(15), chart=chart)
    graph.append_gaussian("motion", first)
    prior = gtsam.PriorFactorVector(KEYS[LEVER_ARM.name], arm, gtsam.noiseModel.Unit.Create(3))
    graph.append("vehicle_parameter", prior)
    other = Gaussian((keys[0],), (poses[0],), 1e6 * np.eye(6), np.ones(6))
    graph.append_gaussian("structure", other)
    last = np.diag(sigma**-2.0)
    second = Gaussian((key_vehicle(2),), (poses[2],), last, np.zeros(6), chart=chart)
    graph.append_gaussian("motion", second)
    values.insert(key_vehicle(0), poses[0])
    values.insert(key_vehicle(1), poses[1].retract(3.0 * sigma))
    values.insert(key_vehicle(2), poses[2].retract(2.0 * sigma))
    values.insert(KEYS[LEVER_ARM.name], arm)
    solution = SimpleNamespace(
        graph=graph,
        values=values,
        factor_kinds=tuple(graph.kinds),
        T_map_vehicle={(0, 10): None, (0, 20): None, (1, 10): None},
    )
    morning, noon = strains(cast(Solution, solution), ["morning", "noon"])
    assert (morning.drive, morning.coordinates) == ("morning", 15)
    assert morning.chi_square == pytest.approx(54.0, rel=1e-3)
    assert (noon.drive, noon.coordinates) == ("noon", 6)
    assert noon.sigmas == pytest.approx(2.0, rel=1e-3)


def test_a_turn_of_all_poses_beside_a_shift_is_no_heave() -> None:
    """A rotation of the IMU that nobody knows, fixes that wander by a metre; heave of 3 mm."""
    sigma = np.array([0.1] * 3 + [1.0, 1.0, 3e-3])
    mean, key = gtsam.Pose3(), key_vehicle(0)
    graph, values = CalibrationGraph(), gtsam.Values()
    gaussian = Gaussian((key,), (mean,), np.diag(sigma**-2.0), np.zeros(6), chart=PoseChart())
    graph.append_gaussian("motion", gaussian)
    turned = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.05, 0.0, 0.0])), np.array([0.0, 1.0, 0.0]))
    values.insert(key, turned)
    solution = SimpleNamespace(
        graph=graph, values=values, factor_kinds=("motion",), T_map_vehicle={(0, 10): None}
    )
    (found,) = strains(cast(Solution, solution), ["drive"])
    assert found.chi_square == pytest.approx(1.25, rel=1e-6)
    assert 2.0 * gaussian.factor().error(values) > 50.0


@pytest.mark.parametrize(("sigmas", "said"), [(3.0, True), (8.0, False)])
def test_a_clock_that_another_mistake_makes_late_is_not_to_be_corrected(
    sigmas: float, said: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    suspect = Suspect("gnss.lever_arm", (0.3,), (0.02,), (0.3,), ("m",), 0.9, sigmas, sigmas)
    late = VehicleParameter(np.array([0.012]), np.array([0.0025]), (True,))
    calibration = replace(nothing_calibrated(), vehicle={"gnss_time_offset": late})
    _, warnings, _ = checked(calibration, monkeypatch, ranked_suspects=(suspect,))
    assert any("correct the clock" in warning for warning in warnings) == said


def test_a_doubt_about_all_guesses_stands_in_place_of_one_about_a_guess(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    guess = Suspect("lidars.roof.initial", (0.2,), (0.05,), (0.2,), ("m",), 0.9, 4.2, 4.2)
    _, (alone,), _ = checked(nothing_calibrated(), monkeypatch, ranked_suspects=(guess,))
    assert "lidars.roof.initial" in alone
    moved = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.2, 0.0]))
    frame = GuessesTogether(("roof", "left"), moved, 4.4, None, 0.0, True)
    together = {"ranked_suspects": (guess,), "perhaps_together": frame}
    _, (said,), _ = checked(nothing_calibrated(), monkeypatch, **together)
    assert "may all be off by the same (together 4.4 sigma)" in said
    assert "lidars.roof.initial" not in said
    # Beside a contradiction of a guess it would say the same twice.
    off = GuessesTogether(("roof", "left"), moved, 7.0, None, 0.0, True)
    monkeypatch.setattr(consistency, "contradictions", lambda _: [off])
    _, warnings, _ = checked(nothing_calibrated(), monkeypatch, perhaps_together=frame)
    assert warnings == ()


def test_the_lidars_that_contradictions_are_about_are_given_by_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not those whose name a sentence holds for another reason, such as that of the drive."""
    far = CloudCount("left", 20, 15, (9, 8), (11, 7), (10, 9), (10, 6), np.array([0.4, 0.0, 0.0]))
    lidars = dict.fromkeys(("roof", "left", "right"), unseen())
    calibration = replace(nothing_calibrated(), lidars=lidars)
    found: list[Contradiction] = [far, Strain("roof", 900.0, 100)]
    monkeypatch.setattr(consistency, "contradictions", lambda _: found)
    contradicted, _, concerned = checked(calibration, monkeypatch)
    assert "drive 'roof'" in contradicted.contradictions[1]
    assert concerned == ("left",)
    # The registrations of several LiDARs do not fit: any of them may be wrong.
    found[:] = [CoarseRegistrations(9.0, (0.01, 0.1), ("left", "right"), None)]
    _, _, concerned = checked(calibration, monkeypatch)
    assert concerned == ("left", "right")
    found[:] = [Creeping(240, 1e-3, 0.002, 1.4, ("left",))]
    _, _, concerned = checked(calibration, monkeypatch)
    assert concerned == ("left",)


@pytest.mark.parametrize("creeps", [False, True])
def test_a_loop_that_ended_on_its_way_is_a_contradiction_of_the_lidars_that_see_a_target(
    creeps: bool,
) -> None:
    seen = SimpleNamespace(observation=SimpleNamespace(clouds=[SimpleNamespace(lidar="left")]))
    solution = SimpleNamespace(
        creeps=creeps,
        course=(
            Iteration(1e-3, 0.01, 3.0, 0.0),
            *[Iteration(2e-4, 0.0017, 1.4, 0.0)] * 4,
            Iteration(1e-4, 1e-3, 0.3, 0.0, way_sigmas=4.2),
        ),
        registrations=(seen,),
        lidars=("roof", "left"),
    )
    found = _creeping(cast("Solution", solution))
    assert found == (Creeping(6, 2e-4, 0.0017, 1.4, ("left",), 4.2) if creeps else None)
    said = consistency.contradictions(consistency.CheckInputs(lidars={}, creeping=found))
    assert said == (() if found is None else (found,))


@pytest.mark.parametrize(
    ("scatter_m", "scattered"),
    [
        ({"left": 0.031, "right": 0.05}, True),
        ({"left": 0.031, "right": 0.044}, False),
        ({"left": 0.029, "right": 0.05}, False),
        ({}, False),
    ],
    ids=["a bush", "one LiDAR sees a surface", "noisier than told", "too few points"],
)
def test_clouds_that_show_no_surface_are_a_contradiction(
    scatter_m: dict[str, float], scattered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    surface = Surface(scatter_m, {"left": 0.008, "right": 0.015})
    seen = SimpleNamespace(observation=SimpleNamespace(name="bush"), surface=surface)
    unknown = SimpleNamespace(observation=SimpleNamespace(name="other"), surface=None)
    lidars = {"left": unseen(), "right": unseen(), "roof": unseen()}
    calibration = replace(nothing_calibrated(), lidars=lidars)
    result, _, concerned = checked(calibration, monkeypatch, registrations=(unknown, seen))
    assert concerned == ()
    assert result.status == ("inconsistent" if scattered else "ok")
    said = " ".join(result.contradictions)
    assert ("the clouds of bush show no surface" in said) == scattered
    assert ("'left' 31 mm with a noise of 8 mm" in said) == scattered


def nothing_calibrated() -> Calibration:
    nothing = np.zeros((0, 0))
    return Calibration("ok", "", {}, nothing, nothing, (), (), (), {})


def unseen() -> LidarResult:
    return LidarResult(gtsam.Pose3(), np.eye(6), dict.fromkeys(AXES, False), 0, saw_target=False)


def checked(
    calibration: Calibration,
    monkeypatch: pytest.MonkeyPatch,
    registrations: object = (),
    **of: object,
) -> tuple[Calibration, tuple[str, ...], tuple[str, ...]]:
    """A calibration that is checked; `of` is what the parts of the check find."""
    found = {
        "_between_parts": ((), ()),
        "ranked_suspects": (),
        "cloud_counts": (),
        "registration_sigma": None,
        "assumptions": (),
        "typical_speed": 1.0,
        "strains": (),
    }
    for name, value in (found | of).items():
        monkeypatch.setattr(checks, name, lambda *_, value=value: value)
    solution = cast(
        "Solution",
        SimpleNamespace(
            registration_scale=1.0, range_bias_m=0.0, creeps=False, registrations=registrations
        ),
    )
    config = cast("Config", None)  # of the suspects
    return checks.check(calibration, solution, [], [], {}, config)
