"""The ground in a few scans against the initial guesses and the vehicle's height.

With its guess, a LiDAR's ground must be level in vehicle axes and lie `ground.vehicle_height` below
the vehicle frame. All guesses are tested together: what is common to the LiDARs is the vehicle's,
what one has alone is its guess's. How far the scans differ is the terrain's, which all LiDARs see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from scipy.special import chdtrc

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray, LidarScan, Recording
from caliv_graph.targets.ground.measure import GroundMeter
from caliv_graph.targets.ground.planes import MEDIAN_OF_NORMAL
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.tilt import body_sigma_rad

SCANS = 8
"""Of a LiDAR, spread over the drive: a bump under one of them does not matter."""

MIN_SCANS = 3
"""With ground, of which the median is taken."""

HEIGHT_FLOOR_M = 0.01
"""1 sigma of the height of a LiDAR by these scans: heave, unevenness, a rise of the ground."""

MEDIAN_OVER_MEAN = 1.2533
"""Sigma of the median over that of the mean, of normal values: sqrt(pi / 2)."""

Quantity = Literal["height", "roll", "pitch"]


@dataclass(frozen=True)
class LidarGround:
    """The ground of one LiDAR, in vehicle axes by its guess.

    Attributes:
        lidar: its name.
        height_m: of the LiDAR above the ground, median of the scans.
        roll_pitch_rad: (2,) of the guess against the ground, median of the scans.
        scans: with ground.
        height_sigma_m: of the height, by how it differs from scan to scan.
        roll_pitch_sigma_rad: (2,) likewise.
    """

    lidar: str
    height_m: float
    roll_pitch_rad: Array
    scans: int
    height_sigma_m: float = 0.0
    roll_pitch_sigma_rad: Array = field(default_factory=partial(np.zeros, 2))


@dataclass(frozen=True)
class Misfit:
    """What one explanation of a misfit of guesses and ground would be, and how strong it is.

    Attributes:
        quantity: height (m), roll or pitch (rad).
        lidar: whose guess would be wrong; empty: what is common to all, the vehicle's.
        value: that would have to be added to it.
        sigma: of `value`.
        sigmas: of the score test: what would be gained by leaving it free.
        chi2: of all LiDARs together.
        dof: their number.
    """

    quantity: Quantity
    lidar: str
    value: float
    sigma: float
    sigmas: float
    chi2: float
    dof: int

    @property
    def p_value(self) -> float:
        """Probability of a larger `chi2` if all guesses are within their sigmas."""
        return float(chdtrc(self.dof, self.chi2))


def lidar_grounds(
    recording: Recording,
    trajectory: VehicleTrajectory,
    config: Config,
    progress: Progress,
) -> tuple[LidarGround, ...]:
    """The ground of each LiDAR of a drive that sees it in a few scans.

    Raises:
        RecordingError: a cloud could not be read.
    """
    meter = GroundMeter(config, trajectory, 0)
    begin, end = trajectory.span_ns
    out = []
    with progress.stage("looking at the ground", len(recording.lidars)) as advance:
        for name in recording.lidars:
            stamps = np.array(
                [t for t in recording.scan_stamps_ns(name) if begin <= t <= end], np.int64
            )
            if len(stamps):
                found = _of_lidar(recording, config, meter, name, stamps)
                if found is not None:
                    out.append(found)
            advance()
    return tuple(out)


def _of_lidar(
    recording: Recording, config: Config, meter: GroundMeter, name: str, stamps: IntArray
) -> LidarGround | None:
    chosen = set(stamps[np.linspace(0, len(stamps) - 1, SCANS).astype(np.int64)].tolist())
    R_guess = config.lidars[name].guess().rotation().matrix()
    heights, tilts = [], []
    for scan in recording.scans(name, chosen):
        plane = _plane(meter, scan)
        if plane is not None:
            heights.append(plane[1])
            x, y, _ = R_guess @ plane[0]
            # A guess turned by w sees the ground's normal at z + w x z.
            tilts.append([-y, x])
    if len(heights) < MIN_SCANS:
        return None
    return LidarGround(
        name,
        float(np.median(heights)),
        np.median(tilts, axis=0),
        len(heights),
        float(_sigma_of_median(np.array(heights))),
        _sigma_of_median(np.array(tilts)),
    )


def _sigma_of_median(values: Array) -> Array:
    """1 sigma of the median of values (n, ...) along the first axis, by their own spread."""
    spread = np.median(np.abs(values - np.median(values, axis=0)), axis=0) / MEDIAN_OF_NORMAL
    return np.asarray(MEDIAN_OVER_MEAN * spread / math.sqrt(len(values)))


def _plane(meter: GroundMeter, scan: LidarScan) -> tuple[Array, float] | None:
    """Normal (lidar frame) and distance of the ground in a scan."""
    try:
        found = meter.measure(scan)
    except TrajectoryError:
        return None  # invalid point times, which the extraction reports
    return None if found is None else (found.normal_lidar, found.distance_m)


def misfits(grounds: Sequence[LidarGround], config: Config) -> tuple[Misfit, ...]:
    """Per quantity the strongest explanation of what guesses and ground differ by."""
    out = []
    if grounds:
        axes: tuple[Quantity, Quantity] = ("roll", "pitch")
        for axis, quantity in enumerate(axes):
            off = np.array([g.roll_pitch_rad[axis] for g in grounds])
            own = np.array([config.lidars[g.lidar].sigma.sigmas()[axis] for g in grounds])
            names = [g.lidar for g in grounds]
            terrain = np.array([g.roll_pitch_sigma_rad[axis] for g in grounds])
            common = math.hypot(body_sigma_rad(config), float(np.median(terrain)))
            out.append(_strongest(quantity, names, -off, np.diag(own**2 + terrain**2), common))
    if grounds and config.ground.vehicle_height is not None:
        out.append(_height(grounds, config, config.ground.vehicle_height))
    return tuple(out)


def _height(grounds: Sequence[LidarGround], config: Config, vehicle_height: float) -> Misfit:
    """Height of all LiDARs above the ground against guesses and `vehicle_height`."""
    guesses = [config.lidars[g.lidar] for g in grounds]
    places = np.array([lidar.guess().translation() for lidar in guesses])
    off = np.array([g.height_m for g in grounds]) - places[:, 2] - vehicle_height
    own = np.array([lidar.sigma.sigmas()[5] for lidar in guesses])
    lever = (
        body_sigma_rad(config) * places[:, :2]
    )  # the body's tilt lifts what is far from the origin
    # Scans of two LiDARs are not quite of the same places.
    terrain_m = np.array([g.height_sigma_m for g in grounds])
    cov = np.diag(own**2 + HEIGHT_FLOOR_M**2 + terrain_m**2) + lever @ lever.T
    common_m = math.hypot(config.ground.sigma, float(np.median(terrain_m)))
    return _strongest("height", [g.lidar for g in grounds], off, cov, common_m)


def _strongest(
    quantity: Quantity, names: Sequence[str], off: Array, cov: Array, common_sigma: float
) -> Misfit:
    """Score tests: the offsets (n,) by what is common, or by one alone; the strongest.

    `cov` (n, n) is of the LiDARs' own errors, `common_sigma` of what is common to them.
    """
    information = np.linalg.inv(cov + common_sigma**2)
    chi2 = float(off @ information @ off)
    candidates: list[tuple[str, Array]] = [("", np.ones(len(off)))]
    if len(off) > 1:
        # With one LiDAR the two explanations are the same.
        candidates += list(zip(names, np.eye(len(off)), strict=True))
    found = []
    for name, along in candidates:
        weight = float(along @ information @ along)
        score = float(along @ information @ off)
        found.append(
            Misfit(
                quantity,
                name,
                score / weight,
                weight**-0.5,
                abs(score) / weight**0.5,
                chi2,
                len(off),
            )
        )
    return max(found, key=lambda misfit: misfit.sigmas)
