"""Vehicle poses in a file: TUM, CSV, KITTI's rows of 12 numbers, nuScenes' ego_pose.json.

| file | a row |
|---|---|
| TUM (.txt, .tum) | `timestamp x y z qx qy qz qw`, blanks between; seconds |
| CSV | the same with commas; or a header that names its columns, in any order |
| KITTI | 12 numbers, a 3 x 4 matrix row by row, without a time: one row per cloud |
| nuScenes | JSON: a list of `timestamp` (us), `translation`, `rotation` (w, x, y, z) |
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.config.model import PoseAxes
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.products import Array, GivenPoses, IntArray
from caliv_graph.readers.poses import poses_of

_MOST_BYTES = 1_000_000_000
"""ego_pose.json of all of nuScenes has half of it."""

_MOST_M = 1e8
_NORM_TOLERANCE = 1e-2
"""Of a quaternion: rounding to two decimals is off by less."""

_TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")

_WHOLE_SECONDS = re.compile(r"(^|[^a-z])secs?$")
"""Name of a column with the seconds of a stamp, whose nanoseconds are in another one."""

_HEADER_STAMP = re.compile(r"(^|[^a-z])stamp$")
"""Name of a column with the stamp of a message: field.header.stamp, /odom/header/stamp. Another
time beside it is that of the recording: %time of `rostopic echo -b`, __time of PlotJuggler."""

_MATRIX_TOLERANCE = 1e-3
"""By which a rotation matrix may differ from one: rounding to four decimals."""

_LEAST_TRAVEL_M = 1.0
"""Of the way from which the axis of travel is told."""

R_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Vehicle axes (x forward, y left, z up) from those of a camera (x right, y down, z forward)."""

_MOST_US = 2**62 // 1000
"""Of a time that is still an integer in nanoseconds."""

_UNITS = ((10**17, 1), (10**14, 10**3), (10**11, 10**6))
"""Least absolute time since 1970 that is written in ns, us and ms, and nanoseconds of each."""


def stamp_of(text: str) -> int | None:
    """Nanoseconds of a time in seconds, milliseconds, microseconds or nanoseconds, by its size.

    Seconds with nine decimals are more than a float holds. None: it is no time.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    if not value.is_finite() or not 0 <= value < 2**62:
        return None
    scale = next((ns for least, ns in _UNITS if value >= least), NANOSECONDS_PER_SECOND)
    stamp_ns = int(value * scale)
    return stamp_ns if stamp_ns < 2**62 else None


def read_poses(path: Path, cloud_stamps_ns: Sequence[int] | None = None) -> GivenPoses:
    """Reads the poses `T_map_vehicle` of a drive.

    Args:
        path: the file.
        cloud_stamps_ns: stamps of clouds, ascending. A file without times has one pose for each.
            None: such a file is refused.

    Raises:
        RecordingError: the file is missing or none of the formats; a pose is damaged; a file
            without times has not as many poses as there are clouds.
    """
    try:
        text = read_input(path, _MOST_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file. Set data.poses to the poses' file") from None
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: is not text in UTF-8. Write the poses as text") from None
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None
    if text.lstrip().startswith("["):
        return _given(*_json_rows(text, path), path)
    names, lines = _table(text)
    if not lines:
        raise RecordingError(f"{path}: holds no poses. Expected TUM, CSV or KITTI poses")
    if not names and len(lines[0][1]) == 12:
        return _kitti(lines, path, cloud_stamps_ns)
    columns = _columns(names, path) if names else dict(zip(_TUM, range(8), strict=True))
    rows = np.empty((len(lines), 7))
    stamps = np.empty(len(lines), np.int64)
    for i, (number, values) in enumerate(lines):
        where = f"{path}, line {number}"
        if len(values) <= max(columns.values()) or (not names and len(values) != 8):
            raise RecordingError(
                f"{where}: {len(values)} values, expected timestamp x y z qx qy qz qw (TUM), or a "
                "header line that names the columns (CSV)"
            )
        stamp_ns = _time(values[columns["time"]], where)
        if "nanoseconds" in columns:
            part_ns = _number(values[columns["nanoseconds"]], where)
            if not 0 <= part_ns < NANOSECONDS_PER_SECOND:
                raise RecordingError(
                    f"{where}: {part_ns:g} ns is not a part of a second, expected 0 to 999999999"
                )
            stamp_ns += int(part_ns)
        stamps[i] = stamp_ns
        rows[i] = [_number(values[columns[name]], where) for name in _TUM[1:]]
    if "recorded" in columns and not stamps.any():  # nobody set the stamps: as in a bag
        recorded = [(f"{path}, line {n}", values[columns["recorded"]]) for n, values in lines]
        stamps = np.array([_time(text, where) for where, text in recorded], np.int64)
    return _given(stamps, rows, path)


def _table(text: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns (none without a header), and number and values of each line."""
    names: list[str] = []
    lines: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        bare = line.strip()
        comment = bare.startswith(("#", "%"))
        values = [v.strip() for v in re.split(r"[,;]" if re.search("[,;]", bare) else r"\s+", bare)]
        values = values[:-1] if values and not values[-1] else values  # a comma ends the line
        if not bare:
            continue
        if comment or not re.fullmatch(r"[-+.\deE]+|nan", values[0]):
            # A comment of a TUM file may name its columns, too, but in the order that it has; and
            # one with a comma need not name any.
            header = [v.lstrip("#% ") for v in values]
            if comment and (len(values) == 1 or set(_TUM) - {_meaning(_plain(v)) for v in header}):
                continue
            if not lines and (not comment or re.search("[,;]", bare)):
                names = header
            elif not comment:
                lines.append((number, values))
            continue
        lines.append((number, values))
    return names, lines


