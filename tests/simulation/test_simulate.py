"""The written folder, read back with nothing of the simulation's own, and its truth."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.common.progress import SilentProgress, StageRecord
from caliv_graph.config.load import load_config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError, OutputError
from caliv_graph.products import Array
from caliv_graph.readers.caliv_folder import CalivFolder
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import CropModel, InitialGuessModel, SuspensionModel
from caliv_graph.scenario.sensor_models import LidarModel, PoseNoiseModel, SweepModel
from caliv_graph.scenario.world import make_world
from caliv_graph.scenario.world_models import ChairModel, WorldModel
from caliv_graph.simulation import (
    Scenario,
    SimulatedDrive,
    load_scenario,
    simulate_caliv,
    write_drive,
)
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.simulation.simulate import Format

SCENARIOS = Path(__file__).parents[2] / "configs" / "scenarios"

SMALL = Scenario(
    name="small",
    drive=ArcDrive(duration_s=5.0),
    lidars={
        "front": LidarModel(
            mounting=PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)),
            channels=24,
            horizontal_resolution_deg=1.0,
        ),
        "side": LidarModel(
            mounting=PoseConfig(xyz=(1.0, -0.8, 1.5), rpy_deg=(1.0, 12.0, -80.0)),
            rate_hz=5.0,
            channels=16,
            horizontal_fov_deg=(-180.0, 180.0),
            horizontal_resolution_deg=2.0,
            max_range_m=60.0,
        ),
    },
    world=WorldModel(objects={"chair": ChairModel(xy_m=(9.0, -3.0))}, targets=("chair",)),
)

QUIET = SMALL.model_copy(
    update={
        "lidars": {
            name: lidar.model_copy(update={"range_sigma_m": 0.0})
            for name, lidar in SMALL.lidars.items()
        },
        "poses": PoseNoiseModel(position_sigma_m=0.0, rotation_sigma_rad=0.0),
        "suspension": SuspensionModel(height_sigma_m=0.02, heave_sigma_m=0.01),
        "initial_guess": InitialGuessModel(translation_m=0.0, rotation_deg=0.0),
    }
)


def parse_pcd(path: Path) -> tuple[dict[str, str], Array]:
    """Header and (n, 3) points of a binary PCD, by the book and by nothing else."""
    data = path.read_bytes()
    end = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    lines = data[:end].decode("ascii").splitlines()
    header = dict(line.split(" ", 1) for line in lines if not line.startswith("#"))
    points = np.frombuffer(data[end:], dtype="<f4").reshape(-1, 3)
    return header, points.astype(np.float64)


def parse_poses(folder: Path) -> dict[str, dict[int, gtsam.Pose3]]:
    raw = yaml.safe_load((folder / "caliv/input/ego_poses.yaml").read_text(encoding="utf-8"))
    return {
        sensor: {int(file.removesuffix(".pcd")): pose_from(values) for file, values in entries}
        for sensor, entries in raw.items()
    }


def pose_from(values: Any) -> gtsam.Pose3:
    x, y, z, qx, qy, qz, qw = (float(v) for v in values)
    return gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))


def true_poses(folder: Path) -> dict[int, gtsam.Pose3]:
    rows = [line.split() for line in (folder / "trajectory.tum").read_text().splitlines()]
    return {round(float(row[0]) * 10.0): pose_from(row[1:]) for row in rows}


def true_mountings(folder: Path) -> dict[str, gtsam.Pose3]:
    truth = yaml.safe_load((folder / "truth.yaml").read_text(encoding="utf-8"))
    return {
        name: pose_from(
            lidar["T_vehicle_lidar"]["translation"] + lidar["T_vehicle_lidar"]["quaternion_xyzw"]
        )
        for name, lidar in truth["lidars"].items()
    }


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SimulatedDrive:
    return simulate_caliv(SMALL, tmp_path_factory.mktemp("small") / "drive", 7, threads=1)


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> SimulatedDrive:
    return simulate_caliv(QUIET, tmp_path_factory.mktemp("quiet") / "drive", 7)


def test_folder_holds_what_it_should_and_nothing_else(small: SimulatedDrive) -> None:
    folder = small.folder
    assert sorted(path.name for path in folder.iterdir()) == [
        "caliv",
        "config.yaml",
        "scenario.yaml",
        "trajectory.tum",
        "truth.yaml",
    ]
    assert [path.name for path in (folder / "caliv").iterdir()] == ["input"]
    assert sorted(path.name for path in (folder / "caliv/input").iterdir()) == [
        "ego_poses.yaml",
        "sensor_1",
        "sensor_2",
    ]
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    # 5 s: 51 frames, of which the second LiDAR, at 5 Hz, takes every other one.
    frames = {
        sensor: sorted(int(path.stem) for path in (folder / "caliv/input" / sensor).glob("*.pcd"))
        for sensor in ("sensor_1", "sensor_2")
    }
    assert frames == {"sensor_1": list(range(51)), "sensor_2": list(range(0, 51, 2))}
    poses = parse_poses(folder)
    assert {sensor: sorted(entries) for sensor, entries in poses.items()} == frames
    assert len(true_poses(folder)) == 51


def test_clouds_are_binary_pcd_of_floats(small: SimulatedDrive) -> None:
    for sensor, name in (("sensor_1", "front"), ("sensor_2", "side")):
        for frame, count in zip((0, 2), (0, 1) if name == "side" else (0, 2), strict=True):
            path = small.folder / "caliv/input" / sensor / f"{frame}.pcd"
            header, points = parse_pcd(path)
            assert header == {
                "VERSION": "0.7",
                "FIELDS": "x y z",
                "SIZE": "4 4 4",
                "TYPE": "F F F",
                "COUNT": "1 1 1",
                "WIDTH": str(len(points)),
                "HEIGHT": "1",
                "VIEWPOINT": "0 0 0 1 0 0 0",
                "POINTS": str(len(points)),
                "DATA": "binary",
            }
            assert len(points) == small.scans[name].points[count]
            assert np.isfinite(points).all()


def test_project_s_own_reader_takes_the_folder(small: SimulatedDrive) -> None:
    config = load_config(small.folder / "config.yaml")
    assert config.data.format == "caliv"
    assert config.data.path is not None
    recording = CalivFolder(config.data.path, config.lidars)
    assert recording.lidars == ("front", "side")
    assert recording.warnings() == ()
    for name in recording.lidars:
        counts = tuple(len(scan.points_lidar) for scan in recording.scans(name))
        assert counts == small.scans[name].points


def test_quiet_points_lie_on_the_world_seen_from_the_written_truth(quiet: SimulatedDrive) -> None:
    world = make_world(QUIET.world)
    caster = RayCaster(world)
    poses, extrinsics = true_poses(quiet.folder), true_mountings(quiet.folder)
    for sensor, name in (("sensor_1", "front"), ("sensor_2", "side")):
        assert max(quiet.scans[name].target_points) > 5
        for frame in (0, 20, 34, 50):
            _, points_lidar = parse_pcd(quiet.folder / "caliv/input" / sensor / f"{frame}.pcd")
            T_map_lidar = poses[frame].compose(extrinsics[name])
            points_map = T_map_lidar.transformFrom(points_lidar.T).T
            assert caster.distance(points_map).max() < 1e-4


def test_without_noise_given_poses_and_guesses_are_the_truth(quiet: SimulatedDrive) -> None:
    true = true_poses(quiet.folder)
    for entries in parse_poses(quiet.folder).values():
        for frame, pose in entries.items():
            assert pose.equals(true[frame], 1e-9)
    config = load_config(quiet.folder / "config.yaml")
    for name, lidar in config.lidars.items():
        assert lidar.given.xyz == pytest.approx(QUIET.lidars[name].mounting.xyz)
        assert lidar.given.rpy_deg == pytest.approx(QUIET.lidars[name].mounting.rpy_deg)


def test_vehicle_heaves_about_a_height_of_its_own(quiet: SimulatedDrive) -> None:
    z = np.array([pose.translation()[2] for pose in true_poses(quiet.folder).values()])
    assert 0.007 < z.std() < 0.013
    assert abs(z.mean()) < 0.06


def test_given_poses_are_noisy_and_common_to_the_sensors(small: SimulatedDrive) -> None:
    true, given = true_poses(small.folder), parse_poses(small.folder)
    position = np.array(
        [
            pose.translation() - true[frame].translation()
            for frame, pose in given["sensor_1"].items()
        ]
    )
    assert position.std() == pytest.approx(0.005, rel=0.25)
    for frame, pose in given["sensor_2"].items():
        assert pose.equals(given["sensor_1"][frame], 1e-12)


def test_truth_has_the_keys_of_its_format(small: SimulatedDrive) -> None:
    truth = yaml.safe_load((small.folder / "truth.yaml").read_text(encoding="utf-8"))
    assert list(truth) == ["lidars"]
    assert list(truth["lidars"]) == ["front", "side"]
    for lidar in truth["lidars"].values():
        assert list(lidar) == ["T_vehicle_lidar", "time_offset"]
        assert list(lidar["T_vehicle_lidar"]) == ["translation", "quaternion_xyzw"]
        assert lidar["time_offset"] == 0.0
    front = truth["lidars"]["front"]["T_vehicle_lidar"]
    assert front["translation"] == [2.0, 0.0, 2.0]
    # 10 degrees about y.
    assert front["quaternion_xyzw"] == pytest.approx([0.0, 0.0871557427, 0.0, 0.9961946981])


def test_config_is_ready_to_run(small: SimulatedDrive) -> None:
    config = load_config(small.folder / "config.yaml")
    assert config.data.path == small.folder / "caliv"
    assert config.reference == "front"
    assert [lidar.topic for lidar in config.lidars.values()] == ["sensor_1", "sensor_2"]
    assert config.lidars["side"].max_range == 60.0
    assert config.ground.vehicle_height == 0.0
    assert config.ground.sigma == 0.005
    assert config.noise.lidar_range_m == 0.01
    assert config.noise.pose_position_m == 0.005
    assert config.noise.pose_rotation_deg == pytest.approx(0.0573, abs=1e-4)
    assert config.noise.pose_drift_position_m is None
    assert config.target
    (region,) = config.target
    assert region.min == pytest.approx((9.0 - 0.40 - 5.0, -3.0 - 0.36 - 5.0, -5.0), abs=0.01)
    assert region.max == pytest.approx((9.0 + 0.37 + 5.0, -3.0 + 0.36 + 5.0, 6.25), abs=0.01)
    extrinsics = true_mountings(small.folder)
    for name, lidar in config.lidars.items():
        shift = np.array(lidar.given.xyz) - extrinsics[name].translation()
        assert 0.001 < np.abs(shift).max() <= 0.1
        guess = gtsam.Rot3.RzRyRx(np.radians(lidar.given.rpy_deg))
        turn = np.degrees(extrinsics[name].rotation().between(guess).rpy())
        assert 0.05 < np.abs(turn).max() <= 3.0 + 1e-5
        assert lidar.sigma.xyz == pytest.approx(0.1 / 3.0**0.5)
        assert lidar.sigma.rpy_deg == pytest.approx(3.0 / 3.0**0.5)


def test_drift_is_stated_as_what_it_comes_to(tmp_path: Path) -> None:
    poses = PoseNoiseModel(position_walk_m_sqrts=0.01, rotation_walk_rad_sqrts=0.0002)
    drive = simulate_caliv(SMALL.model_copy(update={"poses": poses}), tmp_path / "drive", 0)
    noise = load_config(drive.folder / "config.yaml").noise
    assert noise.pose_drift_position_m == pytest.approx(0.01 * 5.0**0.5)
    assert noise.pose_drift_rotation_deg == pytest.approx(np.degrees(0.0002) * 5.0**0.5)


def test_effective_scenario_simulates_the_same_drive_again(
    small: SimulatedDrive, tmp_path: Path
) -> None:
    scenario = load_scenario(small.folder / "scenario.yaml")
    # As many threads as it likes: the bytes are the same.
    again = simulate_caliv(scenario, tmp_path / "again", 7, threads=2)
    assert all_bytes(again.folder) == all_bytes(small.folder)
    assert again.scans == small.scans


def test_another_seed_gives_other_noise(small: SimulatedDrive, tmp_path: Path) -> None:
    other = all_bytes(simulate_caliv(SMALL, tmp_path / "other", 8).folder)
    first = all_bytes(small.folder)
    differing = {name for name in first if first[name] != other.get(name)}
    assert differing == set(first) - {"truth.yaml"}


def test_another_lidar_leaves_the_draws_of_the_others(
    small: SimulatedDrive, tmp_path: Path
) -> None:
    one = SMALL.model_copy(update={"lidars": {"front": SMALL.lidars["front"]}})
    alone = all_bytes(simulate_caliv(one, tmp_path / "alone", 7).folder)
    both = all_bytes(small.folder)
    clouds = [name for name in alone if name.endswith(".pcd")]
    assert len(clouds) == 51
    assert all(alone[name] == both[name] for name in clouds)
    assert alone["trajectory.tum"] == both["trajectory.tum"]


def test_late_stamps_show_the_world_from_where_the_vehicle_was(tmp_path: Path) -> None:
    late = QUIET.lidars["front"].model_copy(update={"time_offset_s": 0.05})
    suspension = SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.0)
    scenario = QUIET.model_copy(update={"lidars": {"front": late}, "suspension": suspension})
    folder = simulate_caliv(scenario, tmp_path / "late", 0).folder
    truth = yaml.safe_load((folder / "truth.yaml").read_text(encoding="utf-8"))
    assert truth["lidars"]["front"]["time_offset"] == 0.05
    on_time = {"front": QUIET.lidars["front"]}
    delayed = ArcDrive(duration_s=5.05, standstill_s=1.05)
    reference = simulate_caliv(
        scenario.model_copy(update={"lidars": on_time, "drive": delayed}), tmp_path / "ref", 0
    ).folder
    for frame in (0, 20, 34, 50):
        name = f"caliv/input/sensor_1/{frame}.pcd"
        np.testing.assert_allclose(
            parse_pcd(folder / name)[1], parse_pcd(reference / name)[1], atol=1e-4
        )
    assert not true_poses(folder)[34].equals(true_poses(reference)[34], 1e-2)


def test_scan_without_a_return_is_not_written(tmp_path: Path) -> None:
    blind = SMALL.lidars["front"].model_copy(update={"max_range_m": 1.5})
    scenario = SMALL.model_copy(update={"lidars": {**SMALL.lidars, "front": blind}})
    drive = simulate_caliv(scenario, tmp_path / "drive", 0)
    assert drive.scans["front"].points == ()
    assert not list((drive.folder / "caliv/input" / "sensor_1").iterdir())
    raw = yaml.safe_load((drive.folder / "caliv/input" / "ego_poses.yaml").read_text())
    assert raw["sensor_1"] == []
    assert len(raw["sensor_2"]) == 26


def test_rate_that_the_folder_cannot_express_is_an_error(tmp_path: Path) -> None:
    for rate_hz in (20.0, 4.0):
        fast = SMALL.lidars["side"].model_copy(update={"rate_hz": rate_hz})
        scenario = SMALL.model_copy(update={"lidars": {"side": fast}})
        with pytest.raises(ConfigError, match=r"lidars\.side\.rate_hz: .* frame every 0\.1 s"):
            simulate_caliv(scenario, tmp_path / "drive", 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phase_s": 0.03}, r"lidars\.side\.phase_s: .* none at 0\.03 s"),
        ({"sweep": SweepModel()}, r"lidars\.side\.sweep: .*\(--format bag\)"),
    ],
)
def test_clouds_that_the_folder_cannot_express_are_an_error(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    side = SMALL.lidars["side"].model_copy(update=changes)
    scenario = SMALL.model_copy(update={"lidars": {"side": side}})
    formats: tuple[Format, ...] = ("caliv", "both")
    for output in formats:
        with pytest.raises(ConfigError, match=message):
            write_drive(scenario, tmp_path / "drive", 0, output=output)
    assert not list(tmp_path.iterdir())


def test_clouds_a_whole_number_of_frames_late_keep_their_frames(tmp_path: Path) -> None:
    side = SMALL.lidars["side"].model_copy(update={"phase_s": 0.3, "rate_hz": 5.0})
    scenario = SMALL.model_copy(update={"lidars": {"side": side}, "reference": "side"})
    folder = simulate_caliv(scenario, tmp_path / "drive", 0).folder
    frames = sorted(int(p.stem) for p in (folder / "caliv/input/sensor_1").glob("*.pcd"))
    assert frames == list(range(3, 50, 2))


def test_both_formats_hold_the_same_clouds(small: SimulatedDrive, tmp_path: Path) -> None:
    drive = write_drive(SMALL, tmp_path / "both", 7, output="both")
    alone, both = all_bytes(small.folder), all_bytes(drive.folder)
    assert {name for name in both if name.startswith("drive/")} == {
        "drive/drive.mcap",
        "drive/metadata.yaml",
    }
    for name in alone:
        if name.startswith("caliv/"):
            assert both[name] == alone[name], name
    assert drive.scans == small.scans
    # The config is for the bag.
    config = load_config(drive.folder / "config.yaml")
    assert config.data.format == "rosbag"
    assert config.lidars["side"].topic == "/lidar/side/points"
    # A later drive of another format replaces all of it.
    write_drive(SMALL, tmp_path / "both", 7, output="caliv", force=True)
    assert all_bytes(tmp_path / "both") == alone


def test_interrupted_bag_leaves_nothing(tmp_path: Path) -> None:
    class Interrupting(SilentProgress):
        def _show(self, record: StageRecord) -> None:
            if record.done == 10:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_drive(SMALL, tmp_path / "drive", 0, progress=Interrupting())
    assert not list(tmp_path.iterdir())


def test_existing_folder_is_not_overwritten_unless_told(
    small: SimulatedDrive, tmp_path: Path
) -> None:
    folder = tmp_path / "drive"
    simulate_caliv(SMALL, folder, 1)
    before = all_bytes(folder)
    with pytest.raises(OutputError, match="exists already"):
        simulate_caliv(SMALL, folder, 7)
    assert all_bytes(folder) == before
    simulate_caliv(SMALL, folder, 7, force=True)
    assert all_bytes(folder) == all_bytes(small.folder)
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


def test_folder_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"holds no truth\.yaml"):
        simulate_caliv(SMALL, folder, 0, force=True)
    (folder / "truth.yaml").write_text("of another kind")
    with pytest.raises(OutputError, match=r"also holds 'thesis\.tex'"):
        simulate_caliv(SMALL, folder, 0, force=True)
    assert (folder / "thesis.tex").read_text() == "years of work"
    file = tmp_path / "file"
    file.write_text("text")
    with pytest.raises(OutputError, match="is a file"):
        simulate_caliv(SMALL, file, 0, force=True)


@pytest.mark.parametrize("force", [False, True])
def test_interruption_leaves_no_half_written_output(tmp_path: Path, force: bool) -> None:
    folder = tmp_path / "drive"
    if force:
        folder.mkdir()
        (folder / "truth.yaml").write_text("older")

    class Interrupting(SilentProgress):
        def _show(self, record: StageRecord) -> None:
            assert record.total == 51
            if record.done == 10:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_caliv(SMALL, folder, 0, force=force, progress=Interrupting())
    assert [path.name for path in tmp_path.iterdir()] == (["drive"] if force else [])
    if force:
        assert all_bytes(folder) == {"truth.yaml": b"older"}


def test_unwritable_place_is_an_error_of_the_output(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("text")
    with pytest.raises(OutputError, match="cannot be written"):
        simulate_caliv(SMALL, tmp_path / "file" / "drive", 0)


def test_demo_arc_is_small_and_both_lidars_see_the_chair_in_turn(tmp_path: Path) -> None:
    drive = simulate_caliv(load_scenario(SCENARIOS / "demo_arc.yaml"), tmp_path / "demo", 1)
    size = sum(len(data) for data in all_bytes(drive.folder).values())
    assert size < 30e6
    sees = {
        name: np.flatnonzero(np.array(scans.target_points) >= 50)
        for name, scans in drive.scans.items()
    }
    assert len(sees["front"]) > 30
    assert len(sees["rear"]) > 30
    assert sees["front"].max() < sees["rear"].min()
    assert max(drive.scans["front"].target_points) > 900
    # As in the authors' clouds: about 150 points at 17 m.
    assert 120 < drive.scans["rear"].target_points[-1] < 200


def test_crop_thins_the_folder_only(small: SimulatedDrive, tmp_path: Path) -> None:
    crop = CropModel(margin_m=0.5, elsewhere_stride=4)
    cropped = simulate_caliv(SMALL.model_copy(update={"crop": crop}), tmp_path / "drive", 7)
    for name in SMALL.lidars:
        assert cropped.scans[name].target_points == small.scans[name].target_points
    full = parse_pcd(small.folder / "caliv/input" / "sensor_1" / "30.pcd")[1]
    part = parse_pcd(cropped.folder / "caliv/input" / "sensor_1" / "30.pcd")[1]
    assert 0 < len(part) < len(full)
    assert {tuple(point) for point in part} <= {tuple(point) for point in full}


def test_open3d_and_rosbags_are_not_imported_before_they_are_needed() -> None:
    code = (
        "import sys, caliv_graph.simulation; "
        "sys.exit('open3d' in sys.modules or 'rosbags' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_seed_below_zero_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="seed"):
        simulate_caliv(SMALL, tmp_path / "drive", -3)
    assert not list(tmp_path.iterdir())
