"""The ground of a whole scan as a surface: it has ramps and kerbs.

Heights on a grid of nodes, bilinear in between, fitted to the lowest point of every cell by
asymmetric least squares: what stands above the surface is not ground, what lies below it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array, csr_array, vstack
from scipy.spatial import cKDTree

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.targets.ground.fit import fit_ground, height_above

HALF_SIZE_M = 35.0
"""The surface reaches this far from the LiDAR along either axis."""

CELL_M = 0.5
"""The lowest point of each cell of this size is a candidate for the ground."""

NODE_M = 2.5
"""Spacing of the nodes: too wide for a target of 1.5 m to lift one."""

PLANE_DISTANCE_M = 0.1
"""Half thickness of the plane that the fit begins with."""

MIN_LEVEL = math.cos(math.radians(25.0))
"""Minimum vertical component of the plane's normal: 10 degrees of guess and 15 of slope. The foot
of a wall, a line, leaves the tilt undetermined."""

TOLERANCES_M = (0.5, 0.3, 0.2, 0.12, 0.12)
"""Cells higher than this above the surface are not ground. The tolerance shrinks, so that hills are
included from the vehicle outwards."""

STIFFNESS = 1.0
"""Weight of a second difference of the nodes over that of a cell. A node with 25 cells follows a
ramp, a node without cells follows its neighbours."""

GAUGE_PRIOR = 1e-6
"""Weight that holds nodes without data at the plane."""

SUPPORT_M = 1.5
"""Ground was seen at a place if one of its cells is within this distance."""

_PER_AXIS = 2 * int(HALF_SIZE_M / NODE_M) + 1
_NODES = _PER_AXIS**2

_BAND = 2 * _PER_AXIS
"""Nodes are coupled to two rows of the grid at most."""

_CORNERS = np.array([0, 1, _PER_AXIS, _PER_AXIS + 1])
"""Nodes about a place, less the first of them."""

_PAIRS = np.triu_indices(len(_CORNERS))


@dataclass(frozen=True)
class GroundSurface:
    """Height of the ground about a LiDAR.

    Attributes:
        nodes: (n, n) metres, height at the nodes, by x, then y; the LiDAR is in the middle.
        cells: (m, 2) metres, x and y of the cells in which ground was seen.
    """

    nodes: Array
    cells: Array

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.cells)

    def height_at(self, xy: Array) -> Array:
        """(k,) metres at places (k, 2); beyond the rim, the height of the rim."""
        node, part = _node_and_part(xy)
        nodes = self.nodes.ravel()
        before = nodes[node] + part[:, 1] * (nodes[node + 1] - nodes[node])
        node = node + _PER_AXIS
        after = nodes[node] + part[:, 1] * (nodes[node + 1] - nodes[node])
        return np.asarray(before + part[:, 0] * (after - before))

    def is_seen_at(self, xy: Array) -> BoolArray:
        """(k,) whether ground was seen within `SUPPORT_M` of places (k, 2)."""
        distance, _ = self._tree.query(xy, distance_upper_bound=SUPPORT_M)
        seen: BoolArray = np.isfinite(distance)
        return seen


def fit_surface(points: Array) -> GroundSurface | None:
    """The ground in a scan (N, 3), metres, z up to the error of the initial guess.

    None if there is no near-horizontal plane.
    """
    lowest = points[_lowest_of_cells(points)]
    plane = fit_ground(lowest, PLANE_DISTANCE_M)
    if plane is None or plane[2] < MIN_LEVEL:
        return None
    # The tilt is removed first: the stiffness concerns deviations from the plane.
    above_plane = height_above(plane, lowest) / plane[2]
    corners, factors = _bilinear(lowest[:, :2])
    entries, products = _normal_entries(corners, factors)
    nodes = np.zeros(_NODES)
    for tolerance in TOLERANCES_M:
        residual = above_plane - (factors * nodes[corners]).sum(axis=0)
        weight = np.where(
            residual > tolerance, 0.0, np.minimum(1.0, tolerance / np.abs(residual - 1e-12))
        )
        normal = _summed(entries, products * weight, _STIFFNESS.size).reshape(_STIFFNESS.shape)
        normal += _STIFFNESS
        right = _summed(corners, factors * (weight * above_plane), _NODES)
        nodes = solveh_banded(normal.T, right, overwrite_ab=True, check_finite=False)
    ground = np.abs(above_plane - (factors * nodes[corners]).sum(axis=0)) < TOLERANCES_M[-1]
    at = np.linspace(-HALF_SIZE_M, HALF_SIZE_M, _PER_AXIS)
    x, y = np.meshgrid(at, at, indexing="ij")
    tilted = (
        nodes.reshape(_PER_AXIS, _PER_AXIS) - (plane[0] * x + plane[1] * y + plane[3]) / plane[2]
    )
    return GroundSurface(tilted, lowest[ground, :2]) if ground.any() else None


def _lowest_of_cells(points: Array) -> IntArray:
    """Index of the lowest point of every cell within the surface's reach."""
    inside = np.flatnonzero(
        (np.abs(points[:, 0]) < HALF_SIZE_M) & (np.abs(points[:, 1]) < HALF_SIZE_M)
    )
    cell = np.floor((points[inside, :2] + HALF_SIZE_M) / CELL_M).astype(np.int64)
    # Cell, height in millimetres and index in one number: sorting those is several times faster
    # than sorting by two keys.
    height_mm = np.clip(1e3 * points[inside, 2] + 2.0**17, 0.0, 2.0**18 - 1.0).astype(np.int64)
    packed = np.sort(((cell[:, 0] * 256 + cell[:, 1]) << 46) | (height_mm << 28) | inside)
    first = np.ones(len(packed), dtype=bool)
    first[1:] = np.diff(packed >> 46) != 0
    return np.asarray(packed[first] & (2**28 - 1))


