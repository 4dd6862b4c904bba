"""GNSS fixes that the motion contradicts: rejection, and a noise level that fits the others."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.solve import ERROR_TOLERANCE, ROUGH_TOLERANCE, solve
from caliv_graph.trajectory.states import States, without_bias

OUTLIER_P_VALUE = 1e-6
"""Probability of a larger squared residual under white noise, at which a fix is an outlier: less
than one false rejection in 2000 drives of 500 fixes."""

MAX_REJECTED = 0.4
"""Part of the fixes. If more exceed the limit, the stated noise is wrong, not the fixes: the median
of the residuals is then no longer that of sound fixes."""

MOST_DROPPED = 0.5
"""Part of the fixes. If more were dropped after all, the rest is no majority: it is not known
whether these fixes or those are right."""

FEWEST_FIXES = 8
"""Fixes from which that is said."""

LIMIT_STEP = 9.0
"""Squared residuals down to a ninth of the largest (a third of its residual) are dropped at once.
Larger steps drop sound fixes beside a jump; smaller ones cost rounds."""

MAX_ROUNDS = 12
"""Of rejection; a jump by a kilometre takes nine."""

SLOW_ORIENTATION_RAD = 3e-3
"""1 sigma of slow errors of orientations while fixes are judged: those of attitude systems are 1 to
10 mrad, and last for tens of seconds. Messages state the noise of one; 400 of a second would then
outvote fixes that are right (a tilt of 1.5 mrad: 4 of 24 were dropped)."""

NOISE_ROUNDS = 3
"""Of scaling the stated noise; the second changes it by a few percent."""


@dataclass(frozen=True)
class Robust:
    """What rejection has found: the input, the fixes with the noise that was used.

    `dropped` (k,) are the indices of the fixes that were dropped.
    """

    data: SmootherInput
    dropped: IntArray
    warnings: tuple[str, ...] = ()


def solve_without_outliers(
    data: SmootherInput, nodes: IntArray, states: States
) -> tuple[Robust, Estimate]:
    """Solves for all nodes; drops GNSS fixes that white noise does not explain, worst first.

    Orientations may err slowly meanwhile; how much they do is estimated with the right fixes. The
    estimate is apart: its graph grows with the drive, and whoever solves anew lets go of it.
    """
    none = np.zeros(0, dtype=np.int64)
    kernel = data.config.robust.kernel
    if data.positions is None or kernel == "none":
        return Robust(data, none), solve(data, nodes, states, none, kernel)
    if data.orientation:
        data = replace(data, slow_orientation_rad=SLOW_ORIENTATION_RAD)
    estimate = solve(data, nodes, states, none, "huber", ROUGH_TOLERANCE)
    data, states, warnings = _with_fitting_noise(data, nodes, estimate.states)
    dropped, solved_with = none, "roughly"
    final = _final_limit(data.config)
    limit: float | None = None
    for _ in range(MAX_ROUNDS):
        found, limit = _outliers(_squared_residuals(data, nodes, states), data.config, limit)
        if np.array_equal(found, dropped) and solved_with == kernel:
            if limit == final:
                break
            continue
        dropped = found
        rough = limit > final
        solved_with = "roughly" if rough else kernel
        tolerance = ROUGH_TOLERANCE if rough else ERROR_TOLERANCE
        del estimate  # its graph: 4 MB per minute of drive
        estimate = solve(data, nodes, states, dropped, kernel, tolerance)
        states = estimate.states
    if solved_with != kernel or data.slow_orientation_rad:
        del estimate
        data = replace(data, slow_orientation_rad=0.0)
        estimate = solve(data, nodes, states, dropped, kernel)
    return Robust(data, dropped, tuple(warnings)), estimate


@dataclass(frozen=True)
class LostFixes:
    """Fixes of which most were dropped: `dropped` of `count`, each beyond `sigmas`."""

    dropped: int
    count: int
    sigmas: float

    def sentence(self, name: str, has_imu: bool) -> str:
        """What to tell of the drive `name`, whose motion is that of an IMU or of wheels."""
        with_imu = "that the IMU's yaw counts from east to the left, " if has_imu else ""
        return (
            f"{name}: {self.dropped} of {self.count} GNSS fixes disagree with the motion, each by "
            f"more than {self.sigmas:.1f} sigma: with most of them dropped the vehicle's path is "
            f"not known. Check that latitude and longitude are in degrees, {with_imu}"
            f"gnss.lever_arm, and the clocks of GNSS and {'IMU' if has_imu else 'velocities'}"
        )


def lost_fixes(data: SmootherInput, dropped: IntArray) -> LostFixes | None:
    """Whether most fixes of a drive were dropped (`MOST_DROPPED`); None if they were not.

    `trimmed` drops as many as it is asked for, and `tls` what it expects of sound ones: that says
    nothing. Nor do a few fixes.
    """
    robust = data.config.robust
    count = 0 if data.positions is None else len(data.positions.stamps_ns)
    expected = robust.tls_p_value if robust.kernel == "tls" else 0.0
    most = (MOST_DROPPED + expected) * count
    if robust.kernel == "trimmed" or count < FEWEST_FIXES or len(dropped) <= most:
        return None
    return LostFixes(len(dropped), count, math.sqrt(_final_limit(data.config)))


def dropped_warnings(robust: Robust) -> list[str]:
    """A line if fixes were dropped."""
    positions, count = robust.data.positions, len(robust.dropped)
    if positions is None or not count:
        return []
    return [
        f"{robust.data.name}: {count} of {len(positions.stamps_ns)} GNSS fixes disagree with the "
        "motion, dropped"
    ]


def _with_fitting_noise(
    data: SmootherInput, nodes: IntArray, states: States
) -> tuple[SmootherInput, States, list[str]]:
    """Scales the covariance of the fixes where more than `MAX_REJECTED` of them exceed the limit.

    A receiver that states no covariance gets the paper's 17 mm and may be good to a metre.
    """
    assert data.positions is not None
    none, stated_by = np.zeros(0, dtype=np.int64), data.positions.source
    total = 1.0
    for _ in range(NOISE_ROUNDS):
        assert data.positions is not None
        # Of fixes that err together, each by what it states.
        squares = _squared_residuals(data, nodes, states) * data.positions.shared
        if (squares > _final_limit(data.config)).mean() <= MAX_REJECTED:
            break
        factor = float(np.median(squares) / chdtri(3, 0.5))
        total *= factor
        positions = replace(data.positions, cov_map=data.positions.cov_map * factor)
        data = replace(data, positions=positions)
        states = solve(data, nodes, states, none, "huber", ROUGH_TOLERANCE).states
    if total <= 1.0:
        return data, states, []
    warning = (
        f"{data.name}: most GNSS fixes disagree with the motion by more than their noise "
        f"({stated_by}): taken as {math.sqrt(total):.1f} times as much. Set "
        "noise.gnss_horizontal_m and noise.gnss_vertical_m"
    )
    return data, states, [warning]


def _final_limit(config: Config) -> float:
    """Squared whitened residual of a fix beyond which it is dropped."""
    p = config.robust.tls_p_value if config.robust.kernel == "tls" else OUTLIER_P_VALUE
    return float(chdtri(3, p))


def _outliers(squares: Array, config: Config, limit: float | None) -> tuple[IntArray, float]:
    """Fixes to drop now, and the limit that they exceed.

    It decreases from round to round: a jump makes sound fixes beside it exceed the final limit.
    """
    final = _final_limit(config)
    if config.robust.kernel == "trimmed":
        count = int(len(squares) * config.robust.trim_percent / 100.0)
        return np.sort(np.argsort(squares)[len(squares) - count :]), final
    limit = next_limit(squares, limit, final)
    return np.flatnonzero(squares > limit), limit


def next_limit(squares: Array, limit: float | None, final: float) -> float:
    """The limit of a round, after that of the round before; None: it is the first."""
    worst = float(squares.max(initial=0.0)) if limit is None else limit
    return max(final, worst / LIMIT_STEP)


def _squared_residuals(data: SmootherInput, nodes: IntArray, states: States) -> Array:
    """(k,) squared whitened residual of each fix at an estimate; 0 outside the nodes' span."""
    assert data.positions is not None
    dead = without_bias(data.inertial, nodes, states)
    carried = carry_to_nodes(data, nodes, dead, frozenset({"gnss"})).positions
    out = np.zeros(len(data.positions.stamps_ns))
    if carried is None:
        return out
    i, dt = carried.nodes, carried.delay_s[:, None]
    g = np.array([0.0, 0.0, -data.gravity_m_s2])
    predicted = states.p_map_imu[i] + states.velocity_map[i] * dt + 0.5 * g * dt**2
    predicted += np.einsum("nij,nj->ni", states.R_map_imu[i], carried.offset_imu)
    r = predicted - carried.position_map
    out[carried.fixes] = np.einsum("ni,nij,nj->n", r, np.linalg.inv(carried.cov_map), r)
    return out
