"""Who sees a target when: by hand, and against clouds that were really cast."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.config.model import ExtractionConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.range_errors import growth
from caliv_graph.planning.sightings import (
    INDEPENDENT_PART,
    POSITION_FLOOR_M,
    ROTATION_FLOOR_RAD,
    SEEN_PART,
    ground_by_range_bias,
    placements,
    scan_stamps,
    sees_ground,
    sight,
    thinned,
)
from caliv_graph.scenario.beams import channel_elevations_deg, unit_vectors
from caliv_graph.scenario.drive_models import StandstillDrive, StraightDrive
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world_models import (
    BoxModel,
    ChairModel,
    GroundModel,
    PoleModel,
    RampModel,
    WorldModel,
)
from caliv_graph.simulation.recording import simulate_drive
from caliv_graph.targets.ground.planes import fit_plane, near_points
from tests.drives_with_chair import ARC, paper_lidar, paper_scenario

EXTRACTION = ExtractionConfig()


def standing(lidar: LidarModel, xy_m: tuple[float, float]) -> Scenario:
    """A vehicle that stands for one second, with one LiDAR, before a chair."""
    scenario = paper_scenario(StandstillDrive(duration_s=1.0), chair_xy_m=xy_m)
    return scenario.model_copy(update={"lidars": {"front": lidar}, "reference": "front"})


def points_at(xy_m: tuple[float, float], lidar: LidarModel | None = None) -> list[int]:
    """Predicted points of each scan."""
    scenario = standing(lidar or paper_lidar(0.0, 0.0), xy_m)
    drive = make_drive(scenario.drive)
    seen = sight(drive, scenario, "front", placements(scenario)[0], EXTRACTION)
    return [round(n) for n in seen.points]


def test_points_fall_with_the_square_of_the_range() -> None:
    near, far = points_at((9.0, 0.0)), points_at((18.0, 0.0))

    assert len(near) == len(far) == 6
    # The LiDAR is 2 m up, the chair's middle 0.6 m: ranges, not distances.
    square = (18.0**2 + 1.4**2) / (9.0**2 + 1.4**2)
    assert near[0] / far[0] == pytest.approx(square, rel=0.03)


@pytest.mark.parametrize(
    ("xy_m", "seen"),
    [
        ((10.0, 0.0), True),
        ((-10.0, 0.0), False),
        ((5.0, 7.8), True),  # 57 degrees to the left, the field of view ends at 60
        ((5.0, 9.5), False),  # 62
        ((5.0, 8.55), False),  # 59.7: the edge cuts the chair
        ((40.0, 0.0), True),  # 28 points
        ((80.0, 0.0), False),  # 7 points
        ((1.0, 0.0), False),  # below the lowest channel
    ],
    ids=str,
)
def test_field_of_view_and_reach(xy_m: tuple[float, float], seen: bool) -> None:
    assert bool(points_at(xy_m)) is seen


def test_half_the_channels_are_half_the_points() -> None:
    lidar = paper_lidar(0.0, 0.0)
    half = lidar.model_copy(update={"channels": 76})

    full, fewer = points_at((9.0, 0.0), lidar), points_at((9.0, 0.0), half)

    assert fewer[0] / full[0] == pytest.approx(75.0 / 151.0, rel=0.02)


def test_uneven_channels_count_where_they_are_dense() -> None:
    lidar = paper_lidar(0.0, 0.0).model_copy(update={"mounting": PoseConfig(xyz=(0.0, 0.0, 0.6))})
    dense = lidar.model_copy(
        update={"elevations_deg": (-20.0, -10.0, *np.linspace(-3.0, 3.0, 61), 10.0, 20.0)}
    )
    even = lidar.model_copy(update={"vertical_fov_deg": (-3.05, 3.05), "channels": 62})

    assert points_at((12.0, 0.0), dense)[0] == pytest.approx(
        points_at((12.0, 0.0), even)[0], rel=0.1
    )


def test_points_are_about_those_of_a_simulated_drive() -> None:
    scenario = paper_scenario(ARC, rate_hz=2.0)
    recording = simulate_drive(scenario, 1)
    placement = placements(scenario)[0]
    chair = recording.world.names.index("chair")
    for lidar in scenario.lidars:
        found = sight(recording.truth.drive, scenario, lidar, placement, EXTRACTION)
        true = {
            s.scan.stamp_ns - recording.truth.start_ns: int((s.objects == chair).sum())
            for s in recording.scans_with_truth(lidar)
        }

        counts = np.array([true[stamp] for stamp in found.stamps_ns.tolist()])
        assert len(counts) > 10
        # Sides of a chair differ, and a backrest hides its seat.
        assert (found.points / counts).mean() == pytest.approx(1.0, abs=0.15)
        assert np.abs(np.log(found.points / counts)).max() < 0.4
        # Nothing was missed but clouds in which the edge cuts it off.
        missed = [n for stamp, n in true.items() if stamp not in found.stamps_ns and n > 60]
        assert len(missed) <= 2


def test_a_target_that_is_carried_away_is_two_targets() -> None:
    moves = ({"begin_s": 0.35, "end_s": 0.55, "xy_m": (9.0, 3.0), "yaw_deg": 90.0},)
    scenario = standing(paper_lidar(0.0, 0.0), (10.0, 0.0))
    chair = ChairModel.model_validate({"xy_m": (10.0, 0.0), "moves": moves})
    world = scenario.world.model_copy(update={"objects": {"chair": chair}})
    scenario = scenario.model_copy(update={"world": world})

    first, second = placements(scenario)

    assert [first.name, second.name] == ["chair", "chair 2"]
    assert second.centre_map[:2] == pytest.approx((9.0, 3.0), abs=0.05)
    drive = make_drive(scenario.drive)
    seen = [sight(drive, scenario, "front", p, EXTRACTION).stamps_ns for p in (first, second)]
    assert seen[0].max() <= 350_000_000
    assert seen[1].min() >= 550_000_000


def test_a_target_on_a_ramp_stands_higher() -> None:
    scenario = standing(paper_lidar(0.0, 0.0), (10.0, 0.0))
    ramp = RampModel(xy_m=(10.0, 0.0), height_m=0.4, flank_m=3.0, top_m=2.0)
    high = scenario.world.model_copy(update={"ground": GroundModel(ramps=(ramp,))})

    flat = placements(scenario)[0]
    raised = placements(scenario.model_copy(update={"world": high}))[0]

    assert raised.centre_map - flat.centre_map == pytest.approx((0.0, 0.0, 0.4))


# ------------------------------------------------------------------ registration


def target(model: ChairModel | BoxModel | PoleModel) -> Scenario:
    scenario = standing(paper_lidar(0.0, 0.0), (10.0, 0.0))
    world = WorldModel(objects={"it": model}, targets=("it",))
    return scenario.model_copy(update={"world": world})


def test_a_chair_at_10_m_has_300_points_that_count() -> None:
    place = placements(target(ChairModel(xy_m=(10.0, 0.0))))[0]

    per_beam = math.radians(25.0 / 151.0) * math.radians(0.18237)
    independent = INDEPENDENT_PART * place.area_m2 / (100.0 * per_beam)
    assert independent == pytest.approx(300.0, rel=0.05)
    info = place.information(np.array([300.0, 1e9]), 0.01)
    sigma = np.diagonal(info, axis1=1, axis2=2) ** -0.5
    # 10 mm over the root of 300, and over a lever of 0.2 m; with so many points only the floors.
    assert sigma[0, 3:] == pytest.approx(np.hypot(0.01 / math.sqrt(300.0), 0.0005) * np.ones(3))
    assert sigma[0, :3] == pytest.approx(3.05e-3 * np.ones(3), rel=0.1)
    floors = [ROTATION_FLOOR_RAD] * 3 + [POSITION_FLOOR_M] * 3
    assert sigma[1] == pytest.approx(floors, rel=1e-3)


def test_a_smaller_target_tells_less_and_a_round_one_no_yaw() -> None:
    count = np.array([100.0])
    small = placements(target(BoxModel(xy_m=(10.0, 0.0), size_m=(0.3, 0.3, 0.3))))[0]
    large = placements(target(BoxModel(xy_m=(10.0, 0.0), size_m=(0.9, 0.9, 0.9))))[0]
    pole = placements(target(PoleModel(xy_m=(10.0, 0.0))))[0]

    assert large.area_m2 == pytest.approx(9.0 * small.area_m2)
    assert large.levers_m == pytest.approx(3.0 * small.levers_m)
    # Mean over directions of a cube of side a: a^2 4 / pi, up to the number of directions.
    assert small.area_m2 == pytest.approx(0.09 * 4.0 / math.pi, rel=0.03)
    assert pole.is_round
    assert pole.information(count, 0.01)[0, 2, 2] == 0.0
    assert small.information(count, 0.01)[0, 2, 2] > 0.0


# ------------------------------------------------------------------ scans and ground


def test_stamps_are_true_times() -> None:
    scenario = paper_scenario(StraightDrive(duration_s=6.0))
    late = scenario.lidars["front"].model_copy(update={"time_offset_s": 0.05, "phase_s": 0.02})
    scenario = scenario.model_copy(update={"lidars": {"front": late}, "reference": "front"})

    stamps = scan_stamps(scenario, "front", 6.0)

    assert stamps[0] == 170_000_000  # the first stamp of 20 ms means a time before the start
    assert set(np.diff(stamps).tolist()) == {200_000_000}


@pytest.mark.parametrize(
    ("count", "seeing", "used"),
    [(7, 2, 0), (8, 2, 8), (120, 2, 120), (300, 2, 120), (300, 3, 100), (300, 1, 120)],
)
def test_as_many_clouds_as_calibrate_takes(count: int, seeing: int, used: int) -> None:
    chosen = thinned(np.ones(count), seeing, ExtractionConfig(max_scans=120))

    assert len(chosen) == used
    assert len(set(chosen.tolist())) == used
    if used:
        # Evenly over all of them.
        gaps = np.diff([-1, *chosen, count])
        assert gaps.max() <= 4


@pytest.mark.parametrize(
    ("pitch_deg", "z_m", "vertical_deg", "seen"),
    [
        (10.0, 2.0, (-12.5, 12.5), True),
        (0.0, 2.0, (-12.5, 12.5), True),
        (-20.0, 2.0, (-12.5, 12.5), False),
        (0.0, 2.0, (0.0, 20.0), False),
        (0.0, 2.0, (-5.0, 5.0), False),  # meets the ground 23 m away
        (0.0, -0.5, (-12.5, 12.5), False),  # below it
    ],
)
def test_who_sees_ground(
    pitch_deg: float, z_m: float, vertical_deg: tuple[float, float], seen: bool
) -> None:
    lidar = LidarModel(
        mounting=PoseConfig(xyz=(0.0, 0.0, z_m), rpy_deg=(0.0, pitch_deg, 0.0)),
        vertical_fov_deg=vertical_deg,
    )

    assert sees_ground(lidar) is seen


def test_range_biases_move_the_ground_as_they_move_the_plane_that_is_fitted() -> None:
    """The points of every beam on level ground, with and without a centimetre of bias."""
    lidar = paper_lidar(x_m=2.0, yaw_deg=0.0)
    T = lidar.mounting.pose()
    R, height_m = T.rotation().matrix(), float(T.translation()[2])
    low, high = np.radians(lidar.horizontal_fov_deg)
    azimuth = np.arange(low, high, math.radians(lidar.horizontal_resolution_deg))
    elevation = np.radians(channel_elevations_deg(lidar))[:, None]
    beams = unit_vectors(elevation, azimuth).reshape(-1, 3) @ R.T
    beams = beams[beams[:, 2] < -0.05]
    range_m = height_m / -beams[:, 2]
    by_each = np.column_stack([np.ones(len(beams)), growth(-beams[:, 2])])

    def plane(biases_m: np.ndarray) -> np.ndarray:
        """Slopes and height of the fitted plane."""
        points = beams * (range_m + by_each @ biases_m)[:, None]
        up = np.array([0.0, 0.0, 1.0])
        found, why = fit_plane(points[near_points(points, up)], up, lidar.range_sigma_m)
        assert found is not None, why
        n = found.normal_lidar
        return np.array([-n[0] / n[2], -n[1] / n[2], -found.distance_m / n[2]])

    shown = [(plane(0.01 * one) - plane(np.zeros(3))) / 0.01 for one in np.eye(3)]
    expected = ground_by_range_bias(lidar)
    assert np.stack(shown, axis=1) == pytest.approx(expected, rel=0.25, abs=3e-3)
    assert abs(expected[0, 0]) > 0.01  # it looks ahead


def test_the_parts_of_the_points_are_in_order() -> None:
    # What counts is part of what is seen.
    assert 0.0 < INDEPENDENT_PART < SEEN_PART < 1.0
