"""Do the data contradict the guesses, or each other? Tests, and what they find, as numbers.

Each test has a known distribution if nothing is wrong (`caliv_graph/uncertainty/README.md`,
"Consistency tests"). `wording.contradictions` says what was found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from scipy.special import bdtrc, chdtrc, chdtri, ndtr, ndtri

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import (
    common_motion,
    right_to_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.mounting.mirror import are_mirror_images
from caliv_graph.products import Array, Guess, LidarResult, Surface
from caliv_graph.trajectory.heading import HeadingSource
from caliv_graph.uncertainty.observability import UNIT, scaling

CONTRADICTION_SIGMAS = 5.0
"""Of a normal variable: the limit of every test."""

TOGETHER_SIGMAS = 3.0
"""Of a guess that is off: what is beyond is no chance, what is below may be."""

TOGETHER_P = 0.1
"""Chance by which guesses of one wrong frame are told as ones that are off each for itself. Two,
one 3.3 sigmas off in x and one in y, would pass for one motion at 0.09."""

PERHAPS_P = 0.01
"""The same where none is contradicted: that their mean is off tells already that all are."""

TOGETHER_LEFT = 0.25
"""Part of the squares of the differences that a common motion may leave at most."""

IN_FRAME = np.array([math.radians(0.5)] * 3 + [0.03] * 3)
"""Difference from a frame up to which a LiDAR is at it, rad and m: what a drive leaves open. No
LiDAR is where another is, or turned as exactly as the vehicle frame and in its origin."""

CONTRADICTION_P = float(2.0 * ndtr(-CONTRADICTION_SIGMAS))
"""Probability of a false alarm, per test: 5.7e-7."""

REGISTRATION_BIAS = np.array([1e-3] * 3 + [5e-3] * 3)
"""Allowance, 1 sigma in rad and m: the common error of all registrations of clouds that see the
target from one side: 1 mrad, which is some millimetres at the LiDAR."""

DOUBT_SIGMAS = 4.0
"""An input that explains more is named in a warning: chance does so in one of 16,000 tests."""

CLOCK_BIAS_S = 2e-3
"""Allowance, 1 sigma: at 2 m/s it moves a cloud by 4 mm, about `REGISTRATION_BIAS`."""

CLOCKS_APART_S = 1e-4
"""Allowance, 1 sigma, for the clocks of two LiDARs against each other: of good synchronisation,
and of times that are told of blocks of points. At 3 m/s it moves S2S by 0.3 mm."""

CLOCK_JITTER_S = 1e-3
"""The same, beyond which it is no jitter of the stamps: at 3 ms in a yard S2S is right, at 10 ms in
a hall 4.8 sigmas off."""

CRAB_RAD = math.radians(0.1)
"""Allowance, 1 sigma: the rear axle of a sound vehicle is not exactly square to its body. Side slip
in curves changes sign with the curve; `heading_disagreement` fits it."""

MIN_HEADING_RAD = 2.0 * CRAB_RAD
"""No vehicle frame is aligned to its body better than this: a smaller angle is no contradiction."""

SCALE_LIMIT = 5.0
"""Sigmas of registrations over what independent point errors give. Points of one channel share that
channel's calibration error: with about 25 points of a channel on a chair 8 m away, sigmas are
sqrt(25) times as large. No known LiDAR effect exceeds this."""

FOLIAGE_NOISE, FOLIAGE_M = 3.0, 0.03
"""Where neighbouring points of each LiDAR scatter along the beams by so many times the noise of its
ranges, and by so much, 1 sigma, there is no surface. Ranges may be noisier than they are told."""

RANGE_BIAS_LIMIT_M = 0.01
"""1 sigma of the biases of ranges that a calibration may have: data sheets of LiDARs state an
accuracy of 20 to 30 mm mostly, which is taken for two to three sigmas."""

STRAIN_LIMIT = 2.0
"""Distance of the vehicle's poses from where the motion data have them, in their sigmas (root of
chi-square over the number of coordinates). Where all sigmas are right it is below 1: 0.3 to 0.7 in
nine drives of two simulators with a target, 1.0 and 1.3 in two without. Two that ended with rolls
and pitches wrong by 5 to 13 mrad, the noise of the gyroscope thought to be a third of what it was,
had 1.7 and 2.5; the latter drive, right once the noise of its IMU is stated, 1.6."""

OUTLIERS = 0.1
"""Fraction of a LiDAR's clouds that may be outliers: the paper's k = 10 percent."""

DETERMINED = 10.0
"""Scaled units (1 mrad, 10 mm), 1 sigma: a score test leaves out directions of larger sigma."""

CLOCK_DETERMINED_S = 0.05
"""Sigma of a clock's offset above which the score test of the clock is not made."""

