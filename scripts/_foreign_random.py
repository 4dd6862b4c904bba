"""Drives of the other simulator that are drawn at random: course, vehicle, LiDARs, place, sensors.

Nothing here is imported from caliv_graph: see `_foreign_drives.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar

import numpy as np

from scripts._foreign_drives import BOT, TRUCK, Scenario
from scripts._foreign_lidar import Kind, Lidar, TimeField
from scripts._foreign_vehicle import Body, Gnss, Imu, Segment
from scripts._foreign_world import TARGETS, Style

Vehicle = Literal["car", "truck", "robot"]

CAR = Body()

_Box = tuple[tuple[float, float, float], tuple[float, float, float]]

CABIN_M: _Box = ((2.0, 0.0, 1.8), (7.4, 2.3, 2.6))
"""Centre and size of a cabin and its load, which hide what is behind them."""

T = TypeVar("T")


@dataclass(frozen=True)
class _Size:
    """What a vehicle has room for, and how it drives.

    Attributes:
        body: its springs and axles.
        reach_m: lowest and highest place of a LiDAR, in the axle frame.
        speed_m_s: slowest and fastest.
        curvature: of a bend at most, 1/m.
        seconds: shortest and longest course.
        top_m: height of the GNSS antenna.
    """

    body: Body
    reach_m: _Box
    speed_m_s: tuple[float, float]
    curvature: float
    seconds: tuple[float, float]
    top_m: float


SIZES: dict[Vehicle, _Size] = {
    "car": _Size(CAR, ((-0.8, -0.9, 0.5), (3.7, 0.9, 1.9)), (1.5, 5.0), 0.16, (25, 50), 1.6),
    "truck": _Size(TRUCK, ((-1.9, -1.4, 0.7), (6.0, 1.4, 3.4)), (1.5, 4.5), 0.09, (35, 60), 3.3),
    "robot": _Size(BOT, ((-0.2, -0.3, 0.3), (0.6, 0.3, 1.0)), (0.4, 1.1), 1.0, (25, 45), 1.1),
}


class _Draw:
    """Random numbers with names for what is asked of them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def within(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        """Between two positive numbers, evenly on a logarithmic scale."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def one_of(self, values: Sequence[T], weights: Sequence[float] | None = None) -> T:
        return values[int(self.rng.choice(len(values), p=weights))]

    def happens(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def spot(self, low_m: Sequence[float], high_m: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = self.rng.uniform(low_m, high_m).round(3).tolist()
        return x, y, z


def random_scenario(seed: int) -> Scenario:
    """Draws a kind of drive; the same for the same seed."""
    draw = _Draw(np.random.default_rng([20261129, seed]))
    vehicle = draw.one_of(tuple(SIZES), (0.6, 0.2, 0.2))
    size = SIZES[vehicle]
    segments = _segments(draw, size)
    style = _style(draw, vehicle)
    odometry = draw.happens(0.5 if style == "hall" else 0.1)
    imu = None if odometry or draw.happens(0.1) else _imu(draw, size)
    wheels = not odometry and (imu is None or draw.happens(0.7))
    targets = _targets(draw)
    duration_s = sum(segment[0] for segment in segments)
    box_m = CABIN_M if vehicle == "truck" and draw.happens(0.7) else None
    return Scenario(
        segments,
        _lidars(draw, size, box_m),
        style,
        clear_m=2.5 if style == "hall" else draw.within(4.0, 9.0),
        body=size.body,
        box_m=box_m,
        base_m=_base(draw, size),
        imu=imu,
        gnss=None if odometry else _gnss(draw, size, duration_s),
        wheels=wheels,
        yaw_rate=wheels and (imu is None or draw.happens(0.3)),
        odometry=odometry,
        targets=targets,
        search=draw.happens(0.6),
        uneven=draw.within(0.2, 0.4) if style == "hall" else draw.within(0.4, 1.6),
        slope_deg=0.1 if style == "hall" else draw.within(0.0, 2.5),
        hill_m=draw.within(1.0, 4.0) if style == "open" and draw.happens(0.3) else 0.0,
        kerbs=style == "street" and draw.happens(0.6),
        grass_m=draw.within(0.01, 0.04) if style == "open" and draw.happens(0.3) else 0.0,
        walker=draw.happens(0.3),
        traffic=style != "hall" and draw.happens(0.25),
    )


def in_words(scenario: Scenario) -> str:
    """A scenario in a few words."""
    lidars = [
        f"{lidar.kind} {lidar.channels}" + " upside down" * (abs(lidar.rpy_deg[0]) > 90)
        for lidar in scenario.lidars.values()
    ]
    sensors = ["odometry"] * scenario.odometry + ["GNSS"] * (scenario.gnss is not None)
    if scenario.imu is not None:
        sensors.append("INS" if scenario.imu.orientation else "IMU")
    sensors += ["wheels"] * scenario.wheels
    seconds = sum(segment[0] for segment in scenario.segments)
    wheelbase_m = scenario.body.wheelbase_m
    return (
        f"{scenario.style}, {seconds:.0f} s, wheelbase {wheelbase_m:g} m, {', '.join(lidars)}; "
        f"{' '.join(sensors)}; targets: {', '.join(scenario.targets) or 'none'}"
        f"{' (searched)' if scenario.targets and scenario.search else ''}"
    )


def _segments(draw: _Draw, size: _Size) -> tuple[Segment, ...]:
    """Stands, drives bends to both sides, perhaps backs up in between, and stands again."""
    seconds = draw.within(*size.seconds)
    speed = draw.within(*size.speed_m_s)
    segments: list[Segment] = [(draw.within(1.5, 2.5), 0.0, 0.0)]
    side = draw.one_of((-1.0, 1.0))
    while sum(segment[0] for segment in segments) < seconds:
        level = speed * draw.within(0.7, 1.2)
        bend = side * size.curvature * draw.within(0.3, 1.0)
        # Nobody takes bends at more than 2.5 m/s2.
        bend = float(np.clip(bend, -2.5 / level**2, 2.5 / level**2))
        segments.append((draw.within(3.0, 8.0), level, bend))
        if draw.happens(0.3):
            segments.append((draw.within(2.0, 5.0), level, 0.0))
        if draw.happens(0.1):
            segments.append((2.0, 0.0, 0.0))
            segments.append((draw.within(3.0, 5.0), -0.6 * level, -bend))
            segments.append((2.0, 0.0, 0.0))
        if draw.happens(0.7):
            side = -side
    return (*segments, (draw.within(1.5, 2.5), 0.0, 0.0))


def _style(draw: _Draw, vehicle: Vehicle) -> Style:
    if vehicle == "robot":
        return draw.one_of(("hall", "yard", "open"), (0.5, 0.3, 0.2))
    return draw.one_of(("yard", "open", "street"), (0.45, 0.3, 0.25))


def _targets(draw: _Draw) -> tuple[str, ...]:
    count = draw.one_of((0, 1, 2), (0.3, 0.5, 0.2))
    return tuple(draw.one_of(sorted(TARGETS)) for _ in range(count))


def _lidars(draw: _Draw, size: _Size, box_m: _Box | None) -> dict[str, Lidar]:
    count = draw.one_of((1, 2, 3, 4), (0.1, 0.55, 0.25, 0.1))
    yaw_deg = draw.within(-180.0, 180.0)
    lidars = {}
    for i in range(count):
        spot_m = draw.spot(*size.reach_m)
        while box_m is not None and _is_inside(spot_m, box_m):
            spot_m = draw.spot(*size.reach_m)
        lidars[f"lidar_{i}"] = _lidar(draw, spot_m, yaw_deg)
        yaw_deg += draw.within(60.0, 180.0)
    return lidars


def _is_inside(spot_m: tuple[float, float, float], box_m: _Box) -> bool:
    """Also within a hand of its faces: nobody mounts a LiDAR flush."""
    centre_m, size_m = np.array(box_m)
    return bool((np.abs(spot_m - centre_m) < size_m / 2 + 0.1).all())


def _lidar(draw: _Draw, place: tuple[float, float, float], yaw_deg: float) -> Lidar:
    kinds: tuple[Kind, ...] = ("spinning", "solid", "rosette", "dome")
    kind = draw.one_of(kinds, (0.6, 0.2, 0.08, 0.12))
    yaw_deg = (yaw_deg + 180.0) % 360.0 - 180.0
    roll_deg, pitch_deg = draw.within(-5.0, 5.0), draw.within(-3.0, 12.0)
    if kind == "spinning" and draw.happens(0.1):
        roll_deg += draw.one_of((180.0, 90.0))
    times: tuple[TimeField, ...] = ("t", "time", "timestamp", "offset_time")
    common = partial(
        Lidar,
        phase_s=draw.within(0.0, 0.09),
        noise_m=draw.log(0.003, 0.02),
        quantum_m=draw.one_of((0.001, 0.002, 0.004)),
        divergence_rad=draw.log(0.0004, 0.0025),
        max_range_m=draw.within(40.0, 120.0),
        time_field=draw.one_of(times),
    )
    turned = (round(roll_deg, 2), round(pitch_deg, 2), round(yaw_deg, 2))
    if kind == "spinning":
        channels = draw.one_of((16, 32, 64, 128))
        half_deg = draw.within(15.0, 22.5)
        fov = (-15.0, 15.0) if channels == 16 else (-half_deg, draw.within(10.0, 22.5))
        # 45,000 beams a sweep at most: 128 channels have fewer columns.
        columns = {16: 1800, 32: 1024, 64: 700, 128: 350}[channels]
        return common(place, turned, kind, channels, fov, columns=columns)
    if kind == "solid":
        rows = draw.one_of((60, 90, 110))
        return common(place, turned, kind, rows, columns=400)
    if kind == "rosette":
        return common(place, turned, kind, 20, (-35.0, 35.0), columns=1000)
    upside_down = draw.happens(0.5)
    if upside_down:
        turned = (turned[0] + 178.0, turned[1], turned[2])
    return common(place, turned, kind, 20, (-7.0, 52.0), columns=1000)


def _base(draw: _Draw, size: _Size) -> tuple[float, float, float]:
    """The vehicle frame is below the rear axle, at its centre, or somewhere else."""
    wheel_m = 0.12 * size.body.wheelbase_m
    places = ((0.0, 0.0, 0.0), (0.0, 0.0, wheel_m), (size.body.wheelbase_m / 2, 0.0, wheel_m))
    return draw.one_of(places, (0.5, 0.3, 0.2))


def _imu(draw: _Draw, size: _Size) -> Imu:
    """From an INS to what a phone has."""
    grade = draw.log(0.3, 4.0)
    turns = (0.0, np.pi / 2, np.pi)
    low_m, high_m = size.reach_m
    tilt = draw.rng.normal(0.0, 0.02, 2)
    return Imu(
        rate_hz=draw.one_of((100.0, 200.0, 400.0)),
        xyz_m=draw.spot((low_m[0], -0.3, 0.3), (high_m[0] / 2, 0.3, 0.7)),
        rpy_rad=(float(tilt[0]), float(tilt[1]), draw.one_of(turns, (0.7, 0.2, 0.1))),
        accel_density=grade * 0.0012,
        gyro_density=grade * 1.2e-4,
        accel_bias=grade * 0.02,
        gyro_bias=grade * 0.002,
        accel_walk=grade * 2e-4,
        gyro_walk=grade * 1e-5,
        vibration_m_s2=draw.log(0.02, 0.3),
        orientation=draw.happens(0.3),
    )


def _gnss(draw: _Draw, size: _Size, duration_s: float) -> Gnss:
    worse_s = None
    if draw.happens(0.15):
        begin_s = draw.within(0.2, 0.6) * duration_s
        worse_s = (begin_s, begin_s + draw.within(3.0, 10.0))
    half_m = 0.3 * size.body.wheelbase_m
    return Gnss(
        rate_hz=draw.one_of((1.0, 5.0, 10.0, 20.0), (0.1, 0.4, 0.4, 0.1)),
        antenna_m=draw.spot((-half_m, -half_m, size.top_m), (half_m, half_m, size.top_m + 0.3)),
        white_m=draw.log(0.002, 0.01),
        slow_m=draw.log(0.004, 0.02),
        time_s=draw.log(20.0, 150.0),
        worse_s=worse_s,
    )
