"""Drives that are drawn at random: vehicle, LiDARs, targets, surroundings and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from pydantic import TypeAdapter

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array
from caliv_graph.scenario.drive_models import DriveModel
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario, parse_scenario

TARGETS = ("chair", "thin_chair", "boxes", "cones", "bicycle", "stroller", "bin")

TARGET_FROM_PATH_M = (2.5, 6.0)
"""Distance of a target from the path of the rear axle: the vehicle passes it, and near."""

WALL_FROM_PATH_M = 4.0
"""Least distance of a wall from the path of the rear axle."""

AROUND_M = 22.0
"""Half side of the square about the path in which walls and walkers are placed."""

LATE_S = 0.03
"""Most that the stamps of a LiDAR are off where its time offset is estimated."""

ARM_SIGMA_M = 0.01
ROTATION_SIGMA_DEG = 0.1
"""Errors of what is measured by hand: the default sigmas of the config."""

_TRIES = 1000


@dataclass(frozen=True)
class RandomDrive:
    """A drive, and what its user tells the program.

    Attributes:
        scenario: vehicle, LiDARs, world and noise.
        seed: of all draws.
        guess: whether the config has initial guesses.
        options: keys of the config that differ from what `simulate` writes, by section.
    """

    scenario: Scenario
    seed: int
    guess: bool
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The drive in a few words; s: sees all around, u: upside down, w: takes sweeps."""
        model = self.scenario
        lidars = [
            f"{lidar.channels}"
            + "s" * (lidar.horizontal_fov_deg[1] > 100.0)
            + "u" * (abs(lidar.mounting.rpy_deg[0]) > 90.0)
            + "w" * (lidar.sweep is not None)
            for lidar in model.lidars.values()
        ]
        objects = model.world.objects
        shapes = [objects[name].shape for name in model.world.targets]
        walls = sum(other.shape == "wall" for other in objects.values())
        parts = [model.drive.kind, "+".join(shapes), f"{walls} walls", "lidars", *lidars]
        parts += [model.config_target] + ["walker"] * bool(model.world.walkers)
        parts += ["no orientation"] * (not model.imu.orientation.enabled)
        parts += ["no wheels"] * (not model.velocity.enabled)
        parts += ["no guess"] * (not self.guess)
        for section, keys in self.options.items():
            parts += [f"{section}.{key}: {value}" for key, value in keys.items()]
        return " ".join(parts)


