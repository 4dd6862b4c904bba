"""Sentences about contradictions: what contradicts what, by how much, and what to check."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from caliv_graph.conventions import AXES
from caliv_graph.products import PoseFrame
from caliv_graph.readers.pose_frame import different_frames, explains
from caliv_graph.trajectory.heading import HEADING_REMEDIES, HeadingSource
from caliv_graph.uncertainty.consistency import (
    FAR_M,
    OUTLIERS,
    RANGE_BIAS_LIMIT_M,
    SCALE_LIMIT,
    Assumed,
    CloudCount,
    CoarseRegistrations,
    Contradiction,
    Creeping,
    GuessContradiction,
    GuessesTogether,
    Heading,
    NoSurface,
    RangesDisagree,
    ScoreTest,
    Strain,
    difference,
    lateness,
    p_value,
)
from caliv_graph.wording.mounting import WITH_Y_LEFT

MOST_OF = 0.75
"""Fraction of the outliers that lie in one part of the drive from which that part is named."""


@dataclass(frozen=True)
class PosesGiven:
    """Given poses, that guesses may be in another frame than.

    Attributes:
        source: where they are from (`readers.pose_frame.poses_source`).
        frame: that they are of; None: nothing names it, or the drives differ.
    """

    source: str
    frame: PoseFrame | None = None


def contradiction_sentence(
    found: Contradiction, led: bool = False, given: PosesGiven | None = None
) -> str:
    """A finding of `uncertainty.consistency.contradictions` for the user.

    `led`: a suspect is named before it. Findings without an input of their own then give no advice.
    `given`: the poses; None: there were raw sensors.
    """
    match found:
        case GuessContradiction():
            return _guess(found)
        case GuessesTogether():
            return _together(found, given)
        case CloudCount():
            return (
                f"{outliers_text(found)}; an outlier ratio of {OUTLIERS:.0%} does not explain that "
                "many. The result follows the other clouds, which may be the wrong ones"
                f"{'' if led else ': check its stamps, its mount and the target'}"
            )
        case CoarseRegistrations():
            return _coarse(found, led)
        case Creeping():
            return _creeping(found, led)
        case NoSurface():
            return f"{no_surface_text(found)}{'' if led else _NO_SURFACE_REMEDY}"
        case RangesDisagree():
            return _ranges(found, led)
        case ScoreTest():
            return f"{_score_test(found)}. {_SCORE_TEST_REMEDIES[found.kind]}"
        case Assumed():
            return _assumed(found)
        case Heading():
            return _heading(found)
        case Strain():
            return _strain(found, led)


def _creeping(found: Creeping, led: bool) -> str:
    advice = (
        ". Give better initial guesses (lidars.<name>.initial), a target with edges that all "
        "LiDARs see, or structure around it"
    )
    way = f", and by {found.way_sigmas:.0f} sigma in the last ten" if found.way_sigmas else ""
    return (
        f"the registration has not come to rest: at the end of {found.iterations} iterations "
        f"LiDARs still moved by up to {1e3 * found.turn_rad:.2f} mrad and "
        f"{1e3 * found.shift_m:.1f} mm ({found.sigmas:.1f} sigma) in one{way}; they may be off by "
        f"many of their sigmas{'' if led else advice}"
    )


def no_surface_text(found: NoSurface) -> str:
    """What the clouds of a target without a surface show."""
    told_m = found.surface.told_m
    scatter = ", ".join(
        f"'{name}' {1e3 * scatter_m:.0f} mm with a noise of {1e3 * told_m[name]:.0f} mm"
        for name, scatter_m in found.surface.scatter_m.items()
    )
    return (
        f"the clouds of {found.target} show no surface, as those of a bush do: neighbouring points "
        f"scatter along the beams by far more than the noise of the ranges ({scatter})"
    )


_NO_SURFACE_REMEDY = (
    ". Use a target with solid faces (a chair, a box) or none (target: false), or state the noise "
    "of the LiDAR (noise.lidar_range_m) if it is that large"
)


def _strain(found: Strain, led: bool) -> str:
    advice = (
        ". The noise of the motion data is larger than it was taken for, or clocks or fixed "
        "mounts of LiDARs are wrong: state the noise of the IMU, the fixes and "
        "the orientation by the data sheets (noise in the config: gyroscope_density_rad_s_sqrthz, "
        "accelerometer_density_m_s2_sqrthz, gnss_horizontal_m, orientation_deg), and check "
        "the IMU's stamps and mounting"
    )
    return (
        f"drive '{found.drive}': the LiDARs put the vehicle's poses {found.sigmas:.1f} times as "
        "far from where the motion data have them as their noise allows (1 at most); S2V may be "
        f"off by many of its sigmas{'' if led else advice}"
    )


def _guess(found: GuessContradiction) -> str:
    parts = []
    for i in found.axes:
        off, sigmas = abs(found.difference[i]), abs(found.difference[i]) / found.sigma[i]
        guessed = float(found.guess.sigmas[i])
        if i >= 3:
            value = float(found.guess.T_vehicle_lidar.translation()[i - 3])
            parts.append(
                f"{AXES[i]} differs from the initial guess {value:.2f} +- {guessed:.2f} m by "
                f"{off:.2f} m: {sigmas:.0f} sigma"
            )
        else:
            parts.append(
                f"{AXES[i]} differs from the initial guess (+- {math.degrees(guessed):.1f} "
                f"degrees) by {math.degrees(off):.1f} degrees: {sigmas:.0f} sigma"
            )
    return f"lidar '{found.lidar}': {'; '.join(parts)}. {_guess_remedy(found)}"


def together_doubt(found: GuessesTogether, given: PosesGiven | None = None) -> str:
    """Guesses that may be off by one motion, though none is contradicted by itself."""
    return _together(found, given, f"may all be off by the same (together {found.sigmas:.1f}")


def _together(found: GuessesTogether, given: PosesGiven | None, how: str | None = None) -> str:
    names = " and ".join(f"'{name}'" for name in found.lidars)
    how = how or f"of all are off by the same ({found.sigmas:.0f}"
    x, y, z = (f"{value:+.2f}" for value in found.T_vehicle_guessed.translation() + 0.0)
    moved = f"{x}, {y}, {z if found.has_z else '-'}"
    turned = ", ".join(
        f"{angle:+.1f}" for angle in np.degrees(found.T_vehicle_guessed.rotation().rpy()) + 0.0
    )
    late = ""
    source, frame = ("", None) if given is None else (given.source, given.frame)
    if found.late_s is not None and not explains(frame, found.T_vehicle_guessed):
        way = "late" if found.late_s > 0.0 else "early"
        late = (
            f". Stamps of all LiDARs that are {abs(found.late_s):.2f} s {way} at "
            f"{found.speed_m_s:.1f} m/s have this effect, too"
        )
    return (
        f"lidars {names}: the initial guesses {how} "
        f"sigma): they fit if their vehicle frame is moved by ({moved}) m and turned by ({turned}) "
        "degrees (roll, pitch, yaw). "
        f"{different_frames(found.T_vehicle_guessed, source, frame)}{late}"
    )


def _guess_remedy(found: GuessContradiction) -> str:
    """The likely mistake, and what to check."""
    if found.swapped_with is not None:
        sides = f", or y counts to the right there: {WITH_Y_LEFT} then" if found.mirrored else ""
        return (
            f"The estimate agrees with the guess of '{found.swapped_with}': check whether their "
            f"topics are swapped{sides}"
        )
    if found.frame is not None:
        of = found.frame.lidar
        if of is None:
            return (
                f"The estimate is the vehicle frame. Either the clouds of '{found.lidar}' are in "
                "that frame already, moved by a driver or a node: give its clouds as it measures "
                f"them. Or the poses are those of '{found.lidar}': then give guesses from it"
            )
        return (
            f"The estimate is that of '{of}': the clouds of '{found.lidar}' are in that frame "
            "already, moved by a driver or a node. Give its clouds as it measures them"
        )
    if found.late_s is not None:
        way = "late" if found.late_s > 0.0 else "early"
        return (
            f"Stamps that are {abs(found.late_s):.2f} s {way} at {found.speed_m_s:.1f} m/s have "
            "this effect: check the clock of the LiDAR, then the guess"
        )
    if any(i < 3 for i in found.axes):
        return (
            "Check the signs and the unit (degrees) of rpy_deg, that it is T_vehicle_lidar and not "
            "its inverse, and that the topic is that of this LiDAR"
        )
    return (
        "Check the guess (metres, signs, T_vehicle_lidar and not its inverse) and that the topic "
        "is that of this LiDAR"
    )


def outliers_text(count: CloudCount) -> str:
    """How many clouds of a LiDAR are outliers, where in the drive, and how far off."""
    offset = ""
    if count.offset_vehicle is not None:
        x, y, z = count.offset_vehicle
        length = float(np.linalg.norm(count.offset_vehicle))
        offset = (
            f", median offset {length:.2f} m ({x:+.2f} forward, {y:+.2f} left, {z:+.2f} up)"
            if length < FAR_M
            else f", median offset above {FAR_M:.0f} m"
        )
    return (
        f"lidar '{count.lidar}': {count.outliers} of its {count.clouds} target clouds contradict "
        f"the other clouds{_where(count)}{offset}"
    )


def _where(count: CloudCount) -> str:
    """The part of the drive that most of the outliers are in."""
    pairs = [
        (count.left, count.right, "in left turns", "in right turns"),
        (count.early, count.late, "in the first half", "in the second half"),
    ]
    for first, second, one, other in pairs:
        for here, there, text in ((first, second, one), (second, first, other)):
            if here[1] > MOST_OF * count.outliers and there[0] > 0 and here[0] > 0:
                return f", {here[1]} of them {text}"
    return ""


def scale_text(scale: float) -> str:
    """That target clouds do not fit each other: their errors over what their points give."""
    return (
        f"its clouds fit only with registration errors {_times_scatter(scale)}, and no other input "
        "explains it"
    )


def _times_scatter(scale: float) -> str:
    return f"{scale:.0f} times what the scatter of their points gives (limit {SCALE_LIMIT:.0f})"


def _coarse(found: CoarseRegistrations, led: bool) -> str:
    rotation, shift = found.sigma
    likely = ""
    if led:
        pass
    elif isinstance(found.likely, CloudCount):
        likely = f" It shows most here: {outliers_text(found.likely)}."
    elif found.likely is not None:
        likely = f" It shows most here: {_score_test(found.likely)}."
    names = " and ".join(f"'{name}'" for name in found.lidars)
    return (
        f"the target clouds (lidars {names}) and the motion of the vehicle contradict each other: "
        f"they fit only with registration errors of {1e3 * rotation:.0f} mrad and "
        f"{1e3 * shift:.0f} mm, {_times_scatter(found.scale)}.{likely}"
        f"{'' if led else _COARSE_REMEDY}"
    )


_COARSE_REMEDY = " Check the stamps of every LiDAR, and that no mount and no target moved"


def _ranges(found: RangesDisagree, led: bool) -> str:
    names = " and ".join(f"'{name}'" for name in found.lidars)
    sigma, limit = 1e3 * found.sigma_m, 1e3 * RANGE_BIAS_LIMIT_M
    return (
        f"the ranges of the lidars {names} on the targets contradict each other: no mounting "
        f"brings them together unless each range on each target is off by at least {sigma:.0f} mm "
        f"(1 sigma; limit {limit:.0f} mm){'' if led else _RANGES_REMEDY}"
    )


_RANGES_REMEDY = (
    ". Check the range calibration of the LiDARs and that no target moved; use matt targets of one "
    "material, and see each from several sides"
)


_SCORE_TEST_REMEDIES = {
    "halves": "Check whether its mount or the target moved during the drive, and its clock",
    "turns": "Late or early stamps have this effect: check its clock, or set solve.time_offset",
    "trust": "Measure it again, or remove 'fixed' so that it is estimated",
    "clock": "Correct its clock, or set solve.time_offset",
}


def _score_test(test: ScoreTest) -> str:
    """The difference that a score test estimates, and how significant it is."""
    overall = float(-ndtri(0.5 * max(p_value(test), 1e-300)))
    if test.kind == "clock":
        late_s, sigma_s = lateness(test)
        return (
            f"lidar '{test.lidar}': its stamps and the motion of the vehicle contradict each "
            f"other: the stamps are {1e3 * abs(late_s):.0f} +- {1e3 * sigma_s:.0f} ms "
            f"{'late' if late_s > 0.0 else 'early'} ({overall:.0f} sigma)"
        )
    d, cov, V = difference(test)
    sigma = np.sqrt(np.diag(cov))
    # d has no part along undetermined directions: an axis that lies in them is not named.
    ratio = np.where(np.sum(V**2, axis=1) > 0.9, np.abs(d) / sigma, 0.0)
    sizes = ", ".join(
        f"{AXES[i]} by {1e3 * d[i]:+.1f} +- {1e3 * sigma[i]:.1f} {'mrad' if i < 3 else 'mm'}"
        for i in np.argsort(-ratio).tolist()[:3]
        if ratio[i] > max(0.5 * ratio.max(), 1.0)
    )
    what = {
        "halves": "its extrinsics from the first and from the second half of its clouds differ",
        "turns": "its extrinsics from left turns and from right turns differ",
        "trust": "its clouds contradict the extrinsic that the config fixes (fixed: true)",
    }[test.kind]
    size = sizes or "along several axes together"
    return f"lidar '{test.lidar}': {what}: {size} ({overall:.0f} sigma in total)"


def _assumed(found: Assumed) -> str:
    if found.kind == "height":
        what, unit = "the height of the vehicle frame above the ground", "m"
        remedy = "Check ground.vehicle_height and ground.sigma"
    else:
        axis = found.kind.removeprefix("tilt_")
        what, unit = f"the tilt of the vehicle against the ground ({axis})", "rad"
        remedy = "Check ground.parallel_sigma_deg and imu.T_vehicle_imu"
    return (
        f"{found.drive}: {what} differs from the config by {found.value:+.3g} {unit} (sigma "
        f"{found.sigma:.2g} {unit}): {abs(found.value) / found.sigma:.0f} sigma. {remedy}"
    )


_HEADING_SOURCES: Mapping[HeadingSource, str] = {
    "imu": "the orientation source",
    "antennas": "the direction by two antennas",
    "none": "the yaw of imu.T_vehicle_imu",
}


def _heading(found: Heading) -> str:
    sigma, off_deg = found.sigma_with_allowance_rad, math.degrees(found.yaw_rad)
    source = _HEADING_SOURCES[found.source]
    remedy = HEADING_REMEDIES[found.source]
    if found.source == "none":
        remedy += f": {off_deg:+.1f} degrees more of yaw would fit"
    return (
        f"{found.drive}: {source} and the direction of travel contradict each other by "
        f"{off_deg:+.2f} +- {math.degrees(sigma):.2f} degrees "
        f"({abs(found.yaw_rad) / sigma:.0f} sigma): the S2V yaw of every LiDAR has the same error. "
        f"{remedy}"
    )
