"""Does what was seen again and again stay at one place of the map?

Variables: the place c (3,) of the object's centre in the map, the error e_a (6,) of each LiDAR's
guess (right perturbation of `T_vehicle_lidar`), and where a hypothesis asks for it the lateness
d_a (s) of a LiDAR's stamps or the velocity u (3,) of the object. The centre q_i that LiDAR a saw at
stamp t_i, vehicle pose (R_i, s_i) and twist (w_i, v_i), lies in the map at

    p_i = R_i (R_a q_i + t_a) + s_i,    r_i = p_i - c - u (t_i - mean t)
    dp/de_a = R_i R_a [-skew(q_i), I],  dp/dd_a = -R_i (v_i + w_i x (R_a q_i + t_a))

Noise: `SEEN_SIGMA_M`, isotropic. Gauge: e_a has the guess's sigma as a prior; c and u have none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array

SEEN_SIGMA_M = 0.03
"""Error of a centre in the map, 1 sigma: of the pose, centimetres, and of its registration. It
weighs the centres against the prior of the guesses."""

QUARTILE = 0.75
"""The scatter is this quantile of the residuals: someone who passes in front displaces a few."""

ITERATIONS = 4
HUBER = 1.5
"""Residuals beyond this many times their median have less weight: the Huber kernel."""

WIDE_SIGMAS = np.array([0.5] * 3 + [1.0] * 3)
"""Prior of a guess that is not believed, rad and m."""

LATE_SIGMA_S = 0.5
"""Prior of the lateness of stamps: two clocks that were never set against each other are far more
off, and that the motion data show."""


@dataclass(frozen=True)
class Sightings:
    """Centres of one object, each as one LiDAR saw it in one scan.

    Attributes:
        lidars: (n) names.
        centres_lidar: (n, 3) metres.
        R_map_vehicle: (n, 3, 3) attitudes of the vehicle.
        t_map_vehicle: (n, 3) metres, its positions.
        twists: (n, 6) its velocities, a right perturbation per second.
        times_s: (n,) times, from any origin.
    """

    lidars: tuple[str, ...]
    centres_lidar: Array
    R_map_vehicle: Array
    t_map_vehicle: Array
    twists: Array
    times_s: Array


@dataclass(frozen=True)
class Place:
    """Where an object stands, as well as one place explains what was seen.

    Attributes:
        place_map: (3,) metres.
        scatter_m: third quartile of the distances of the centres from it.
        T_vehicle_lidar: the guesses with their errors removed.
        late_s: LiDAR -> lateness of its stamps, of those that were free.
        velocity_map: (3,) m/s of the object; zero if it was not free.
        cov: LiDAR -> (6, 6) covariance of what is left of its guess's error, right perturbation,
            rad and m; the guess's own where nothing was seen that tells it.
    """

    place_map: Array
    scatter_m: float
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    late_s: Mapping[str, float]
    velocity_map: Array
    cov: Mapping[str, Array]


def fit_place(
    seen: Sightings,
    guesses: Mapping[str, tuple[gtsam.Pose3, Array]],
    late: Sequence[str] = (),
    moves: bool = False,
) -> Place:
    """Least squares of one place.

    Args:
        seen: the centres.
        guesses: LiDAR -> `T_vehicle_lidar` and the sigmas (6,) of its errors, rad and m.
        late: LiDARs whose stamps may be late.
        moves: whether the object may have a velocity.
    """
    names = [name for name in guesses if name in set(seen.lidars)]
    index = np.array([names.index(name) for name in seen.lidars])
    T = {name: guesses[name][0] for name in names}
    n, m = len(index), len(names)
    columns = 3 + 6 * m + m + 3
    since = seen.times_s - seen.times_s.mean()
    free = np.ones(columns, bool)
    free[3 + 6 * m : 3 + 7 * m] = [name in late for name in names]
    free[3 + 7 * m :] = moves
    prior = np.zeros(columns)
    for k, name in enumerate(names):
        prior[3 + 6 * k : 9 + 6 * k] = 1.0 / guesses[name][1]
    prior[3 + 6 * m : 3 + 7 * m] = 1.0 / LATE_SIGMA_S
    error, rest, A = np.zeros(columns), np.zeros((n, 3)), np.zeros((0, columns))
    weights = np.ones(n)
    for _ in range(ITERATIONS):
        p, J = _places(seen, index, [T[name] for name in names], error[3 + 6 * m : 3 + 7 * m])
        J[:, :, 3 + 7 * m :] = -since[:, None, None] * np.eye(3)
        J[:, :, :3] = -np.eye(3)
        r = p - error[:3] - since[:, None] * error[3 + 7 * m :]
        w = np.sqrt(weights)[:, None] / SEEN_SIGMA_M
        A = np.vstack([(w[:, :, None] * J).reshape(3 * n, columns), np.diag(prior)])[:, free]
        b = np.concatenate([(w * r).ravel(), prior * error])
        step = np.zeros(columns)
        step[free] = -np.linalg.lstsq(A, b, rcond=None)[0]
        error = error + step
        for k, name in enumerate(names):
            T[name] = T[name].retract(step[3 + 6 * k : 9 + 6 * k])
        p, _ = _places(seen, index, [T[name] for name in names], error[3 + 6 * m : 3 + 7 * m])
        rest = p - error[:3] - since[:, None] * error[3 + 7 * m :]
        length = np.linalg.norm(rest, axis=1)
        weights = np.minimum(1.0, HUBER * max(float(np.median(length)), SEEN_SIGMA_M) / length)
    late_s = error[3 + 6 * m : 3 + 7 * m]
    cov = np.zeros((columns, columns))
    cov[np.ix_(free, free)] = np.linalg.inv(A.T @ A)
    parts = [slice(3 + 6 * k, 9 + 6 * k) for k in range(m)]
    return Place(
        place_map=error[:3],
        scatter_m=float(np.quantile(np.linalg.norm(rest, axis=1), QUARTILE)),
        T_vehicle_lidar={**{name: T for name, (T, _) in guesses.items()}, **T},
        late_s={name: float(late_s[k]) for k, name in enumerate(names) if name in late},
        velocity_map=error[3 + 7 * m :],
        cov={name: cov[part, part] for name, part in zip(names, parts, strict=True)},
    )


def _places(
    seen: Sightings, index: Array, T: Sequence[gtsam.Pose3], late_s: Array
) -> tuple[Array, Array]:
    """(n, 3) the centres in the map; (n, 3, columns) their derivatives (zero for place, drift)."""
    n, m = len(index), len(T)
    R_guess = np.array([pose.rotation().matrix() for pose in T])[index]
    t_guess = np.array([pose.translation() for pose in T])[index]
    vehicle = np.einsum("nij,nj->ni", R_guess, seen.centres_lidar) + t_guess
    flow = seen.twists[:, 3:] + np.cross(seen.twists[:, :3], vehicle)
    rate = -np.einsum("nij,nj->ni", seen.R_map_vehicle, flow)
    p = np.einsum("nij,nj->ni", seen.R_map_vehicle, vehicle) + seen.t_map_vehicle
    p = p + late_s[index][:, None] * rate
    R = seen.R_map_vehicle @ R_guess
    J = np.zeros((n, 3, 3 + 7 * m + 3))
    turned = np.concatenate([-R @ skew(seen.centres_lidar), R], axis=2)
    for k in range(m):
        mine = index == k
        J[mine, :, 3 + 6 * k : 9 + 6 * k] = turned[mine]
        J[mine, :, 3 + 6 * m + k] = rate[mine]
    return p, J
