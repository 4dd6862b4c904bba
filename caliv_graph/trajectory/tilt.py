"""Vertical against the vehicle's z over a drive: roll and pitch of the vehicle frame.

An error of roll and pitch of `imu.T_vehicle_imu` turns every LiDAR's S2V by the same angles. The
slope of the ground is told apart by the climb of the path and by changes of heading (`README.md`,
section 14).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array
from caliv_graph.trajectory.given_physics import MAX_TILT_RAD
from caliv_graph.trajectory.imu import exp_so3
from caliv_graph.trajectory.noise import stated
from caliv_graph.trajectory.parameters import IMU_ROTATION
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

STEP_NS = 200_000_000
"""Of the samples."""

MAX_SAMPLES = 3000

CLIMB_WINDOW_NS = 500_000_000
"""Half the time over which the climb of the path is measured: a metre at 2 m/s."""

CORRELATED_S = 5.0
"""Time over which the slope of the ground under a vehicle changes: so much driving counts as one
sample of it."""

SLOPE_SIGMA_RAD = math.radians(2.0)
"""1 sigma of the mean slope of the ground, per axis, where nothing tells it: roads have a crossfall
of 2.5 percent."""

SURFACE_SAMPLES = 64
"""Samples by which the surface of the ground is told: one a second of a minute."""

HILLS_M = (6.0, 12.0, 24.0, 48.0)
HILL_SLOPES_RAD = tuple(np.radians([1.0, 2.0, 4.0, 8.0]).tolist())
"""Lengths over which the slope of the ground changes, and 1 sigma of it: from kerbs and ramps to
the side of a valley."""

BUMPS_M = 2.0
BUMP_SLOPES_RAD = tuple(np.radians([0.1, 0.3, 1.0, 3.0]).tolist())
"""The same of bumps, of how the body leans in bends, and of what else the path does not follow."""

BUMP_USUAL_RAD = math.radians(1.0)
"""Its usual size; of hills it is that of the mean slope."""

SURFACE_NOISE_RAD = 2e-3
"""1 sigma of a sample beside: steps of poses."""

CLIMB_NOISE_RAD = (0.0, 0.015, 0.1)
"""1 sigma of the climbs alone, beside: heights of given poses have noise, 50 mm of which are 70
mrad over a metre. It is no bump, which would lean to the side as well."""

MIN_CLIMB_SIGMA_RAD = 1e-3
MIN_SLOPE_SIGMA_RAD = 5e-3
"""Minimum sigmas of one sample: of climb against pitch, as wheels and body give way, and of the
local slope."""

MIN_SPEED_M_S = 0.5
"""Below, the direction of the path is noise."""

BODY_SIGMA_RAD = math.radians(0.3)
"""1 sigma of the body's roll and pitch on its springs at rest: a centimetre over 2 m by load."""


@dataclass(frozen=True)
class VehicleTilt:
    """Roll and pitch of the vehicle's axes against the ground.

    Attributes:
        name: of the recording.
        roll_pitch_rad: (2,) of the vehicle frame against the ground under it.
        sigma_rad: (2,) of them, body and slope included.
        given: whether the poses were given, not smoothed from the IMU.
    """

    name: str
    roll_pitch_rad: Array
    sigma_rad: Array
    given: bool

    @property
    def up_vehicle(self) -> Array:
        """(3,) the vertical in the vehicle's axes."""
        roll, pitch = self.roll_pitch_rad.tolist()
        level = math.cos(pitch)
        return np.array([-math.sin(pitch), math.sin(roll) * level, math.cos(roll) * level])

    @property
    def lies(self) -> bool:
        """Whether the vehicle's axes lie on a side: no height and no level ground is below them."""
        return bool(self.up_vehicle[2] < math.cos(MAX_TILT_RAD))


def body_sigma_rad(config: Config) -> float:
    """How parallel to the ground the vehicle stands, 1 sigma: as the config says, or as usual."""
    stated = config.ground.parallel_sigma_deg
    return BODY_SIGMA_RAD if stated is None else math.radians(stated)


