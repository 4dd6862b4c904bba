"""Drives with structure: beside a target, without one, and LiDARs that see nothing else."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.assemble import DRIVES, MARKS
from caliv_graph.calibration.structure_evidence import KEPT_POSES
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import (
    GroundConfig,
    SolveConfig,
    StructureConfig,
    TargetRegion,
)
from caliv_graph.errors import TargetError
from caliv_graph.fusion.compare import compare
from caliv_graph.fusion.merge import merge
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.mounting.doubts import Doubt
from caliv_graph.pipeline import calibrate, look, with_prior
from caliv_graph.products import Calibration, MotionData, MountSlip, Recording
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.report.folder import write_result
from caliv_graph.report.tables import calibration_table
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.run import CalibrationRun
from caliv_graph.uncertainty.pairs import pair_determined, sigmas_s2s
from caliv_graph.workflows.repeatability import split_halves
from caliv_graph.workflows.survey import survey
from tests.drives_with_chair import ARC, QUICK, ChairDrive, paper_lidar, paper_scenario, simulated
from tests.fake_structure import SIGMAS, Structure, patches_of

NO_PROGRESS = SilentProgress()


@cache
def arc() -> ChairDrive:
    """The paper's arc, and a LiDAR that looks to the other side."""
    with TemporaryDirectory() as folder:
        scenario = paper_scenario(
            ARC,
            rate_hz=1.25,
            position_sigma_m=2e-3,
            rotation_sigma_rad=2e-4,
            others={"right": paper_lidar(0.5, -90.0, y_m=-0.8, rate_hz=1.25)},
        )
        return simulated(scenario, 1, Path(folder)).asked(
            registration=QUICK, ground=GroundConfig(use=True), structure=StructureConfig()
        )


@pytest.fixture
def walls(monkeypatch: pytest.MonkeyPatch) -> Structure:
    """All LiDARs know where they are."""
    return structure(monkeypatch, Structure(arc().truth))


def structure(monkeypatch: pytest.MonkeyPatch, terms: Structure) -> Structure:
    monkeypatch.setattr("caliv_graph.pipeline.preparation.read_patches", patches_of)
    monkeypatch.setattr("caliv_graph.pipeline.run.structure_terms", terms)
    return terms


def run_on(drive: ChairDrive) -> CalibrationRun:
    return calibrate([drive.recording], drive.config, NO_PROGRESS)


def sparser() -> ChairDrive:
    """Every third cloud, where none shows a target: how a run ends does not depend on them."""
    drive = arc()
    clouds = {name: scans[::3] for name, scans in drive.recording.clouds.items()}
    return replace(drive, recording=replace(drive.recording, clouds=clouds))


@cache
def by_target() -> Calibration:
    return run_on(arc().asked(structure=StructureConfig(use=False))).calibration


@cache
def by_target_and_walls() -> CalibrationRun:
    """By the target, and structure that knows how all LiDARs lie to each other."""
    with pytest.MonkeyPatch.context() as patch:
        structure(patch, Structure(arc().truth, pairs=True))
        return run_on(arc())


@cache
def by_walls() -> tuple[CalibrationRun, Structure]:
    """By structure that knows where all LiDARs are, without a target."""
    with pytest.MonkeyPatch.context() as patch:
        walls = structure(patch, Structure(arc().truth))
        return run_on(arc().asked(target=False)), walls


def errors_of(calibration: Calibration, truth: dict[str, gtsam.Pose3]) -> dict[str, np.ndarray]:
    return {
        name: vehicle_axes_difference(lidar.T_vehicle_lidar, truth[name])
        for name, lidar in calibration.lidars.items()
    }


def test_without_a_target_structure_calibrates_alone(tmp_path: Path) -> None:
    drive = arc().asked(target=False)

    run, walls = by_walls()

    result = run.calibration
    assert walls.called == 1
    assert (result.status, result.unmet, result.contradictions) == ("ok", (), ())
    for name, error in errors_of(result, dict(arc().truth)).items():
        assert (np.abs(error) < 5.0 * SIGMAS).all(), name
    for lidar in result.lidars.values():
        assert (lidar.saw_target, lidar.has_data, lidar.scans_used) == (False, True, 0)
        assert all(lidar.determined.values())
    assert run.solution.registrations == ()
    assert run.solution.converged
    assert "a hedge was left out" in run.calibration.warnings
    assert not any("target" in line for line in run.calibration.warnings)
    # The ground takes part, at the poses that were kept.
    assert run.record is not None
    assert {g.lidar for g in run.record.grounds} == set(drive.config.lidars)
    assert run.solution.factor_kinds.count("structure") == 1
    assert run.solution.factor_kinds.count("ground_plane") > 20
    check_files(run, drive, tmp_path)


