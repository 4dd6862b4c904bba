"""How sharp the map is that a LiDAR draws with a mounting, and the mounting that draws it sharpest.

Objects that stand still are seen again and again. With the right mounting all scans put them at one
place. The measure is the number of pairs of points that lie in one cell of a grid: Renyi's
quadratic entropy with boxes in place of Gaussians (Sheehan, Harrison and Newman, 2012; Maddern,
Harrison and Newman, 2012).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from caliv_graph.products import Array, IntArray

Complex = npt.NDArray[np.complex128]
"""Places x + iy."""

REACH_M = 10.0
"""Farthest place of a LiDAR from the vehicle's origin: a lorry with its trailer has two origins."""

CELLS_M = (2.0, 1.0, 0.5, 0.25)
"""Sides of the cells, the coarsest first. The search steps by a cell, and turns by what moves a
point at `TURN_RANGE_M` by one: the coarsest grid has a few thousand steps. Below the finest, the
sides of an object that show change its place."""

TURN_RANGE_M = 15.0
"""Range at which a turn moves a point by a step: most of what is seen is nearer."""

KEPT = 16
"""Places on the coarsest grid that are refined; half of them on each finer one."""

MOST_POINTS = 3000
"""Points that count: more draw the same map."""

CENTRAL = 0.3
"""Part that a mounting at `REACH_M` loses, one at half of it a quarter of that. Where mountings fit
alike, as on an arc, the one near the origin is taken."""

REPEATS_M = 128.0
MOST_CELLS = 256
"""The grid repeats after this length, or so many cells: what is farther apart falls together by
chance, alike for all mountings."""

NEIGHBOURS = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Sightings:
    """What stands around, as one LiDAR sees it: points in level axes about the LiDAR.

    Attributes:
        level: (n,) x + iy, metres; its axes are turned against the vehicle's by an unknown yaw.
        heading: (n,) e^(i yaw) of the vehicle when the point was measured.
        position: (n,) x + iy of the vehicle in the map, metres.
    """

    level: Complex
    heading: Complex
    position: Complex

    @cached_property
    def _turned(self) -> Complex:
        return np.asarray(self.heading * self.level)

    @property
    def mirrored(self) -> Sightings:
        """The same on the way that the map shows in a mirror: turns to the left go to the right."""
        return Sightings(self.level, self.heading.conj(), self.position.conj())

    def in_map(self, mounting: Array) -> Complex:
        """(n,) places in the map, x + iy, with a mounting (yaw in rad, x and y in metres)."""
        yaw, x, y = mounting.tolist()
        return np.asarray(
            complex(math.cos(yaw), math.sin(yaw)) * self._turned
            + complex(x, y) * self.heading
            + self.position
        )


@dataclass(frozen=True)
class Found:
    """Mountings (k, 3) that draw sharp maps, the sharpest first: yaw (rad), x and y (m).

    Attributes:
        mountings: (k, 3).
        sharpness: (k,) of each, pairs of points.
    """

    mountings: Array
    sharpness: Array


def sharpest(own: Sightings, others: Sequence[tuple[Sightings, Array]] = ()) -> Found:
    """The mounting of a LiDAR with which its map, and that of other LiDARs with it, is sharpest.

    Args:
        own: what the LiDAR sees.
        others: what LiDARs see whose mountings are known, and these (yaw, x, y).
    """
    grids = {cell: _known(others, cell) for cell in CELLS_M}

    def value(mounting: Array, cell: float) -> float:
        places = own.in_map(mounting)
        pairs = 0.0
        for offset, known in zip((0.0, 0.5), grids[cell], strict=True):
            at = _cell_of(places, cell, offset)
            pairs += float((np.bincount(at)[at] + 2 * known[at]).sum())
        far = (mounting[1] ** 2 + mounting[2] ** 2) / REACH_M**2
        return pairs * (1.0 - CENTRAL * float(far))

    cell = CELLS_M[0]
    tried = _coarse(cell)
    found = _apart(tried, np.array([value(m, cell) for m in tried]), cell, KEPT)
    for level, cell in enumerate(CELLS_M[1:], 1):
        climbed = [_climbed(mounting, value, cell) for mounting in found.mountings]
        mountings, values = (np.array(of) for of in zip(*climbed, strict=True))
        found = _apart(mountings, values, cell, max(KEPT >> level, 4))
    return found


