"""Several objects in one region: each is a placement, and LiDARs share it only beyond doubt."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.common.exits import DONE, exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.lidars import LidarConfig, PoseSigmaConfig
from caliv_graph.config.load import load_config, parse_config
from caliv_graph.config.model import Config, RegistrationConfig, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, LidarScan, TargetCloud, TargetObservation
from caliv_graph.readers import open_recording
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.drive_models import FigureEightDrive
from caliv_graph.scenario.model import CropModel, Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import GROUND
from caliv_graph.scenario.world_models import BoxModel, ChairModel, ObjectModel, WorldModel
from caliv_graph.simulation.writer import config_of as written_config
from caliv_graph.targets import extract_targets
from caliv_graph.targets.cloud.constellation import (
    AMBIGUOUS,
    UNMATCHED,
    LidarObjects,
    _misfit,
    _plausible_matchings,
    match_objects,
    one_object,
    static_objects,
)
from caliv_graph.targets.cloud.region import Candidate, RegionExtractor
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import sigmas_s2s
from tests.kept import KeptDrive
from tests.targets.cloud.test_extract import (
    Scene,
    config_of,
    extracted_from,
    recall_and_strangers,
    scene,
    standing,
)

EDGAR = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "edgar_static"

LEFT = LidarModel(
    mounting=PoseConfig(xyz=(2.0, 0.6, 1.6), rpy_deg=(-20.0, 1.0, -1.0)),
    horizontal_fov_deg=(-30.0, 30.0),
    vertical_fov_deg=(-22.5, 22.5),
    channels=128,
    horizontal_resolution_deg=0.35,
)
RIGHT = LEFT.model_copy(
    update={"mounting": PoseConfig(xyz=(2.0, -0.6, 1.6), rpy_deg=(20.0, 1.0, 0.5))}
)
MODELS = {"left": LEFT, "right": RIGHT}

BOXES: Mapping[str, ObjectModel] = {
    "one": BoxModel(xy_m=(9.9, -2.4), size_m=(0.45, 0.5, 0.5), yaw_deg=5.0),
    "two": BoxModel(xy_m=(9.8, 0.0), size_m=(0.5, 0.5, 0.5), yaw_deg=-25.0),
    "three": BoxModel(xy_m=(9.7, 2.0), size_m=(0.45, 0.5, 0.5)),
}

AROUND_ALL = TargetRegion(min=(8.5, -3.2, -0.3), max=(11.0, 3.2, 2.0))

SCANS = 3


@cache
def seen_by(lidar: str, *names: str, clutter: bool = False) -> tuple[Scene, ...]:
    """Scans of a standing vehicle's LiDAR of some of the boxes."""
    objects: dict[str, ObjectModel] = {name: BOXES[name] for name in names}
    if clutter:
        objects["pole"] = BoxModel(xy_m=(9.3, 1.0), size_m=(0.1, 0.1, 2.0))
        objects["wall"] = BoxModel(xy_m=(10.9, 6.0), size_m=(0.2, 5.0, 2.0), yaw_deg=5.0)
        objects["beside"] = BoxModel(xy_m=(7.2, -2.4), size_m=(0.4, 0.4, 0.4))
    return tuple(scene(objects, MODELS[lidar], seed=seed) for seed in range(SCANS))


def guess(lidar: str, yaw_deg: float, sigma_deg: float = 1.73) -> LidarConfig:
    """The true extrinsic turned about the vehicle's z axis."""
    mounting = MODELS[lidar].mounting
    roll, pitch, yaw = mounting.rpy_deg
    initial = PoseConfig(xyz=mounting.xyz, rpy_deg=(roll, pitch, yaw + yaw_deg))
    return LidarConfig(
        topic=lidar, initial=initial, sigma=PoseSigmaConfig(xyz=0.058, rpy_deg=sigma_deg)
    )


