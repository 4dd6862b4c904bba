"""Errors of the beams of a LiDAR: its channels differ.

Each channel has a range and a direction of its own, calibrated to millimetres and tenths of a
milliradian, the same in every scan. A LiDAR that is pitched sees the wall ahead with other channels
than that behind, and what these differ by looks like its place.

Where the channels are few and seen (`channels.py`), each has its errors. Where they are not, errors
change linearly between some elevations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse

from caliv_graph.config.range_errors import RangeErrors
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.channels import found_channels, nearest_channels
from caliv_graph.structure.patches import DrivePatches, fitted_along

KINDS = 5
"""Of one elevation: the range, m; elevation and azimuth of the beam, rad; and how the first two
change from there to the next channels, m/rad and rad/rad. A patch of two or three channels is
tilted by what these differ, in every scan alike."""

CHANNEL_KINDS = 3
"""Of one channel: the first three."""

RANGE, AZIMUTH = 0, 2
"""Which of them is the range, and which the azimuth."""

NODES = 16
"""Elevations at most between which the errors of a LiDAR change linearly."""

LEAST_APART_RAD = np.radians(0.5)
"""Smallest distance of two of them: a patch has no less."""

LEAST_BY_CHANNEL = 0.5
"""Share of the patches of a LiDAR, at least, whose points are summed by channel."""

MEANS = {RANGE: 1e-4}
"""1 sigma of the mean error of all elevations of a LiDAR, by kind, m: that of the ranges is its
bias, which has a variable of its own. That of the azimuths is a turn of the LiDAR, and left to
their priors: held at zero, one channel that is thought to be 2.7 mrad off turned the other fifteen
and the LiDAR by 0.2 mrad (`yardbot` of the second simulator, at a claimed 0.05)."""


class BeamErrors(NamedTuple):
    """How many errors the beams of a LiDAR have: kind by kind, of each those of all nodes."""

    nodes: int
    kinds: int

    @property
    def size(self) -> int:
        """Number of errors."""
        return self.nodes * self.kinds


def parts_of(beams: Sequence[BeamErrors]) -> Iterator[tuple[int, int, slice]]:
    """Index of the LiDAR, kind, and where the errors of its nodes are among those of all LiDARs."""
    begin = 0
    for lidar, errors in enumerate(beams):
        for kind in range(errors.kinds):
            yield lidar, kind, slice(begin, begin + errors.nodes)
            begin += errors.nodes


def usual_sigmas(beams: Sequence[BeamErrors], ranges: RangeErrors) -> Array:
    """(E,) 1 sigma of each error of the beams of all LiDARs with which their estimate begins."""
    usual = [
        np.full(errors.nodes, ranges.beams[k]) for errors in beams for k in range(errors.kinds)
    ]
    return np.concatenate([np.zeros(0), *usual])


@dataclass(frozen=True)
class BeamNodes:
    """Where the beams of a LiDAR have errors of their own.

    Attributes:
        elevation_rad: (k,) ascending.
        channels: whether these are its channels; else errors change linearly in between.
    """

    elevation_rad: Array
    channels: bool = False

    @property
    def errors(self) -> BeamErrors:
        """How many they are."""
        kinds = CHANNEL_KINDS if self.channels else KINDS
        return BeamErrors(len(self.elevation_rad), kinds)


@dataclass(frozen=True)
class BeamGroups:
    """Points of patches that share their errors: those of a channel, or all of a patch; G groups.

    Attributes:
        beams: of each LiDAR.
        patch: (G,) their patch.
        node: (G,) the node at or below, of all LiDARs, numbered through.
        share: (G,) how far from there to the next they are, 0 to 1; 0 for channels.
        value: (G, 3) metres by which an error of 1 of range, elevation and azimuth moves them along
            the normal of their strip, with a minus.
        sums: (G, 4) sum of h, in the lidar frame at the stamp of the scan.
        changes: (G, 4) sum of h times the elevation above that of their middle, rad; 0 for
            channels.
    """

    beams: tuple[BeamErrors, ...]
    patch: IntArray
    node: IntArray
    share: Array
    value: Array
    sums: Array
    changes: Array


@dataclass(frozen=True)
class SeenBeams:
    """What the errors of the beams add to the residuals of Q sightings, at most C errors each.

    Attributes:
        column: (Q, C) among the errors of the beams of all LiDARs; any where `by` is zero.
        by: (Q, C, 4) linear in h = (p, 1), by an error of 1.
        turning: (Q, C) share of the points whose azimuth each is an error of; they sum to 1.
    """

    column: IntArray
    by: Array
    turning: Array

    def only(self, keep: IntArray | BoolArray | slice) -> SeenBeams:
        """Those of some sightings."""
        return SeenBeams(self.column[keep], self.by[keep], self.turning[keep])

    def turned(self, by_turn: Array) -> SeenBeams:
        """The same, errors of all azimuths together being a turn of the LiDAR the other way.

        That is what they are, and nothing tells one from the other. By the middles of channels
        they are that but for the noise of the points, a mean over a patch, and dents of the ground
        (`residuals.smooth_normals`): some thousandths, where a thousand sightings tell the yaw a
        thousand times better than the errors' priors do.

        Args:
            by_turn: (Q, 4) derivative of the residuals by a turn of the LiDAR about its z axis.
        """
        own = self.turning > 0.0
        missing = -by_turn - np.einsum("qc,qci->qi", own, self.by)
        by = self.by + self.turning[:, :, None] * missing[:, None]
        return replace(self, by=by)


def beam_nodes(patches: DrivePatches) -> tuple[BeamNodes, ...]:
    """Of each LiDAR its channels; where it has none, elevations of its patches.

    As many patches between two of these as between any others.
    """
    seen, lidar = patches.elevations_rad, patches.scan_lidar[patches.scan]
    return tuple(
        _channels(patches, lidar == i) or BeamNodes(_quantiles(seen[lidar == i]))
        for i in range(len(patches.lidars))
    )


def _channels(patches: DrivePatches, own: BoolArray) -> BeamNodes | None:
    """The channels of a LiDAR, whose patches `own` (N,) are; None: it has none."""
    channels = patches.channels and patches.channels.part(own, len(own))
    if not channels or len(np.unique(channels.patch)) < LEAST_BY_CHANNEL * own.sum():
        return None
    found = found_channels(channels.elevation_rad)
    return None if found is None else BeamNodes(found, channels=True)


def _quantiles(elevation_rad: Array) -> Array:
    """(k,) elevations, ascending, evenly over those of patches (n,)."""
    if not len(elevation_rad):
        return np.zeros(1)
    nodes = np.quantile(elevation_rad, np.linspace(0.0, 1.0, NODES)).tolist()
    kept = nodes[:1]
    for node in nodes[1:]:
        if node - kept[-1] >= LEAST_APART_RAD:
            kept.append(node)
    return np.array(kept)


def beam_groups(
    patches: DrivePatches, nodes: tuple[BeamNodes, ...], normals: Array, R: Array, t: Array
) -> BeamGroups:
    """The points of N patches by their beams.

    A range that is too long by b moves points by `-b cos(incidence)` along the normal; an error of
    the direction moves them across the beam.

    Args:
        patches: of the drive.
        nodes: of each LiDAR (`beam_nodes`).
        normals: (N, 3) of their strips, in the lidar frame at the stamp of the scan.
        R: (N, 3, 3) rotation to that frame of what is in that of the patch's own time.
        t: (N, 3) metres, likewise.
    """
    lidar = patches.scan_lidar[patches.scan]
    whole = np.ones(len(lidar), dtype=bool)
    patch, elevation, sums = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4))
    if patches.channels is not None:
        of_channels = np.array([of.channels for of in nodes])[lidar]
        known = patches.channels.part(of_channels, len(lidar))
        patch, elevation = np.flatnonzero(of_channels)[known.patch], known.elevation_rad
        sums = known.sums
        whole[patch] = False
    # Of scans without channels all points of a patch have those of its middle.
    rest = np.flatnonzero(whole)
    patch = np.concatenate([patch, rest])
    elevation = np.concatenate([elevation, patches.elevations_rad[rest]])
    sums = np.concatenate([sums, patches.moments[rest, :, 3]])

    centres = sums[:, :3] / sums[:, 3, None]
    distance = np.linalg.norm(centres, axis=1)
    flat = np.hypot(centres[:, 0], centres[:, 1])
    along = centres / distance[:, None]
    x, y = (centres[:, :2] / np.maximum(flat, 1e-9)[:, None]).T
    up, left = np.zeros_like(centres), np.zeros_like(centres)
    up[:, 0], up[:, 1], up[:, 2] = -along[:, 2] * x, -along[:, 2] * y, flat / distance
    left[:, 0], left[:, 1] = -y, x
    normal = np.einsum("nji,nj->ni", R, normals)[patch]
    moved = (along, distance[:, None] * up, flat[:, None] * left)
    value = -np.stack([np.einsum("ni,ni->n", normal, of) for of in moved], axis=1)

    several = len(sums) - len(rest)
    changes = np.zeros_like(sums)
    steeper = np.column_stack([up, np.zeros(len(up))])[several:] / distance[several:, None]
    steeper[:, 3] = -np.einsum("ni,ni->n", steeper[:, :3], centres[several:])
    changes[several:] = np.einsum("nij,nj->ni", patches.moments[rest], steeper)
    node, share = _places(nodes, lidar[patch], elevation)
    return BeamGroups(
        beams=tuple(of.errors for of in nodes),
        patch=patch,
        node=node,
        share=share,
        value=value,
        sums=_moved(sums, R[patch], t[patch]),
        changes=_moved(changes, R[patch], t[patch]),
    )


def _moved(sums: Array, R: Array, t: Array) -> Array:
    """(G, 4) weighted sums of h of points moved by `R p + t`, (G, 3, 3) and (G, 3)."""
    out = sums.copy()
    out[:, :3] = np.einsum("gij,gj->gi", R, sums[:, :3]) + sums[:, 3:] * t
    return out


def _places(
    nodes: tuple[BeamNodes, ...], lidar: IntArray, elevation: Array
) -> tuple[IntArray, Array]:
    """The node (G,) at or below each elevation of a LiDAR, and how far it is to the next one."""
    node, share = np.zeros(len(elevation), np.int64), np.zeros(len(elevation))
    first = 0
    for i, of in enumerate(nodes):
        own, at = lidar == i, of.elevation_rad
        if of.channels:
            node[own] = nearest_channels(at, elevation[own])
        elif len(at) > 1:
            place = np.clip(np.searchsorted(at, elevation[own], side="right") - 1, 0, len(at) - 2)
            step = (elevation[own] - at[place]) / np.diff(at)[place]
            node[own], share[own] = place, np.clip(step, 0.0, 1.0)
        node[own] += first
        first += len(at)
    return node, share


def seen_beams(
    groups: BeamGroups,
    patch: IntArray,
    sighting: IntArray,
    weight: Array,
    moments: Array,
    normals: Array,
) -> SeenBeams:
    """What the beams' errors are in sightings, each of which is the sum of some patches.

    Over a sighting the errors are fitted by a plane, along its surface only.

    Args:
        groups: of the points of all N patches.
        patch: (n,) those that are seen.
        sighting: (n,) in which.
        weight: (n,) of their points.
        moments: (Q, 4, 4) weighted, of the sightings.
        normals: (Q, 3) of their strips, in the lidar frame at the stamp.
    """
    count = np.array([errors.nodes for errors in groups.beams])
    kinds = np.array([errors.kinds for errors in groups.beams])
    several = int(count.sum())
    place = np.full(int(groups.patch.max(initial=-1)) + 1, -1)
    place[patch] = np.arange(len(patch))
    at = place[groups.patch]
    low = np.flatnonzero(at >= 0)
    high = low[groups.share[low] > 0.0]
    own = np.concatenate([low, high])
    node = np.concatenate([groups.node[low], groups.node[high] + 1])
    part = np.concatenate([1.0 - groups.share[low], groups.share[high]]) * weight[at[own]]
    key = sighting[at[own]] * several + node
    order = np.argsort(key, kind="stable")
    own, part, key = own[order], part[order], key[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    total = np.zeros((len(starts), KINDS, 4))
    for kind in range(int(kinds.max())):
        of = groups.sums if kind < CHANNEL_KINDS else groups.changes
        by_point = (part * groups.value[own, kind % CHANNEL_KINDS])[:, None] * of[own]
        total[:, kind] = np.add.reduceat(by_point, starts)
    of_sighting, node = np.divmod(key[starts], several)
    by = fitted_along(moments, normals, total, of_sighting)

    lidar = np.repeat(np.arange(len(count)), count)[node]
    first = np.cumsum(count * kinds) - count * kinds
    local = node - (np.cumsum(count) - count)[lidar]
    column = (first[lidar] + local)[:, None] + count[lidar][:, None] * np.arange(KINDS)
    used = np.arange(KINDS) < kinds[lidar][:, None]
    of_sighting = np.repeat(of_sighting, kinds[lidar])
    place = np.arange(len(of_sighting)) - np.searchsorted(of_sighting, of_sighting)
    shape = (len(moments), int(place.max(initial=-1)) + 1)
    out = SeenBeams(np.zeros(shape, dtype=np.int64), np.zeros((*shape, 4)), np.zeros(shape))
    out.column[of_sighting, place] = column[used]
    out.by[of_sighting, place] = by[used]
    points = np.zeros(by.shape[:2])
    points[:, AZIMUTH] = np.add.reduceat(part * groups.sums[own, 3], starts)
    out.turning[of_sighting, place] = points[used]
    out.turning[:] /= np.maximum(out.turning.sum(axis=1, keepdims=True), 1e-9)
    return out


def mean_rows(
    beams: Sequence[BeamErrors], first: int, errors: Array
) -> tuple[scipy.sparse.csr_array, Array]:
    """Rows (n, D) and residuals (n,) of the mean errors of each LiDAR, by their sigmas.

    Of `MEANS`.

    Args:
        beams: of each LiDAR.
        first: coordinate of the first error of the beams.
        errors: (D,).
    """
    held = [(kind, part) for _, kind, part in parts_of(beams) if kind in MEANS]
    of_nodes = np.array([part.stop - part.start for _, part in held], dtype=np.int64)
    row = np.repeat(np.arange(len(held)), of_nodes)
    column = np.concatenate([np.zeros(0, np.int64), *(np.r_[part] + first for _, part in held)])
    each = np.array([1.0 / MEANS[kind] for kind, _ in held]) / np.maximum(of_nodes, 1)
    J = scipy.sparse.csr_array((each[row], (row, column)), shape=(len(held), len(errors)))
    return J, np.asarray(J @ errors)