def vehicle_tilt(trajectory: VehicleTrajectory, name: str, config: Config) -> VehicleTilt:
    """Roll and pitch of the vehicle's axes over a drive.

    Pitch by least squares against the climb of the path, if heights were measured, roll by
    `_across_a_surface`.
    """
    begin, end = trajectory.span_ns
    count = min(MAX_SAMPLES, max(int((end - begin) // STEP_NS), 1))
    # From the start: since 1970 a float has steps of 256 ns, which may lie beyond the end.
    at = begin + np.linspace(0, end - begin, count).astype(np.int64)
    R, t_map_vehicle = trajectory.poses_at(at)
    R = R @ _as_configured(trajectory)
    up = R[:, 2, :]  # e_z of the map in vehicle axes
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    before, after = np.maximum(at - CLIMB_WINDOW_NS, begin), np.minimum(at + CLIMB_WINDOW_NS, end)
    moved = trajectory.poses_at(after)[1] - trajectory.poses_at(before)[1]
    seconds = (after - before) / NANOSECONDS_PER_SECOND
    across = np.hypot(moved[:, 0], moved[:, 1])
    driving = (across > MIN_SPEED_M_S * seconds) & _knows_heights(trajectory)
    climb = np.where(driving, moved[:, 2] / np.where(driving, across, 1.0), 0.0)
    # Positive where the vehicle moves forward.
    ahead = np.sign(moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading))
    climb *= ahead
    c, s = np.cos(heading), np.sin(heading)
    zero, one = np.zeros(count), np.ones(count)
    # Unknowns: mean of up along x, slope of the ground along the map's x and y.
    groups = [
        (np.stack([one, zero, zero], 1)[driving], (up[:, 0] - climb)[driving]),
        (np.stack([zero, c, s], 1)[driving], climb[driving]),
        (np.stack([one, c, s], 1)[~driving], up[~driving, 0]),
    ]
    least = (MIN_CLIMB_SIGMA_RAD, *[MIN_SLOPE_SIGMA_RAD] * 2)
    sigmas = np.array(least)
    prior = np.diag([0.0, SLOPE_SIGMA_RAD**-2, SLOPE_SIGMA_RAD**-2])
    # So many samples count as one: correlated over `CORRELATED_S`.
    alike = max(CORRELATED_S * (count - 1) / max((end - begin) * 1e-9, 1e-9), 1.0)
    found, information = np.zeros(3), prior
    for _ in range(5):
        weights = [1.0 / (sigma**2 * alike) for sigma in sigmas]
        information = prior + sum(w * A.T @ A for w, (A, _) in zip(weights, groups, strict=True))
        right = sum((w * A.T @ y for w, (A, y) in zip(weights, groups, strict=True)), np.zeros(3))
        found = np.linalg.lstsq(information, right)[0]
        spread = [
            float(np.sqrt(((y - A @ found) ** 2).mean())) if len(y) else 0.0 for A, y in groups
        ]
        sigmas = np.maximum(spread, least)
    x, variance = float(found[0]), float(np.linalg.pinv(information)[0, 0])
    y, of_roll = _across_a_surface(
        t_map_vehicle[:, :2], heading, np.where(driving, climb, np.nan), up[:, 1]
    )
    of_both = np.array([of_roll, variance]) + np.diag(_attitude_cov(trajectory))[::-1]
    z = float(np.median(up[:, 2]))
    # Nose up: up leans along +x in vehicle axes, which is a negative pitch; left side up: +y, roll.
    return VehicleTilt(
        name=name,
        roll_pitch_rad=np.array([math.atan2(y, z), -math.atan2(x, math.hypot(y, z))]),
        sigma_rad=np.sqrt(of_both + body_sigma_rad(config) ** 2),
        given=not isinstance(trajectory, SmoothedTrajectory),
    )


def _across_a_surface(
    places: Array, heading: Array, climb: Array, up_left: Array
) -> tuple[float, float]:
    """Mean of up along the vehicle's y where the ground is a smooth random surface; its variance.

    Its slopes along the path and across it are of one surface: hills of one size (squared
    exponential, Rasmussen & Williams 2006, section 9.4), bumps, and a plane. Sizes and noise of the
    climbs are integrated over, with the mean. A slope that is constant over the drive is not
    enough: beside a hill the ground falls to one side all along the path.

    Args:
        places: (n, 2) metres.
        heading: (n,) rad.
        climb: (n,) of the path ahead; nan: the vehicle stands.
        up_left: (n,) the vertical along the vehicle's y.
    """
    some = np.linspace(0, len(places) - 1, min(len(places), SURFACE_SAMPLES)).astype(np.int64)
    places, heading, climb, up_left = (of[some] for of in (places, heading, climb, up_left))
    known = np.flatnonzero(np.isfinite(climb))
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    at, along = np.vstack([places[known], places]), np.vstack([ahead[known], left])
    y = np.concatenate([climb[known], up_left])
    mean = np.append(np.zeros(len(known)), np.ones(len(places)))
    d = at[:, None, :] - at[None, :, :]
    square, cosine = np.einsum("ijk,ijk->ij", d, d), along @ along.T
    both = np.einsum("ijk,ik->ij", d, along) * np.einsum("ijk,jk->ij", d, along)

    def slopes(length_m: float) -> Array:
        """Covariance of the slopes for a variance of one."""
        return np.asarray((cosine - both / length_m**2) * np.exp(-0.5 * square / length_m**2))

    base = SLOPE_SIGMA_RAD**2 * cosine + SURFACE_NOISE_RAD**2 * np.eye(len(y))
    bumps, of_climbs = slopes(BUMPS_M), np.diag(1.0 - mean)
    surfaces = [(0.0, bumps, 1.0)]
    surfaces += [(hill, slopes(m), 1.0 / len(HILLS_M)) for m in HILLS_M for hill in HILL_SLOPES_RAD]
    noises = CLIMB_NOISE_RAD if len(known) else CLIMB_NOISE_RAD[:1]
    told = []
    for (hill, hills, share), bump, noise in itertools.product(surfaces, BUMP_SLOPES_RAD, noises):
        cov = base + hill**2 * hills + bump**2 * bumps + noise**2 * of_climbs
        lower = scipy.linalg.cholesky(cov, lower=True)
        of_mean, of_y = scipy.linalg.solve_triangular(
            lower, np.stack([mean, y], axis=1), lower=True
        ).T
        information = float(of_mean @ of_mean)
        value = float(of_mean @ of_y) / information
        cost = float(of_y @ of_y) - information * value**2
        cost += 2.0 * float(np.log(np.diag(lower)).sum()) + math.log(information)
        # Steep ground is rare (Cauchy): where nothing tells the sizes, they are small.
        cost += 2.0 * sum(
            math.log1p((size / usual) ** 2)
            for size, usual in ((hill, SLOPE_SIGMA_RAD), (bump, BUMP_USUAL_RAD))
        )
        told.append((cost - 2.0 * math.log(share), value, 1.0 / information))
    costs, values, variances = np.array(told).T
    weights = np.exp(-0.5 * (costs - costs.min()))
    weights /= weights.sum()
    middle = float(weights @ values)
    return middle, float(weights @ (variances + (values - middle) ** 2))


def _as_configured(trajectory: VehicleTrajectory) -> Array:
    """(3, 3) from the vehicle frame by the configured T_vehicle_imu to that by the estimated one.

    A rotation of the IMU with a sigma gives way to velocities, and hides a part of its error.
    """
    uncertain = trajectory.parameters if isinstance(trajectory, SmoothedTrajectory) else ()
    for each in uncertain:
        if each.parameter is IMU_ROTATION and each.offset is not None:
            return np.asarray(exp_so3(each.offset[None])[0])
    return np.eye(3)


def _knows_heights(trajectory: VehicleTrajectory) -> bool:
    """Whether heights were measured, and so the climb of the path.

    Without fixes they are those of the accelerometer, whose bias and mounting look like a climb.
    """
    return not isinstance(trajectory, SmoothedTrajectory) or trajectory.data.positions is not None


def _attitude_cov(trajectory: VehicleTrajectory) -> Array:
    """(2, 2) of a pose's pitch and roll, taken as common to the drive; zero if unknown."""
    if isinstance(trajectory, SmoothedTrajectory):
        return np.diag(trajectory.pose_sigmas[[1, 0]] ** 2)
    cov = trajectory.trajectory.cov
    known = None if cov is None else cov[stated(cov)]
    if known is None or not len(known):
        return np.zeros((2, 2))
    median = np.median(np.diagonal(known, axis1=1, axis2=2), axis=0)
    return np.diag(median[[1, 0]])
