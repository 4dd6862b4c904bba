"""Do the data contradict the guesses, or each other? A wrong result is called wrong (SPEC 5).

Each test has a distribution that it follows if nothing is wrong, and asks for what chance gives
less often than 5 sigma of a normal variable, once in 1.7 million. A drive has a few dozen tests:
together they are wrong once in 30 000 drives. What models leave out by construction is in the
distributions as an allowance, not in a higher limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import bdtrc, chdtrc, ndtr, ndtri

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import right_to_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array, LidarResult
from caliv_graph.uncertainty.observability import UNIT, scaling

SIGMAS = 5.0
"""SPEC 5."""

CHANCE = float(2.0 * ndtr(-SIGMAS))
"""Of a false alarm, per test."""

BIAS = np.array([1e-3] * 3 + [5e-3] * 3)
"""Allowance, 1 sigma in rad and m: what a registration is off by in all clouds that see the target
from one side (SPEC 8: 1 mrad, which are some millimetres at the LiDAR)."""

CLOCK_BIAS_S = 2e-3
"""Allowance, 1 sigma: 4 mm at 2 m/s, as much as a registration may be off by."""

CRAB_RAD = math.radians(0.1)
"""Allowance, 1 sigma: a rear axle that is not square to the body lets a sound vehicle go that much
sideways. Side slip in curves is told from it by its sign: `heading_disagreement` fits it."""

LEAST_TURNED_RAD = 2.0 * CRAB_RAD
"""No vehicle frame is squared better to its body than this, however well the angle is known."""

SCALE_LIMIT = 5.0
"""Sigmas of registrations against what the scatter of their points allows, were each point's error
its own. All points of a channel may share one (its calibration): some 25 of a chair 8 m away, which
makes sigmas 5 times as large. Nothing that a LiDAR does makes them larger."""

OUTLIERS = 0.1
"""Part of a LiDAR's clouds that may be bad for a reason of its own: the paper's k = 10 percent."""

TOLD = 10.0
"""Scaled units (1 mrad, 10 mm), 1 sigma: along what is known no better, a contrast says nothing."""

TOLD_CLOCK_S = 0.05
"""The same for a clock: of a larger sigma its offset is not told."""

SUSPECT = 1e-3
"""Chance below which a contrast is named as the likely reason of a contradiction found otherwise:
registrations taken for coarse make every contrast less sure than it is."""

FAR_M = 3.0
"""Clouds that are farther off are off because the mounting is; the number means nothing."""

ScoreTestKind = Literal["halves", "turns", "clock", "trust"]


@dataclass(frozen=True)
class ScoreTest:
    """What would differ between two parts of the data, were it let differ.

    Minus the log-likelihood of a difference d is `d^T information d / 2 - gradient^T d`, all else
    following. `halves`, `turns`: mounting in the first half less that in the second, in left turns
    less in right turns; `trust`: mounting that the clouds ask for less the one that was trusted
    ((6,), vehicle axes); `clock`: stamps less true time ((1,) seconds).

    Attributes:
        lidar: its name.
        kind: what is set against what.
        information: (k, k).
        gradient: (k,).
    """

    lidar: str
    kind: ScoreTestKind
    information: Array
    gradient: Array


@dataclass(frozen=True)
class CloudCount:
    """How many clouds of a LiDAR do not fit.

    Attributes:
        lidar: its name.
        clouds: all of it.
        down: those of less than half their weight, or beyond three sigma per axis.
        left: (clouds, down) in left turns.
        right: (clouds, down) in right turns.
        early: (clouds, down) in the first half.
        late: (clouds, down) in the second half.
        offset_vehicle: (3,) metres, median of where the middle of the clouds that are down lies
            from where the others have it, in vehicle axes; None if there are none.
    """

    lidar: str
    clouds: int
    down: int
    left: tuple[int, int]
    right: tuple[int, int]
    early: tuple[int, int]
    late: tuple[int, int]
    offset_vehicle: Array | None = None


@dataclass(frozen=True)
class Assumed:
    """What was assumed to be about zero, and what it came out as.

    Attributes:
        what: as a person says it, with the drive where there are several.
        value: in `unit`.
        sigma: that was assumed, same unit.
        unit: for the message.
        remedy: what to look at.
    """

    what: str
    value: float
    sigma: float
    unit: str
    remedy: str


@dataclass(frozen=True)
class Heading:
    """Orientation source against direction of travel, of one drive.

    Attributes:
        drive: what to call it.
        yaw_rad: by which the heading is turned against the motion, positive to the left.
        sigma_rad: of it.
        told_apart: whether the drive tells it from a vehicle frame that is off the rear axle.
        measured: whether lateral velocity was measured: what the axle does is in it then.
    """

    drive: str
    yaw_rad: float
    sigma_rad: float
    told_apart: bool
    measured: bool = False


@dataclass(frozen=True)
class CheckInputs:
    """What the tests look at.

    Attributes:
        lidars: the result.
        score_tests: between parts of the data.
        counts: of clouds that do not fit.
        registration_scale: sigmas of the registrations against what their points' scatter allows.
        registration_sigma: rad and m, of the median cloud, scaled.
        assumed: what was assumed to be about zero.
        headings: of the drives that tell it.
        speed_m_s: median over the clouds.
    """

    lidars: Mapping[str, LidarResult]
    score_tests: Sequence[ScoreTest] = ()
    counts: Sequence[CloudCount] = ()
    registration_scale: float = 1.0
    registration_sigma: tuple[float, float] = (0.0, 0.0)
    assumed: Sequence[Assumed] = ()
    headings: Sequence[Heading] = ()
    speed_m_s: float = 0.0


def contradictions(evidence: CheckInputs) -> tuple[str, ...]:
    """What contradicts what, a sentence each; empty if all is as it should be."""
    return (
        *against_guesses(evidence.lidars, evidence.speed_m_s),
        *misfits(evidence.counts),
        *too_coarse(evidence),
        *(text for contrast in evidence.score_tests if (text := contrasted(contrast))),
        *(text for assumed in evidence.assumed if (text := denied(assumed))),
        *(text for heading in evidence.headings if (text := turned(heading))),
    )


# ------------------------------------------------------------------ guesses


def against_guesses(lidars: Mapping[str, LidarResult], speed_m_s: float = 0.0) -> list[str]:
    """Estimates that are more than 5 sigma, of guess and data, off the guess on a determined axis.

    The sum of the two variances is that of the difference if the guess had no say in the estimate
    (`auto`), and too large where it had (`joint`).

    Args:
        lidars: the result; those that are trusted or saw nothing are not tested.
        speed_m_s: of the vehicle, to say how late stamps would have to be.
    """
    out = []
    for name, lidar in lidars.items():
        guess = lidar.guess
        if guess is None or guess.fixed or not lidar.saw_target:
            continue
        off = vehicle_axes_difference(lidar.T_vehicle_lidar, guess.T_vehicle_lidar)
        Q = right_to_vehicle_axes(lidar.T_vehicle_lidar)
        sigma = np.sqrt(np.diag(Q @ lidar.cov @ Q.T) + guess.sigmas**2)
        told = np.array([lidar.determined[axis] for axis in AXES])
        wrong = np.flatnonzero(told & (np.abs(off) > SIGMAS * sigma))
        if not len(wrong):
            continue
        parts = []
        for i in sorted(wrong.tolist(), key=lambda i: -abs(off[i]) / sigma[i]):
            size = f"{abs(off[i]) / sigma[i]:.0f} sigma"
            if i >= 3:
                value = float(guess.T_vehicle_lidar.translation()[i - 3])
                parts.append(
                    f"{AXES[i]} is {abs(off[i]):.2f} m from the guess {value:.2f} +- "
                    f"{guess.sigmas[i]:.2f}: {size}"
                )
            else:
                parts.append(
                    f"{AXES[i]} is {math.degrees(abs(off[i])):.1f} degrees from the guess +- "
                    f"{math.degrees(guess.sigmas[i]):.1f}: {size}"
                )
        cause = _cause(name, lidars, off, wrong.tolist(), speed_m_s)
        out.append(f"lidar '{name}': {'; '.join(parts)}. {cause}")
    return out


def _cause(
    name: str, lidars: Mapping[str, LidarResult], off: Array, wrong: Sequence[int], speed_m_s: float
) -> str:
    """Which kinds of mistake put an estimate where it is."""
    T = lidars[name].T_vehicle_lidar
    for other, lidar in lidars.items():
        if other == name or lidar.guess is None:
            continue
        there = vehicle_axes_difference(T, lidar.guess.T_vehicle_lidar)
        if (np.abs(there) < SIGMAS * lidar.guess.sigmas).all():
            return f"It is where '{other}' was guessed to be: are their topics swapped?"
    rotated = any(i < 3 for i in wrong)
    if not rotated and abs(off[3]) > 2.0 * np.hypot(off[4], off[5]) and speed_m_s > 0.1:
        way = "late" if off[3] < 0.0 else "early"
        return (
            f"Stamps that are {abs(off[3]) / speed_m_s:.2f} s {way} at {speed_m_s:.1f} m/s do "
            "this: check the clock of the LiDAR, then the guess"
        )
    if rotated:
        return (
            "Check the signs and the unit (degrees) of rpy_deg, that it is T_vehicle_lidar and not "
            "its inverse, and that the topic is that of this LiDAR"
        )
    return (
        "Check the guess (metres, signs, T_vehicle_lidar and not its inverse) and that the topic "
        "is that of this LiDAR"
    )


# ------------------------------------------------------------------ clouds


def misfits(counts: Sequence[CloudCount]) -> list[str]:
    """LiDARs of whose clouds more do not fit than may be bad for reasons of their own.

    The number that is down is at most binomial with `OUTLIERS`. Robust weights let the others
    decide: the result looks fine, and which part of the data is right nobody knows.
    """
    return [
        f"{_down(count)}; at most {OUTLIERS:.0%} may. The result goes by the others, which may be "
        "the wrong ones: check its stamps, its mount and the target"
        for count in counts
        if bdtrc(count.down - 1, count.clouds, OUTLIERS) < CHANCE
    ]


def _down(count: CloudCount) -> str:
    """How many clouds of a LiDAR do not fit, and where they lie."""
    away = ""
    if count.offset_vehicle is not None:
        x, y, z = count.offset_vehicle
        length = float(np.linalg.norm(count.offset_vehicle))
        away = (
            f", off by {length:.2f} m ({x:+.2f} forward, {y:+.2f} left, {z:+.2f} up) in the median"
        )
        if not length < FAR_M:
            away = f", off by more than {FAR_M:.0f} m"
    return (
        f"lidar '{count.lidar}': {count.down} of its {count.clouds} clouds of the target"
        f"{_where(count)} contradict the others{away}"
    )


def _where(count: CloudCount) -> str:
    """Which part of the drive most of the clouds that are down are in."""
    pairs = [
        (count.left, count.right, "in left turns", "in right turns"),
        (count.early, count.late, "in the first half", "in the second half"),
    ]
    for first, second, one, other in pairs:
        for here, there, text in ((first, second, one), (second, first, other)):
            if here[1] > 0.75 * count.down and there[0] > 0 and here[0] > 0:
                return f", {here[1]} of them {text},"
    return ""


def too_coarse(evidence: CheckInputs) -> list[str]:
    """Whether the clouds fit each other worse than registrations can be off."""
    scale = evidence.registration_scale
    if scale < SCALE_LIMIT:
        return []
    turn, shift = evidence.registration_sigma
    seen = [(1.0 - count.down / count.clouds, _down(count)) for count in evidence.counts]
    shown = [text for part, text in sorted(seen) if part < 1.0][:1]
    likely = min(evidence.score_tests, key=chance, default=None)
    if not shown and likely is not None and chance(likely) < SUSPECT:
        shown = [_asked(likely)]
    hint = f" It shows most here: {shown[0]}." if shown else ""
    names = " and ".join(f"'{count.lidar}'" for count in evidence.counts)
    return [
        f"the clouds of the target (lidars {names}) and the motion of the vehicle contradict each "
        f"other: each cloud would have to be off by {1e3 * turn:.0f} mrad and {1e3 * shift:.0f} mm,"
        f" {scale:.0f} times what the scatter of its points allows (limit {SCALE_LIMIT:.0f}).{hint}"
        " Check the stamps of every LiDAR, and that nothing moved: a mount, the target"
    ]


def chance(contrast: ScoreTest) -> float:
    """Of a larger contrast if nothing is wrong; 1 if it is not known to `TOLD`.

    Chi-square of the difference along the directions that are told, with the allowance for what
    registrations are off by.
    """
    if contrast.kind == "clock":
        late_s, sigma_s = _lateness(contrast)
        return float(2.0 * ndtr(-abs(late_s) / sigma_s))
    d, cov, V = difference(contrast)
    if not V.shape[1]:
        return 1.0
    along = V.T @ (d / UNIT)
    spread = V.T @ (cov / np.outer(UNIT, UNIT)) @ V
    squares = max(float(along @ np.linalg.solve(spread, along)), 0.0)
    return float(chdtrc(len(along), squares))


def contrasted(contrast: ScoreTest) -> str:
    """What a contrast says, if it is beyond chance; else nothing."""
    if chance(contrast) >= CHANCE:
        return ""
    remedy = {
        "halves": "Check whether its mount or the target moved during the drive, and its clock",
        "turns": "Stamps that are late or early do this: check its clock, or set solve.time_offset",
        "trust": "Measure it again, or let it be estimated",
        "clock": "Mend its clock, or set solve.time_offset",
    }[contrast.kind]
    return f"{_asked(contrast)}. {remedy}"


def _asked(contrast: ScoreTest) -> str:
    """What a contrast asks for, and how sure it is."""
    overall = float(-ndtri(0.5 * max(chance(contrast), 1e-300)))
    if contrast.kind == "clock":
        late_s, sigma_s = _lateness(contrast)
        return (
            f"lidar '{contrast.lidar}': its stamps and the motion of the vehicle contradict each "
            f"other: they seem {1e3 * abs(late_s):.0f} +- {1e3 * sigma_s:.0f} ms "
            f"{'late' if late_s > 0.0 else 'early'} ({overall:.0f} sigma)"
        )
    d, cov, V = difference(contrast)
    sigma = np.sqrt(np.diag(cov))
    # What is not told of an axis is not in d: it shall not be named.
    ratio = np.where(np.sum(V**2, axis=1) > 0.9, np.abs(d) / sigma, 0.0)
    sizes = ", ".join(
        f"{AXES[i]} by {1e3 * d[i]:+.1f} +- {1e3 * sigma[i]:.1f} {'mrad' if i < 3 else 'mm'}"
        for i in np.argsort(-ratio).tolist()[:3]
        if ratio[i] > max(0.5 * ratio.max(), 1.0)
    )
    what = {
        "halves": "the first half of its clouds and the second ask for different extrinsics",
        "turns": "left turns and right turns ask for different extrinsics",
        "trust": "its clouds contradict the mounting that the config says to trust (fixed)",
    }[contrast.kind]
    size = sizes or "along several axes together"
    return f"lidar '{contrast.lidar}': {what}: {size} ({overall:.0f} sigma in all)"


def difference(contrast: ScoreTest) -> tuple[Array, Array, Array]:
    """The difference that a contrast of extrinsics asks for.

    Returns:
        (6,) difference along what is told, vehicle axes; (6, 6) covariance with the allowance,
        (6, k) the directions that are told, scaled, orthonormal.
    """
    unit = scaling(1)
    values, vectors = np.linalg.eigh(contrast.information * np.outer(unit, unit))
    told = values > TOLD**-2.0
    V = vectors[:, told]
    d = unit * (V @ ((V.T @ (unit * contrast.gradient)) / values[told]))
    cov = np.outer(unit, unit) * ((V / values[told]) @ V.T) + np.diag(BIAS**2)
    return d, cov, V


def _lateness(contrast: ScoreTest) -> tuple[float, float]:
    """Seconds by which stamps seem late, and its sigma with the allowance; 0 if not told."""
    information = float(contrast.information[0, 0])
    if information <= TOLD_CLOCK_S**-2.0:
        return 0.0, TOLD_CLOCK_S
    return float(contrast.gradient[0]) / information, math.hypot(information**-0.5, CLOCK_BIAS_S)


# ------------------------------------------------------------------ vehicle


def denied(assumed: Assumed) -> str:
    """What is said if an assumed value came out beyond 5 sigma of what was assumed.

    At an estimate it is nearer to zero than it really is, so that this is cautious.
    """
    if abs(assumed.value) <= SIGMAS * assumed.sigma:
        return ""
    return (
        f"{assumed.what}: the data have it {assumed.value:+.3g} {assumed.unit} from what the "
        f"config says +- {assumed.sigma:.2g}: {abs(assumed.value) / assumed.sigma:.0f} sigma. "
        f"{assumed.remedy}"
    )


def turned(heading: Heading) -> str:
    """What is said if the orientation source points elsewhere than the vehicle goes."""
    sigma = heading.sigma_rad if heading.measured else math.hypot(heading.sigma_rad, CRAB_RAD)
    least = max(SIGMAS * sigma, LEAST_TURNED_RAD)
    if not heading.told_apart or abs(heading.yaw_rad) <= least:
        return ""
    return (
        f"{heading.drive}: the orientation source and the direction of travel contradict each "
        f"other by {math.degrees(heading.yaw_rad):+.2f} +- {math.degrees(sigma):.2f} degrees "
        f"({abs(heading.yaw_rad) / sigma:.0f} sigma): yaw of every LiDAR to the vehicle is off by "
        "as much. Check imu.T_vehicle_imu, or set imu.yaw_bias"
    )
