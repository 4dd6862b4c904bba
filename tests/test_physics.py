"""Findings of the raw data: the cause of an error, and contradictions of a calibration."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Literal, cast

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import TargetError, TrajectoryError
from caliv_graph.physics import (
    clock_findings,
    contradicted,
    contradictions_of,
    raise_fatal,
    ranked_with,
    slip_findings,
    smoothed_findings,
    warnings_of,
    with_cause,
    without_effects,
)
from caliv_graph.products import (
    Finding,
    MotionData,
    MountSlip,
    Recording,
    StructureTerm,
    Suspect,
    Trajectory,
    VehicleParameter,
)
from caliv_graph.targets.ground.guesses import LidarGround
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.wording.offsets import late_clock_sentences
from tests.samples import make_calibration


def finding(
    sigmas: float, severity: Literal["fatal", "contradiction", "warning"] = "contradiction"
) -> Finding:
    key = "imu.T_vehicle_imu" if sigmas > 10.0 else "ground.vehicle_height"
    return Finding(key, (), 0.1, sigmas, severity, f"it is off by {sigmas:.0f} sigma")


def test_the_most_significant_finding_takes_the_place_of_a_wrong_remedy() -> None:
    error = TargetError("target: none found", "Add target: ...")
    assert str(error) == "target: none found. Add target: ..."

    blamed = with_cause(error, [finding(6.0), finding(20.0), finding(4.0, "warning")])

    assert isinstance(blamed, TargetError)
    assert str(blamed) == (
        "target: none found. Most likely because of imu.T_vehicle_imu: it is off by 20 sigma"
    )
    assert with_cause(error, []) is error
    assert str(with_cause(TrajectoryError("no"), [finding(6.0)])).startswith("no. Most likely")


def test_only_fatal_findings_stop() -> None:
    raise_fatal([finding(20.0), finding(4.0, "warning")])
    with pytest.raises(TrajectoryError, match="off by 12 sigma"):
        raise_fatal([finding(20.0), finding(7.0, "fatal"), finding(12.0, "fatal")])


def test_contradictions_make_a_calibration_inconsistent_and_warnings_do_not() -> None:
    calibration = make_calibration("front", "rear")
    assert (
        contradicted(calibration, (), contradictions_of([finding(4.0, "warning")])) is calibration
    )

    found = contradicted(
        calibration, (), contradictions_of([finding(6.0), finding(4.0, "warning")])
    )

    assert found.status == "inconsistent"
    assert found.contradictions == (*calibration.contradictions, "it is off by 6 sigma")
    assert warnings_of([finding(6.0), finding(4.0, "warning")]) == ("it is off by 4 sigma",)


def suspect(name: str, sigmas: float) -> Suspect:
    return Suspect(name, (0.1,), (0.05,), (0.1,), ("m",), 0.5, sigmas, 0.3)


def test_an_input_that_a_finding_contradicts_leads_where_no_score_does() -> None:
    height, guess = suspect("ground.vehicle_height", 2.0), suspect("lidars.rear.initial", 2.5)
    doubtful = replace(make_calibration("front", "rear"), suspects=(guess, height))
    found = ranked_with(doubtful, [finding(6.0), finding(5.5)]).suspects
    # The same data: 6 sigma, not 2 and 6 together.
    assert found == (replace(height, sigmas=6.0, sigmas_left=6.0), guess)
    blamed = Finding("lidars.rear.initial.xyz", (2.0,), 0.1, 7.0, "contradiction", "")
    assert [s.sigmas for s in ranked_with(doubtful, [blamed]).suspects] == [7.0, 2.0]
    assert ranked_with(doubtful, [finding(4.0, "warning")]).suspects == (guess, height)
    culprit = replace(doubtful, suspects=(suspect("gnss.lever_arm", 20.0), height))
    assert ranked_with(culprit, [finding(6.0)]) is culprit


def test_a_clock_of_the_fixes_that_is_far_off_has_the_value_of_the_solve() -> None:
    # The smoother begins at 0.48 s, from where the graph has the rest.
    rest, height = suspect("gnss.time_offset", 0.9), suspect("ground.vehicle_height", 2.0)
    vehicle = {"gnss_time_offset": VehicleParameter(np.array([0.4994]), np.array([9e-4]), (True,))}
    calm = replace(make_calibration(), suspects=(height, rest), vehicle=vehicle)
    found = Finding("topics.gnss", (0.48,), 0.012, 40.0, "contradiction", "late")

    first, second = ranked_with(calm, [found]).suspects

    assert (first.input, first.sigmas, second) == ("gnss.time_offset", 40.0, height)
    assert (first.value, first.change, first.sigma) == ((0.4994,), (0.4994,), (9e-4,))
    (exact, _) = ranked_with(replace(calm, vehicle={}), [found]).suspects
    assert (exact.value, exact.sigma) == ((0.48,), (0.012,))


def term(**clocks: tuple[float, float]) -> StructureTerm:
    nothing = np.zeros(0)
    return StructureTerm(
        0, np.zeros(0, np.int64), (), {}, {}, {}, nothing, nothing, (), 0.0, clocks=clocks
    )


def test_where_clocks_of_lidars_are_wrong_that_of_the_poses_is_not_to_be_corrected() -> None:
    between = VehicleParameter(np.array([-0.027]), np.array([0.0024]), (True,))
    calibration = replace(make_calibration(), vehicle={"pose_time_offset": between})
    doubts = ("another doubt", *late_clock_sentences(calibration.vehicle))
    assert len(doubts) == 2
    assert without_effects(doubts, [finding(50.0)], calibration) == ("another doubt",)
    assert without_effects(doubts, [finding(9.0, "warning")], calibration) == doubts
    assert without_effects(doubts, [], calibration) == doubts


def test_a_clock_that_walls_contradict_leads_where_the_ranking_has_no_culprit() -> None:
    clock, height = suspect("lidars.front.time_offset", 1.4), suspect("ground.vehicle_height", 2.0)
    calm = replace(make_calibration(), suspects=(height, clock))

    (found,) = clock_findings(["drive"], [term(front=(0.0191, 0.0009), rear=(0.006, 0.01))], calm)

    assert (found.input, found.severity) == ("lidars.front.time_offset", "contradiction")
    # With the allowance of 2 ms: 19.1 / sqrt(0.9^2 + 2^2).
    assert found.sigmas == pytest.approx(8.71, abs=0.01)
    assert "drive: lidars.front.time_offset: by the surfaces around, the stamps are" in (
        found.sentence
    )
    assert "0.019 +- 0.002 s late (9 sigma). Correct the clock of lidar 'front'" in found.sentence
    first, _ = ranked_with(calm, [found]).suspects
    assert (first.input, first.value, first.change) == (clock.input, (0.0191,), (0.0191,))
    assert (first.sigmas, first.sigma) == (found.sigmas, (found.sigma,))
    # An IMU that is late explains both clocks, one LiDAR that is late its own alone.
    early = (-0.02, 0.0)
    imu = {"imu_time_offset": VehicleParameter(np.array([0.02]), np.array([1e-3]), (True,))}
    late = replace(calm, vehicle=imu)
    assert clock_findings(["drive"], [term(front=early, rear=early)], late) == ()
    (alone,) = clock_findings(["drive"], [term(front=early, rear=(0.0, 0.0))], late)
    assert alone.input == "lidars.front.time_offset"
    # Against given poses, whose clock the graph estimates, all being late says nothing of LiDARs.
    poses = {"pose_time_offset": VehicleParameter(np.zeros(1), np.full(1, 1e-4), (True,))}
    given = replace(calm, vehicle=poses)
    assert clock_findings(["drive"], [term(front=(0.053, 0.008), rear=(0.053, 0.008))], given) == ()
    unequal = term(front=(0.053, 0.008), rear=(0.053, 0.008), left=(0.053, 0.015))
    assert clock_findings(["drive"], [unequal], given) == ()
    # One of them is; the clock of the poses may have been put in between.
    between = VehicleParameter(np.full(1, -0.027), np.full(1, 2e-3), (True,))
    for of_poses in (poses["pose_time_offset"], between):
        late = replace(calm, vehicle={"pose_time_offset": of_poses})
        one = term(front=(0.0, 0.004), rear=(0.053, 0.004))
        (alone,) = clock_findings(["drive"], [one], late)
        assert (alone.input, alone.value) == ("lidars.rear.time_offset", (0.053,))
    # 4.5 sigma are a warning, 3.9 are nothing.
    (doubt,) = clock_findings(["drive"], [term(front=(-0.009, 0.0))], calm)
    assert doubt.severity == "warning"
    assert "0.002 s early" in doubt.sentence
    assert clock_findings(["drive"], [term(front=(0.0078, 0.0))], calm) == ()
    # Another culprit bends the walls.
    culprit = replace(calm, suspects=(suspect("gnss.drift", 8.0), clock))
    assert clock_findings(["drive"], [term(front=(0.02, 0.001))], culprit) == ()


SLIP = MountSlip(("front",), (), 13.2, 25.0, np.array([0.0, 0.0, 0.0174, 0.003, 0.0, 0.0]), 16.4)


def test_a_mount_that_slips_is_a_contradiction_if_nothing_else_is_wrong() -> None:
    calm = replace(make_calibration(), suspects=(suspect("ground.vehicle_height", 2.0),))
    slips = [replace(term(), slip=replace(SLIP, sigmas=s)) for s in (16.4, 4.5, 3.9)]

    found = slip_findings(["one"], [*slips, term()], calm)

    assert [f.severity for f in found] == ["contradiction", "warning"]
    # What a target says of the mount is of other data: it keeps its own value and sigmas.
    of_target = replace(calm, suspects=(suspect("lidars.front.mount.halves", 0.9),))
    assert ranked_with(of_target, found) == of_target
    culprit = replace(calm, suspects=(suspect("gnss.lever_arm", 8.0),))
    assert slip_findings(["one"], slips, culprit) == ()


def test_a_mount_that_slips_says_nothing_against_clocks_in_other_drives() -> None:
    calm = replace(make_calibration(), suspects=(suspect("ground.vehicle_height", 2.0),))
    late = term(front=(0.02, 0.001))
    slips, steady = replace(late, slip=SLIP), replace(late, drive=1)

    found = clock_findings(["one", "two"], [slips, steady], calm)

    assert len(found) == 1
    assert "two" in found[0].sentence
    doubted = replace(late, slip=replace(SLIP, sigmas=4.5))
    assert len(clock_findings(["one"], [doubted], calm)) == 1


def apart(**told: float) -> StructureTerm:
    """Clocks that are so many milliseconds later than that of 'front', to 0.2."""
    pairs = {("front", name): (1e-3 * ms, 2e-4) for name, ms in told.items()}
    return replace(term(**dict.fromkeys(("front", *told), (0.0, 1e-3))), clocks_apart=pairs)


def test_clocks_of_lidars_are_compared_with_each_other() -> None:
    calm = make_calibration()

    (found,) = clock_findings(["drive"], [apart(rear=-1.5)], calm)

    # Jitter of the stamps may take it up: S2S may be right.
    assert (found.input, found.severity) == ("lidars.rear.time_offset", "warning")
    # With the allowance of 0.1 ms: 1.5 / sqrt(0.2^2 + 0.1^2).
    assert found.sigmas == pytest.approx(6.71, abs=0.01)
    assert "drive: lidars 'front' and 'rear': by the surfaces around" in found.sentence
    assert "'rear' are 1.50 +- 0.22 ms earlier than those of 'front' (7 sigma)" in found.sentence
    assert "whose mount moved during the drive may look like this" in found.sentence
    (later,) = clock_findings(["drive"], [apart(rear=1.0)], calm)
    assert "ms later than" in later.sentence
    assert clock_findings(["drive"], [apart(rear=0.8)], calm) == ()
    # Jitter takes up milliseconds, not 5.2 ms: five sigmas with the allowance of 1 ms.
    severities = [
        clock_findings(["drive"], [apart(rear=ms)], calm)[0].severity for ms in (5.0, 5.2, -9.0)
    ]
    assert severities == ["warning", "contradiction", "contradiction"]
    # One clock that is off is off against all others: one sentence says so.
    (worst,) = clock_findings(["drive"], [apart(rear=1.5, left=2.0)], calm)
    assert worst.input == "lidars.left.time_offset"
    # One that the motion data contradict, too, is named by itself.
    both = replace(apart(rear=20.0), clocks={"front": (0.0, 1e-3), "rear": (0.02, 1e-3)})
    (alone,) = clock_findings(["drive"], [both], calm)
    assert "and 'rear'" not in alone.sentence


@pytest.mark.parametrize(
    ("rpy_deg", "asked"), [((-90.0, 0.0, -90.0), []), ((0.0, 0.0, 0.0), ["drive"])]
)
def test_a_vehicle_on_its_side_has_no_height(
    rpy_deg: tuple[float, float, float], asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses of a camera seemed to ask for a vehicle_height of 31 m."""
    seen: list[str] = []

    def grounds(recording: Recording, *_: object) -> tuple[LidarGround, ...]:
        seen.append(recording.name)
        return ()

    monkeypatch.setattr("caliv_graph.physics.lidar_grounds", grounds)
    t = np.arange(0.0, 30.0, 0.1)
    R = gtsam.Rot3.RzRyRx(*np.radians(rpy_deg).tolist())
    poses = [gtsam.Pose3(gtsam.Rot3.Rz(0.2 * s).compose(R), [2.0 * s, 0.0, 0.0]) for s in t]
    trajectory = GivenTrajectory(Trajectory((1e9 * t).astype(np.int64), tuple(poses)))
    recording = cast("Recording", SimpleNamespace(name="drive"))
    config = Config.model_validate({"lidars": {"a": {"topic": "/a"}}})

    found = smoothed_findings(
        [recording], [trajectory], {0: MotionData("drive")}, config, SilentProgress()
    )

    assert seen == asked
    assert ("roll -90" in "".join(each.sentence for each in found)) == (not asked)