def test_a_mount_that_slips_is_said_and_clocks_that_it_makes_seem_apart_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slip = MountSlip(("rear",), (), 12.0, 25.0, np.array([0.0, 0.0, 0.0175, 0.0, 0.0, 0.0]), 9.0)
    drive = arc().asked(target=False)
    found = {}
    for sigmas in (9.0, 4.5):
        walls = Structure(arc().truth, slip=replace(slip, sigmas=sigmas), apart_s=0.004)
        structure(monkeypatch, walls)
        found[sigmas] = run_on(drive).calibration

    (said,) = found[9.0].contradictions
    assert found[9.0].status == "inconsistent"
    assert "the mount of lidar 'rear' slips about 12 s after the first scan" in said
    assert not any("the stamps of" in line for line in found[9.0].warnings)
    assert found[4.5].contradictions == ()
    assert any("the mount of lidar 'rear' may slip" in line for line in found[4.5].warnings)
    assert any("the stamps of" in line for line in found[4.5].warnings)


def check_files(run: CalibrationRun, drive: ChairDrive, folder: Path) -> None:
    """Everything that is written and read without a target."""
    result = run.calibration
    write_result(folder, result, run.solution, drive.config, [], result.warnings, run.record)
    again = read_calibration(folder / "calibration.yaml")
    assert again.structure == result.structure
    assert again.structure is not None
    assert (again.structure.strips, again.structure.surfaces) == (3, 2)
    assert again.structure.shared["front", "rear"] == 1
    assert [lidar.has_data for lidar in again.lidars.values()] == [True] * 3
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    (said,) = [line for line in lines if "structure" in line]
    assert (said["strips"], said["dropped"], said["surfaces"]) == (4, 1, 3)
    # Of the thickness before, one strip knows nothing.
    assert (said["scatter_m"], said["before_m"]) == (0.004, 0.02)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "all six axes" in page
    assert "no target seen" not in page
    assert not list(folder.glob("target*.ply"))
    calibration_table(result)


def test_its_result_is_compared_merged_and_a_prior() -> None:
    alone = by_walls()[0].calibration
    # As of another drive of the vehicle.
    alone = replace(alone, provenance={**alone.provenance, DRIVES: ["another"], MARKS: [[]]})
    other = by_target()

    assert not compare(alone, other, ("walls", "chair")).moved
    both = merge({"walls": alone, "chair": other}).calibration
    assert all(all(lidar.determined.values()) for lidar in both.lidars.values())
    assert all(lidar.has_data for lidar in both.lidars.values())
    assert both.structure is None

    # The target's run does not determine x on an arc; structure did.
    after, warnings = with_prior(other, alone, arc().config)
    assert warnings == ()
    assert not all(other.lidars["front"].determined.values())
    assert all(after.lidars["front"].determined.values())


def test_how_lidars_lie_to_each_other_needs_no_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    structure(monkeypatch, Structure(arc().truth, pairs=True))
    drive = arc().asked(target=False, ground=GroundConfig(use=False))

    for mode in ("auto", "joint"):
        result = run_on(drive.asked(solve=SolveConfig(mode=mode))).calibration

        assert result.unmet == ()  # `require: [s2s]`
        assert not any(result.lidars["front"].determined.values())
        assert all(pair_determined(result, "front", "rear").values())
        assert result.status == "partial"


