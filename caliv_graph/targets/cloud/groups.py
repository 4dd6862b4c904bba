"""Groups of points of one scan that are of one object, near a region and beyond its rim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.config.model import ExtractionConfig
from caliv_graph.products import Array, IntArray
from caliv_graph.targets.cloud.beams import Linking
from caliv_graph.targets.ground.fit import height_above
from caliv_graph.targets.search.objects import connected

MAX_HEIGHT_M = 2.5
"""Maximum height of a candidate: targets are at most 2 m high, and a ground plane has errors at the
rim."""

MAX_EXTENT_M = 2.0
"""Largest horizontal extent of a candidate: targets are at most 1.5 m wide; tilt errors of the
ground and noise make them larger."""


def extent_m(points: Array) -> float:
    """Largest horizontal extent of points (n, 3), z up."""
    return float(np.ptp(points[:, :2], axis=0).max())


def groups_of(points: Array, linking: Linking) -> list[IntArray]:
    """Indices of the points (n, 3), region frame, of each object: those that are linked.

    What is too wide that way is taken apart by plain distance: a sparse LiDAR's target that stands
    near something else.
    """
    out = []
    for member in _connected(linking.pairs(), len(points)):
        if linking.row_m and extent_m(points[member]) > MAX_EXTENT_M:
            near = cKDTree(points[member]).query_pairs(linking.link_m, output_type="ndarray")
            out += [member[part] for part in _connected(near, len(member))]
        else:
            out.append(member)
    return out


def _connected(pairs: IntArray, count: int) -> list[IntArray]:
    """Indices of the points of each connected component, given linked pairs (p, 2)."""
    labels = connected(pairs, count)
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


@dataclass(frozen=True)
class Standing:
    """What stands on the ground near a region.

    Points (n, 3), region frame, metres; their ascending indices `near` in the scan; heights above
    the ground in metres.
    """

    points: Array
    near: IntArray
    height_m: Array

    @classmethod
    def of(
        cls,
        points: Array,
        near: IntArray,
        plane: Array | None,
        extraction: ExtractionConfig,
    ) -> Standing:
        """Of points near a region; without ground all points stand."""
        height_m = np.full(len(near), extraction.ground_distance * 2.0)
        if plane is not None:
            height_m = height_above(plane, points)
        above = (height_m > extraction.ground_distance) & (height_m < MAX_HEIGHT_M)
        return cls(points[above], near[above], height_m[above])


def completed_groups(
    standing: Standing,
    groups: Sequence[IntArray],
    cut_off: Sequence[bool],
    beyond: Standing,
    linking: Linking,
) -> tuple[list[IntArray], list[bool]]:
    """Groups of points with what of them is outside the region, and which of them stay cut off.

    A guess that is far off, or unknown along an arc, moves a target over the rim of its region, and
    that cut through it. What would be too wide as a whole, such as a wall, stays as it was.

    Args:
        standing: what stands near the region.
        groups: indices of `standing` of each.
        cut_off: which of them reach the rim.
        beyond: what stands in a wider region, that near it included.
        linking: of the points of `beyond`.

    Returns:
        Indices of `beyond` of each group, and which are cut off.
    """
    wider = groups_of(beyond.points, linking)
    group_of = np.zeros(len(beyond.near), np.int64)
    for number, member in enumerate(wider):
        group_of[member] = number
    out: list[IntArray] = []
    still: list[bool] = []
    taken: set[int] = set()
    for chosen, reaches in zip(groups, cut_off, strict=True):
        own = np.flatnonzero(np.isin(beyond.near, standing.near[chosen], assume_unique=True))
        if not len(own):
            continue  # it was ground, which only the wider region shows
        whole = int(np.bincount(group_of[own]).argmax())
        if not reaches or extent_m(beyond.points[wider[whole]]) > MAX_EXTENT_M:
            out.append(own)
            still.append(reaches)
        elif whole not in taken:
            taken.add(whole)
            out.append(wider[whole])
            still.append(False)
    return out, still
