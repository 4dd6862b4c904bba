"""Meshes of what stands around a drive: walls that are not flat, kerbs, cars, hedges and bushes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.solids import Mesh, bar, join, solid_between, tube
from caliv_graph.scenario.world_models import BushModel, HedgeModel, WallModel

NO_WINDOW = -1

EDGE_M = 0.1
"""Least distance from a window to the end of its wall, metres."""

CAR_HALF_M = (2.15, 0.9)
"""Half the length and half the width of a car, metres."""

LEAN_M = 0.01
"""Distance by which a kerb's side leans, metres."""


@dataclass(frozen=True)
class _Lines:
    """Lines of a wall's grid along one axis; an edge of a window has two at the same place.

    Attributes:
        at_m: (n,) ascending.
        window: (n,) the window that a line belongs to, `NO_WINDOW` outside.
    """

    at_m: Array
    window: IntArray


def _cell_borders(
    low_m: float, high_m: float, cell_m: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Ascending borders of cells from `low_m` to `high_m`, whose sides are drawn from a range."""
    length_m = high_m - low_m
    count = max(round(length_m / (0.5 * (cell_m[0] + cell_m[1]))), 1)
    sides = rng.uniform(*cell_m, count)
    borders: Array = low_m + length_m * np.concatenate([[0.0], np.cumsum(sides) / sides.sum()])
    return borders


def _lines(borders_m: Array, windows_m: Array) -> _Lines:
    """Lines at the borders of cells and, twice, at the edges of windows (k, 2)."""
    last = np.searchsorted(windows_m[:, 0], borders_m) - 1
    # Before the first window `last` is -1, which takes the end that is appended.
    ends_m = np.append(windows_m[:, 1], -np.inf)
    of_border = np.where(borders_m < ends_m[last], last, NO_WINDOW)
    number = np.arange(len(windows_m))
    outside = np.full(len(windows_m), NO_WINDOW)
    at_m = np.concatenate([borders_m, *(windows_m[:, i] for i in (0, 0, 1, 1))])
    window = np.concatenate([of_border, outside, number, number, outside])
    # The sort is stable: at the first edge the wall comes before the window, at the second after.
    order = np.argsort(at_m, kind="stable")
    return _Lines(at_m[order], window[order])


def _window_spans(model: WallModel) -> tuple[Array, Array]:
    """(k, 2) spans of the windows along the wall, and (1, 2) or (0, 2) their span in height."""
    reveals = model.reveals
    if reveals is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    wide_m, high_m = reveals.size_m
    count = max(math.floor((model.length_m - wide_m - 2.0 * EDGE_M) / reveals.spacing_m) + 1, 1)
    middle_m = reveals.spacing_m * (np.arange(count) - 0.5 * (count - 1))
    half_m = 0.5 * wide_m
    return (
        np.column_stack([middle_m - half_m, middle_m + half_m]),
        np.array([[reveals.sill_m, reveals.sill_m + high_m]]),
    )


def wall(model: WallModel) -> Mesh:
    """A wall along x, its faces at y = -+thickness / 2, with bumps and windows set back."""
    rng = np.random.default_rng(model.seed)
    half_m = 0.5 * model.length_m
    borders_x = _cell_borders(-half_m, half_m, model.bumps_cell_m, rng)
    borders_z = _cell_borders(0.0, model.height_m, model.bumps_cell_m, rng)
    along, in_height = _window_spans(model)
    x, z = _lines(borders_x, along), _lines(borders_z, in_height)
    in_window = (x.window != NO_WINDOW)[:, None] & (z.window != NO_WINDOW)
    faces = []
    for side in (1.0, -1.0):
        corners = model.bumps_sigma_m * rng.standard_normal((len(borders_x), len(borders_z)))
        by_z = np.stack([np.interp(z.at_m, borders_z, row) for row in corners])
        out_m = np.stack([np.interp(x.at_m, borders_x, column) for column in by_z.T], axis=1)
        if model.reveals is not None:
            deep_m = rng.uniform(*model.reveals.depth_m, len(along))
            out_m -= np.where(in_window, deep_m[np.maximum(x.window, 0)][:, None], 0.0)
        y = side * (0.5 * model.thickness_m + out_m)
        faces.append(np.stack(np.broadcast_arrays(x.at_m[:, None], y, z.at_m), axis=-1))
    return solid_between(faces[0], faces[1])


def kerb(length_m: float, height_m: float, width_m: float) -> Mesh:
    """A kerbstone along x, wider at the ground."""
    foot, top = (length_m, width_m + 2.0 * LEAN_M), (length_m, width_m)
    return bar((0.0, 0.0, 0.0), (0.0, 0.0, height_m), foot, top)


def car() -> Mesh:
    """A car, front +x: a hull with curved sides, a cabin that narrows upwards, four wheels.

    4.3 x 1.8 x 1.45 m; the origin is on the ground below its middle. Glass is opaque.
    """
    half_length, half_width = CAR_HALF_M
    u, z = np.meshgrid(np.linspace(-1.0, 1.0, 15), np.linspace(0.2, 0.85, 6), indexing="ij")
    wide = half_width * (1.0 - 0.15 * u**4) * (1.0 - 0.25 * (z - 0.55) ** 2)
    x = half_length * u
    hull = solid_between(np.stack([x, wide, z], axis=-1), np.stack([x, -wide, z], axis=-1))
    cabin = bar((-0.2, 0.0, 0.84), (-0.35, 0.0, 1.45), (2.7, 1.6), (1.5, 1.2))
    wheels = [
        tube(np.array([[x, side * 0.68, 0.31], [x, side * 0.88, 0.31]]), 0.31, sides=24)
        for x in (-1.3, 1.35)
        for side in (-1.0, 1.0)
    ]
    return join([hull, cabin, *wheels])


def _leaves(middles: Array, leaf_m: float, rng: np.random.Generator) -> Mesh:
    """Equilateral triangles of side `leaf_m` at (n, 3), each turned at random."""
    n = len(middles)
    across = rng.standard_normal((n, 2, 3))
    one = across[:, 0] / np.linalg.norm(across[:, 0], axis=1, keepdims=True)
    other = across[:, 1] - (across[:, 1] * one).sum(axis=1, keepdims=True) * one
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    angle = np.radians([90.0, 210.0, 330.0])
    spread = np.cos(angle)[:, None] * one[:, None] + np.sin(angle)[:, None] * other[:, None]
    corners = middles[:, None] + leaf_m / math.sqrt(3.0) * spread
    return Mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3))


def _leaf_count(volume_m3: float, leaf_m: float, penetration_m: float) -> int:
    """Leaves for a mean free path of a beam; a leaf turned at random shows half of its area."""
    shown_m2 = 0.5 * math.sqrt(3.0) / 4.0 * leaf_m**2
    return max(round(volume_m3 / (penetration_m * shown_m2)), 1)


def hedge(model: HedgeModel) -> Mesh:
    """A box full of leaves on the ground; not closed."""
    rng = np.random.default_rng(model.seed)
    size = np.array(model.size_m)
    count = _leaf_count(float(size.prod()), model.leaf_m, model.penetration_m)
    middles = rng.uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 1.0], (count, 3)) * size
    return _leaves(middles, model.leaf_m, rng)


def bush(model: BushModel) -> Mesh:
    """An ellipsoid full of leaves on the ground; not closed. See `hedge`."""
    rng = np.random.default_rng(model.seed)
    half = 0.5 * np.array(model.size_m)
    volume_m3 = 4.0 / 3.0 * math.pi * float(half.prod())
    count = _leaf_count(volume_m3, model.leaf_m, model.penetration_m)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    middles = directions * np.cbrt(rng.random((count, 1))) * half + [0.0, 0.0, half[2]]
    return _leaves(middles, model.leaf_m, rng)