def observed(
    scenes: Mapping[str, Sequence[Scene]],
    yaw_deg: float = 0.0,
    sigma_deg: float = 1.73,
    region: TargetRegion = AROUND_ALL,
) -> tuple[TargetObservation, ...]:
    """With guesses of the two LiDARs that are wrong by `yaw_deg` in opposite directions."""
    lidars = {
        "left": guess("left", yaw_deg, sigma_deg),
        "right": guess("right", -yaw_deg, sigma_deg),
    }
    config = config_of(region, lidars={name: lidars[name] for name in scenes}, min_scans=SCANS)
    clouds = {name: [s.points_lidar for s in of_lidar] for name, of_lidar in scenes.items()}
    return extracted_from(clouds, config)


def what_is_seen(
    observation: TargetObservation, scenes: Mapping[str, Sequence[Scene]]
) -> dict[str, str]:
    """LiDAR -> name of the object that its clouds show, which they show whole and alone."""
    out: dict[str, str] = {}
    for cloud in observation.clouds:
        shown = scenes[cloud.lidar][cloud.stamp_ns]
        points = {tuple(p) for p in cloud.points_lidar.tolist()}
        (name,) = (n for n in shown.world.names if n != GROUND and points & shown.of(n))
        recall, strangers = recall_and_strangers(cloud, shown, name)
        assert recall > 0.8
        assert strangers == 0
        assert out.setdefault(cloud.lidar, name) == name
    return out


# ------------------------------------------------------------------ a vehicle that stands


@pytest.mark.parametrize("yaw_deg", [0.0, 2.5, -2.5])
def test_three_boxes_are_three_placements_that_both_lidars_share(yaw_deg: float) -> None:
    # The guesses put a box up to 0.68 m apart, in LiDARs that the boxes are 2 and 2.4 m apart for.
    scenes = {name: seen_by(name, *BOXES) for name in MODELS}

    observations = observed(scenes, yaw_deg)

    assert [o.placement for o in observations] == [0, 1, 2]
    assert [o.name for o in observations] == [f"target, object {n} of 3" for n in (1, 2, 3)]
    shown = [what_is_seen(o, scenes) for o in observations]
    assert {s["left"] for s in shown} == set(BOXES)
    assert all(s["left"] == s["right"] for s in shown)
    for observation, one in zip(observations, shown, strict=True):
        assert len(observation.clouds) == 2 * SCANS
        x, y = BOXES[one["left"]].xy_m
        assert np.linalg.norm(observation.centre_map[:2] - np.array([x, y])) < 0.4
    assert observations[0].warnings == (
        "target: 3 objects stand in the region, each solved for by itself: 3 seen by 'left' and "
        "'right'",
    )


def test_only_what_stands_in_the_region_is_meant() -> None:
    # Too thin, cut off by the widened region, and 1.1 m outside the region.
    scenes = {name: seen_by(name, *BOXES, clutter=True) for name in MODELS}
    clutter = {n for s in scenes["left"] for n in s.hit} - {GROUND, *BOXES}
    assert clutter == {"pole", "wall", "beside"}

    observations = observed(scenes)

    assert [what_is_seen(o, scenes) for o in observations] in (
        [{"left": n, "right": n} for n in order] for order in _orders(tuple(BOXES))
    )


def _orders(names: Sequence[str]) -> list[list[str]]:
    if not names:
        return [[]]
    return [[n, *rest] for n in names for rest in _orders([m for m in names if m != n])]


def test_of_one_object_in_the_region_nothing_changes() -> None:
    # A neighbour is outside the region: the clouds are those that each LiDAR chooses by itself.
    scenes = {name: seen_by(name, *BOXES) for name in MODELS}
    region = TargetRegion(min=(8.8, -0.7, -0.3), max=(11.0, 0.7, 2.0))

    (observation,) = observed(scenes, region=region)

    assert observation.name == "target"
    assert observation.warnings == ()
    assert observation.centre_map.tolist() == [9.9, 0.0, 0.85]
    config = config_of(region, lidars={n: guess(n, 0.0) for n in MODELS}, min_scans=SCANS)
    extractor = RegionExtractor(region, config, standing(scans=SCANS))
    chosen = [
        cloud
        for name, of_lidar in scenes.items()
        for cloud in extractor.choose(
            [
                extractor.candidates(LidarScan(name, i, s.points_lidar, f"{name}/{i}.pcd"), 0)
                for i, s in enumerate(of_lidar)
            ],
            name,
        )
    ]
    assert len(chosen) == len(observation.clouds) == 2 * SCANS
    for cloud, expected in zip(observation.clouds, chosen, strict=True):
        assert (cloud.lidar, cloud.stamp_ns) == (expected.lidar, expected.stamp_ns)
        np.testing.assert_array_equal(cloud.points_lidar, expected.points_lidar)


