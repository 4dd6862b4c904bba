"""The same clouds under two names: a topic that was given twice, or republished in another frame.

Two LiDARs never measure the same: the noise of each range is its own. Copies have the same
distances between consecutive points to a fraction of a millimetre, whatever frame they are in.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, IntArray, Recording

SCANS = 5
"""Of each LiDAR that are compared: all that show enough must be copies."""

MIN_COMPARED = 2
"""Of these, with enough points."""

MAX_POINTS = 20_000
"""Of a scan: the first ones, which follow each other as they were measured."""

MIN_POINTS = 100
"""Of a scan that can be compared, and of points that correspond."""

MIN_EXTENT_M = 1.0
"""Of a cloud along its longest axis."""

SAME_M = 1e-3
"""Points of copies agree to it: single precision is 1e-5 m at 100 m, some drivers round to 1 mm.
The noise of a range is 5 mm and more, so that independent clouds agree nowhere."""

LENGTH_M = 2e-3
"""Bin of the distances between consecutive points."""

CHAIN = 4
"""Consecutive distances that must agree for two points to correspond: with bins of 2 mm and a
noise of 5 mm, one in some thousands agrees by chance, and no transform makes those fit."""

SHRINKING_M = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Residuals of the points that a transform is refitted to."""

MIN_SHARE = 0.5
"""Part of the smaller cloud's points that must be in the other, after one transform. A range filter
in either frame drops some; of independent clouds a few are, by chance."""

ON_PLANE_M = 0.03
"""Points this near to the largest plane of a cloud are on it."""

PLANES = 500
"""Planes through three points that are tried: with a fifth on the ground, one in 125 is of it."""


@dataclass(frozen=True)
class Copy:
    """Two LiDARs with the same clouds.

    Attributes:
        lidars: the two.
        moved_m: translation between their frames, 0 if the points are the same.
        turned_rad: rotation between them.
    """

    lidars: tuple[str, str]
    moved_m: float
    turned_rad: float


def copies(recording: Recording) -> tuple[Copy, ...]:
    """Pairs of LiDARs whose clouds are copies, by a few scans of each.

    Raises:
        RecordingError: a cloud could not be read.
    """
    stamps = {
        name: np.asarray(recording.scan_stamps_ns(name), np.int64) for name in recording.lidars
    }
    known = [name for name in recording.lidars if len(stamps[name]) >= SCANS]
    wanted = {name: _pairs_with(name, known, stamps) for name in known}
    clouds: dict[tuple[str, int], Array] = {}
    for name in known:
        chosen = {at for pairs in wanted.values() for pair in pairs for n, at in pair if n == name}
        for scan in recording.scans(name, chosen):
            clouds[name, scan.stamp_ns] = scan.points_lidar[:MAX_POINTS]
    found = []
    for first, second in itertools.combinations(known, 2):
        pairs = [
            (clouds.get(one, NOTHING), clouds.get(other, NOTHING))
            for one, other in wanted[first]
            if other[0] == second
        ]
        fits = [_fit(a, b) for a, b in pairs if _tells(a) and _tells(b)]
        same = [fit for fit in fits if fit is not None]
        if len(same) == len(fits) >= MIN_COMPARED:
            moved, turned = np.median(same, axis=0).tolist()
            found.append(Copy((first, second), moved, turned))
    return tuple(found)


NOTHING = np.zeros((0, 3))

Taken = tuple[str, int]
"""A LiDAR and the stamp of one of its scans."""


def _pairs_with(
    name: str, names: list[str], stamps: Mapping[str, IntArray]
) -> list[tuple[Taken, Taken]]:
    """Scans of a LiDAR spread over the drive, each with the nearest in time of the later LiDARs."""
    own = stamps[name]
    # Not at the very ends, where one of the two may be missing.
    at = own[np.linspace(0, len(own) - 1, SCANS + 2).astype(np.int64)[1:-1]].tolist()
    out = []
    for other in names[names.index(name) + 1 :]:
        for stamp in at:
            nearest = int(stamps[other][np.abs(stamps[other] - stamp).argmin()])
            out.append(((name, stamp), (other, nearest)))
    return out


def _tells(points: Array) -> bool:
    """Whether a cloud (n, 3) shows enough: not all returns are at one place."""
    return len(points) >= MIN_POINTS and float(np.ptp(points, axis=0).max()) > MIN_EXTENT_M