@dataclass
class _Draw:
    """Random numbers, and the path that objects keep away from."""

    rng: np.random.Generator
    path_xy: Array = field(default_factory=lambda: np.zeros((1, 2)))

    def within(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def one_of(self, values: Sequence[Any], weights: Sequence[float] | None = None) -> Any:
        return values[int(self.rng.choice(len(values), p=weights))]

    def happens(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def place(self, points: Array, low_m: float, high_m: float, around_m: float) -> Array:
        """(2,) a shift that takes points (n, 2) to this distance from the path.

        The distance is that of the nearest point.
        """
        middle = 0.5 * (self.path_xy.min(axis=0) + self.path_xy.max(axis=0))
        half = 0.5 * np.ptp(self.path_xy, axis=0) + around_m
        for _ in range(_TRIES):
            xy: Array = middle + self.rng.uniform(-half, half)
            away = points[:, None] + xy - self.path_xy
            if low_m <= np.sqrt((away**2).sum(axis=-1)).min() <= high_m:
                return xy
        raise ValueError(f"no place at {low_m} to {high_m} m from the path")


def random_drive(seed: int) -> RandomDrive:
    """Draws a drive; the same for the same seed."""
    draw = _Draw(np.random.default_rng([20261123, seed]))
    drive = _drive(draw)
    model = make_drive(TypeAdapter(DriveModel).validate_python(drive))
    stamps_ns = np.arange(0.0, model.duration_s, 0.1) * NANOSECONDS_PER_SECOND
    draw.path_xy = model.states(stamps_ns.astype(np.int64)).position_map[:, :2]
    lidars = _lidars(draw)
    raw = {
        "name": f"random_{seed}",
        "drive": drive,
        "lidars": lidars,
        "world": _world(draw, seed),
        "crop": {"margin_m": 1.0, "elsewhere_stride": _stride(draw, lidars)},
        **_motion_sensors(draw),
        "bag": {"covariances": draw.one_of(["stated", "unknown"], [0.8, 0.2])},
        "suspension": {
            "height_sigma_m": draw.within(0.003, 0.02),
            "heave_sigma_m": draw.within(0.001, 0.01),
        },
        "config_target": draw.one_of(["region", "search"]),
    }
    return RandomDrive(parse_scenario(raw, f"seed {seed}"), seed, guess=draw.happens(0.75))


def with_options(drive: RandomDrive) -> RandomDrive:
    """The same drive with options of the config drawn at random.

    Where `solve.time_offset` is set, the LiDARs' stamps are late or early. Lever arm and rotation
    of the IMU are unknown, off by the sigmas that the program takes by default, or exact.
    """
    draw = _Draw(np.random.default_rng([20261124, drive.seed]))
    model, options = drive.scenario, dict[str, dict[str, Any]]()

    def option(probability: float, section: str, key: str, value: Any) -> bool:
        happens = draw.happens(probability)
        if happens:
            options.setdefault(section, {})[key] = value
        return happens

    if option(0.4, "solve", "time_offset", True):
        lidars = {
            name: lidar.model_copy(update={"time_offset_s": draw.within(-LATE_S, LATE_S)})
            for name, lidar in model.lidars.items()
        }
        model = model.model_copy(update={"lidars": lidars})
    option(0.3, "solve", "mode", draw.one_of(["joint", "staged"]))
    option(0.5, "robust", "kernel", draw.one_of(["tls", "trimmed", "none"]))
    if option(0.2, "gnss", "lever_arm", None):
        options["gnss"]["lever_arm_sigma"] = None
    if option(0.2, "imu", "T_vehicle_imu", {"xyz": [*model.imu.mounting.xyz], "rpy_deg": None}):
        options["imu"]["rotation_sigma_deg"] = None
    option(0.2, "structure", "use", False)
    option(0.1, "ground", "use", False)
    option(0.1, "ground", "parallel_sigma_deg", 0.3)
    if "gnss" not in options and draw.happens(0.5):
        arm = draw.rng.normal(model.gnss.lever_arm, ARM_SIGMA_M)
        options["gnss"] = {"lever_arm": np.round(arm, 4).tolist(), "lever_arm_sigma": None}
    if "imu" not in options and draw.happens(0.5):
        mounting, turn_deg = model.imu.mounting, draw.rng.normal(0.0, ROTATION_SIGMA_DEG, 3)
        R = gtsam.Rot3.Expmap(np.radians(turn_deg)).compose(mounting.pose().rotation())
        rpy_deg = np.round(np.degrees(R.rpy()), 4).tolist()
        T: dict[str, Any] = {"xyz": [*mounting.xyz], "rpy_deg": rpy_deg}
        options["imu"] = {"T_vehicle_imu": T, "rotation_sigma_deg": None}
    return replace(drive, scenario=model, options=options)


def _drive(draw: _Draw) -> dict[str, Any]:
    kind = draw.one_of(["figure_eight", "s_curve", "arc"], [0.55, 0.3, 0.15])
    drive = {
        "kind": kind,
        "start_yaw_deg": draw.within(-180.0, 180.0),
        "speed_m_s": draw.within(1.5, 4.0),
        "radius_m": draw.within(6.0, 13.0),
        "turn": draw.one_of(["left", "right"]),
        "wheelbase_m": draw.within(2.0, 6.0),
    }
    if kind != "figure_eight":
        drive["duration_s"] = draw.within(10.0, 25.0)
    if kind != "arc":
        drive["transition_m"] = draw.within(2.0, 4.0)
    return drive


def _lidars(draw: _Draw) -> dict[str, Any]:
    """One to three LiDARs on a vehicle whose height is drawn, from a small car to a lorry."""
    yaw_deg, top_m = draw.within(-180.0, 180.0), draw.within(1.2, 3.5)
    lidars = {}
    for i in range(draw.one_of([1, 2, 3], [0.1, 0.6, 0.3])):
        lidars[f"lidar_{i}"] = _lidar(draw, yaw_deg, top_m)
        yaw_deg += draw.within(60.0, 180.0)
    return lidars


def _lidar(draw: _Draw, yaw_deg: float, top_m: float) -> dict[str, Any]:
    upside_down, spins = draw.happens(0.15), draw.happens(0.5)
    down_deg, up_deg = draw.within(12.0, 18.0), draw.within(8.0, 15.0)
    rate_hz = draw.one_of([10.0, 20.0], [0.7, 0.3])
    lidar = {
        "mounting": {
            "xyz": [draw.within(-1.0, 4.0), draw.within(-1.0, 1.0), draw.within(0.7, 1.0) * top_m],
            "rpy_deg": [
                draw.within(-5.0, 5.0) + 180.0 * upside_down,
                draw.within(-4.0, 6.0) if spins else draw.within(0.0, 8.0),
                (yaw_deg + 180.0) % 360.0 - 180.0,
            ],
        },
        "horizontal_fov_deg": [-180.0, 180.0] if spins else [-60.0, 60.0],
        "vertical_fov_deg": [-up_deg, down_deg] if upside_down else [-down_deg, up_deg],
        "channels": draw.one_of([16, 32, 64, 128]),
        "horizontal_resolution_deg": draw.one_of([0.2, 0.25, 0.4]),
        "rate_hz": rate_hz,
        "phase_s": draw.within(0.0, 0.04) if draw.happens(0.5) else 0.0,
        "range_sigma_m": draw.within(0.005, 0.03),
        "range_bias_sigma_m": draw.within(0.0, 0.01),
        "incidence_bias_m": draw.within(0.0, 0.004),
        "max_range_m": draw.within(60.0, 150.0),
    }
    if draw.happens(0.5):
        lidar["sweep"] = {
            "time_field": "time",
            "stamp_at": draw.one_of(["start", "end"]),
            "direction": draw.one_of(["clockwise", "counter_clockwise"]),
        }
    return lidar


def _stride(draw: _Draw, lidars: Mapping[str, Any]) -> int:
    """Of which channels and columns beams are cast where no target is.

    The LiDAR with the fewest channels keeps 16 or 32 of them, or all: it must see ground and walls.
    """
    fewest = min(lidar["channels"] for lidar in lidars.values())
    return int(max(fewest // draw.one_of([16, 32]), 1))


def _world(draw: _Draw, seed: int) -> dict[str, Any]:
    """One or two targets, a pole, walls, perhaps one behind a target, and perhaps a walker."""
    objects = {f"target_{i}": _target(draw) for i in range(draw.one_of([1, 2], [0.75, 0.25]))}
    targets = tuple(objects)
    pole_xy = draw.place(np.zeros((1, 2)), 4.0, np.inf, AROUND_M)
    objects["pole"] = {"shape": "pole", "radius_m": 0.1, "xy_m": pole_xy.tolist()}
    for i in range(draw.one_of([0, 1, 3, 6])):
        objects[f"wall_{i}"] = _wall(draw, i + 1)
    if draw.happens(0.25):
        objects["wall_behind"] = _wall_behind(draw, objects["target_0"])
    world: dict[str, Any] = {
        "objects": objects,
        "targets": targets,
        "region_margin_m": draw.within(2.0, 5.0),
        "ground": {"bumps_sigma_m": draw.within(0.001, 0.004), "bumps_seed": seed + 1},
    }
    if draw.happens(0.25):
        ends = [draw.place(np.zeros((1, 2)), 2.5, 15.0, AROUND_M).tolist() for _ in range(2)]
        world["walkers"] = {"walker": {"from_xy_m": ends[0], "to_xy_m": ends[1]}}
    return world


def _target(draw: _Draw) -> dict[str, Any]:
    low_m, high_m = TARGET_FROM_PATH_M
    xy = draw.place(np.zeros((1, 2)), low_m, high_m, high_m)
    shape = draw.one_of(TARGETS)
    return {"shape": shape, "xy_m": xy.tolist(), "yaw_deg": draw.within(-180.0, 180.0)}


def _wall(draw: _Draw, seed: int) -> dict[str, Any]:
    wall = _face(draw, seed)
    yaw_deg = draw.within(-180.0, 180.0)
    along = np.array([math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))])
    points = np.linspace(-0.5, 0.5, 21)[:, None] * wall["length_m"] * along
    xy = draw.place(points, WALL_FROM_PATH_M, np.inf, AROUND_M)
    return {**wall, "xy_m": xy.tolist(), "yaw_deg": yaw_deg}


def _wall_behind(draw: _Draw, target: Mapping[str, Any]) -> dict[str, Any]:
    """A wall that the target stands before, seen from the nearest point of the path."""
    xy = np.array(target["xy_m"])
    away = xy - _nearest(draw.path_xy, xy)
    away /= np.linalg.norm(away)
    yaw_deg = math.degrees(math.atan2(away[1], away[0])) + 90.0 + draw.within(-20.0, 20.0)
    xy_m = (xy + draw.within(1.5, 4.0) * away).tolist()
    return {**_face(draw, 99), "length_m": draw.within(3.0, 6.0), "xy_m": xy_m, "yaw_deg": yaw_deg}


def _nearest(path_xy: Array, xy: Array) -> Array:
    """(2,) the point of a path (n, 2) that is nearest to `xy`."""
    nearest: Array = path_xy[np.linalg.norm(path_xy - xy, axis=1).argmin()]
    return nearest


def _face(draw: _Draw, seed: int) -> dict[str, Any]:
    return {
        "shape": "wall",
        "length_m": draw.within(6.0, 16.0),
        "height_m": draw.within(2.5, 5.0),
        "thickness_m": 0.4,
        "bumps_sigma_m": draw.within(0.002, 0.008),
        "seed": seed,
    }


def _motion_sensors(draw: _Draw) -> dict[str, Any]:
    """IMU, GNSS and wheel speed; one receiver in five is one without fixed ambiguities."""
    noise = draw.within(3.0, 5.0) if draw.happens(0.2) else 1.0
    return {
        "imu": {
            "mounting": {
                "xyz": [draw.within(-0.5, 1.5), draw.within(-0.3, 0.3), draw.within(0.3, 1.0)],
                "rpy_deg": [
                    draw.within(-4.0, 4.0),
                    draw.within(-4.0, 4.0),
                    draw.one_of([0.0, 90.0, 180.0], [0.5, 0.25, 0.25]) + draw.within(-3.0, 3.0),
                ],
            },
            "accelerometer_sigma_m_s2": draw.within(0.01, 0.05),
            "gyroscope_sigma_rad_s": draw.within(0.0005, 0.003),
            "orientation": {"enabled": draw.happens(0.5)},
        },
        "gnss": {
            "lever_arm": [draw.within(-1.0, 1.0), draw.within(-0.5, 0.5), draw.within(1.0, 2.0)],
            "horizontal_sigma_m": noise * draw.within(0.008, 0.025),
            "vertical_sigma_m": noise * draw.within(0.015, 0.04),
            "correlated_horizontal_sigma_m": draw.within(0.0, 0.02),
            "correlation_s": draw.within(5.0, 40.0),
            "rate_hz": draw.one_of([5.0, 10.0]),
        },
        "velocity": {"enabled": draw.happens(0.7), "sigma_m_s": draw.within(0.02, 0.1)},
    }