def test_a_box_that_one_lidar_does_not_see_is_no_other_box() -> None:
    scenes = {"left": seen_by("left", "one", "two"), "right": seen_by("right", "two", "three")}

    observations = observed(scenes, yaw_deg=0.5)

    assert sorted(map(str, (what_is_seen(o, scenes) for o in observations))) == sorted(
        map(str, [{"left": "one"}, {"left": "two", "right": "two"}, {"right": "three"}])
    )


def test_an_arrangement_that_fits_in_two_ways_is_not_used() -> None:
    # With a sigma of 6 degrees, boxes one and two may be boxes two and three.
    scenes = {"left": seen_by("left", "one", "two"), "right": seen_by("right", "two", "three")}

    observations = observed(scenes, sigma_deg=6.0)

    assert all(len({c.lidar for c in o.clouds}) == 1 for o in observations)
    assert len(observations) == 4
    _, doubt = observations[0].warnings
    assert "which object of lidar 'left' is which of lidar 'right' is ambiguous" in doubt
    assert "Give better guesses" in doubt


def test_lidars_that_see_one_box_each_share_none() -> None:
    scenes = {"left": seen_by("left", "one"), "right": seen_by("right", "three")}

    observations = observed(scenes, sigma_deg=0.6)

    assert [what_is_seen(o, scenes) for o in observations] == [{"left": "one"}, {"right": "three"}]
    (said,) = observations[0].warnings
    assert said.endswith("1 seen by 'left' alone, 1 seen by 'right' alone")


@pytest.mark.parametrize(
    "places_m",
    [
        [-2.5 + 0.25 * i for i in range(15)],
        # It stops for 6 of 16 scans: more than min_scans.
        [-2.0, -1.7, -1.4, -1.1, -0.8, -0.5, *[-0.2] * 6, 0.2, 0.6, 1.0, 1.4],
    ],
)
def test_what_walks_by_is_no_placement(places_m: Sequence[float]) -> None:
    chair = ChairModel(xy_m=(10.5, 2.0), yaw_deg=200.0)
    scenes = {
        "left": [
            scene(
                {"chair": chair, "walker": BoxModel(xy_m=(9.5, y), size_m=(0.4, 0.5, 1.7))},
                LEFT,
                seed=i,
            )
            for i, y in enumerate(places_m)
        ]
    }

    (observation,) = observed(scenes)

    assert what_is_seen(observation, scenes) == {"left": "chair"}
    assert len(observation.clouds) == len(places_m)


@pytest.mark.parametrize(("gap_m", "placements"), [(0.3, 1), (0.7, 2)])
def test_boxes_that_stand_together_are_one_target(gap_m: float, placements: int) -> None:
    """From 0.2 m on they are seen apart; guesses that are off by 0.44 m each way exchange them."""
    y_m = 0.25 + 0.5 * gap_m
    boxes = {
        "one": BoxModel(xy_m=(9.8, -y_m), size_m=(0.5, 0.5, 0.5)),
        "two": BoxModel(xy_m=(9.8, y_m), size_m=(0.5, 0.5, 0.7)),
    }
    scenes = {
        name: [scene(boxes, model, seed=seed) for seed in range(SCANS)]
        for name, model in MODELS.items()
    }

    observations = observed(scenes, yaw_deg=2.5 if placements == 1 else 0.0)

    assert len(observations) == placements
    for observation in observations:
        assert len(observation.clouds) == 2 * SCANS
    if placements == 1:
        assert observations[0].warnings == ()
        for cloud in observations[0].clouds:
            shown = scenes[cloud.lidar][cloud.stamp_ns]
            points = {tuple(p) for p in cloud.points_lidar.tolist()}
            for name in boxes:
                assert len(points & shown.of(name)) > 0.8 * len(shown.of(name))
            assert points <= shown.of("one") | shown.of("two")
            low, high = np.percentile(cloud.points_lidar, [2, 98], axis=0)
            assert high[1] - low[1] > 1.2  # 1.3 m from end to end