def sharpest_near(own: Sightings, mounting: Array) -> tuple[Array, float]:
    """The mounting near one (yaw, x, y) that draws the sharpest map, and how sharp that is.

    Returns:
        (3,) the mounting, at most 1.5 m and 6 degrees away; and how many points share one of the
        finest cells, mean over the points: about 1.5 where nothing is seen at its place again.
    """

    def value(mounting: Array, cell: float) -> float:
        places = own.in_map(mounting)
        at = [_cell_of(places, cell, offset) for offset in (0.0, 0.5)]
        return sum(float(np.bincount(of)[of].sum()) for of in at)

    value_of = 0.0
    for cell in CELLS_M[-2:]:
        mounting, value_of = _climbed(mounting, value, cell)
    return mounting, 0.5 * value_of / max(len(own.level), 1)  # of two grids


def _climbed(
    mounting: Array, value: Callable[[Array, float], float], cell: float
) -> tuple[Array, float]:
    """The best (3,) within two steps of a cell from a mounting, and its value."""
    best = 0.0
    for _ in range(2):
        around = mounting + NEIGHBOURS * [cell / TURN_RANGE_M, cell, cell]
        scores = [value(m, cell) for m in around]
        mounting, best = around[int(np.argmax(scores))], max(scores)
    return mounting, best


def _coarse(cell: float) -> Array:
    """(m, 3) every yaw and every place within reach, in steps of a cell."""
    yaws = np.arange(-math.pi, math.pi, cell / TURN_RANGE_M)
    steps = np.arange(-REACH_M, REACH_M + 0.5 * cell, cell)
    grid = np.stack(np.meshgrid(yaws, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid[np.hypot(grid[:, 1], grid[:, 2]) <= REACH_M])


def _known(others: Sequence[tuple[Sightings, Array]], cell: float) -> list[IntArray]:
    """Points of the other LiDARs in each cell of the two grids."""
    return [
        sum(
            (
                np.bincount(_cell_of(of.in_map(mounting), cell, offset), minlength=_side(cell) ** 2)
                for of, mounting in others
            ),
            np.zeros(_side(cell) ** 2, dtype=np.int64),
        )
        for offset in (0.0, 0.5)
    ]


def _side(cell: float) -> int:
    """Number of cells along a side of the grid, a power of two."""
    return min(round(REPEATS_M / cell), MOST_CELLS)


def _cell_of(places: Complex, cell: float, offset: float) -> IntArray:
    """The cell of each place (n,), x + iy."""
    side = _side(cell)
    at = places.view(np.float64) / cell  # x and y in turn
    at += offset
    cells = np.floor(at, out=at).astype(np.int64)
    cells &= side - 1  # the remainder, also of negative ones: a division takes three times as long
    found: IntArray = cells[::2] * side + cells[1::2]
    return found


def _apart(mountings: Array, sharpness: Array, cell: float, most: int) -> Found:
    """The sharpest, no two of them nearer to each other than a step."""
    kept: list[int] = []
    for i in np.argsort(-sharpness, kind="stable").tolist():
        if all(difference_m(mountings[i], mountings[j]) > 1.1 * cell for j in kept):
            kept.append(i)
        if len(kept) == most:
            break
    return Found(mountings[kept], sharpness[kept])


def difference_m(a: Array, b: Array) -> float:
    """How far two mountings (yaw, x, y) put a point at `TURN_RANGE_M` from each other, metres."""
    turn = abs((float(a[0] - b[0]) + math.pi) % (2.0 * math.pi) - math.pi)
    shift_m: float = np.abs(a[1:] - b[1:]).max()
    return max(TURN_RANGE_M * turn, shift_m)