LIKELY_P = 1e-3
"""P-value below which a score test is named as the likely reason of coarse registrations. They
widen every score test, so that none may reach `CONTRADICTION_P`."""

FAR_M = 3.0
"""Clouds that are farther off have a wrong extrinsic; the distance itself has no meaning."""

MIN_SPEED_M_S = 0.1
"""Below, no clock error explains an offset along x."""

ScoreTestKind = Literal["halves", "turns", "clock", "trust"]
AssumedKind = Literal["height", "tilt_x", "tilt_y"]


@dataclass(frozen=True)
class ScoreTest:
    """A parameter that the model leaves out, linearised at the estimate (Rao 1948).

    `halves`, `turns`: extrinsic in the first half less that in the second, in left turns less in
    right turns; `trust`: extrinsic that the clouds ask for less the trusted one ((6,), vehicle
    axes); `clock`: stamps less true time ((1,) seconds).

    Attributes:
        lidar: its name.
        kind: what is compared with what.
        information: (k, k) and
        gradient: (k,) of `d^T information d / 2 - gradient^T d`, minus the log-likelihood of a
            difference d, all other variables eliminated.
    """

    lidar: str
    kind: ScoreTestKind
    information: Array
    gradient: Array


@dataclass(frozen=True)
class CloudCount:
    """How many clouds of a LiDAR are outliers, and where in the drive.

    Attributes:
        lidar: its name.
        clouds: all of it.
        outliers: those of less than half their weight, or beyond three sigma per axis.
        left: (clouds, outliers) in left turns.
        right: (clouds, outliers) in right turns.
        early: (clouds, outliers) in the first half.
        late: (clouds, outliers) in the second half.
        offset_vehicle: (3,) metres, median position of the outliers relative to the other clouds,
            vehicle axes; None if there are none.
    """

    lidar: str
    clouds: int
    outliers: int
    left: tuple[int, int]
    right: tuple[int, int]
    early: tuple[int, int]
    late: tuple[int, int]
    offset_vehicle: Array | None = None


@dataclass(frozen=True)
class Assumed:
    """A quantity that the config assumes, and how far the estimate is from it.

    Attributes:
        drive: its name.
        kind: `height` of the vehicle frame above the ground (m); `tilt_x`, `tilt_y` of the vehicle
            against the ground (rad).
        value: estimate less assumed value.
        sigma: that was assumed.
    """

    drive: str
    kind: AssumedKind
    value: float
    sigma: float


@dataclass(frozen=True)
class Heading:
    """Heading against direction of travel, of one drive.

    Attributes:
        drive: its name.
        yaw_rad: by which the heading is turned against the motion, positive to the left.
        sigma_rad: of it.
        told_apart: whether the drive separates it from a vehicle frame that is off the rear axle.
        measured: whether lateral velocity was measured: it then contains what the axle does.
        source: orientations of the IMU's messages tell the heading, two antennas, or none; then
            fixes and gyroscope tell that of the IMU, and `imu.T_vehicle_imu` the vehicle's.
    """

    drive: str
    yaw_rad: float
    sigma_rad: float
    told_apart: bool
    measured: bool = False
    source: HeadingSource = "imu"

    @property
    def sigma_with_allowance_rad(self) -> float:
        """Sigma with the allowance for the axle, where the axle is not in the measurement."""
        return self.sigma_rad if self.measured else math.hypot(self.sigma_rad, CRAB_RAD)


