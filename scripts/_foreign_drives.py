"""Drives of another simulator than the project's: worlds, vehicles, LiDARs, and their bags.

These modules (`_foreign_*.py`) share no code with caliv_graph and import nothing from it. An error
of the project's simulator that its calibration repeats cancels in drives of that simulator, but not
in these. A drive is a folder: a bag (MCAP), config.yaml as a user would write it, and truth.yaml.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scripts._foreign_bag import Bag
from scripts._foreign_draws import Draws
from scripts._foreign_lidar import Lidar, Scene, scan
from scripts._foreign_vehicle import (
    Body,
    Fixes,
    Gnss,
    Imu,
    Motion,
    Segment,
    drive,
    measure_gnss,
    measure_imu,
    measure_poses,
    measure_wheels,
    plan,
)
from scripts._foreign_world import (
    TARGETS,
    Array,
    Grass,
    Ground,
    Mesh,
    Mover,
    Style,
    car,
    make_ground,
    person,
    populate,
)

PLACE = (52.2646, 10.5236, 92.0)
"""Latitude, longitude (deg) and altitude (m) of the map's origin."""

GUESS_OFF_M = 0.045
GUESS_OFF_DEG = 1.5
"""Sigmas of the errors of initial guesses; the config states 0.05 m and 1.7 degrees."""

TAPE_SIGMA_M = 0.005
"""Of lever arms that are measured by hand."""

TARGET_TRIES = 400


@dataclass(frozen=True)
class Scenario:
    """One kind of drive.

    Attributes:
        segments: of the course.
        lidars: by name.
        style: of the surroundings.
        clear_m: from the path to the surroundings.
        body: of the vehicle.
        box_m: centre and size of a body that hides what is behind it, in the axle frame.
        base_m: base_link in the axle frame.
        imu: None: there is none.
        gnss: None: there is none.
        wheels: whether there is a wheel speed.
        yaw_rate: whether the wheels report one.
        odometry: whether there is an odometry.
        targets: their shapes; none: the config says so.
        search: whether targets are searched for; else the config has boxes.
        uneven: factor of the unevenness of the ground.
        slope_deg: of the ground.
        hill_m: height of a hill in the middle of the path.
        kerbs: whether a street has some.
        grass_m: mean height of what beams meet of grass above the soil; 0: none.
        walker: whether somebody crosses.
        traffic: whether a car passes.
    """

    segments: Sequence[Segment]
    lidars: dict[str, Lidar]
    style: Style = "yard"
    clear_m: float = 5.0
    body: Body = field(default_factory=Body)
    box_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    base_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu: Imu | None = field(default_factory=Imu)
    gnss: Gnss | None = field(default_factory=Gnss)
    wheels: bool = True
    yaw_rate: bool = False
    odometry: bool = False
    targets: tuple[str, ...] = ("chair",)
    search: bool = True
    uneven: float = 1.0
    slope_deg: float = 0.6
    hill_m: float = 0.0
    kerbs: bool = False
    grass_m: float = 0.0
    walker: bool = False
    traffic: bool = False


@dataclass(frozen=True)
class Drive:
    """What happens in a drive, without what sensors make of it."""

    motion: Motion
    scene: Scene
    targets_m: Sequence[Array]


def make_drive(draws: Draws, scenario: Scenario) -> Drive:
    """Draws the world and drives through it."""
    rng = draws.stream("world")
    course = plan(draws, scenario.segments)
    path, yaw = course.xy_m[::50], course.yaw_rad[::50]
    ground = make_ground(
        rng,
        path,
        scenario.style,
        uneven=scenario.uneven * draws.on("uneven"),
        slope_rad=np.radians(scenario.slope_deg),
        hill_m=scenario.hill_m,
        kerbs=scenario.kerbs and draws.on("kerbs"),
        crown=0.022 * draws.on("crown"),
    )
    still = populate(rng, ground, path, yaw, scenario.style, scenario.clear_m)
    targets = _place_targets(draws, scenario, ground, path, still)
    still.add(*ground.mesh().arrays())
    motion = drive(draws, course, ground, scenario.body)
    movers = _movers(rng, scenario, ground, path, yaw) if draws.on("movers") else []
    body = None
    if scenario.box_m is not None:
        body = Mesh()
        body.box(*scenario.box_m)
    grass = None
    if scenario.grass_m:
        grass = Grass(draws.stream("grass"), ground, scenario.grass_m)
    return Drive(motion, Scene(still, movers, body, grass), targets)


