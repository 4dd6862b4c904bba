"""Where a registration begins, and how large the target is, in axes of the views, not the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, Side
from caliv_graph.registration.clouds import CloudStack

UP = np.array([0.0, 0.0, 1.0])
"""Axis of the target frame."""

STRAIGHT_DOWN = 1e-3
"""Level part of a direction below which it has no azimuth: numerical."""

NEAREST_AXIS = math.cos(math.radians(45.0))
"""A direction within 45 degrees of an axis is along it."""

LEAST_WIDE_M = 0.05
"""Smallest width and height of the volume that outliers are spread over."""


MIDDLE = 0.05
"""1 sigma of the middle of a whole extent, as a part of it: where beams fell."""

LACKING, NARROW = 0.5, 0.1
"""1 sigma of a middle, as a part of what its cloud lacks of the median extent: in depth, or where
the field of view cuts it off; and across the view, where a target may be narrower from there."""


@dataclass(frozen=True)
class Middles:
    """Middles of the extents of clouds.

    Attributes:
        points: (J, 3) metres, each in the frame of its LiDAR.
        axes: (J, 3, 3) rows ahead, left and up of each view, axes of the map.
        sigmas_m: (J, 3) 1 sigma along these, as middles of the target.
    """

    points: Array
    axes: Array
    sigmas_m: Array


def middles_of(
    clouds: CloudStack, R: Array, t: Array, cut: Sequence[frozenset[Side]] = ()
) -> Middles:
    """The middle of every cloud's extent.

    All clouds of a target have about the same extent, whatever the density of their points. Where
    the edge of the field of view cuts a cloud off (`cut`, of each cloud; empty: of none), its
    middle is half the median extent of the others away from the side that is whole.

    Args:
        clouds: the clouds.
        R: (J, 3, 3) rotations map from lidar.
        t: (J, 3) metres.
        cut: sides of each cloud.
    """
    points = clouds.moved(R, t)
    beams = clouds.rotated(R, clouds.beams)
    ends = np.append(clouds.starts, len(points))
    sides = cut or [frozenset()] * clouds.count
    axes, low, high = np.empty((clouds.count, 3, 3)), np.empty_like(t), np.empty_like(t)
    # Of each cloud: right and left, bottom and top.
    off = np.zeros((clouds.count, 2, 2), dtype=bool)
    for j, own_sides in enumerate(sides):
        own = slice(ends[j], ends[j + 1])
        # Axes of the view, not of the map: its placing shall not matter.
        axes[j] = _axes_of_view(beams[own].mean(axis=0))
        low[j], high[j] = np.percentile(points[own] @ axes[j].T, [2, 98], axis=0)
        off[j] = _cut_ends(own_sides, R[j], axes[j])
    middle, extent = 0.5 * (low + high), (high - low)[:, 1:]
    typical = np.empty(2)
    for axis in (0, 1):
        whole = extent[~off[:, axis].any(axis=1), axis]
        typical[axis] = np.median(whole) if len(whole) else extent[:, axis].max()
    lacks = np.maximum(typical - extent, 0.0)
    middle[:, 1:] -= 0.5 * lacks * (off[..., 0].astype(float) - off[..., 1])
    # Along the view a target is taken to be as deep as it is wide.
    deep, whole_m = (high - low)[:, :1], typical[[0, 0, 1]]
    unseen = LACKING * np.maximum(typical[0] - deep, 0.0)
    unseen = np.hstack([unseen, np.where(off.any(axis=2), LACKING, NARROW) * lacks])
    sigmas_m = MIDDLE * np.maximum(whole_m, LEAST_WIDE_M) + unseen
    in_map = np.einsum("jba,jb->ja", axes, middle) - t
    return Middles(np.einsum("jba,jb->ja", R, in_map), axes, sigmas_m)


def _cut_ends(sides: frozenset[Side], R_target_lidar: Array, axes: Array) -> BoolArray:
    """(2, 2) which ends are cut, right and left, bottom and top, in the axes of a view (3, 3).

    `sides` are the LiDAR's own: upside down its top is below, on its side it is left or right. A
    side that is nearer to none of the axes counts for none.
    """
    top = R_target_lidar[:, 2]
    left = np.cross(top, axes[0])
    directions = {"top": top, "bottom": -top, "left": left, "right": -left}
    cut = np.zeros((2, 2), dtype=bool)
    for side in sides:
        direction = directions[side]
        along = axes[1:] @ direction
        which = int(np.abs(along).argmax())
        if np.abs(along[which]) > NEAREST_AXIS * np.linalg.norm(direction):
            cut[which, int(along[which] > 0.0)] = True
    return cut


def _axes_of_view(view: Array) -> Array:
    """(3, 3) rows ahead, left and up of a direction (3,); level."""
    level = float(np.hypot(*view[:2]))
    ahead = np.append(view[:2], 0.0) / level if level > STRAIGHT_DOWN else np.eye(3)[0]
    return np.array([ahead, np.cross(UP, ahead), UP])


def depth_of(points: Array) -> float:
    """Diagonal, metres, of the upright cylinder that holds points (N, 3) but for a few outliers."""
    away = np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=1)
    low, high = np.percentile(points[:, 2], [1, 99])
    wide = 2.0 * float(np.percentile(away, 98))
    return math.hypot(max(wide, LEAST_WIDE_M), max(float(high - low), LEAST_WIDE_M))
