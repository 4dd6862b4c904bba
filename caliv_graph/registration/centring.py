"""Where a registration begins, and how large the target is, in axes of the views, not the map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caliv_graph.products import Array, Side
from caliv_graph.registration.clouds import CloudStack

UP = np.array([0.0, 0.0, 1.0])
"""Axis of the target frame."""

STRAIGHT_DOWN = 1e-3
"""Level part of a direction below which it has no azimuth: numerical."""

NEAREST_AXIS = math.cos(math.radians(45.0))
"""A direction within 45 degrees of an axis is along it."""

LEAST_WIDE_M = 0.05
"""Smallest width and height of the volume that outliers are spread over."""


def centre_clouds(
    clouds: CloudStack, R: Array, t: Array, cut: Sequence[frozenset[Side]] = ()
) -> Array:
    """(J, 3) translations that put the middle of every cloud's extent at the origin.

    An initial guess displaces the target by up to 1 m (3 degrees at 20 m). All clouds of a target
    have about the same extent, whatever the density of their points. Where the edge of the field of
    view cuts a cloud off (`cut`, of each cloud; empty: of none), its middle is half the median
    extent of the others away from the side that is whole.
    """
    points = clouds.moved(R, t)
    beams = clouds.rotated(R, clouds.beams)
    out = t.copy()
    ends = np.append(clouds.starts, len(points))
    sides = cut or [frozenset()] * clouds.count
    # Per cloud, at right angles to the view and upwards: direction, low, high, which ends are cut.
    spans = []
    for j, own_sides in enumerate(sides):
        own = slice(ends[j], ends[j + 1])
        # Axes of the view, not of the map: its placing shall not matter.
        axes = _axes_of_view(beams[own].mean(axis=0))
        low, high = np.percentile(points[own] @ axes.T, [2, 98], axis=0)
        out[j] -= 0.5 * (low + high) @ axes
        cut_ends = _cut_ends(own_sides, R[j], axes)
        spans.append(
            (
                (axes[1], (low[1], high[1]), cut_ends[0]),
                (UP, (low[2], high[2]), cut_ends[1]),
            )
        )
    for axis in (0, 1):
        whole = [np.ptp(span[axis][1]) for span in spans if not any(span[axis][2])]
        typical = float(np.median(whole or [max(np.ptp(span[axis][1]) for span in spans)]))
        for j, span in enumerate(spans):
            direction, (low, high), (cut_low, cut_high) = span[axis]
            lacks = max(typical - (high - low), 0.0)
            out[j] += 0.5 * lacks * (float(cut_low) - float(cut_high)) * direction
    return out


def _cut_ends(
    sides: frozenset[Side], R_target_lidar: Array, axes: Array
) -> tuple[tuple[bool, bool], tuple[bool, bool]]:
    """Which ends are cut, (right, left) and (bottom, top), in the level axes of a view (3, 3).

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
    (right, left_end), (bottom, top_end) = cut.tolist()
    return (right, left_end), (bottom, top_end)


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
