"""Finds walls, poles and objects in points of the map.

Walls grow from flat cells and may have any direction. The remaining points are grouped in columns:
thin and tall columns are poles, compact ones are objects. A point belongs to at most one of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray

SEED_CELL_M = 1.5
"""Cells in which flat pieces are searched, for point spacings up to 0.4 m."""

SEED_POINTS = 8
"""Smallest number of points of a piece."""

PIECE_M = 1.5
"""Largest gap within a wall. Pieces with a larger gap are two walls."""

WALL_POINTS = 60
WALL_LENGTH_M = 1.0
WALL_WIDTH_M = 0.4
"""Smallest number of points, length and width of a wall."""

MOST_WALLS = 40
"""Largest number of walls."""

LEVEL = 0.8
"""Vertical component of a normal above which a plane is level (ground or roof)."""

UNIFORM = 0.5
"""Largest scatter of a plane in units of the gate. Evenly spread points have 0.58."""

ROUNDS = 4
"""Rounds of fitting a wall and collecting its points."""

COLUMN_CELL_M = 0.2
"""Horizontal cells in which columns of points are separated."""

CELL_POINTS = 3
"""Smallest number of points of an occupied cell."""

POLE_WIDTH_M = 0.5
POLE_HEIGHT_M = 1.2
"""Largest width and smallest height of a pole."""

POLE_RADIUS_M = (0.02, 0.3)
"""Smallest and largest radius of a pole."""

OBJECT_WIDTH_M = (0.2, 2.5)
"""Limits of an object's horizontal extent. A person who walks leaves a longer trace."""

COLUMN_POINTS = 20
"""Smallest number of points of a pole or an object."""

MIN_SCANS = 5
"""Smallest number of scans of a structure. Structure in fewer scans may be moving."""

POLE_STEPS = 15
"""Gauss-Newton steps of the fit of a pole."""


@dataclass(frozen=True)
class Wall:
    """A plane.

    Attributes:
        members: (n,) indices of its points.
        centre: (3,) metres.
        normal: (3,) unit.
        axes: (2, 3) unit vectors in the plane, the longer extent first.
        extent_m: lengths along the axes, metres.
    """

    members: IntArray
    centre: Array
    normal: Array
    axes: Array
    extent_m: tuple[float, float]

    @property
    def is_level(self) -> bool:
        """Whether it is level: ground rather than a wall."""
        return bool(abs(self.normal[2]) > LEVEL)


@dataclass(frozen=True)
class Pole:
    """An upright round column: (x, y) of its axis at height z is `foot + slope (z - middle_z)`.

    Attributes:
        members: (n,) indices of its points.
        foot: (2,) metres, position of the axis at `middle_z`.
        slope: (2,) inclination of the axis, metres per metre.
        middle_z: metres, middle height of its points.
        radius_m: its radius.
        height_m: from its lowest to its highest point.
    """

    members: IntArray
    foot: Array
    slope: Array
    middle_z: float
    radius_m: float
    height_m: float


@dataclass(frozen=True)
class Thing:
    """A compact object of any shape.

    Attributes:
        members: (n,) indices of its points.
        centre: (3,) metres.
        extent_m: largest horizontal extent.
    """

    members: IntArray
    centre: Array
    extent_m: float


@dataclass(frozen=True)
class Structure:
    """All structure that was found."""

    walls: tuple[Wall, ...]
    poles: tuple[Pole, ...]
    things: tuple[Thing, ...]

    @property
    def surfaces(self) -> tuple[Wall | Pole, ...]:
        """Walls and poles."""
        return (*self.walls, *self.poles)


def find_structure(
    points: Array,
    beams: Array,
    scan: IntArray,
    gate_m: float,
    with_ground: bool,
    columns: bool = True,
) -> Structure:
    """Walls, poles and objects.

    Args:
        points: (N, 3) metres, map.
        beams: (N, 3) unit vectors of their beams, map.
        scan: (N,) index of the scan of each point.
        gate_m: largest distance of a point from its surface.
        with_ground: whether level planes count too.
        columns: whether poles and objects are searched too.
    """
    if not len(points):
        return Structure((), (), ())
    free = np.ones(len(points), dtype=bool)
    walls: list[Wall] = []
    # Points of seeds that did not grow into a wall.
    spent = np.zeros(len(points), dtype=bool)
    while len(walls) < MOST_WALLS:
        seed = _flattest(points, free & ~spent, gate_m)
        if seed is None:
            break
        wall = _grown(points, free, seed, gate_m)
        if wall is None or len(np.unique(scan[wall.members])) < MIN_SCANS:
            spent[seed] = True
            continue
        free[wall.members] = False
        # Points slightly off the wall or behind its edges are not another wall.
        off = np.abs((points - wall.centre) @ wall.normal)
        spent |= (off < 2.0 * gate_m) & _beside(points, wall)
        if with_ground or not wall.is_level:
            walls.append(wall)
    walls.sort(key=lambda wall: -len(wall.members))
    if not columns:
        return Structure(tuple(walls), (), ())
    poles, things = _columns(points, beams, scan, free & ~spent)
    return Structure(tuple(walls), tuple(poles), tuple(things))