def _fit(one: Array, other: Array) -> tuple[float, float] | None:
    """Translation and rotation between two clouds (n, 3) and (m, 3); None if they are no copies."""
    smaller, larger = (one, other) if len(one) <= len(other) else (other, one)
    judged = smaller[_decisive(smaller)]
    if len(judged) < MIN_POINTS:
        return None
    tree = cKDTree(larger)
    for R, t in _transforms(one, other):
        moved = judged @ R.T + t if smaller is one else (judged - t) @ R
        distance, _ = tree.query(moved, distance_upper_bound=SAME_M)
        if float(np.isfinite(distance).mean()) >= MIN_SHARE:
            cosine = 0.5 * (float(np.trace(R)) - 1.0)
            return float(np.linalg.norm(t)), float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return None


def _transforms(one: Array, other: Array) -> Iterator[tuple[Array, Array]]:
    """R and t that may bring one cloud to the other: none, point by point, by likeness."""
    yield np.eye(3), np.zeros(3)
    starts = [_corresponding(one, other)]
    if len(one) == len(other):
        starts.insert(0, (np.arange(len(one)), np.arange(len(one))))
    for i, j in starts:
        T = _transform(one, other, i, j)
        if T is not None:
            yield T


def _decisive(points: Array) -> IntArray:
    """(k,) indices of points (n, 3) whose agreement tells copies from similar views.

    Noise does. Without it, which only a simulation is, two LiDARs on level ground see the same
    rings: then only what is beside the ground counts.
    """
    rng = np.random.default_rng(0)
    triples = points[rng.integers(0, len(points), (PLANES, 3))]
    normals = cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0.0] / length[length > 0.0, None]
    offsets = np.sum(normals * triples[length > 0.0, 0], axis=1)
    some = points[:: max(1, len(points) // 2000)]
    near = np.abs(some @ normals.T - offsets) < ON_PLANE_M
    best = int(near.sum(axis=0).argmax())
    height = points @ normals[best] - offsets[best]
    on_plane = np.abs(height) < ON_PLANE_M
    noise_m = float(np.median(np.abs(height[on_plane])))
    return np.arange(len(points)) if noise_m > SAME_M else np.flatnonzero(~on_plane)


def _transform(one: Array, other: Array, i: IntArray, j: IntArray) -> tuple[Array, Array] | None:
    """R and t that bring `one` to `other`, by points that may correspond, some falsely."""
    if len(i) < MIN_POINTS:
        return None
    near = np.ones(len(i), dtype=bool)
    for limit_m in (np.inf, *SHRINKING_M, SAME_M, SAME_M):
        R, t = _rigid(one[i[near]], other[j[near]])
        left = np.linalg.norm(one[i] @ R.T + t - other[j], axis=1)
        # False ones bend the first fits: half of all are kept.
        near = left < min(limit_m, max(float(np.median(left)), SAME_M))
        if near.sum() < MIN_POINTS // 2:
            return None
    return R, t


def _corresponding(one: Array, other: Array) -> tuple[IntArray, IntArray]:
    """Indices of points of both clouds whose next few points are at the same distances."""
    keys = []
    for points in (one, other):
        bins = np.round(np.linalg.norm(np.diff(points, axis=0), axis=1) / LENGTH_M).astype(np.int64)
        chains = np.lib.stride_tricks.sliding_window_view(bins, CHAIN)
        # Distances of a few metres: each fits into 15 bits.
        keys.append((np.clip(chains, 0, 2**15 - 1) << (15 * np.arange(CHAIN))).sum(axis=1))
    # Chains that occur once in a cloud: the others tell nothing.
    unique = []
    for key in keys:
        values, first, count = np.unique(key, return_index=True, return_counts=True)
        unique.append((values[count == 1], first[count == 1]))
    _, i, j = np.intersect1d(unique[0][0], unique[1][0], assume_unique=True, return_indices=True)
    return np.asarray(unique[0][1][i], np.int64), np.asarray(unique[1][1][j], np.int64)


def _rigid(p: Array, q: Array) -> tuple[Array, Array]:
    """R (3, 3) and t (3,) with `q = R p + t`, least squares (Kabsch)."""
    centre_p, centre_q = p.mean(axis=0), q.mean(axis=0)
    U, _, Vt = np.linalg.svd((q - centre_q).T @ (p - centre_p))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(U @ Vt)))])
    R = U @ sign @ Vt
    return R, centre_q - R @ centre_p
