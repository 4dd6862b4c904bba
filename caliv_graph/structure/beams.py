"""Errors of the beams of a LiDAR that change with their elevation: its channels differ.

Each channel has a range and a direction of its own, calibrated to millimetres and tenths of a
milliradian, the same in every scan. A LiDAR that is pitched sees the wall ahead with other channels
than that behind, and what these differ by looks like its place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches, fitted_along

KINDS = 5
"""Of one elevation: the range, m; elevation and azimuth of the beam, rad; and how the first two
change from there to the next channels, m/rad and rad/rad. A patch of two or three channels is
tilted by what these differ, in every scan alike."""

RANGE, AZIMUTH = 0, 2
"""Which of them are the range and the azimuth."""

NODES = 16
"""Elevations at most between which the errors of a LiDAR change linearly."""

LEAST_APART_RAD = np.radians(0.5)
"""Smallest distance of two of them: a patch has no less."""

MEANS = {RANGE: 1e-4, AZIMUTH: 1e-5}
"""1 sigma of the mean error of all elevations of a LiDAR, by kind, m and rad: that of the ranges is
its bias, which has a variable of its own, and that of the azimuth is what its yaw means."""


@dataclass(frozen=True)
class SeenBeams:
    """What the errors of the beams add to the residuals of Q sightings, at most W nodes each.

    Attributes:
        node: (Q, W) of all LiDARs, numbered through; any where `by` is zero.
        by: (Q, W, KINDS, 4) linear in h = (p, 1), by an error of 1 at the node.
    """

    node: IntArray
    by: Array

    def only(self, keep: IntArray | BoolArray) -> SeenBeams:
        """Those of some sightings."""
        return SeenBeams(self.node[keep], self.by[keep])


def elevations(patches: DrivePatches) -> Array:
    """(N,) of the middle of each patch, rad, about the z axis of its LiDAR."""
    x, y, z = patches.centres_lidar.T
    return np.asarray(np.arctan2(z, np.hypot(x, y)))


def beam_nodes(patches: DrivePatches) -> tuple[Array, ...]:
    """Of each LiDAR the elevations (k,) between which its errors change linearly, ascending.

    As many patches between two of them as between any others.
    """
    seen, lidar = elevations(patches), patches.scan_lidar[patches.scan]
    out = []
    for i in range(len(patches.lidars)):
        own = seen[lidar == i]
        nodes = list(np.quantile(own, np.linspace(0.0, 1.0, NODES))) if len(own) else [0.0]
        kept = nodes[:1]
        for node in nodes[1:]:
            if node - kept[-1] >= LEAST_APART_RAD:
                kept.append(node)
        out.append(np.array(kept))
    return tuple(out)


def seen_beams(
    nodes: tuple[Array, ...],
    elevation: Array,
    lidar: IntArray,
    centres: Array,
    normals: Array,
    moments: Array,
    starts: IntArray,
) -> SeenBeams:
    """What the beams' errors are in sightings, each of which is the sum of some patches.

    A range that is too long by b moves points by `-b cos(incidence)` along the normal; an error of
    the direction moves them across the beam. Over a sighting the errors of its patches are fitted
    by a plane, along its surface only.

    Args:
        nodes: of each LiDAR (`beam_nodes`).
        elevation: (n,) of the patches, sighting by sighting.
        lidar: (n,) whose they are.
        centres: (n, 3) in the lidar frame at the stamp.
        normals: (n, 3) of their strips, likewise.
        moments: (n, 4, 4) weighted.
        starts: (Q,) first patch of each sighting.
    """
    first = np.cumsum([0, *map(len, nodes)])[:-1]
    low, share = np.zeros(len(elevation), dtype=np.int64), np.zeros(len(elevation))
    for i, own_nodes in enumerate(nodes):
        own = lidar == i
        if len(own_nodes) > 1:
            place = np.searchsorted(own_nodes, elevation[own], side="right") - 1
            place = np.clip(place, 0, len(own_nodes) - 2)
            step = (elevation[own] - own_nodes[place]) / np.diff(own_nodes)[place]
            low[own], share[own] = place, np.clip(step, 0.0, 1.0)
        low[own] += first[i]
    distance = np.linalg.norm(centres, axis=1)
    flat = np.hypot(centres[:, 0], centres[:, 1])
    along = centres / distance[:, None]
    x, y = (centres[:, :2] / np.maximum(flat, 1e-9)[:, None]).T
    up, left = np.zeros_like(centres), np.zeros_like(centres)
    up[:, 0], up[:, 1], up[:, 2] = -along[:, 2] * x, -along[:, 2] * y, flat / distance
    left[:, 0], left[:, 1] = -y, x
    by_kind = [
        np.einsum("ni,ni->n", normals, moved)
        for moved in (along, distance[:, None] * up, flat[:, None] * left)
    ]
    value = -np.stack([*by_kind, *by_kind[:2]], axis=1)

    number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(elevation)))
    several = int(sum(map(len, nodes)))
    key = np.concatenate([number * several + low, number * several + low + (share > 0.0)])
    weight = np.concatenate([1.0 - share, share])
    steeper = np.column_stack([up, -np.einsum("ni,ni->n", up, centres)]) / distance[:, None]
    changes = np.einsum("nij,nj->ni", moments, steeper)
    parts = [moments[:, :, 3]] * 3 + [changes] * 2
    by_point = np.tile(value[:, :, None] * np.stack(parts, axis=1), (2, 1, 1))
    keys, at = np.unique(key, return_inverse=True)
    total = np.zeros((len(keys), KINDS, 4))
    np.add.at(total, at.ravel(), weight[:, None, None] * by_point)

    of, node = np.divmod(keys, several)
    fitted = fitted_along(np.add.reduceat(moments, starts), normals[starts], total, of)
    begin = np.searchsorted(of, np.arange(len(starts)))
    place = np.arange(len(keys)) - begin[of]
    width = int(place.max(initial=-1)) + 1
    out = SeenBeams(
        np.zeros((len(starts), width), dtype=np.int64), np.zeros((len(starts), width, KINDS, 4))
    )
    out.node[of, place] = node
    out.by[of, place] = fitted
    return out


def mean_rows(
    beams: tuple[int, ...], first: int, errors: Array
) -> tuple[scipy.sparse.csr_array, Array]:
    """Rows (2 n, D) and residuals (2 n,) of the mean errors of each of n LiDARs, by their sigmas.

    Of `MEANS`. A turn about the axis of the channels is the same as an error of all their azimuths:
    left to the priors of these, a turn of 0.4 mrad passed for sixteen errors.

    Args:
        beams: number of elevations of each LiDAR.
        first: coordinate of the first error of the beams.
        errors: (D,).
    """
    n = len(beams)
    lidar = np.repeat(np.arange(n), beams)
    column = np.concatenate([first + KINDS * np.arange(len(lidar)) + kind for kind in MEANS])
    row = np.concatenate([lidar + n * i for i in range(len(MEANS))])
    each = [mean_weight(beams[i], kind) for kind in MEANS for i in lidar.tolist()]
    J = scipy.sparse.csr_array((np.array(each), (row, column)), shape=(len(MEANS) * n, len(errors)))
    return J, np.asarray(J @ errors)


def mean_weight(count: int, kind: int) -> float:
    """The entry of a row of `mean_rows`, of a LiDAR with `count` elevations; 0: it has none."""
    return 1.0 / (count * MEANS[kind]) if kind in MEANS else 0.0