def _columns(names: Sequence[str], path: Path) -> dict[str, int]:
    """Index of each value of a pose by the header of a CSV.

    Where messages are recorded with their stamps, `time` is the stamp and `recorded` the other.
    """
    found: dict[str, int] = {}
    seconds: int | None = None
    stamp: int | None = None
    for index, name in enumerate(names):
        plain = _plain(name)
        meaning = _meaning(plain)
        if meaning is not None:
            found.setdefault(meaning, index)
        if meaning == "time" and seconds is None and _WHOLE_SECONDS.search(plain):
            seconds = index
        if meaning == "time" and stamp is None and _HEADER_STAMP.search(plain):
            stamp = index
    first = found.get("time")
    # Beside the two parts of a stamp there may be the time of recording, with its fraction.
    if "nanoseconds" in found and seconds is not None:
        found["time"] = seconds
    elif "nanoseconds" in found and "time" not in found:
        found["time"] = found.pop("nanoseconds")
    elif stamp is not None:
        found["time"] = stamp
    if first is not None and first != found["time"]:
        found["recorded"] = first
    missing = [name for name in _TUM if name not in found]
    if missing:
        raise RecordingError(
            f"{path}: its header names no column for {', '.join(missing)}: "
            f"{', '.join(names)[:200]}. Name them timestamp, x, y, z, qx, qy, qz, qw"
        )
    return found


def _plain(name: str) -> str:
    """A name in lower case, without a unit in brackets."""
    return re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower()


def _meaning(plain: str) -> str | None:
    """The value that a column of this name holds: one of `_TUM`, or `nanoseconds`."""
    if re.search(r"nsec|nanosec", plain):
        return "nanoseconds"
    if plain in ("t", "sec", "secs") or re.search(r"time|stamp|\bsecs?$", plain):
        return "time"
    match = re.fullmatch(r"(.*?)[._ ]?([xyzw])", plain)
    if match is None:
        return None
    before, axis = match.groups()
    if re.search(r"vel|acc|gyr|omega|twist|cov|std|sigma|rate|bias|\bv$|\ba$|^[vawb]_", before):
        return None
    if re.search(r"^q|quat|orient|rot", before):
        return f"q{axis}"
    return axis if axis != "w" and re.fullmatch(r"|[pt]|[pt]_.*|.*(pos|trans).*", before) else None


def _time(text: str, where: str) -> int:
    stamp_ns = stamp_of(text)
    if stamp_ns is None:
        raise RecordingError(f"{where}: {text[:40]!r} is not a time. Write seconds")
    return stamp_ns


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RecordingError(
            f"{where}: {text[:40]!r} is not a number. Mend or remove the line"
        ) from None


def _json_rows(text: str, path: Path) -> tuple[IntArray, Array]:
    try:
        entries: Any = json.loads(text)
        table = {
            int(e["timestamp"]): [*e["translation"], *e["rotation"][1:], e["rotation"][0]]
            for e in entries
        }
        stamps = np.array(sorted(table), np.int64) * 1000
        rows = np.array([table[key] for key in sorted(table)], np.float64)
        if rows.shape != (len(stamps), 7) or not len(rows):
            raise ValueError
        if min(table) < 0 or max(table) >= _MOST_US:
            raise ValueError
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError):
        raise RecordingError(
            f"{path}: is JSON, expected a list of poses with timestamp (us), translation and "
            "rotation (w, x, y, z), as ego_pose.json of nuScenes"
        ) from None
    return stamps, rows


