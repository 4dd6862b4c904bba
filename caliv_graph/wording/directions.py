"""Names of directions that the data do not determine, and what would determine them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.products import Array, Direction, Uncertainty
from caliv_graph.uncertainty.observability import (
    UNIT,
    looks_the_same,
    rigid_twist,
    undetermined_twists,
)
from caliv_graph.uncertainty.predicted import PredictedCovariance
from caliv_graph.wording.remedies import REMEDIES, TURNED_ALREADY, Evidence, evidence_of

NOTABLE = 0.2
"""Fraction of a direction's largest coordinate from which an axis is named."""

STATIONARY_TWISTS = 5
"""Undetermined motions of all LiDARs together from which the vehicle did not move: driving straight
ahead leaves four undetermined, and five past walls without ground, the yaw being determined."""

PARAMETER_KEYS = {
    "lever_arm": "gnss.lever_arm",
    "imu_place": "imu.T_vehicle_imu.xyz",
    "imu_rotation": "imu.T_vehicle_imu",
    "wheels_rotation": "wheels.T_vehicle_wheels",
    "heading_yaw": "heading.yaw_deg",
    "gnss_time_offset": "gnss.time_offset",
    "imu_time_offset": "imu.time_offset",
    "twist_time_offset": "twist.time_offset",
    "pose_time_offset": "time offset of topics.pose",
    "speed_scale": "scale of the speeds in topics.twist",
}
"""What was measured on the vehicle, or is the clock of a sensor -> what messages call it."""


def same_as_parameters(
    uncertainty: Uncertainty, D: Array, knowing: Mapping[str, Array]
) -> Uncertainty:
    """The named findings, with the parameters of the vehicle that look the same as a direction.

    `D` (6n, 6n) is the information of the data, `knowing` the same if a parameter were known.
    """
    undetermined = []
    for direction in uncertainty.undetermined:
        keys = [
            PARAMETER_KEYS[name]
            for name, D_knowing in knowing.items()
            if looks_the_same(direction, D, D_knowing)
        ]
        if keys:
            which = _listed(keys)
            direction = replace(
                direction,
                text=f"{direction.text}; an error of {which} looks the same",
                remedy=f"measure {which} and state its sigma, or {direction.remedy}",
            )
        undetermined.append(direction)
    return replace(uncertainty, undetermined=tuple(undetermined))


def named(
    uncertainty: Uncertainty,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    evidence: Evidence = "target",
) -> Uncertainty:
    """The same findings, each direction with its text and its remedy, at the given extrinsics.

    `evidence` is what the LiDARs saw: a remedy speaks of it.
    """
    stationary = stationary_text(uncertainty.undetermined, T_vehicle_lidar)
    undetermined = []
    for direction in _each_named(uncertainty.undetermined, T_vehicle_lidar, False, evidence):
        if stationary and direction.together:
            direction = replace(direction, text=stationary, remedy=REMEDIES[evidence].stationary)
        undetermined.append(direction)
    weak = _each_named(uncertainty.weak, T_vehicle_lidar, True, evidence)
    return replace(uncertainty, undetermined=tuple(undetermined), weak=tuple(weak))


def named_prediction(
    predicted: PredictedCovariance, evidence: Evidence | None = None
) -> PredictedCovariance:
    """The same prediction, each direction with its text and its remedy.

    `evidence` is what the LiDARs saw; None: as the results of the LiDARs say.
    """
    poses = {n: predicted.calibration.lidars[n].T_vehicle_lidar for n in predicted.lidars}
    evidence = evidence or evidence_of(predicted.calibration.lidars.values())
    uncertainty = named(predicted.uncertainty, poses, evidence)
    calibration = replace(
        predicted.calibration, undetermined=uncertainty.undetermined, weak=uncertainty.weak
    )
    return replace(predicted, uncertainty=uncertainty, calibration=calibration)


def _each_named(
    directions: Iterable[Direction],
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    weak: bool,
    evidence: Evidence,
) -> Iterable[Direction]:
    for direction in directions:
        yield replace(
            direction,
            text=describe(direction.vector, T_vehicle_lidar),
            remedy=remedy(direction.vector, T_vehicle_lidar, weak, evidence),
        )