@dataclass(frozen=True)
class Strain:
    """How far the LiDARs move the vehicle's poses from where the motion data of a drive have them.

    Attributes:
        drive: its name.
        chi_square: of the poses of the graph, by the joint Gaussian of the motion data.
        coordinates: of these poses, six each, and of the parameters that it has besides.
    """

    drive: str
    chi_square: float
    coordinates: int

    @property
    def sigmas(self) -> float:
        """Root mean square, in sigmas of the motion data."""
        return math.sqrt(max(self.chi_square, 0.0) / max(self.coordinates, 1))


@dataclass(frozen=True)
class CheckInputs:
    """What the tests look at.

    Attributes:
        lidars: the result.
        score_tests: of differences between parts of the data.
        counts: of outliers.
        registration_scale: sigmas of the registrations over what their points' scatter gives.
        registration_sigma: rad and m, of the median cloud, scaled.
        range_bias_m: 1 sigma of the biases of the ranges is at least this, metres.
        assumed: quantities that the config assumes.
        headings: of the drives that have one.
        speed_m_s: median over the clouds.
        strains: of the drives with a smoothed trajectory.
        creeping: the joint loop, if it ended far from where it leads.
        surfaces: placement -> whether the clouds of its target show one.
    """

    lidars: Mapping[str, LidarResult]
    score_tests: Sequence[ScoreTest] = ()
    counts: Sequence[CloudCount] = ()
    registration_scale: float = 1.0
    registration_sigma: tuple[float, float] = (0.0, 0.0)
    range_bias_m: float = 0.0
    assumed: Sequence[Assumed] = ()
    headings: Sequence[Heading] = ()
    speed_m_s: float = 0.0
    strains: Sequence[Strain] = ()
    creeping: Creeping | None = None
    surfaces: Mapping[str, Surface] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A frame that clouds may be in: of a LiDAR, or of the vehicle (None)."""

    lidar: str | None


@dataclass(frozen=True)
class GuessContradiction:
    """An estimate that is too far from its initial guess.

    Attributes:
        lidar: its name.
        guess: its initial guess.
        difference: (6,) estimate less guess, vehicle axes, rad and m.
        sigma: (6,) of the difference.
        axes: indices of the axes beyond the limit, worst first.
        swapped_with: LiDAR whose guess the estimate agrees with; None if there is none.
        late_s: lateness of stamps (negative: early) that gives the same offset; None if a clock
            does not explain it.
        speed_m_s: of the vehicle.
        mirrored: whether the guess mirrors that of `swapped_with`: left and right are exchanged.
        frame: the frame that the estimate is at, where no LiDAR is: "vehicle", or that of another
            LiDAR; None: of its own. The clouds are in that frame already.
    """

    lidar: str
    guess: Guess
    difference: Array
    sigma: Array
    axes: tuple[int, ...]
    swapped_with: str | None
    late_s: float | None
    speed_m_s: float
    mirrored: bool = False
    frame: Frame | None = None


@dataclass(frozen=True)
class GuessesTogether:
    """Guesses of all LiDARs that are off by one motion of the vehicle frame.

    Attributes:
        lidars: all that have a guess.
        T_vehicle_guessed: the frame of the guesses: with it, all of them fit.
        sigmas: of the largest difference of an estimate from its guess.
        late_s: as of `GuessContradiction`, the median of those that are contradicted.
        speed_m_s: of the vehicle.
        has_z: whether the data determine the z of all of them.
    """

    lidars: tuple[str, ...]
    T_vehicle_guessed: gtsam.Pose3
    sigmas: float
    late_s: float | None
    speed_m_s: float
    has_z: bool = True


@dataclass(frozen=True)
class CoarseRegistrations:
    """Clouds that fit each other and the motion worse than registrations can be off.

    Attributes:
        scale: sigmas of the registrations over what their points' scatter gives.
        sigma: rad and m, of the median cloud, scaled.
        lidars: that take part.
        likely: where it shows most: the LiDAR with the largest fraction of outliers, or else the
            smallest p-value below `LIKELY_P`.
    """

    scale: float
    sigma: tuple[float, float]
    lidars: tuple[str, ...]
    likely: CloudCount | ScoreTest | None


@dataclass(frozen=True)
class Creeping:
    """A joint loop whose iterations ended far from where they lead.

    Attributes:
        iterations: how many there were.
        turn_rad: largest step of a LiDAR in the one of the last that moves most.
        shift_m: likewise.
        sigmas: of the steps of all LiDARs in it, in joint standard deviations.
        lidars: that see a target.
        way_sigmas: how far they have come in the last ten, likewise.
    """

    iterations: int
    turn_rad: float
    shift_m: float
    sigmas: float
    lidars: tuple[str, ...]
    way_sigmas: float = 0.0


@dataclass(frozen=True)
class NoSurface:
    """Clouds of a target that show no surface, as those of a bush.

    Attributes:
        target: name of the placement.
        surface: what shows it.
    """

    target: str
    surface: Surface


@dataclass(frozen=True)
class RangesDisagree:
    """Ranges of LiDARs on several targets that no mounting brings together.

    Attributes:
        sigma_m: of the biases of each LiDAR on each target, at least, metres.
        lidars: that take part.
    """

    sigma_m: float
    lidars: tuple[str, ...]


Contradiction = (
    GuessContradiction
    | GuessesTogether
    | CloudCount
    | CoarseRegistrations
    | Creeping
    | NoSurface
    | RangesDisagree
    | ScoreTest
    | Assumed
    | Heading
    | Strain
)
"""One finding; `wording.contradictions` makes a sentence of it."""


def contradictions(inputs: CheckInputs) -> tuple[Contradiction, ...]:
    """All tests: what contradicts what; empty if nothing is wrong."""
    guesses = together(tuple(against_guesses(inputs.lidars, inputs.speed_m_s)), inputs.lidars)
    frame = perhaps_together(inputs.lidars)
    if frame is not None and frame.sigmas > CONTRADICTION_SIGMAS:
        guesses = (frame,)
    return (
        *guesses,
        *(count for count in inputs.counts if too_many_outliers(count)),
        *coarse_registrations(inputs),
        *([] if inputs.creeping is None else [inputs.creeping]),
        *without_surface(inputs.surfaces),
        *disagreeing_ranges(inputs),
        *(test for test in inputs.score_tests if p_value(test) < CONTRADICTION_P),
        *(each for each in inputs.assumed if assumption_contradicted(each)),
        *(heading for heading in inputs.headings if heading_contradicted(heading)),
        *(strain for strain in inputs.strains if too_strained(strain)),
    )


def too_strained(strain: Strain) -> bool:
    """Whether the LiDARs contradict the motion data, by size and beyond chance."""
    beyond = float(chdtrc(strain.coordinates, strain.chi_square)) < CONTRADICTION_P
    return beyond and strain.sigmas > STRAIN_LIMIT


def against_guesses(
    lidars: Mapping[str, LidarResult], speed_m_s: float = 0.0
) -> Iterator[GuessContradiction]:
    """Estimates that differ from the guess by more than 5 sigma on a determined axis.

    The variance of the difference is the sum of both variances if the guess has no weight in the
    estimate (`auto`); where it has (`joint`) the sum is too large, and the test cautious. LiDARs
    that are trusted or saw nothing are not tested. `speed_m_s` says how late stamps would have to
    be.
    """
    for name, (lidar, guess) in _tested(lidars).items():
        off = vehicle_axes_difference(lidar.T_vehicle_lidar, guess.T_vehicle_lidar)
        sigma = _sigmas(lidar, guess)
        determined = np.array([lidar.determined[axis] for axis in AXES])
        wrong = np.flatnonzero(determined & (np.abs(off) > CONTRADICTION_SIGMAS * sigma)).tolist()
        if wrong:
            swapped = _swapped_with(name, lidars)
            other = lidars[swapped].guess if swapped is not None else None
            yield GuessContradiction(
                lidar=name,
                guess=guess,
                difference=off,
                sigma=sigma,
                axes=tuple(sorted(wrong, key=lambda i: -abs(off[i]) / sigma[i])),
                swapped_with=swapped,
                late_s=_late_s(off, wrong, speed_m_s),
                speed_m_s=speed_m_s,
                frame=_already_in(name, lidars),
                mirrored=other is not None
                and are_mirror_images(guess.T_vehicle_lidar, other.T_vehicle_lidar),
            )


def _tested(lidars: Mapping[str, LidarResult]) -> dict[str, tuple[LidarResult, Guess]]:
    """LiDARs that saw something and whose guess a user gave, but does not trust; and the guess."""
    return {
        name: (lidar, guess)
        for name, lidar in lidars.items()
        if (guess := lidar.guess) and not guess.fixed and not guess.found and lidar.has_data
    }


def _sigmas(lidar: LidarResult, guess: Guess) -> Array:
    """(6,) of the difference of estimate and guess, vehicle axes, rad and m."""
    Q = right_to_vehicle_axes(lidar.T_vehicle_lidar)
    return np.asarray(np.sqrt(np.diag(Q @ lidar.cov @ Q.T) + guess.sigmas**2))


def _already_in(name: str, lidars: Mapping[str, LidarResult]) -> Frame | None:
    """The frame in which the clouds of a LiDAR are, by where it was found."""
    others = [(Frame(other), of.T_vehicle_lidar) for other, of in lidars.items() if other != name]
    lidar = lidars[name]
    told = {n: np.array([of.determined[axis] for axis in AXES]) for n, of in lidars.items()}
    # In plan, too: of two on one mast z may be all that differs.
    if not told[name][:5].all():
        return None
    for frame, T in ((Frame(None), gtsam.Pose3()), *others):
        if frame.lidar is not None and not (told[name].all() and told[frame.lidar].all()):
            continue
        off = np.abs(vehicle_axes_difference(lidar.T_vehicle_lidar, T))
        if (off < IN_FRAME)[told[name]].all():
            return frame
    return None


def together(
    found: Sequence[GuessContradiction], lidars: Mapping[str, LidarResult]
) -> tuple[GuessContradiction | GuessesTogether, ...]:
    """The findings; one in their place if a motion of the vehicle frame explains all guesses.

    Not where one LiDAR is at the guess of another, where some guess is right as it is, where a
    trusted extrinsic tells that the frame is right, or where x, y or a rotation is undetermined.
    """
    swapped = any(each.swapped_with is not None for each in found)
    if not found or swapped:
        return tuple(found)
    common = _common(lidars, TOGETHER_P)
    if common is None or min(float(off.max()) for off in common.as_given) < TOGETHER_SIGMAS:
        return tuple(found)
    late = [each.late_s for each in found if each.late_s is not None]
    late_s = float(np.median(late)) if len(late) == len(found) else None
    speed_m_s = found[0].speed_m_s
    return (
        GuessesTogether(
            lidars=common.lidars,
            T_vehicle_guessed=common.T_vehicle_guessed,
            sigmas=max(float(off.max()) for off in common.as_given),
            late_s=late_s,
            speed_m_s=speed_m_s,
            has_z=common.has_z,
        ),
    )


def perhaps_together(lidars: Mapping[str, LidarResult]) -> GuessesTogether | None:
    """Guesses that are off by one motion, though none of them is by 5 sigma; None: they are not.

    The mean of their differences on each determined axis is tested, against the errors of the
    guesses, which are independent, and those of the vehicle's poses, which all of them share.
    """
    common = _common(lidars, PERHAPS_P)
    if common is None or max(float(off.max()) for off in common.as_given) > CONTRADICTION_SIGMAS:
        return None
    tested = [*_tested(lidars).values()]
    off = np.array(
        [
            vehicle_axes_difference(lidar.T_vehicle_lidar, guess.T_vehicle_lidar)
            for lidar, guess in tested
        ]
    )
    guessed = np.array([guess.sigmas**2 for _, guess in tested])
    shared = np.array([_sigmas(*each) ** 2 for each in tested]) - guessed
    variance = guessed.sum(axis=0) / len(tested) ** 2 + shared.max(axis=0)
    axes = 6 if common.has_z else 5
    chi_square = float((off.mean(axis=0) ** 2 / variance)[:axes].sum())
    sigmas = float(-ndtri(0.5 * max(chdtrc(axes, chi_square), 1e-300)))
    if sigmas <= DOUBT_SIGMAS:
        return None
    return GuessesTogether(common.lidars, common.T_vehicle_guessed, sigmas, None, 0.0, common.has_z)


@dataclass(frozen=True)
class _Common:
    """A motion of the vehicle frame that brings all guesses to the estimates.

    Attributes:
        lidars: that were tested.
        T_vehicle_guessed: the motion.
        as_given: per LiDAR, differences of the estimate from the guess on determined axes, sigmas.
        has_z: whether z is determined for all of them.
    """

    lidars: tuple[str, ...]
    T_vehicle_guessed: gtsam.Pose3
    as_given: list[Array]
    has_z: bool


def _common(lidars: Mapping[str, LidarResult], p: float) -> _Common | None:
    """The motion that explains how all guesses are off; None: none does, or it is not told.

    What it leaves has at least the probability `p`. It is not told where a trusted extrinsic tells
    that the frame is right, or where x, y or a rotation is undetermined.
    """
    tested = _tested(lidars)
    told = {
        name: np.array([of.determined[axis] for axis in AXES]) for name, (of, _) in tested.items()
    }
    trusted = any(of.guess is not None and of.guess.fixed and of.has_data for of in lidars.values())
    if len(tested) < 2 or trusted or not all(axes[:5].all() for axes in told.values()):
        return None
    T_vehicle_guessed = common_motion(
        [lidar.T_vehicle_lidar for lidar, _ in tested.values()],
        [guess.T_vehicle_lidar for _, guess in tested.values()],
    )
    as_given, moved = (
        [_off_sigmas(*tested[name], T)[told[name]] for name in tested]
        for T in (gtsam.Pose3(), T_vehicle_guessed)
    )
    squares, left = (sum(float(off @ off) for off in offs) for offs in (as_given, moved))
    free = sum(len(off) for off in moved) - max(len(off) for off in moved)
    if left > min(float(chdtri(free, p)), TOGETHER_LEFT * squares):
        return None
    has_z = all(bool(axes[5]) for axes in told.values())
    return _Common(tuple(tested), T_vehicle_guessed, as_given, has_z)


def _off_sigmas(lidar: LidarResult, guess: Guess, T_vehicle_guessed: gtsam.Pose3) -> Array:
    """(6,) differences of an estimate from a guess that is moved, in sigmas."""
    moved = T_vehicle_guessed.compose(guess.T_vehicle_lidar)
    off = np.abs(vehicle_axes_difference(lidar.T_vehicle_lidar, moved))
    return np.asarray(off / _sigmas(lidar, guess))


def _swapped_with(name: str, lidars: Mapping[str, LidarResult]) -> str | None:
    """The LiDAR at whose guess this one was found."""
    T = lidars[name].T_vehicle_lidar
    for other, lidar in lidars.items():
        if other == name or lidar.guess is None:
            continue
        off = vehicle_axes_difference(T, lidar.guess.T_vehicle_lidar)
        if (np.abs(off) < CONTRADICTION_SIGMAS * lidar.guess.sigmas).all():
            return other
    return None


def _late_s(off: Array, wrong: Sequence[int], speed_m_s: float) -> float | None:
    """Lateness that gives this offset: a shift along x without any rotation."""
    rotated = any(i < 3 for i in wrong)
    along_x = abs(off[3]) > 2.0 * np.hypot(off[4], off[5])
    if rotated or not along_x or speed_m_s <= MIN_SPEED_M_S:
        return None
    return float(-off[3] / speed_m_s)


def too_many_outliers(count: CloudCount) -> bool:
    """Whether a LiDAR has more outliers than `OUTLIERS` explains; their number is binomial."""
    return bool(bdtrc(count.outliers - 1, count.clouds, OUTLIERS) < CONTRADICTION_P)


def coarse_registrations(inputs: CheckInputs) -> tuple[CoarseRegistrations, ...]:
    """Whether the clouds fit each other worse than registrations can be off."""
    if inputs.registration_scale < SCALE_LIMIT:
        return ()
    likely: CloudCount | ScoreTest | None = max(
        (count for count in inputs.counts if count.outliers),
        key=lambda count: count.outliers / count.clouds,
        default=None,
    )
    if likely is None:
        test = min(inputs.score_tests, key=p_value, default=None)
        likely = test if test is not None and p_value(test) < LIKELY_P else None
    return (
        CoarseRegistrations(
            inputs.registration_scale,
            inputs.registration_sigma,
            tuple(count.lidar for count in inputs.counts),
            likely,
        ),
    )


def without_surface(surfaces: Mapping[str, Surface]) -> tuple[NoSurface, ...]:
    """The targets whose clouds show no surface."""
    return tuple(NoSurface(name, of) for name, of in surfaces.items() if is_scattered(of))


def is_scattered(surface: Surface) -> bool:
    """Whether the points of all LiDARs scatter far beyond the noise of their ranges."""
    return bool(surface.scatter_m) and all(
        scatter_m >= max(FOLIAGE_NOISE * surface.told_m[name], FOLIAGE_M)
        for name, scatter_m in surface.scatter_m.items()
    )


def disagreeing_ranges(inputs: CheckInputs) -> tuple[RangesDisagree, ...]:
    """Whether the ranges on the targets contradict each other by more than LiDARs are off."""
    if inputs.range_bias_m < RANGE_BIAS_LIMIT_M:
        return ()
    return (RangesDisagree(inputs.range_bias_m, tuple(inputs.lidars)),)


def p_value(test: ScoreTest) -> float:
    """Probability of a larger difference if nothing is wrong; 1 if nothing is determined."""
    if test.kind == "clock":
        late_s, sigma_s = lateness(test)
        return float(2.0 * ndtr(-abs(late_s) / sigma_s))
    d, cov, V = difference(test)
    if not V.shape[1]:
        return 1.0
    along = V.T @ (d / UNIT)
    spread = V.T @ (cov / np.outer(UNIT, UNIT)) @ V
    squares = max(float(along @ np.linalg.solve(spread, along)), 0.0)
    return float(chdtrc(len(along), squares))


def difference(test: ScoreTest) -> tuple[Array, Array, Array]:
    """The difference of extrinsics that a score test estimates, one Newton step from zero.

    Returns (6,) the difference along the determined directions, vehicle axes, rad and m; (6, 6) its
    covariance with the allowance; (6, k) the determined directions, scaled, orthonormal.
    """
    unit = scaling(1)
    values, vectors = np.linalg.eigh(test.information * np.outer(unit, unit))
    determined = values > DETERMINED**-2.0
    V = vectors[:, determined]
    d = unit * (V @ ((V.T @ (unit * test.gradient)) / values[determined]))
    cov = np.outer(unit, unit) * ((V / values[determined]) @ V.T) + np.diag(REGISTRATION_BIAS**2)
    return d, cov, V


def lateness(test: ScoreTest) -> tuple[float, float]:
    """Seconds by which stamps are late, and sigma with the allowance; 0 if it is undetermined."""
    information = float(test.information[0, 0])
    if information <= CLOCK_DETERMINED_S**-2.0:
        return 0.0, CLOCK_DETERMINED_S
    return float(test.gradient[0]) / information, math.hypot(information**-0.5, CLOCK_BIAS_S)


def assumption_contradicted(assumed: Assumed) -> bool:
    """Whether an assumed quantity was estimated beyond 5 sigma of its assumption."""
    return abs(assumed.value) > CONTRADICTION_SIGMAS * assumed.sigma


def heading_contradicted(heading: Heading) -> bool:
    """Whether the orientation source and the direction of travel contradict each other."""
    limit = max(CONTRADICTION_SIGMAS * heading.sigma_with_allowance_rad, MIN_HEADING_RAD)
    return heading.told_apart and abs(heading.yaw_rad) > limit