def _beside(points: Array, wall: Wall) -> BoolArray:
    """Whether points are in front of or behind a wall rather than past its end."""
    inside = np.ones(len(points), dtype=bool)
    for axis, length in zip(wall.axes, wall.extent_m, strict=True):
        inside &= np.abs((points - wall.centre) @ axis) < 0.5 * length + 0.5
    return inside


def _flattest(points: Array, free: BoolArray, gate_m: float) -> IntArray | None:
    """Points of the flat cell with the most points."""
    index = np.flatnonzero(free)
    if len(index) < SEED_POINTS:
        return None
    cell = np.floor(points[index] / SEED_CELL_M).astype(np.int64)
    _, member, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    member = member.ravel()
    n = len(count)
    total = np.stack([np.bincount(member, p, n) for p in points[index].T], axis=1)
    centre = total / count[:, None]
    off = points[index] - centre[member]
    cov = np.empty((n, 3, 3))
    for i in range(3):
        for j in range(3):
            cov[:, i, j] = np.bincount(member, off[:, i] * off[:, j], n) / count
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(cov), 0.0))
    flat = (count >= SEED_POINTS) & (values[:, 0] < max(UNIFORM * gate_m, 0.03))
    flat &= (values[:, 1] > 0.15) & (values[:, 0] < 0.35 * values[:, 1])
    if not flat.any():
        return None
    best = int(np.argmax(np.where(flat, count, 0)))
    return np.asarray(index[member == best])


def plane_of(points: Array) -> tuple[Array, Array, Array]:
    """Centre (3,), axes (3, 3) in rows by descending scatter, and scatter (3,) of points (n, 3)."""
    centre = points.mean(axis=0)
    off = points - centre
    values, vectors = np.linalg.eigh(off.T @ off / len(points))
    return centre, vectors.T[::-1], np.sqrt(np.maximum(values[::-1], 0.0))


def _grown(points: Array, free: BoolArray, seed: IntArray, gate_m: float) -> Wall | None:
    """The wall that grows from a piece; None if it is no wall."""
    members = seed
    index = np.flatnonzero(free)
    for _ in range(ROUNDS):
        centre, axes, _ = plane_of(points[members])
        near = index[np.abs((points[index] - centre) @ axes[2]) < gate_m]
        place = (points[near] - centre) @ axes[:2].T
        at = (points[seed].mean(axis=0) - centre) @ axes[:2].T
        members = near[_connected(place, at)]
        if len(members) < WALL_POINTS:
            return None
    centre, axes, scatter = plane_of(points[members])
    if scatter[2] > UNIFORM * gate_m:
        return None
    place = (points[members] - centre) @ axes[:2].T
    low, high = np.quantile(place, [0.02, 0.98], axis=0)
    extent = (float(high[0] - low[0]), float(high[1] - low[1]))
    if extent[0] < WALL_LENGTH_M or extent[1] < WALL_WIDTH_M:
        return None
    return Wall(members, centre, axes[2], axes[:2], extent)


def _connected(place: Array, at: Array) -> BoolArray:
    """Whether places (n, 2) are connected with the one at (2,), over gaps of PIECE_M."""
    cell = np.floor(place / PIECE_M).astype(np.int64)
    low = cell.min(axis=0, initial=0) - 1
    # The grid is limited: points far away in the plane are put at its border.
    cell = np.clip(cell - low, 0, 400)
    filled = np.zeros(cell.max(axis=0, initial=0) + 2, dtype=bool)
    filled[cell[:, 0], cell[:, 1]] = True
    pieces = _pieces(filled)
    home = np.clip(np.floor(at / PIECE_M).astype(np.int64) - low, 0, np.array(filled.shape) - 1)
    own = pieces[home[0], home[1]]
    if own == 0:
        return np.zeros(len(place), dtype=bool)
    return np.asarray(pieces[cell[:, 0], cell[:, 1]] == own)