def describe(parts: Mapping[str, Array], T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> str:
    """The name of a direction: per LiDAR (6,), vehicle axes, rad and m, any common scale."""
    twist = rigid_twist(parts, T_vehicle_lidar)
    if twist is None:
        return _describe_apart(parts)
    names = list(parts)
    together = len(names) > 1
    return _describe_twist(twist, "all LiDARs" if together else f"lidar '{names[0]}'", together)


def remedy(
    parts: Mapping[str, Array],
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    weak: bool = False,
    evidence: Evidence = "target",
) -> str:
    """What would determine a direction (as in `describe`): a manoeuvre, or a setting."""
    twist = rigid_twist(parts, T_vehicle_lidar)
    known = REMEDIES[evidence]
    if twist is None:
        size = np.max([np.abs(part / UNIT) for part in parts.values()], axis=0)
        by_axis = {"yaw": known.apart_yaw, "z": known.apart_z}
        return known.more if weak else by_axis.get(AXES[size.argmax()], known.apart)
    notable = set(_notable(twist))
    if notable == {"z"}:
        return known.height
    done = TURNED_ALREADY if weak and evidence != "odometry" else ""
    if "yaw" in notable and notable <= {"yaw", "x", "y"}:
        return known.turn_centre + done
    if notable & {"x", "y"}:
        return known.straight + done
    return known.tilt if notable <= {"roll", "pitch"} else known.stationary


def stationary_text(
    undetermined: Sequence[Direction], T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> str:
    """The name of every common direction of a vehicle that did not move; empty if it moved."""
    lost, best = undetermined_twists(undetermined, T_vehicle_lidar)
    if lost < STATIONARY_TWISTS:
        return ""
    if lost == len(AXES):
        return "all S2V axes: the vehicle did not move"
    # The one motion that is determined. The ground determines the height; of a vehicle that drove
    # straight ahead past walls, without ground, the yaw is determined.
    axis = AXES[int(np.abs(best / UNIT).argmax())]
    if axis == "yaw":
        return ""
    but = "the height" if axis == "z" else "one"
    return f"all S2V axes but {but}: the vehicle did not move"


def _notable(twist: Array) -> list[str]:
    """Axes of a twist that are named."""
    scaled = np.abs(twist / UNIT)
    leading = scaled / scaled.max()
    return [axis for axis, size in zip(AXES, leading, strict=True) if size > NOTABLE]


def _describe_twist(twist: Array, whole: str, several: bool) -> str:
    """A motion of the whole sensor set relative to the vehicle."""
    together = " together" if several else ""
    notable = _notable(twist)
    if notable == ["z"]:
        return f"height of {whole}{together}"
    if notable in (["x"], ["y"]):
        way = "forward" if notable == ["x"] else "sideways"
        return f"shift of {whole}{together} {way}: {notable[0]}"
    if "yaw" in notable and set(notable) <= {"yaw", "x", "y"}:
        shift = " and ".join(axis for axis in ("x", "y") if axis in notable)
        if not shift:
            return f"rotation of {whole} about the vertical through the vehicle frame: yaw"
        radius_m = float(np.hypot(twist[3], twist[4]) / abs(twist[2]))
        return (
            f"rotation of {whole} about the turn centre: {shift} and yaw together, "
            f"{radius_m:.2f} m per rad"
        )
    return f"{' and '.join(notable)} of {whole}{together}"


def _describe_apart(parts: Mapping[str, Array]) -> str:
    """A direction in which LiDARs move relative to each other."""
    largest = max(float(np.abs(p / UNIT).max()) for p in parts.values())
    sizes = {
        name: size
        for name, part in parts.items()
        if ((size := np.abs(part / UNIT / largest)) > NOTABLE).any()
    }
    names = list(sizes)
    if len(names) == 1:
        axes = [axis for axis, v in zip(AXES, sizes[names[0]], strict=True) if v > NOTABLE]
        together = " together" if len(axes) > 1 else ""
        return f"{' and '.join(axes)} of lidar '{names[0]}'{together}"
    # Which way each of them moves is in the vector; the text names the axes, the largest first.
    of_any = np.max(list(sizes.values()), axis=0)
    order = np.argsort(-of_any, kind="stable").tolist()
    affected = _listed([AXES[i] for i in order if of_any[i] > NOTABLE])
    quoted = [f"'{name}'" for name in names]
    return f"relative {affected} between lidars {_listed(quoted)}"


def _listed(words: Sequence[str]) -> str:
    """The words as a person lists them: a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