def test_where_none_is_found_a_warning_says_so(
    walls: Structure, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise TargetError("drive: no object stands still", "Give a region")

    monkeypatch.setattr("caliv_graph.pipeline.preparation.find_target", fail)
    drive = sparser().asked(target=None)

    run = run_on(drive)

    said = run.calibration.warnings
    assert any("without a target" in w and "no object stands still" in w for w in said)
    assert run.calibration.status == "ok"

    # Structure that tells nothing: the error names both.
    monkeypatch.setattr("caliv_graph.pipeline.run.structure_terms", lambda *_: ())
    with pytest.raises(
        TargetError, match=r"no object stands still.*neither a target nor structure"
    ):
        run_on(drive)
    # A mistake of the config that leaves nothing to see has its own remedy.
    lidars = dict(drive.config.lidars)
    lidars["front"] = lidars["front"].model_copy(update={"min_range": 30.0})
    with pytest.raises(TargetError, match=r"of lidars 'front' 30 to 500 m is used \(min_range"):
        run_on(drive.asked(lidars=lidars))
    for change in (
        {"structure": StructureConfig(use=False)},
        {"solve": SolveConfig(mode="staged")},
    ):
        with pytest.raises(TargetError, match="no object stands still"):
            run_on(drive.asked(**change))
    # A region that the user gave has a target, or is wrong.
    empty = TargetRegion(min=(90.0, 90.0, 0.0), max=(91.0, 91.0, 2.0))
    with pytest.raises(TargetError):
        run_on(sparser().asked(target=(empty,)))


def test_a_lidar_that_only_sees_structure_is_calibrated_by_it() -> None:
    without = by_target()
    assert not without.lidars["right"].has_data
    assert without.unmet

    run = by_target_and_walls()

    right = run.calibration.lidars["right"]
    assert (right.saw_target, right.has_data) == (False, True)
    assert run.calibration.unmet == ()
    assert all(pair_determined(run.calibration, "right", "rear").values())
    assert all(right.determined[axis] for axis in ("roll", "pitch", "y"))
    truth = arc().truth
    T = run.calibration.lidars["rear"].T_vehicle_lidar.between(right.T_vehicle_lidar)
    off = vehicle_axes_difference(T, truth["rear"].between(truth["right"]))
    assert (np.abs(off) < 6.0 * np.array([3e-4] * 3 + [3e-3] * 3)).all()


def test_a_drive_without_a_target_counts_beside_one_that_has_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its structure and its ground, at poses that are kept for them."""
    alone = by_target_and_walls().calibration
    structure(monkeypatch, Structure(arc().truth, pairs=True))

    class Elsewhere(ForwardingRecording):
        """The same drive at another place of the map, far from the target's region."""

        @property
        def name(self) -> str:
            return "elsewhere"

        def motion(self) -> MotionData:
            motion = super().motion()
            assert motion.poses is not None
            away = gtsam.Pose3(gtsam.Rot3(), np.array([300.0, 0.0, 0.0]))
            moved = tuple(map(away.compose, motion.poses.T_map_vehicle))
            return replace(motion, poses=replace(motion.poses, T_map_vehicle=moved))

    drives: list[Recording] = [arc().recording, Elsewhere(arc().recording)]

    run = calibrate(drives, arc().config, NO_PROGRESS)

    assert run.solution.factor_kinds.count("structure") == 2
    kept = [stamp for drive, stamp in run.solution.T_map_vehicle if drive == 1]
    assert 10 < len(kept) <= KEPT_POSES
    assert run.record is not None
    assert {g.stamp_ns for g in run.record.grounds if g.drive == 1} <= set(kept)
    assert any(g.drive == 1 for g in run.record.grounds)
    both = run.calibration
    for name in ("front", "rear", "right"):
        sigmas = [np.sqrt(np.diag(c.lidars[name].cov)) for c in (both, alone)]
        assert (sigmas[0] < 0.95 * sigmas[1]).any(), name
    # What `Structure` says of a LiDAR against the first, which nothing else sees, is said twice.
    x, y, yaw = 3, 4, 2
    twice, once = (sigmas_s2s(c, "right", "front")[[yaw, x, y]] for c in (both, alone))
    assert (twice < 0.85 * once).all(), twice / once
    assert survey(drives, arc().config, NO_PROGRESS).unmet == ()


def test_other_commands_do_without_a_target(walls: Structure) -> None:
    drive = arc().asked(target=False)

    found = survey([drive.recording], drive.config, NO_PROGRESS)

    assert found.unmet == ()
    assert found.scans == {}
    assert all(found.covariance.sigma_s2v["front"] < 2.0 * SIGMAS)
    beside = survey([arc().recording], arc().config, NO_PROGRESS)
    assert beside.covariance.calibration.lidars["right"].has_data
    seen = look(drive.recording, drive.config, NO_PROGRESS)
    assert (seen.observations, seen.problems) == ((), ())
    halves = split_halves(drive.recording, drive.config, NO_PROGRESS, 1e-3)
    assert halves.comparison is None
    assert "target" in halves.reason


def test_where_structure_tells_nothing_a_mistake_of_the_guesses_is_the_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = Doubt(0, "drive", "left_handed", ("front",), 0, {"front": (1.1, 4.0)}, given=False)
    monkeypatch.setattr("caliv_graph.pipeline.run.mistakes", lambda *_, **__: (found,))
    monkeypatch.setattr("caliv_graph.pipeline.run.structure_terms", lambda *_: ())
    with pytest.raises(TargetError, match=r"neither a target nor structure.*left-handed"):
        run_on(arc().asked(target=False))
