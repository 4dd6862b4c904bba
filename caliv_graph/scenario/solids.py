"""Closed solids of triangles, made in code, of which the objects of a scenario are built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.products import Array, IntArray

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (n, 3) metres, frame by context.
        triangles: (m, 3) indices of vertices, counter-clockwise seen from outside.
    """

    vertices: Array
    triangles: IntArray

    def moved(self, T_a_b: gtsam.Pose3) -> Mesh:
        """The mesh with its vertices transformed from frame b into frame a."""
        vertices = self.vertices @ T_a_b.rotation().matrix().T + T_a_b.translation()
        return Mesh(vertices, self.triangles)

    def signed_volume(self) -> float:
        """Volume in cubic metres of a closed mesh; positive if its faces point outwards."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one. Solids may overlap: a ray from outside hits the outer skin first."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.triangles + o for mesh, o in zip(meshes, offsets[:-1], strict=True)]),
    )


def _quads(a: IntArray, b: IntArray, c: IntArray, d: IntArray) -> IntArray:
    """Two triangles for each quadrilateral a b c d."""
    a, b, c, d = (x.reshape(-1) for x in (a, b, c, d))
    return np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def grid_quads(index: IntArray) -> IntArray:
    """Two triangles for each square of a grid (r, c) of indices of vertices."""
    return _quads(index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])


def solid_between(one: Array, other: Array) -> Mesh:
    """The closed solid between two grids (r, c, 3) of points and the rim between their borders."""
    rows, columns = one.shape[:2]
    n = rows * columns
    index = np.arange(n).reshape(rows, columns)
    border = np.concatenate(
        [index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0], index[0, :1]]
    )
    triangles = np.vstack(
        [
            grid_quads(index)[:, ::-1],
            grid_quads(index + n),
            _quads(border[1:], border[:-1], border[:-1] + n, border[1:] + n),
        ]
    )
    mesh = Mesh(np.vstack([one.reshape(-1, 3), other.reshape(-1, 3)]), triangles)
    # The orientation of the faces depends on the side of `one` on which `other` lies.
    return mesh if mesh.signed_volume() > 0.0 else Mesh(mesh.vertices, triangles[:, ::-1])


def rectangle(centre: Point, size: tuple[float, float], axes: tuple[int, int]) -> Array:
    """(2, 2, 3) corners of a rectangle that spans two of the axes x, y, z (0, 1, 2)."""
    corners = np.tile(np.array(centre, dtype=np.float64), (2, 2, 1))
    corners[:, :, axes[0]] += np.array([[-0.5], [0.5]]) * size[0]
    corners[:, :, axes[1]] += np.array([-0.5, 0.5]) * size[1]
    return corners


def bar(
    begin: Point,
    end: Point,
    begin_size: tuple[float, float],
    end_size: tuple[float, float],
    axes: tuple[int, int] = (0, 1),
) -> Mesh:
    """A tapered bar between two rectangles in parallel planes.

    Args:
        begin: centre of one end in metres.
        end: centre of the other end.
        begin_size: sides of the rectangle at `begin` along the two axes.
        end_size: sides at `end`.
        axes: the two axes of x, y, z (0, 1, 2) that the rectangles span.
    """
    return solid_between(rectangle(begin, begin_size, axes), rectangle(end, end_size, axes))


def box(size_m: Point) -> Mesh:
    """A box of this size; the origin is in the middle of its bottom face."""
    x, y, z = size_m
    return bar((0.0, 0.0, 0.0), (0.0, 0.0, z), (x, y), (x, y))


def cylinder(
    begin: Point, end: Point, begin_radius_m: float, end_radius_m: float, sides: int = 24
) -> Mesh:
    """An upright round solid between two levels, tapered if the radii differ."""
    angle = np.linspace(0.0, 2.0 * math.pi, sides, endpoint=False)
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    low = np.array(begin) + begin_radius_m * rim
    high = np.array(end) + end_radius_m * rim
    n = len(angle)
    i = np.arange(n)
    j = (i + 1) % n
    low_centre, high_centre = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    triangles = np.vstack(
        [
            _quads(i, j, j + n, i + n),
            np.column_stack([j, i, low_centre]),
            np.column_stack([i + n, j + n, high_centre]),
        ]
    )
    return Mesh(np.vstack([low, high, [begin], [end]]), triangles)


def tube(path: Array, radius_m: float, sides: int = 8, *, closed: bool = False) -> Mesh:
    """A round tube along a line of points; one point and the next give a straight piece.

    Args:
        path: (n, 3) metres, middle of the tube; at a bend it becomes narrower by the cosine of half
            the angle.
        radius_m: from the middle to the corners of its section.
        sides: corners of its section.
        closed: whether the last point is followed by the first; the path must lie in a plane then.
    """
    n = len(path)
    pieces = np.roll(path, -1, axis=0) - path
    pieces /= np.linalg.norm(pieces, axis=1, keepdims=True)
    before = np.roll(pieces, 1, axis=0)
    if not closed:
        before[0], pieces[-1] = pieces[0], before[-1]
    directions = before + pieces
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The section must not turn about the path, or the tube would be twisted.
    side = np.eye(3)[0 if abs(directions[0, 2]) > 0.9 else 2]
    sections = np.empty((n, sides, 3))
    angle = np.linspace(0.0, 2.0 * math.pi, sides, endpoint=False)[:, None]
    for i, direction in enumerate(directions):
        side = side - (side @ direction) * direction
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        sections[i] = path[i] + radius_m * (np.cos(angle) * side + np.sin(angle) * other)
    index = np.arange(n * sides).reshape(n, sides)
    around = np.column_stack([index, index[:, 0]])
    if closed:
        around = np.vstack([around, around[:1]])
        vertices = sections.reshape(-1, 3)
        triangles = grid_quads(around)[:, ::-1]
    else:
        vertices = np.vstack([sections.reshape(-1, 3), path[:1], path[-1:]])
        begin, end = (np.full(sides, n * sides + k) for k in range(2))
        triangles = np.vstack(
            [
                grid_quads(around)[:, ::-1],
                np.column_stack([around[0, 1:], around[0, :-1], begin]),
                np.column_stack([around[-1, :-1], around[-1, 1:], end]),
            ]
        )
    return Mesh(vertices, triangles)
