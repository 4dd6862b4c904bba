"""Marks of a drive's messages, by which parts and copies of one recording are known as one drive.

A copy without a topic, cut in time or thinned has another digest (`terms.drive_digest`). Its
messages are those of the first recording, and noise makes each of them unlike any of another drive.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from caliv_graph.calibration.assemble import DRIVES, MARKS
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.odometry import OdometryPoses

MARKS_OF_TOPIC = 16
"""The smallest hashes of the messages of a topic: of a copy that has a part of them, the marks are
marks of the whole as often as that part says (bottom-k sketches; Cohen and Kaplan, 2007)."""

HASHED_ROWS = 1024
"""Messages that are hashed at a time: the memory of the hashes does not grow with the drive."""

FEWEST_SHARED = 3
"""Marks that two drives share by no chance. Exact poses of two simulated drives may share the one
at the start."""


def drive_marks(motion: MotionData) -> tuple[str, ...]:
    """The marks of a drive; none without motion data. No YAML reader takes them for numbers."""
    out = []
    for stamps, values in _topics(motion):
        smallest: list[str] = []
        for begin in range(0, len(stamps), HASHED_ROWS):
            some = slice(begin, begin + HASHED_ROWS)
            smallest = sorted({*smallest, *_hashes(stamps[some], values[some])})[:MARKS_OF_TOPIC]
        out += smallest
    return tuple(out)


def _hashes(stamps_ns: IntArray, values: Array) -> Iterator[str]:
    """The hash of each of n messages, of stamps (n,) and values (n, k)."""
    rows = np.ascontiguousarray(values, np.float64)
    for stamp, row in zip(stamps_ns.tolist(), rows, strict=True):
        yield "m" + hashlib.blake2b(row.tobytes(), digest_size=6, key=b"%d" % stamp).hexdigest()


def _topics(motion: MotionData) -> Iterator[tuple[IntArray, Array]]:
    """Stamps (n,) and values (n, k) of each kind of message."""
    if motion.imu is not None:
        yield (
            motion.imu.stamps_ns,
            np.hstack([motion.imu.angular_velocity, motion.imu.specific_force]),
        )
    if motion.gnss is not None:
        fixes = motion.gnss
        columns = [fixes.latitude_deg, fixes.longitude_deg, fixes.altitude_m]
        yield fixes.stamps_ns, np.column_stack(columns)
    if motion.twist is not None:
        yield motion.twist.stamps_ns, motion.twist.velocity
    if motion.poses is not None and not isinstance(motion.poses, OdometryPoses):
        R, t = stack(motion.poses.T_map_vehicle)
        yield motion.poses.stamps_ns, np.hstack([R.reshape(-1, 9), t])


def marked_drives(provenance: Mapping[str, object]) -> dict[str, frozenset[str]]:
    """Digest of a drive -> its marks, of a result and of all that it was made of."""
    out: dict[str, frozenset[str]] = {}
    digests, marks = provenance.get(DRIVES), provenance.get(MARKS)
    if isinstance(digests, Sequence) and isinstance(marks, Sequence):
        for digest, of in zip(digests, marks, strict=False):
            if isinstance(of, Sequence):
                out[str(digest)] = frozenset(map(str, of))
    for value in provenance.values():
        inner = value if isinstance(value, list | tuple) else [value]
        for part in inner:
            if isinstance(part, Mapping):
                out |= marked_drives(part)
    return out


def are_one(first: frozenset[str], second: frozenset[str]) -> bool:
    """Whether two drives have messages in common."""
    return len(first & second) >= FEWEST_SHARED