def _node_and_part(xy: Array) -> tuple[IntArray, Array]:
    """Per place (k, 2) the node (k,) below it along x and y, and how far (k, 2) it is beyond."""
    at = np.clip((xy + HALF_SIZE_M) / NODE_M, 0.0, _PER_AXIS - 1.0)
    low = np.minimum(at.astype(np.int64), _PER_AXIS - 2)
    return np.asarray(low[:, 0] * _PER_AXIS + low[:, 1]), np.asarray(at - low)


def _bilinear(xy: Array) -> tuple[IntArray, Array]:
    """Per place (k, 2) the nodes about it (4, k), and the factors (4, k) that interpolate them."""
    node, part = _node_and_part(xy)
    x, y = part.T
    factors = np.stack([(1.0 - x) * (1.0 - y), (1.0 - x) * y, x * (1.0 - y), x * y])
    return node + _CORNERS[:, None], factors


def _normal_entries(corners: IntArray, factors: Array) -> tuple[IntArray, Array]:
    """What places add to the normal matrix: entries (10, k) of its bands, products (10, k)."""
    row, column = (corners[pair] for pair in _PAIRS)
    first, second = (factors[pair] for pair in _PAIRS)
    return column * (_BAND + 1) + _BAND + row - column, first * second


def _summed(index: IntArray, values: Array, size: int) -> Array:
    """(size,) sums of the values with the same index, both of the same shape."""
    return np.asarray(np.bincount(index.ravel(), values.ravel(), size))


def _bending() -> csr_array:
    """(nodes, nodes) sum of squares of the second differences along x, y, and of the twist."""
    index = np.arange(_NODES).reshape(_PER_AXIS, _PER_AXIS)
    stencils = [
        ((index[:-2], index[1:-1], index[2:]), (1.0, -2.0, 1.0)),
        ((index[:, :-2], index[:, 1:-1], index[:, 2:]), (1.0, -2.0, 1.0)),
        (
            (index[1:, 1:], index[:-1, 1:], index[1:, :-1], index[:-1, :-1]),
            (1.0, -1.0, -1.0, 1.0),
        ),
    ]
    blocks = []
    for nodes, factors in stencils:
        count = nodes[0].size
        rows = np.tile(np.arange(count), len(nodes))
        columns = np.concatenate([n.ravel() for n in nodes])
        values = np.repeat(factors, count)
        blocks.append(coo_array((values, (rows, columns)), shape=(count, _NODES)))
    stacked = vstack(blocks).tocsr()
    return csr_array(stacked.T @ stacked)


def _stiffness() -> Array:
    """(nodes, band + 1) upper bands of what holds the nodes together.

    Transposed they are those of `solveh_banded`, in LAPACK's order of memory: no copy is made.
    """
    entries = (STIFFNESS * _bending()).tocoo()
    upper = entries.col >= entries.row
    row, column = entries.row[upper], entries.col[upper]
    banded = np.zeros((_NODES, _BAND + 1))
    banded[column, _BAND + row - column] = entries.data[upper]
    banded[:, _BAND] += GAUGE_PRIOR
    return banded


_STIFFNESS = _stiffness()