@pytest.mark.parametrize(
    ("with_box", "of_box"), [((0, 4, 8), True), ((3, 4), False)], ids=["stands", "stops"]
)
def test_the_wall_behind_a_target_is_not_it_though_more_scans_show_it(
    with_box: tuple[int, ...], of_box: bool
) -> None:
    # 0.8 m behind the box, 1.7 m of 12 in the widened region, and a box in a third of the scans.
    wall = BoxModel(xy_m=(11.0, 0.0), size_m=(0.2, 12.0, 2.0))
    region = TargetRegion(min=(9.3, -0.6, -0.3), max=(10.7, 0.6, 2.0))
    config = config_of(region, lidars={"left": guess("left", 0.0, sigma_deg=0.5)})
    extractor = RegionExtractor(region, config, standing(scans=9))
    found = []
    for number in range(9):
        objects = {"wall": wall, "two": BOXES["two"]} if number in with_box else {"wall": wall}
        points = scene(objects, LEFT, seed=number).points_lidar
        found.append(extractor.candidates(LidarScan("left", number, points, f"{number}.pcd"), 0))

    seen = static_objects(extractor, found, "left", 2)

    assert seen is not None
    assert [len(of_scan) for of_scan in found] == [2 if n in with_box else 1 for n in range(9)]
    x_m, scans = (9.65, 3) if of_box else (10.9, 9)
    assert seen.places[:, 0] == pytest.approx([x_m], abs=0.15)
    assert len(seen.candidates[0]) == scans


def test_joined_candidates_keep_times_and_origins_of_their_points() -> None:
    def candidate(x_m: float, time_s: float, top_m: float) -> Candidate:
        points = np.array([[x_m, 0.0, 0.0], [x_m, 1.0, 0.0]])
        swept = LidarScan("left", 5, points + 0.1, "scan", np.full(2, time_s))
        cloud = TargetCloud(
            "left", 0, 5, points, "scan", swept=swept, origins_lidar=np.full((2, 3), time_s)
        )
        middle = points.mean(axis=0)
        return Candidate(cloud, middle, np.eye(3), np.zeros(3), points + 0.1, 0.01, top_m, False)

    one = candidate(4.0, 0.01, 0.4).joined(candidate(6.0, 0.02, 0.9))

    assert one.cloud.points_lidar[:, 0].tolist() == [4.0, 4.0, 6.0, 6.0]
    assert one.cloud.origins_lidar is not None
    assert one.cloud.origins_lidar[:, 0].tolist() == [0.01, 0.01, 0.02, 0.02]
    assert one.cloud.swept is not None
    assert one.cloud.swept.point_times_s is not None
    assert one.cloud.swept.point_times_s.tolist() == [0.01, 0.01, 0.02, 0.02]
    np.testing.assert_allclose(one.cloud.swept.points_lidar, one.cloud.points_lidar + 0.1)
    np.testing.assert_allclose(one.measured_lidar, one.cloud.points_lidar + 0.1)
    np.testing.assert_allclose(one.centre_lidar, [5.0, 0.5, 0.0])
    assert one.top_m == 0.9


# ------------------------------------------------------------------ matchings by hand


def in_a_row(lidar: str, *y_m: float, common_m: float, own_m: float = 0.1) -> LidarObjects:
    """Objects at y, 10 m ahead, with a common error and one of each, sigmas in metres."""
    places = np.array([[10.0, y, 0.0] for y in y_m])
    together = np.tile(np.eye(3), (len(y_m), 1))
    cov: Array = common_m**2 * together @ together.T + own_m**2 * np.eye(3 * len(y_m))
    return LidarObjects(lidar, 10, ((),) * len(y_m), places, cov)


def matched(*lidars: LidarObjects) -> tuple[list[dict[str, int]], bool]:
    found = match_objects(lidars)
    return [dict(o.seen) for o in found.objects], bool(found.ambiguous)