def _place_targets(
    draws: Draws, scenario: Scenario, ground: Ground, path: Array, still: Mesh
) -> list[Array]:
    """Adds targets where most of the path is 3.5 to 11 m away, and returns their places."""
    rng = draws.stream("targets")
    near = cKDTree(path)
    least_m = 1.2 if scenario.style == "hall" else 3.0
    vertices, _ = still.arrays()
    within = np.clip(vertices[:, :2], [ground.xs[0], ground.ys[0]], [ground.xs[-1], ground.ys[-1]])
    crowd = cKDTree(vertices[vertices[:, 2] - ground.z(within) > 0.05, :2])
    places: list[Array] = []
    middle = (path.min(0) + path.max(0)) / 2
    half = path.max(0) - middle + scenario.clear_m
    for shape in scenario.targets:
        best, score = path[0] + 6, -1.0
        for _ in range(TARGET_TRIES):
            xy = rng.uniform(path.min(0) - 7, path.max(0) + 7)
            others = [np.linalg.norm(xy - place[:2]) for place in places]
            if scenario.style == "hall" and not (np.abs(xy - middle) < half - 0.8).all():
                continue  # beyond its walls
            if (
                near.query(xy)[0] < least_m
                or crowd.query(xy)[0] < 1.8
                or min(others, default=9) < 5
            ):
                continue
            away = np.linalg.norm(path - xy, axis=1)
            seen = float(np.mean((away > 3.5) & (away < 11)))
            if seen > score:
                best, score = xy, seen
        place = ground.place(best)
        still.add_mesh(TARGETS[shape](), place, rng.uniform(0, 6.28))
        places.append(place)
    return places


