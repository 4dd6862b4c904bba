"""The other simulator: its LiDARs see what is there, and its draws do not hang on each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from caliv_graph._open3d import import_open3d
from caliv_graph.config.load import load_config
from caliv_graph.readers import open_recording
from caliv_graph.results.truth_file import read_truth
from scripts import benchmark_foreign as benchmark
from scripts._foreign_draws import EFFECTS, Draws
from scripts._foreign_drives import SCENARIOS, simulate
from scripts._foreign_lidar import Kind, Lidar, Scene, Sweep, scan
from scripts._foreign_random import in_words, random_scenario
from scripts._foreign_vehicle import Gnss, Imu, Motion, measure_gnss, measure_imu
from scripts._foreign_world import Array, Grass, Ground, Mesh
from scripts._judged import rows_of

SCRIPTS = Path(benchmark.__file__).parent
WALL_X_M = 8.0
ALL = frozenset(EFFECTS)


@pytest.fixture(autouse=True, scope="module")
def _open3d() -> None:
    import_open3d()


@pytest.fixture(scope="module")
def motion() -> Motion:
    """Half a second at 4 m/s, turning and rolling."""
    t = np.linspace(0.0, 0.6, 61)
    values = np.column_stack([4 * t, 0.3 * t, 0 * t, 0.05 * t, 0.02 * t, 0.4 * t])
    return Motion(t, CubicSpline(t, values), np.full(61, 4.0), np.full(61, 0.4))


@pytest.fixture(scope="module")
def wall() -> Scene:
    mesh = Mesh()
    mesh.box((WALL_X_M + 0.5, 0.0, 0.0), (1.0, 60.0, 60.0))
    return Scene(mesh, [], None)


def a_lidar(kind: Kind) -> Lidar:
    fov_deg = (-35.0, 35.0) if kind == "rosette" else (-20.0, 30.0)
    return Lidar((1.0, 0.3, 1.5), (5.0, -3.0, 10.0), kind, 16, fov_deg, 400)


def in_world(lidar: Lidar, motion: Motion, sweep: Sweep) -> Array:
    """The points of a sweep, by the true poses and the true mounting."""
    turns, places = motion.pose(sweep.start_s + sweep.time_s)
    in_axle = sweep.points @ lidar.mounting.T + lidar.xyz_m
    return np.asarray(np.einsum("nij,nj->ni", turns, in_axle) + places)


@pytest.mark.parametrize("kind", ["spinning", "solid", "rosette", "dome"])
def test_without_effects_points_are_on_the_wall(kind: Kind, motion: Motion, wall: Scene) -> None:
    lidar = replace(a_lidar(kind), max_range_m=20.0)

    sweeps = list(scan(Draws("wall", 1, ALL), "front", lidar, motion, wall))

    assert len(sweeps) == 4
    for sweep in sweeps:
        assert len(sweep.points) > 500
        np.testing.assert_allclose(in_world(lidar, motion, sweep)[:, 0], WALL_X_M, atol=1e-3)


def test_an_effect_of_a_lidar_changes_nothing_else(motion: Motion, wall: Scene) -> None:
    lidar = replace(a_lidar("spinning"), max_range_m=20.0, divergence_rad=1e-4)

    def scanned(*off: str) -> list[Sweep]:
        return list(scan(Draws("wall", 1, frozenset(off)), "front", lidar, motion, wall))

    # Such thin beams have no edges on a wall: the other draws are the same to the bit.
    for one, other in zip(scanned("dropouts"), scanned("dropouts", "edges"), strict=True):
        np.testing.assert_array_equal(one.points, other.points)
    for some, every in zip(scanned(), scanned("dropouts"), strict=True):
        assert len(some.points) < len(every.points)
        assert set(map(tuple, some.points)) < set(map(tuple, every.points))


def test_grass_lifts_what_is_seen_of_the_ground_and_of_nothing_else(motion: Motion) -> None:
    xs = np.arange(-40.0, 40.0, 0.5)
    ground, mesh = Ground(xs, xs, np.zeros((len(xs), len(xs)))), Mesh()
    mesh.box((WALL_X_M + 0.5, 0.0, 15.0), (1.0, 60.0, 30.0))
    mesh.add(*ground.mesh().arrays())
    grass = Grass(np.random.default_rng(1), ground, 0.03)
    lidar = replace(a_lidar("spinning"), max_range_m=12.0, fov_deg=(-40.0, 30.0))
    draws = Draws("lawn", 1, ALL - {"grass"})

    sweeps = list(scan(draws, "front", lidar, motion, Scene(mesh, [], None, grass)))

    x, _, z = np.concatenate([in_world(lidar, motion, sweep) for sweep in sweeps]).T
    below = z[(z < 0.5) & (x < WALL_X_M - 0.5)]
    assert len(below) > 1000
    assert below.mean() == pytest.approx(0.03, abs=0.006)
    assert below.min() > -1e-4
    np.testing.assert_allclose(x[z > 0.5], WALL_X_M, atol=1e-3)


def test_a_stretch_of_worse_fixes_is_the_only_one_that_changes(motion: Motion) -> None:
    gnss = Gnss(rate_hz=20, worse_s=(0.2, 0.3))

    worse = measure_gnss(Draws("wall", 1), motion, gnss)
    usual = measure_gnss(Draws("wall", 1, frozenset({"gnss_worse"})), motion, gnss)

    changed = np.any(worse.position_m != usual.position_m, axis=1)
    assert changed.any()
    np.testing.assert_array_equal(changed, (worse.t_s > 0.2) & (worse.t_s < 0.3))
    np.testing.assert_array_equal(worse.arrival_s, usual.arrival_s)


def test_an_imu_without_effects_measures_gravity_and_the_turning_earth() -> None:
    t = np.linspace(0.0, 1.0, 101)
    values = np.zeros((101, 6))
    still = Motion(t, CubicSpline(t, values), np.zeros(101), np.zeros(101))

    samples = measure_imu(Draws("still", 1, ALL), still, Imu(), 45.0, 0.0)

    np.testing.assert_allclose(samples.force_m_s2, [[0, 0, 9.8062]] * len(samples.t_s), atol=1e-4)
    earth = 7.292e-5 * np.sqrt(0.5)
    np.testing.assert_allclose(
        samples.rate_rad_s, [[0, earth, earth]] * len(samples.t_s), atol=1e-7
    )
    assert Rotation.from_quat(samples.xyzw).magnitude().max() < 1e-9


def messages(folder: Path) -> Iterator[tuple[str, int, bytes]]:
    with Reader(folder / "drive") as reader:
        for connection, stamp_ns, content in reader.messages():
            yield connection.topic, stamp_ns, bytes(content)


def test_the_same_seed_gives_the_same_drive_which_the_program_reads(tmp_path: Path) -> None:
    whole = SCENARIOS["yardbot"]
    short = replace(whole, segments=((0.4, 0.5, 0.0), (0.6, 0.9, 0.3)))
    draws = {
        "one": Draws("short", 1),
        "again": Draws("short", 1),
        "exact_arms": Draws("short", 1, frozenset({"lever_arm"})),
    }
    for name, of in draws.items():
        simulate(short, of, tmp_path / name)

    one = list(messages(tmp_path / "one"))
    assert one == list(messages(tmp_path / "again"))
    assert one == list(messages(tmp_path / "exact_arms"))
    configs = {name: load_config(tmp_path / name / "config.yaml") for name in draws}
    assert configs["one"].lidars == configs["exact_arms"].lidars
    assert configs["one"].gnss != configs["exact_arms"].gnss
    truth = read_truth(tmp_path / "one" / "truth.yaml")
    assert truth.keys() == short.lidars.keys()
    recording = open_recording(configs["one"], None)
    assert all(len(recording.scan_stamps_ns(name)) > 3 for name in truth)


def test_every_scenario_seed_and_name_has_a_stream_of_its_own() -> None:
    draws = [Draws("eight", 1), Draws("eight", 2), Draws("slalom", 1)]
    first = {of.stream(name).random() for of in draws for name in ("imu arm", "gnss arm")}

    assert len(first) == 6
    assert Draws("eight", 1).stream("imu arm").random() in first


def test_unknown_effects_are_refused() -> None:
    with pytest.raises(ValueError, match="no such effect: edge"):
        Draws("eight", 1, frozenset({"edge"}))
    with pytest.raises(SystemExit):
        benchmark.main(["--off", "edge"])


def test_the_simulator_imports_nothing_from_the_program() -> None:
    own = {f"scripts.{path.stem}" for path in SCRIPTS.glob("_foreign_*.py")}
    assert len(own) > 4
    for path in SCRIPTS.glob("_foreign_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert name.split(".")[0] not in ("caliv_graph", "scripts") or name in own, path


def test_the_errors_of_a_run_are_shown_with_sigmas() -> None:
    of = {"error": [1e-3] * 5 + [None], "sigma": [5e-4] * 6, "nees": 20.0, "axes": 5}
    outcome = {"errors": {"S2V front": of}, "undetermined": ["height"], "said": []}

    row, undetermined = rows_of(outcome)

    assert "roll 1.00 ± 0.50" in row
    assert "z " not in row
    assert row.endswith("NEES 20.0 of 5, worst 2.0 sigmas")
    assert undetermined == "  not determined: height"


def test_a_random_drive_is_the_same_for_the_same_seed_and_has_room_for_its_lidars() -> None:
    for seed in range(1, 60):
        scenario = random_scenario(seed)
        assert scenario == random_scenario(seed)
        assert in_words(scenario) == in_words(random_scenario(seed))
        assert scenario.gnss is not None or scenario.odometry
        if scenario.box_m is not None:
            centre, size = np.array(scenario.box_m)
            for lidar in scenario.lidars.values():
                assert (np.abs(lidar.xyz_m - centre) > size / 2 + 0.05).any()
    assert len({in_words(random_scenario(seed)) for seed in range(1, 60)}) == 59