def _kitti(
    lines: Sequence[tuple[int, list[str]]], path: Path, cloud_stamps_ns: Sequence[int] | None
) -> GivenPoses:
    """Poses of KITTI's odometry: of a camera, or of whatever moves along its x axis."""
    if cloud_stamps_ns is None or len(cloud_stamps_ns) != len(lines):
        clouds = "the clouds of a bag" if cloud_stamps_ns is None else len(cloud_stamps_ns)
        raise RecordingError(
            f"{path}: {len(lines)} poses of 12 numbers have no times, and cannot be those of "
            f"{clouds} {'clouds' if cloud_stamps_ns is not None else ''}".rstrip()
            + ". Write them as TUM: timestamp x y z qx qy qz qw"
        )
    M = np.empty((len(lines), 3, 4))
    for i, (number, values) in enumerate(lines):
        where = f"{path}, line {number}"
        if len(values) != 12:
            raise RecordingError(f"{where}: {len(values)} values, expected 12 as in line 1")
        M[i] = np.reshape([_number(v, where) for v in values], (3, 4))
    R, t = M[:, :, :3], M[:, :, 3]
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rotates = (off <= _MATRIX_TOLERANCE) & (np.linalg.det(R) > 0.0)
        good = rotates & (np.abs(t) <= _MOST_M).all(axis=1)
    if not good.all():
        worst = int(np.flatnonzero(~good)[0])
        what = "usable position" if rotates[worst] else "rotation"
        raise RecordingError(f"{path}, line {lines[worst][0]}: holds no {what}. Mend or remove it")
    if _moves_along_z(R, t, path):
        R = R_CAMERA @ R @ R_CAMERA.T
        t = t @ R_CAMERA.T
    poses = tuple(gtsam.Pose3(gtsam.Rot3(a), b) for a, b in zip(R, t, strict=True))
    return GivenPoses(np.array(cloud_stamps_ns, np.int64), poses)


def _moves_along_z(R: Array, t: Array, path: Path) -> bool:
    """Whether the way is along the z axis of the poses, as a camera's, rather than along x."""
    steps = np.einsum("nji,nj->ni", R[:-1], np.diff(t, axis=0))
    travelled = np.abs(steps).sum(axis=0)
    if max(travelled[0], travelled[2]) < _LEAST_TRAVEL_M:
        raise RecordingError(
            f"{path}: the poses move by less than {_LEAST_TRAVEL_M:g} m, and it cannot be told "
            "whether their axes are a camera's. Write them as TUM, with x forward"
        )
    return bool(travelled[2] > travelled[0])


def _given(stamps_ns: IntArray, rows: Array, path: Path) -> GivenPoses:
    """Poses by time from rows (n, 7) of x y z qx qy qz qw; of two with one time the first."""
    with np.errstate(invalid="ignore", over="ignore"):
        norms = np.linalg.norm(rows[:, 3:], axis=1)
        good = (np.abs(norms - 1.0) <= _NORM_TOLERANCE) & (np.abs(rows[:, :3]) <= _MOST_M).all(1)
    if not good.all():
        worst = int(np.flatnonzero(~good)[0])
        raise RecordingError(
            f"{path}: pose {worst + 1} is {rows[worst].tolist()}: expected x y z in metres and "
            "qx qy qz qw, a unit quaternion. Mend or remove it"
        )
    order = np.argsort(stamps_ns, kind="stable")
    stamps_ns, rows = stamps_ns[order], rows[order]
    keep = np.concatenate([[True], np.diff(stamps_ns) > 0])
    stamps_ns, rows = stamps_ns[keep], rows[keep]
    return GivenPoses(stamps_ns, poses_of(rows[:, :3], rows[:, 3:]))


def in_vehicle_axes(poses: GivenPoses, axes: PoseAxes) -> GivenPoses:
    """Poses of a vehicle with x forward, y left, z up, in a map with z up, from those in `axes`.

    Half a turn about x: with `frd`, T_map_flu = T_map_frd C; with `ned`, also of the map, C T C.
    Right perturbations of the result are those of the old axes turned by C.
    """
    if axes == "flu":
        return poses
    C = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
    turned = tuple((C.compose(T) if axes == "ned" else T).compose(C) for T in poses.T_map_vehicle)
    signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    cov = None if poses.cov is None else poses.cov * np.outer(signs, signs)
    frame = poses.frame
    if frame is not None and frame.T_vehicle_frame is not None:
        frame = replace(frame, T_vehicle_frame=frame.T_vehicle_frame.compose(C))
    return replace(poses, T_map_vehicle=turned, cov=cov, frame=frame)


def check_overlap(poses: GivenPoses, path: Path, span_ns: tuple[int, int], what: str) -> None:
    """Raises RecordingError if the poses are of another time than the clouds of a recording.

    `span_ns` are the first and last stamp of the clouds, `what` names the recording.
    """
    first, last = int(poses.stamps_ns[0]), int(poses.stamps_ns[-1])
    if last < span_ns[0] or first > span_ns[1]:
        raise RecordingError(
            f"{path}: its poses are of {first / 1e9:.3f} to {last / 1e9:.3f} s, the clouds of "
            f"{what} of {span_ns[0] / 1e9:.3f} to {span_ns[1] / 1e9:.3f} s. Give the times of the "
            "poses in the clock of the clouds"
        )
