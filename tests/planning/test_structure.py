"""Walls in a plan: the table of null directions, what hides what, and who sees what."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caliv_graph.config.model import ExtractionConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import ConfigError
from caliv_graph.planning import Assumptions, Prediction, predict
from caliv_graph.planning.assumptions import Ground
from caliv_graph.planning.faces import faces_of
from caliv_graph.planning.patches import planned_patches
from caliv_graph.planning.predict import SeenDrive
from caliv_graph.planning.suggest import Planned, suggest
from caliv_graph.products import Array
from caliv_graph.report.predicted import plan_document, plan_table
from caliv_graph.scenario.drive_models import (
    ArcDrive,
    DriveModel,
    FigureEightDrive,
    SCurveDrive,
    StraightDrive,
)
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.scenario.sensor_models import LidarModel, PoseNoiseModel
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.scenario.world_models import (
    BoxModel,
    CarModel,
    ChairModel,
    ObjectModel,
    WallModel,
    WorldModel,
)
from caliv_graph.structure.term import lidars_with_ground
from caliv_graph.uncertainty.observability import UNIT
from tests.drives_with_chair import RADIUS_M, paper_lidar
from tests.samples import turn_about, twist_of_all
from tests.scan_rates import scanned_at

SCENARIOS = Path(__file__).resolve().parents[2] / "configs" / "scenarios"


def wall(x_m: float, y_m: float, yaw_deg: float, length_m: float = 10.0) -> WallModel:
    return WallModel(xy_m=(x_m, y_m), yaw_deg=yaw_deg, length_m=length_m)


def coarse(x_m: float, yaw_deg: float) -> LidarModel:
    return paper_lidar(x_m, yaw_deg).model_copy(
        update={"channels": 40, "horizontal_resolution_deg": 1.0}
    )


AHEAD = {"front": coarse(2.0, 0.0), "rear": coarse(-0.4, 180.0)}
ASIDE = {"front": coarse(2.0, 52.0), "rear": coarse(-0.4, -52.0)}
"""To the left and to the right: ahead, both see the same ground, and no wall."""


def drive_past(
    drive: DriveModel,
    objects: Mapping[str, ObjectModel],
    lidars: Mapping[str, LidarModel] = AHEAD,
    rate_hz: float = 2.0,
) -> Scenario:
    """With poses that are the truth."""
    return Scenario(
        name="walls",
        drive=drive,
        lidars={n: m.model_copy(update={"rate_hz": rate_hz}) for n, m in lidars.items()},
        world=WorldModel(objects=dict(objects)),
        poses=PoseNoiseModel(position_sigma_m=0.0, rotation_sigma_rad=0.0),
    )


def numbered(*walls: ObjectModel) -> dict[str, ObjectModel]:
    return {f"wall_{i}": one for i, one in enumerate(walls)}


def ring(x_m: float, y_m: float, radius_m: float, count: int) -> dict[str, ObjectModel]:
    """Walls around a place, none parallel to another."""
    at = 2.0 * math.pi * np.arange(count) / count
    return numbered(
        *(
            wall(
                x_m + radius_m * math.cos(a),
                y_m + radius_m * math.sin(a),
                math.degrees(a) + 90.0 + 15.0 * math.sin(3.0 * a + 0.4),
            )
            for a in at.tolist()
        )
    )


STRAIGHT = StraightDrive(duration_s=12.0, standstill_s=0.0)
ARC = ArcDrive(duration_s=17.0, standstill_s=0.0)
S_CURVE = SCurveDrive(duration_s=20.0, standstill_s=0.0)
EIGHT = FigureEightDrive(standstill_s=0.0, radius_m=5.0)
OBLIQUE = numbered(wall(4, 9, 20), wall(14, 10, -25), wall(6, -9, -15), wall(16, -9, 30))
PARALLEL = numbered(wall(10, 8, 0, 30.0), wall(10, -8, 0, 30.0))

DRIVES = {
    "straight, oblique": drive_past(STRAIGHT, OBLIQUE),
    "straight, parallel": drive_past(STRAIGHT, PARALLEL),
    "straight, none shared": drive_past(STRAIGHT, OBLIQUE, ASIDE),
    "arc": drive_past(ARC, ring(0.0, -9.0, 18.0, 8)),
    "S-curve": drive_past(S_CURVE, ring(12.0, -12.0, 24.0, 12), rate_hz=1.0),
    "figure-eight": drive_past(EIGHT, ring(0.0, 0.0, 17.0, 8), rate_hz=1.0),
}

STRAIGHT_WALLS = {"c x", "c y", "c z", "c roll", "c pitch", "d z"}

TABLE: dict[str, tuple[set[str], set[str], set[str]]] = {
    "straight, oblique": (
        STRAIGHT_WALLS,
        {"c x", "c y", "c z", "c roll"},
        {"c x", "c y", "c roll"},
    ),
    "straight, parallel": (
        STRAIGHT_WALLS | {"d x", "d pitch"},
        {"c x", "c y", "c z", "c roll", "d x"},
        {"c x", "c y", "c roll", "d x"},
    ),
    # Nothing ties what one LiDAR sees to what the other sees: not y and roll either.
    "straight, none shared": (
        STRAIGHT_WALLS | {"d x", "d pitch", "d y", "d roll"},
        {"c x", "c y", "c z", "c roll", "d x", "d y"},
        {"c x", "c y", "c roll", "d x", "d y"},
    ),
    "arc": ({"c turn", "c z", "d z"}, {"c turn", "c z"}, {"c turn"}),
    "S-curve": ({"c z", "d z"}, {"c z"}, set()),
    "figure-eight": ({"c z", "d z"}, {"c z"}, set()),
}
HEIGHTS = {"z of lidar 'front'", "z of lidar 'rear'"}
"""What walls leave open however the vehicle drives."""

WALLS_ALONE = Assumptions(ground="none", source="poses", heave_sigma_m=0.0)
GROUNDS: tuple[Ground, ...] = ("none", "plane", "height")


@cache
def planned(name: str, ground: Ground) -> Prediction:
    return predict(DRIVES[name], assumptions=replace(WALLS_ALONE, ground=ground))


def direction(text: str) -> Array:
    """(12,) scaled unit vector; c: all LiDARs together, d: the front one alone."""
    kind, axis = text.split()
    mounts = {name: model.mounting.pose() for name, model in AHEAD.items()}
    if kind == "d":
        parts = {"front": np.eye(6)[AXES.index(axis)], "rear": np.zeros(6)}
    elif axis == "turn":
        parts = twist_of_all(turn_about((0.0, -RADIUS_M)), mounts)
    else:
        parts = twist_of_all(np.eye(6)[AXES.index(axis)].tolist(), mounts)
    vector = np.concatenate([part / UNIT for part in parts.values()])
    return np.asarray(vector / np.linalg.norm(vector))


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("name", list(TABLE))
def test_the_table_of_what_walls_leave_open(name: str, ground: Ground) -> None:
    lost = TABLE[name][GROUNDS.index(ground)]

    prediction = planned(name, ground)

    # What walls tell they tell to a millimetre; what they do not tell stays 500 times worse.
    sigma = prediction.covariance.uncertainty.spectrum
    assert (sigma > 400.0).sum() == len(lost)
    assert (sigma < 1.5).sum() == 12 - len(lost)
    unit = np.tile(UNIT, 2)
    D = prediction.covariance.information_data * np.outer(unit, unit)
    basis = np.array([direction(text) for text in sorted(lost)]).reshape(-1, 12)
    for text, vector in zip(sorted(lost), basis, strict=True):
        assert vector @ D @ vector < 1e-5, text
    # They are as many as they are counted.
    assert np.linalg.matrix_rank(basis, tol=1e-3) == len(lost)
    assert len(prediction.undetermined) == len(lost)
    for found in prediction.undetermined:
        assert found.text
        assert "did not move" not in found.text
        assert "target" not in found.remedy


def test_what_is_missing_is_named_with_its_remedy() -> None:
    parallel = {d.text: d.remedy for d in planned("straight, parallel", "height").undetermined}
    assert "not parallel" in parallel["x of lidar 'front'"]
    assert "not parallel" in parallel["x of lidar 'rear'"]
    (pair,) = planned("straight, parallel", "height").covariance.determined_s2s.values()
    assert not pair["x"]
    assert pair["y"]

    walls_only = {d.text: d.remedy for d in planned("figure-eight", "none").undetermined}
    assert set(walls_only) == HEIGHTS
    assert all("ground.use" in remedy for remedy in walls_only.values())

    arc = {d.text: d.remedy for d in planned("arc", "height").undetermined}
    (text,) = arc
    assert text.startswith("rotation of all LiDARs about the turn centre: x and yaw together, 9.16")
    assert "figure-eight" in arc[text]


def test_a_suggestion_counts_the_walls_of_a_recorded_drive() -> None:
    """Beside an arc to the right past walls alone, an arc to the left is enough."""
    scenario = DRIVES["arc"]
    drive = make_drive(scenario.drive)
    structure = SeenDrive.of(scenario, drive, Assumptions()).structure
    assert structure is not None
    # As `next_drive` makes it of a recording: the world of the scenario has no walls.
    elsewhere = scenario.model_copy(update={"world": WorldModel()})
    recorded = SeenDrive(elsewhere, drive, Assumptions(), (), structure)
    chair = WorldModel(objects={"chair": ChairModel(xy_m=(0.0, 0.0))}, targets=("chair",))
    vehicle = scenario.model_copy(update={"world": chair})

    alone = suggest(vehicle, {}, Assumptions())
    beside = suggest(vehicle, {}, Assumptions(), [recorded])

    assert alone is not None
    assert beside is not None
    assert beside.met
    assert "arc to the left" in beside.manoeuvre
    assert "S-curve" in alone.manoeuvre


def test_who_shares_which_wall() -> None:
    (shared,) = planned("straight, oblique", "none").walls
    (apart,) = planned("straight, none shared", "none").walls
    assert shared is not None
    assert apart is not None

    assert shared.strips["front", "rear"] > 10
    assert shared.shared["front", "rear"] == ("wall_0", "wall_1", "wall_2", "wall_3")
    assert apart.strips == {("front", "rear"): 0}
    assert apart.shared == {("front", "rear"): ()}
    # The left one sees the walls on the left.
    assert {what for what, lidar in apart.scans if lidar == "front"} == {"wall_0", "wall_1"}
    assert {what for what, lidar in apart.scans if lidar == "rear"} == {"wall_2", "wall_3"}


def test_the_document_and_the_words_name_what_is_shared() -> None:
    for name, part in (
        ("straight, oblique", "both see "),
        ("straight, none shared", "see no piece of a wall that the other sees"),
    ):
        prediction = planned(name, "none")
        (seen,) = prediction.walls
        assert seen is not None

        asked = Planned(prediction, DRIVES[name], Assumptions())
        document = plan_document(asked, {}, False, None)
        words = io.StringIO()
        Console(width=300, file=words).print(plan_table(asked, {}, False, None))

        (shared,) = document["shared_walls"]
        assert shared["lidars"] == ["front", "rear"]
        assert shared["strips"] == seen.strips["front", "rear"]
        assert {w["wall"]: w["scans"] for w in document["walls"] if w["lidar"] == "front"} == {
            wall: scans for (wall, lidar), scans in seen.scans.items() if lidar == "front"
        }
        assert part in words.getvalue()
        assert "sees the target" not in words.getvalue()


def test_a_wall_hides_what_is_behind_it() -> None:
    behind = wall(10.0, 12.0, 0.0, 6.0)
    scans = []
    for screen in (wall(10.0, 6.0, 0.0, 40.0), wall(10.0, -6.0, 0.0, 40.0)):
        scenario = drive_past(STRAIGHT, {"behind": behind, "screen": screen})
        (seen,) = predict(scenario, assumptions=WALLS_ALONE).walls
        assert seen is not None
        scans.append({what for what, _ in seen.scans})
    assert scans == [{"screen"}, {"behind", "screen"}]


def test_points_of_a_patch_follow_from_the_beams() -> None:
    """A wall across the view at 10 m: 0.25 m^2 of a 1 degree by 0.64 degree grid."""
    still = drive_past(
        StraightDrive(duration_s=6.0, standstill_s=2.0),
        {"ahead": BoxModel(size_m=(0.5, 8, 3), xy_m=(12.25, 0.0))},
    )
    faces = faces_of(still)
    patches, face = planned_patches(still, make_drive(still.drive), faces, ground=False)

    first = patches.scan == 0
    centres = patches.centres_lidar[first]
    # The LiDAR is 2 m up and 2 m ahead of the origin, nose down by 10 degrees.
    in_vehicle = AHEAD["front"].mounting.pose().transformFrom(centres.T).T
    assert in_vehicle[:, 0] == pytest.approx(12.0)
    assert {faces.names[f] for f in face[first].tolist()} == {"ahead"}
    middle = np.abs(in_vehicle - [12.0, 0.25, 1.75]).max(axis=1).argmin()
    beams = 0.25 / (10.0 * math.radians(1.0) * 10.0 * math.radians(25.0 / 39.0))
    assert patches.points[first][middle] == pytest.approx(beams, rel=0.02)
    moments = patches.moments[first][middle]
    spread = moments[:3, :3] / moments[3, 3] - np.outer(centres[middle], centres[middle])
    assert np.linalg.eigvalsh(spread) == pytest.approx([0.0, 0.25 / 12, 0.25 / 12], abs=1e-9)


def test_what_is_flat_counts_and_what_is_not_does_not() -> None:
    world: dict[str, ObjectModel] = {
        "car": CarModel(xy_m=(10.0, 5.0)),
        "chair": ChairModel(xy_m=(5.0, 5.0)),
        "crate": BoxModel(size_m=(0.4, 0.4, 0.4), xy_m=(5.0, -5.0)),
        "wall": wall(0.0, 9.0, 0.0),
    }
    faces = faces_of(drive_past(STRAIGHT, world))

    flat = [name for name, yes in zip(faces.names, faces.flat, strict=True) if yes]
    # Front and back of the car, both faces of the wall and not its ends.
    assert flat == ["car", "car", "wall", "wall"]
    assert "chair" not in faces.names


def test_walls_make_a_target_unnecessary_and_help_beside_one() -> None:
    yard = load_scenario(SCENARIOS / "yard.yaml")
    few = {
        name: lidar.model_copy(update={"rate_hz": 1.0, "channels": 40})
        for name, lidar in yard.lidars.items()
    }
    yard = yard.model_copy(update={"lidars": few})
    with_chair = yard.model_copy(
        update={"world": yard.world.model_copy(update={"targets": ("chair",)})}
    )
    alone, both = predict(yard), predict(with_chair)
    chair = predict(with_chair, assumptions=Assumptions(structure=False))

    assert alone.undetermined == both.undetermined == ()
    assert chair.walls == (None,)
    for name in ("front", "rear"):
        assert (both.sigma_s2v[name] <= alone.sigma_s2v[name]).all()
        assert (alone.sigma_s2v[name][2:5] < 0.6 * chair.sigma_s2v[name][2:5]).all()
        # Height: what is known of the vehicle's own, and how uneven the ground is below it.
        assert 0.005 < alone.sigma_s2v[name][5] < 0.006
    (pair,), (by_chair,) = alone.sigma_s2s.values(), chair.sigma_s2s.values()
    assert (pair[2:5] < 0.5 * by_chair[2:5]).all()
    assert not alone.covariance.calibration.lidars["front"].saw_target
    assert alone.covariance.calibration.lidars["front"].saw_structure


def test_the_height_above_strips_and_planes_of_ground_counts_once() -> None:
    """z of a LiDAR is no better known than the height that is stated, here to 5 cm."""
    objects = numbered(wall(22, -5, 80), wall(5, 8, 10)) | {"chair": ChairModel(xy_m=(9.0, -19.0))}
    scenario = drive_past(S_CURVE, objects, rate_hz=1.0).model_copy(
        update={"world": WorldModel(objects=objects, targets=("chair",))}
    )
    drive = make_drive(scenario.drive, make_terrain(scenario.world.ground))
    assumptions = Assumptions(
        source="poses", ground_height_sigma_m=0.05, extraction=ExtractionConfig(min_scans=4)
    )
    seen = SeenDrive.of(scenario, drive, assumptions)
    assert seen.structure is not None
    assert len(seen.structure.found.stands().pose)
    assert not lidars_with_ground(seen.structure.found)  # too few scans: their planes count

    H = seen.information(tuple(scenario.lidars))

    z = 5
    rest = np.delete(np.arange(12), z)
    cross = H[z, rest]
    information = H[z, z] - cross @ np.linalg.solve(H[np.ix_(rest, rest)], cross)
    assert 0.05 < information**-0.5 < 0.051


def test_ground_without_walls_is_told_cell_by_cell() -> None:
    """As `calibrate` has it: bumps stay where they are, planes of scans take them as independent.

    Calibrations of `paper_arc` claim 0.23 mrad of S2S roll, planes 0.06.
    """
    scenario = load_scenario(SCENARIOS / "paper_arc.yaml")
    cells = predict(scenario)
    planes = predict(scenario, assumptions=Assumptions(structure=False))
    roll = AXES.index("roll")
    by_cells, by_planes = (of.sigma_s2s["front", "rear"][roll] for of in (cells, planes))
    assert by_cells == pytest.approx(0.22e-3, rel=0.15)
    assert by_cells > 2.0 * by_planes
    assert cells.walls == (None,)
    assert "walls" not in plan_document(Planned(cells, scenario, Assumptions()), {}, False, None)


def test_a_lidar_that_sees_ground_alone_is_not_taken_as_known() -> None:
    """It knows the ground no better than its own mounting; taken as known it halved S2V roll."""
    scenario = scanned_at(load_scenario(SCENARIOS / "paper_arc.yaml"), 2.0)
    down = scenario.lidars["rear"].model_copy(update={"vertical_fov_deg": (-60.0, -40.0)})
    front = scenario.model_copy(update={"lidars": {"front": scenario.lidars["front"]}})
    both = scenario.model_copy(update={"lidars": {**front.lidars, "rear": down}})
    grounds: tuple[Ground, ...] = ("plane", "height")
    for ground in grounds:
        alone, beside = (predict(s, assumptions=Assumptions(ground=ground)) for s in (front, both))
        assert (beside.sigma_s2v["front"] > 0.9 * alone.sigma_s2v["front"]).all()
        assert beside.sigma_s2v["front"][5] > 0.98 * alone.sigma_s2v["front"][5]
        assert [d.text for d in beside.undetermined] == [d.text for d in alone.undetermined]
        assert any("never sees a target or a wall" in text for text in beside.warnings)


def test_a_clock_beside_walls() -> None:
    timed = predict(DRIVES["S-curve"], assumptions=replace(WALLS_ALONE, time_offset=True))

    assert set(timed.covariance.offsets_s) == {"front", "rear"}
    assert max(timed.covariance.offsets_s.values()) < 0.002
    assert {d.text for d in timed.undetermined} == HEIGHTS


def test_two_drives_past_walls_tell_more_than_either() -> None:
    to_the_left = ARC.model_copy(update={"turn": "left"})
    left = drive_past(to_the_left, ring(0.0, 9.0, 18.0, 8))

    alone, both = planned("arc", "none"), predict(DRIVES["arc"], [left], WALLS_ALONE)

    assert len(alone.undetermined) == 3
    assert {d.text for d in both.undetermined} == HEIGHTS


def test_nothing_to_plan_with_is_said() -> None:
    empty = drive_past(STRAIGHT, {})

    with pytest.raises(ConfigError, match="walls"):
        predict(empty)
    with pytest.raises(ConfigError, match="walls"):
        predict(replace_objects(empty, OBLIQUE), assumptions=Assumptions(structure=False))


def replace_objects(scenario: Scenario, objects: Mapping[str, ObjectModel]) -> Scenario:
    world = scenario.world.model_copy(update={"objects": dict(objects)})
    return scenario.model_copy(update={"world": world})