def _pieces(filled: BoolArray) -> IntArray:
    """Numbers from 1 of the connected pieces of a grid, corners included; 0 where it is empty."""
    from scipy.ndimage import label  # here: a report does not need it; 0.1 s to import

    return np.asarray(label(filled, np.ones((3, 3)))[0])


def _columns(
    points: Array, beams: Array, scan: IntArray, free: BoolArray
) -> tuple[list[Pole], list[Thing]]:
    """Poles and objects among the points that belong to no wall."""
    index = np.flatnonzero(free)
    if not len(index):
        return [], []
    cell = np.floor(points[index, :2] / COLUMN_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    size = cell.max(axis=0) + 2
    count = np.zeros(size, dtype=np.int64)
    np.add.at(count, (cell[:, 0], cell[:, 1]), 1)
    pieces = _pieces(count >= CELL_POINTS)
    of = pieces[cell[:, 0], cell[:, 1]]
    poles: list[Pole] = []
    things: list[Thing] = []
    for number in np.unique(of[of > 0]).tolist():
        members = index[of == number]
        if len(members) < COLUMN_POINTS or len(np.unique(scan[members])) < MIN_SCANS:
            continue
        low, high = np.quantile(points[members], [0.02, 0.98], axis=0)
        width, height = float(np.hypot(*(high - low)[:2])), float(high[2] - low[2])
        if width < math.sqrt(2.0) * POLE_WIDTH_M and height > POLE_HEIGHT_M:
            pole = fit_pole(points[members], beams[members], members)
            if pole is not None:
                poles.append(pole)
        elif OBJECT_WIDTH_M[0] < width < OBJECT_WIDTH_M[1] and height > OBJECT_WIDTH_M[0]:
            things.append(Thing(members, 0.5 * (low + high), width))
    poles.sort(key=lambda pole: -len(pole.members))
    things.sort(key=lambda thing: -len(thing.members))
    return poles, things


def fit_pole(
    p: Array, beams: Array, members: IntArray, radius_m: float | None = None
) -> Pole | None:
    """A pole through points, by Gauss-Newton on their distances from its surface.

    Args:
        p: (n, 3) metres, its points.
        beams: (n, 3) unit vectors of their beams; the axis is behind the points.
        members: (n,) indices of the points, for the result.
        radius_m: its radius, if it is known.

    Returns:
        None if the radius is not that of a pole.
    """
    low, high = np.quantile(p[:, 2], [0.02, 0.98])
    middle = float(0.5 * (low + high))
    z = p[:, 2] - middle
    start_m = radius_m or 0.1
    # The centroid of a half circle is 2/pi of the radius in front of its centre.
    behind = np.median(p[:, :2] + 2.0 / math.pi * start_m * beams[:, :2], axis=0)
    state = np.array([*behind, 0.0, 0.0, start_m])
    # A weak prior: from one side alone, radius and position are almost unobservable.
    expected, weak = np.array([*state[:2], 0.0, 0.0, 0.1]), np.array([1.0, 1.0, 0.05, 0.05, 0.1])
    if radius_m is not None:
        weak[4] = 1e-9
        expected[4] = radius_m
    for _ in range(POLE_STEPS):
        residual, normal = pole_residuals(p, state[:2], state[2:4], middle, state[4])
        J = np.column_stack([-normal, -normal * z[:, None], -np.ones(len(p))])
        scale = max(1.5 * float(np.median(np.abs(residual))), 0.005)
        weight = 1.0 / np.maximum(np.abs(residual) / (2.0 * scale), 1.0) / scale**2
        H = (J * weight[:, None]).T @ J + np.diag(weak**-2.0)
        g = (J * weight[:, None]).T @ residual + (state - expected) / weak**2
        state = state - np.linalg.solve(H, g)
        state[4] = np.clip(state[4], 1e-3, 1.0)
    if radius_m is None and not POLE_RADIUS_M[0] < state[4] < POLE_RADIUS_M[1]:
        return None
    return Pole(members, state[:2], state[2:4], middle, float(state[4]), float(high - low))


def pole_residuals(
    points: Array, foot: Array, slope: Array, middle_z: float, radius_m: float
) -> tuple[Array, Array]:
    """Distances (n,) of points from a pole's surface, and (n, 2) outward directions."""
    off = points[:, :2] - foot - slope * (points[:, 2] - middle_z)[:, None]
    distance = np.linalg.norm(off, axis=1)
    return distance - radius_m, off / np.maximum(distance, 1e-6)[:, None]