def test_the_arrangement_decides_where_places_do_not() -> None:
    # Displaced by 1 m, of 1 m between them: the nearest would be the wrong ones.
    a = in_a_row("a", 0.0, 1.0, 3.0, common_m=0.5)
    b = in_a_row("b", 1.0, 2.0, 4.0, common_m=0.5)
    assert matched(a, b) == ([{"a": 0, "b": 0}, {"a": 1, "b": 1}, {"a": 2, "b": 2}], False)


def test_equal_gaps_are_ambiguous_where_the_ends_do_not_show() -> None:
    a = in_a_row("a", 0.0, 1.0, common_m=0.5)
    b = in_a_row("b", 1.0, 2.0, common_m=0.5)
    seen, ambiguous = matched(a, b)
    assert ambiguous
    assert all(len(s) == 1 for s in seen)
    # With guesses that are five times better it is clear that they share one.
    a, b = in_a_row("a", 0.0, 1.0, common_m=0.1), in_a_row("b", 1.0, 2.0, common_m=0.1)
    assert matched(a, b) == ([{"a": 0}, {"a": 1, "b": 0}, {"b": 1}], False)


def test_a_third_lidar_is_matched_with_all_that_the_first_two_saw() -> None:
    a = in_a_row("a", 0.0, 2.5, common_m=0.2)
    b = in_a_row("b", 2.6, 5.0, common_m=0.2)
    c = in_a_row("c", 0.1, 5.1, common_m=0.2)
    assert matched(a, b, c) == (
        [{"a": 0, "c": 0}, {"a": 1, "b": 0}, {"b": 1, "c": 1}],
        False,
    )


def test_only_matchings_that_can_count_are_tried() -> None:
    """Of twelve objects and six others there are 1.4 million; two metres apart few are plausible.

    These are the same as of all: the cheapest, and every one that is nearly as cheap.
    """
    rng = np.random.default_rng(7)
    a = in_a_row("a", *(2.0 * k for k in range(12)), common_m=0.3)
    b = in_a_row("b", *(6.0 + 2.0 * k + rng.normal(0.0, 0.1) for k in range(6)), common_m=0.3)
    found = _plausible_matchings(a.places, a.cov, b.places, b.cov)
    assert len(found) < 5000
    assert tuple((k + 3, k) for k in range(6)) in found
    # Of few objects, by hand: all of them, and those below the limit.
    a, b = in_a_row("a", 0.0, 1.0, 3.0, common_m=0.5), in_a_row("b", 1.0, 2.0, common_m=0.5)
    found = _plausible_matchings(a.places, a.cov, b.places, b.cov)
    every = [
        tuple(zip(of_a, of_b, strict=True))
        for size in range(3)
        for of_a in itertools.combinations(range(3), size)
        for of_b in itertools.permutations(range(2), size)
    ]
    assert len(every) == 13
    limit = 2.0 * UNMATCHED * 2 + AMBIGUOUS
    for pairs in every:
        misfit = _misfit(pairs, a.places, a.cov, b.places, b.cov)
        assert (pairs in found) == (misfit <= limit)
        assert found.get(pairs, misfit) == pytest.approx(misfit)


def test_order_and_names_of_lidars_do_not_matter() -> None:
    a = in_a_row("a", 0.0, 1.0, 3.0, common_m=0.5)
    b = in_a_row("b", 3.6, 0.6, 1.6, common_m=0.5)
    forth, back = match_objects((a, b)), match_objects((b, a))
    assert {frozenset(o.seen.items()) for o in forth.objects} == {
        frozenset(o.seen.items()) for o in back.objects
    }


def test_one_object_by_hand() -> None:
    # sqrt(2 (0.3^2 + 0.1^2)) = 0.447 m: 2.4 m apart are 28.8 squared sigmas, 2.5 m are 31.
    a = in_a_row("a", 0.0, common_m=0.3)
    assert one_object((a, in_a_row("b", 2.4, common_m=0.3)))
    assert not one_object((a, in_a_row("b", 2.5, common_m=0.3)))
    assert not one_object((a, in_a_row("b", 0.0, 2.0, common_m=0.3)))


# ------------------------------------------------------------------ a vehicle that drives