def _movers(
    rng: np.random.Generator, scenario: Scenario, ground: Ground, path: Array, yaw: Array
) -> list[Mover]:
    """Somebody who crosses the path, and a car that passes."""
    along = np.array([np.cos(yaw[0]), np.sin(yaw[0])])
    left = np.array([-along[1], along[0]])
    movers = []
    if scenario.walker:
        start, end = path[len(path) // 3] + 4 * left, path[len(path) // 2] - 4 * left
        movers.append(Mover(person(), ground.place(start), ground.place(end), 1.35))
    if scenario.traffic:
        lane = path[0] + 3.6 * left
        start, end = lane - 30 * along, lane + 40 * along
        movers.append(Mover(car(rng), ground.place(start), ground.place(end), 7.0))
    return movers


def simulate(scenario: Scenario, draws: Draws, folder: Path) -> None:
    """Writes bag, config and truth of one drive into a new folder."""
    made = make_drive(draws, scenario)
    folder.mkdir(parents=True)
    config: dict[str, Any] = {
        "data": {"format": "rosbag", "path": "drive"},
        "topics": {},
        "lidars": {},
    }
    truth: dict[str, Any] = {"lidars": {}}
    with Bag(folder / "drive") as bag:
        fixes = _write_motion(bag, config, scenario, draws, made.motion)
        for name, lidar in scenario.lidars.items():
            topic = f"/lidar/{name}/points"
            for sweep in scan(draws, name, lidar, made.motion, made.scene):
                end_s = sweep.start_s + lidar.period_s
                bag.cloud(topic, name, sweep, lidar.time_field, end_s)
            config["lidars"][name] = {"topic": topic}
    base = np.array(scenario.base_m)
    guess = draws.stream("guess")
    for name, lidar in scenario.lidars.items():
        xyz, turn = np.array(lidar.xyz_m) - base, Rotation.from_matrix(lidar.mounting)
        config["lidars"][name] |= _guess(guess, xyz, turn)
        pose = {"translation": xyz.tolist(), "quaternion_xyzw": turn.as_quat().tolist()}
        truth["lidars"][name] = {"T_vehicle_lidar": pose, "time_offset": 0.0}
    config["ground"] = {"use": True, "vehicle_height": float(base[2]), "sigma": 0.01}
    if not scenario.targets:
        config["target"] = False
    elif not scenario.search:
        # The map of a config begins at the first fix.
        first = np.zeros(3) if fixes is None else fixes.position_m[0]
        config["target"] = [
            {
                "min": (place - first - [1.5, 1.5, 0.6]).round(2).tolist(),
                "max": (place - first + [1.5, 1.5, 2.0]).round(2).tolist(),
                "frame": "map",
            }
            for place in made.targets_m
        ]
    for name, content in (("config.yaml", config), ("truth.yaml", truth)):
        (folder / name).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _write_motion(
    bag: Bag, config: dict[str, Any], scenario: Scenario, draws: Draws, motion: Motion
) -> Fixes | None:
    """Writes the messages of all motion sensors and their part of the config; returns fixes."""
    base = np.array(scenario.base_m)

    def by_tape(xyz_m: Sequence[float], sensor: str) -> list[float]:
        off = draws.on("lever_arm") * TAPE_SIGMA_M * draws.stream(f"{sensor} arm").normal(size=3)
        return list((np.array(xyz_m) - base + off).round(3).tolist())

    fixes = None
    topics = config["topics"]
    if scenario.imu is not None:
        imu = scenario.imu
        bag.imu("/imu/data", imu, measure_imu(draws, motion, imu, PLACE[0], PLACE[2]))
        topics["imu"] = "/imu/data"
        turn = np.degrees(imu.rpy_rad).round(3).tolist()
        mounting = {"xyz": by_tape(imu.xyz_m, "imu"), "rpy_deg": turn}
        config["imu"] = {"T_vehicle_imu": mounting, "rotation_sigma_deg": 0.1}
    if scenario.gnss is not None:
        fixes = measure_gnss(draws, motion, scenario.gnss)
        bag.fixes("/gnss/fix", fixes, PLACE)
        topics["gnss"] = "/gnss/fix"
        arm = by_tape(scenario.gnss.antenna_m, "gnss")
        config["gnss"] = {"lever_arm": arm, "lever_arm_sigma": 0.01}
    if scenario.wheels:
        bag.wheels("/vehicle/twist", measure_wheels(draws, motion), scenario.yaw_rate)
        topics["twist"] = "/vehicle/twist"
        if np.any(base):
            mounting = {"xyz": (-base).tolist(), "rpy_deg": [0, 0, 0]}
            config["wheels"] = {"T_vehicle_wheels": mounting}
    if scenario.odometry:
        bag.odometry("/odom", measure_poses(draws, motion), base)
        topics["pose"] = "/odom"
    return fixes


def _guess(rng: np.random.Generator, xyz_m: Array, turn: Rotation) -> dict[str, Any]:
    """Initial guess of a LiDAR, as measured by hand."""
    off = Rotation.from_rotvec(np.radians(GUESS_OFF_DEG) * rng.normal(size=3))
    yaw, pitch, roll = (off * turn).as_euler("ZYX", degrees=True).round(2).tolist()
    xyz = xyz_m + GUESS_OFF_M * rng.normal(size=3)
    return {
        "initial": {"xyz": xyz.round(3).tolist(), "rpy_deg": [roll, pitch, yaw]},
        "sigma": {"xyz": 0.05, "rpy_deg": 1.7},
    }


# ------------------------------------------------------------------ scenarios


EIGHT = ((2, 0, 0), (4, 2.5, 0), (19, 2.6, 0.13), (19, 2.6, -0.13), (3, 2, 0), (2, 0, 0))
SWING = (
    *((2, 0, 0), (7, 3, 0), (5, 3, 0.12), (6, 3, -0.14), (5, 2.5, 0.13), (6, 2, -0.1)),
    *((4, 3, 0), (2, 0, 0)),
)
SWING_EIGHT = (*SWING, *EIGHT[1:4])
PARK = (
    *((2, 0, 0), (5, 2.2, 0), (5, 1.8, 0.16), (2, 0, -0.1), (6, -1.4, -0.18), (2, 0, 0.1)),
    *((6, 1.6, 0.18), (2, 0, 0), (5, -1.5, 0.05), (2, 0, -0.1), (7, 2, -0.16), (5, 2.4, 0.02)),
    (2, 0, 0),
)
BENDS = (
    *((1.5, 0, 0), (7, 6, 0), (4.5, 4.2, 0.085), (7, 7, 0), (5.5, 4.5, -0.08), (7, 6.5, 0)),
    *((3, 2, 0), (1.5, 0, 0)),
)
ROUND = (
    *((1.5, 0, 0), (5, 5.5, 0), (2.5, 4.5, -0.08), (15, 4.6, 0.075), (2.5, 4.5, -0.08)),
    *((5, 5.5, 0), (2, 1, 0), (1.5, 0, 0)),
)
SLALOM = (
    *((1.5, 0, 0), (4, 3.5, 0)),
    *((3.2, 3.6, side * 0.09) for side in (1, -1) * 5),
    *((4, 3, 0), (1.5, 0, 0)),
)
ROBOT = (
    *((2, 0, 0), (6, 0.9, 0), (6, 0.7, 0.7), (5, 0.9, -0.2), (7, 0.8, -0.8), (4, 0.4, 1.2)),
    *((7, 0.9, 0.1), (6, 0.8, 0.6), (2, 0, 0)),
)
HILL = (
    *((1.5, 0, 0), (6, 4, 0.01), (6, 5, 0.05), (6, 5, -0.06), (6, 5, 0.05), (6, 5, -0.05)),
    *((3, 2, 0), (1.5, 0, 0)),
)
STRAIGHT = ((1.5, 0, 0), (8, 4, 0.004), (8, 5, -0.005), (8, 4, 0.02), (4, 2, 0), (1.5, 0, 0))

ROOF_LEFT = Lidar((1.25, 0.55, 1.78), (2.0, 1.5, 35.0))
ROOF = {
    "roof_left": ROOF_LEFT,
    "roof_right": Lidar((1.22, -0.56, 1.80), (-12.0, 3.0, -40.0), phase_s=0.044, time_field="time"),
}
YARD_PAIR = {
    "front": Lidar((3.6, 0.05, 0.7), (0, 2, 1), "solid", 110, columns=460, noise_m=0.01),
    "roof": Lidar((1.2, -0.1, 1.9), (0.5, 0.7, -90), channels=64, fov_deg=(-25, 10), columns=900),
}
TRUCK = Body(
    wheelbase_m=4.8,
    track_m=2.0,
    frequency_hz=1.2,
    damping=0.3,
    roll_gain_rad=0.007,
    pitch_gain_rad=0.0035,
)
CORNER_SPINNING = Lidar(
    (5.85, 1.30, 0.85),
    (0, 8, 50),
    channels=64,
    fov_deg=(-25, 15),
    columns=900,
    noise_m=0.006,
    quantum_m=0.001,
    time_field="timestamp",
)
CORNER_SOLID = Lidar(
    (5.85, -1.30, 0.85),
    (1, 7, -50),
    "solid",
    90,
    columns=420,
    phase_s=0.03,
    noise_m=0.012,
    quantum_m=0.004,
    time_field="timestamp",
)
CORNERS = {
    "front_left": CORNER_SPINNING,
    "front_right": CORNER_SOLID,
    "rear_left": replace(
        CORNER_SOLID, xyz_m=(-1.75, 1.28, 0.95), rpy_deg=(-2, 9, 140), phase_s=0.06
    ),
    "rear_right": replace(
        CORNER_SPINNING, xyz_m=(-1.75, -1.28, 0.95), rpy_deg=(0, 8, -140), phase_s=0.08
    ),
}
BOT = Body(
    wheelbase_m=0.7,
    track_m=0.55,
    frequency_hz=4.0,
    damping=0.5,
    roll_gain_rad=0.001,
    pitch_gain_rad=0.001,
    slip_gain_rad=0.0,
)
BOT_TOP = Lidar(
    (0.25, 0.0, 0.72),
    (1.0, -2.0, 3.0),
    channels=16,
    fov_deg=(-15, 15),
    columns=1800,
    noise_m=0.01,
    time_field="time",
    max_range_m=60,
)
BOT_DOME = Lidar(
    (0.42, 0.12, 0.38),
    (178.0, 15.0, -20.0),
    "dome",
    20,
    fov_deg=(-7, 52),
    columns=1000,
    phase_s=0.02,
    noise_m=0.012,
    quantum_m=0.001,
    max_range_m=40,
    time_field="offset_time",
)
BOT_SIDE = Lidar((0.1, -0.25, 0.5), (88.0, 3.0, 10.0), phase_s=0.05, max_range_m=60)
ROSETTE = Lidar(
    (3.5, 0.3, 0.6),
    (0, 0, 12),
    "rosette",
    20,
    fov_deg=(-35, 35),
    columns=1200,
    noise_m=0.01,
    time_field="offset_time",
    phase_s=0.02,
)
HILL_WIDE = Lidar(
    (1.2, -0.5, 1.75), (4, 20, -60), channels=128, fov_deg=(-25, 15), columns=512, phase_s=0.07
)
INS = Imu(
    rate_hz=400,
    xyz_m=(1.3, 0, 0.4),
    orientation=True,
    accel_density=5e-4,
    gyro_density=5e-5,
    accel_bias=0.01,
    gyro_bias=5e-4,
)
LIGHT_IMU = Imu(
    rate_hz=100,
    xyz_m=(0.3, 0.0, 0.25),
    accel_density=0.002,
    gyro_density=2.5e-4,
    accel_bias=0.06,
    gyro_bias=0.006,
    vibration_m_s2=0.04,
)

SCENARIOS: dict[str, Scenario] = {
    "eight": Scenario(EIGHT, ROOF),
    "yard_s": Scenario(
        SWING,
        YARD_PAIR,
        targets=("boxes",),
        walker=True,
        traffic=True,
        base_m=(1.35, 0, 0.35),
        imu=INS,
    ),
    "truck": Scenario(
        SWING_EIGHT,
        CORNERS,
        clear_m=8,
        body=TRUCK,
        box_m=((2.0, 0.0, 1.8), (7.4, 2.3, 2.6)),
        targets=("bin",),
        gnss=Gnss(rate_hz=10, antenna_m=(5.2, 0.6, 3.2), time_s=80),
    ),
    "parking": Scenario(
        PARK,
        ROOF,
        targets=("bicycle",),
        search=False,
        gnss=Gnss(rate_hz=10, worse_s=(14, 24)),
    ),
    "street": Scenario(
        BENDS,
        ROOF,
        "street",
        clear_m=6,
        targets=(),
        kerbs=True,
        traffic=True,
        walker=True,
        uneven=1.3,
    ),
    "roundabout": Scenario(
        ROUND,
        ROOF,
        "open",
        targets=("boxes", "chair"),
        wheels=False,
        search=False,
        imu=Imu(rate_hz=100, xyz_m=(1.3, 0.2, 0.6), rpy_rad=(0, 0, np.pi / 2)),
    ),
    "slalom": Scenario(SLALOM, {"roof_left": ROOF_LEFT, "rosette": ROSETTE}, "open"),
    "robot": Scenario(
        ROBOT,
        {"top": BOT_TOP, "livox": BOT_DOME},
        "hall",
        clear_m=2.5,
        body=BOT,
        imu=None,
        gnss=None,
        wheels=False,
        odometry=True,
        targets=(),
        slope_deg=0.1,
        uneven=0.3,
    ),
    "yardbot": Scenario(
        ROBOT,
        {"top": BOT_TOP, "side": BOT_SIDE},
        clear_m=3.5,
        body=BOT,
        imu=LIGHT_IMU,
        gnss=Gnss(antenna_m=(0.0, 0, 0.9), rate_hz=10),
        slope_deg=1.0,
        uneven=1.5,
    ),
    "hill": Scenario(
        HILL,
        {"a": ROOF_LEFT, "b": HILL_WIDE},
        "open",
        clear_m=6,
        targets=("bin",),
        hill_m=4.0,
        traffic=True,
        gnss=Gnss(time_s=100),
    ),
    "noimu": Scenario(
        SWING_EIGHT, ROOF, imu=None, yaw_rate=True, gnss=Gnss(rate_hz=10), targets=()
    ),
    "meadow": Scenario(
        SWING_EIGHT,
        {
            "mast": replace(ROOF_LEFT, xyz_m=(1.9, 0.0, 2.3), rpy_deg=(1.0, 12.0, 2.0)),
            "hood": Lidar((2.6, -0.1, 1.3), (0, 6, -2), "solid", 90, columns=420, phase_s=0.03),
        },
        "open",
        body=Body(wheelbase_m=2.6, track_m=1.7),
        targets=("bin",),
        grass_m=0.03,
        uneven=1.5,
    ),
    "straightish": Scenario(STRAIGHT, ROOF, "street", clear_m=6, targets=(), kerbs=True),
}
