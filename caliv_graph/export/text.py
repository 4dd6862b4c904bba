"""Text of exported files: numbers, the comment at the top, caveats."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from caliv_graph import __version__
from caliv_graph.conventions import AXES
from caliv_graph.export.request import Request, Transform
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import LidarResult
from caliv_graph.wording.guesses import unseen_sentence

_DECIMALS = 12
"""A picometre or picoradian, as in calibration.yaml."""

_FIRST = "caliv-graph export"
_LAST = "end of caliv-graph export"


def number(value: float) -> str:
    """A number that every YAML, XML and ROS parser reads as a double.

    YAML 1.1 reads 1e-05 as text, and ROS 2 refuses an integer for a double parameter.
    """
    text = f"{value:.{_DECIMALS}f}".rstrip("0")
    text = f"{text}0" if text.endswith(".") else text
    return "0.0" if text == "-0.0" else text


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """Several numbers."""
    return separator.join(number(float(value)) for value in values)


def rpy(pose: gtsam.Pose3) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians as in URDF: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, yaw = (float(angle) for angle in pose.rotation().rpy())
    return roll, pitch, yaw


def quaternion_xyzw(pose: gtsam.Pose3) -> tuple[float, float, float, float]:
    """Unit quaternion, x y z w."""
    q: Any = pose.rotation().toQuaternion()
    return float(q.x()), float(q.y()), float(q.z()), float(q.w())


def undetermined_axes(result: LidarResult) -> list[str]:
    """Vehicle axes along which the drive did not determine an extrinsic."""
    return [axis for axis in AXES if not result.determined[axis]]


def caveats(request: Request, lidars: Iterable[str]) -> list[str]:
    """Warnings about undetermined axes and contradictions of a calibration."""
    lines = []
    if request.calibration.status == "inconsistent":
        lines.append(
            f"{request.source}: status inconsistent: the data contradict each other or the initial "
            "guess. Find the cause before you use this file"
        )
    for name in lidars:
        result = request.calibration.lidars[name]
        axes = undetermined_axes(result)
        if not result.has_data:
            lines.append(unseen_sentence(name, result.without_guess))
        elif axes:
            lines.append(
                f"LiDAR '{name}': {', '.join(axes)} (vehicle axes) not determined by the drive: "
                + (
                    "no initial guess was given, so that the values mean nothing"
                    if result.without_guess
                    else "values of the initial guesses"
                )
            )
    return lines


def notice(request: Request, transforms: Sequence[Transform], extra: Sequence[str] = ()) -> str:
    """The comment of a file with these transforms, several lines without comment marks.

    `without_notice` finds its first and its last line.
    """
    lines = [f"{_FIRST} {__version__} of {request.source}, status {request.calibration.status}"]
    lines.append("Metres and radians unless stated otherwise; R = Rz(yaw) Ry(pitch) Rx(roll).")
    for transform in transforms:
        remark = f" {transform.remark}" if transform.remark else ""
        lines.append(
            f"{transform.lidar}: p_parent = T p_child with parent '{transform.parent}', child "
            f"'{transform.child}'.{remark}"
        )
    lidars = list(dict.fromkeys(transform.lidar for transform in transforms))
    for name in lidars:
        lines += _lines_of(name, request.calibration.lidars[name])
    lines += [*extra, *(f"ATTENTION: {caveat}" for caveat in caveats(request, lidars)), _LAST]
    # Names of frames and LiDARs are user input and must not break a line.
    return "\n".join(" ".join(line.split()) for line in lines)


def with_hash(text: str) -> str:
    """Text as a comment of YAML, Python and the shell."""
    return "".join(f"# {line}\n" for line in text.splitlines())


def with_xml(text: str) -> str:
    """Text as a comment of XML, which must not contain two hyphens in a row."""
    inner = re.sub(r"-(?=-)", "- ", text)
    return f"<!-- {inner} -->\n"


def with_c(text: str) -> str:
    """Text as a comment of C, which GLIM's JSON reader accepts."""
    return f"/* {text.replace('*/', '* /')} */\n"


def without_notice(text: str) -> str:
    """A text without the comment of an earlier export."""
    marks = (
        rf"^# {_FIRST} \d.*?^# {_LAST}\r?\n",
        rf"<!-- {_FIRST} \d.*?{_LAST} -->\r?\n",
        rf"/\* {_FIRST} \d.*?{_LAST} \*/\r?\n",
    )
    for mark in marks:
        text = re.sub(mark, "", text, count=1, flags=re.DOTALL | re.MULTILINE)
    return text


def _lines_of(name: str, result: LidarResult) -> list[str]:
    cov = parent_axes_covariance(result.T_vehicle_lidar, result.cov)
    sigma = np.sqrt(np.diag(cov)) * 1e3
    parts = [
        f"{axis} {value:.3g} {unit}" + ("" if result.determined[axis] else " (guess)")
        for axis, value, unit in zip(AXES, sigma, ["mrad"] * 3 + ["mm"] * 3, strict=True)
    ]
    lines = [f"{name}: 1 sigma of the extrinsic, vehicle axes: {', '.join(parts)}."]
    if result.time_offset is not None:
        late_s, sigma_s = result.time_offset
        lines.append(f"{name}: its stamps are late by {late_s:.6f} s, 1 sigma {sigma_s:.1g} s.")
    return lines