def eight() -> tuple[KeptDrive, Config]:
    """Two coarse LiDARs on a figure-eight past a chair and a box in one region."""
    lidar = LidarModel(
        mounting=PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)),
        rate_hz=2.0,
        channels=80,
        horizontal_resolution_deg=0.3,
    )
    rear = PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0))
    objects: dict[str, ObjectModel] = {
        "chair": ChairModel(xy_m=(12.08, 0.0), yaw_deg=180.0),
        "box": BoxModel(xy_m=(11.6, 2.6), size_m=(0.5, 0.45, 0.6), yaw_deg=25.0),
    }
    scenario = Scenario(
        name="eight",
        drive=FigureEightDrive(radius_m=9.16),
        lidars={"front": lidar, "rear": lidar.model_copy(update={"mounting": rear})},
        world=WorldModel(objects=objects, targets=("chair", "box")),
        crop=CropModel(margin_m=0.3, elsewhere_stride=10),
    )
    recording = KeptDrive(scenario, 0)
    raw = written_config(recording, has_bag=True)
    raw["target"] = {"min": [7.0, -5.0, -1.0], "max": [17.0, 6.0, 3.0]}
    raw["registration"] = {"components": 200, "max_points": 200}
    return recording, parse_config(raw, "config.yaml", Path("/nowhere"))


def test_two_objects_of_a_figure_eight_are_two_placements() -> None:
    # Of front and rear, the one sees the chair most often and the other the box.
    recording, config = eight()
    trajectories = smooth_trajectories([recording], config, [[]], {0: recording.motion()})

    observations = extract_targets([recording], trajectories, config, SilentProgress())

    assert len(observations) == 2
    for observation, (x, y) in zip(observations, ((12.08, 0.0), (11.6, 2.6)), strict=True):
        assert np.linalg.norm(observation.centre_map[:2] - np.array([x, y])) < 0.2
        assert {c.lidar for c in observation.clouds} == {"front", "rear"}
        for cloud in observation.clouds:
            T = trajectories[0].poses_at([cloud.stamp_ns])
            mounting = recording.scenario.lidars[cloud.lidar].mounting.pose()
            middle = cloud.points_lidar.mean(axis=0)
            at = T[0][0] @ mounting.transformFrom(middle) + T[1][0]
            assert np.linalg.norm(at[:2] - np.array([x, y])) < 0.45


# ------------------------------------------------------------------ real clouds


@cache
def edgar(name: str) -> CalibrationRun:
    coarse = RegistrationConfig(components=400, max_points=400)
    config = load_config(EDGAR / name).model_copy(update={"registration": coarse})
    return calibrate([open_recording(config)], config, SilentProgress())


@pytest.mark.skipif(not EDGAR.is_dir(), reason=f"the real clouds are not at {EDGAR.name}")
@pytest.mark.parametrize("name", ["config_one_box.yaml", "config_three_boxes.yaml"])
def test_real_boxes_are_within_three_sigmas_or_it_is_said(name: str) -> None:
    # Ours, by generalised ICP on all of the clouds; walls and boxes disagree by 15 mm across.
    T_one_two = gtsam.Pose3(
        gtsam.Rot3.RzRyRx(0.7001, -0.0065, 0.0222), np.array([0.002, -1.231, -0.430])
    )
    run = edgar(name)

    shared = [{c.lidar for c in o.clouds} for o in run.observations]
    assert shared == [{"sensor_1", "sensor_2"}] * 3

    T_one = run.calibration.lidars["sensor_1"].T_vehicle_lidar
    truth = {"sensor_1": T_one, "sensor_2": T_one.compose(T_one_two)}
    (pair,) = evaluate(run.calibration, truth)["pairs"]
    error = np.array([*pair["rotation_rad"], *pair["translation_m"]])
    sigmas = sigmas_s2s(run.calibration, pair["from"], pair["to"])
    code = exit_code(run.calibration)
    assert code != DONE or (np.abs(error) < 3.0 * sigmas).all()
    assert code == DONE or run.calibration.unmet or run.calibration.contradictions
    # No box was taken for another: 2 m apart, they would turn it by 200 mrad.
    assert np.abs(error[:3]).max() < 0.01
    assert np.abs(error[3:]).max() < 0.05
