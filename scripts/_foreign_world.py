"""Triangle meshes of places where a vehicle is calibrated: ground, houses, trees, cars, targets.

Nothing here is imported from caliv_graph: see `_foreign_drives.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CELL_M = 0.25
"""Side of a cell of the ground."""

MARGIN_M = 45.0
"""Of the ground around a path."""

STOREY_M = 2.8
PLASTER_CELL_M = 0.7

Style = Literal["yard", "street", "open", "hall"]
"""Of the surroundings of a path."""


@dataclass
class Mesh:
    """Vertices and triangles that grow part by part."""

    vertices: list[Array] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    count: int = 0

    def add(self, vertices: Array, faces: IntArray) -> None:
        """Appends one part."""
        self.vertices.append(np.asarray(vertices, float))
        self.faces.append(np.asarray(faces, np.int64) + self.count)
        self.count += len(vertices)

    def add_mesh(self, other: Mesh, xyz_m: Array, yaw_rad: float = 0.0) -> None:
        """Appends another mesh, turned about its z axis and moved."""
        turn = Rotation.from_euler("z", yaw_rad).as_matrix()
        v, f = other.arrays()
        self.add(v @ turn.T + xyz_m, f)

    def arrays(self) -> tuple[Array, IntArray]:
        """All vertices and all triangles."""
        return np.concatenate(self.vertices), np.concatenate(self.faces)

    def box(
        self,
        centre_m: tuple[float, float, float],
        size_m: tuple[float, float, float],
        rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Appends a box."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
        turn = Rotation.from_euler("xyz", rpy_rad).as_matrix()
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
        self.add(corners * size_m @ turn.T + centre_m, np.array(faces))

    def tube(self, start_m: Array, end_m: Array, r0_m: float, r1_m: float, sides: int = 10) -> None:
        """Appends a tube or cone frustum with closed ends."""
        axis = (end_m - start_m) / np.linalg.norm(end_m - start_m)
        side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        a = np.arange(sides) * 2 * np.pi / sides
        ring = np.cos(a)[:, None] * side + np.sin(a)[:, None] * other
        v = np.concatenate([start_m + r0_m * ring, end_m + r1_m * ring, [start_m], [end_m]])
        i, j = np.arange(sides), (np.arange(sides) + 1) % sides
        f = np.concatenate(
            [
                np.c_[i, j, j + sides],
                np.c_[i, j + sides, i + sides],
                np.c_[j, i, 0 * i + 2 * sides],
                np.c_[i + sides, j + sides, 0 * i + 2 * sides + 1],
            ]
        )
        self.add(v, f)

    def sheet(self, x: Array, y: Array, z: Array) -> None:
        """Appends a surface of which the points of a grid are given."""
        index = np.arange(x.size).reshape(x.shape)
        a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
        c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
        vertices = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        self.add(vertices, np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]))

    def leaves(self, rng: np.random.Generator, centres_m: Array, size_m: float) -> None:
        """Appends one randomly turned triangle per centre."""
        n = len(centres_m)
        corners = rng.normal(size=(n, 3, 3)) * size_m / 2 + centres_m[:, None, :]
        self.add(corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3))


def chair() -> Mesh:
    """A kitchen chair, front towards +x."""
    m = Mesh()
    m.box((0, 0, 0.45), (0.42, 0.40, 0.03))
    for x, y in ((0.18, 0.17), (0.18, -0.17), (-0.19, 0.17), (-0.19, -0.17)):
        m.box((x, y, 0.22), (0.035, 0.035, 0.44))
    for y in (-0.18, 0.18):
        m.box((-0.22, y, 0.70), (0.03, 0.035, 0.50), (0, -0.12, 0))
    for z in (0.60, 0.74, 0.88):
        m.box((-0.22 - 0.12 * (z - 0.7), 0, z), (0.02, 0.36, 0.08), (0, -0.12, 0))
    return m


def boxes() -> Mesh:
    """A few cardboard boxes piled up askew."""
    m = Mesh()
    m.box((0, 0, 0.2), (0.6, 0.4, 0.4), (0, 0, 0.2))
    m.box((0.05, -0.02, 0.55), (0.4, 0.35, 0.3), (0, 0, -0.5))
    m.box((0.45, 0.35, 0.15), (0.35, 0.3, 0.3), (0, 0, 0.9))
    return m


def bin_() -> Mesh:
    """A wheeled bin of 120 litres."""
    m = Mesh()
    v = np.array(
        [
            [s * x, t * y, z]
            for z, x, y in ((0.08, 0.18, 0.17), (0.88, 0.27, 0.24))
            for s, t in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ]
    )
    f = [
        t
        for i in range(4)
        for t in ((i, (i + 1) % 4, (i + 1) % 4 + 4), (i, (i + 1) % 4 + 4, i + 4))
    ]
    m.add(v, np.array([*f, (0, 1, 2), (0, 2, 3)]))
    m.box((-0.02, 0, 0.92), (0.58, 0.50, 0.05), (0, -0.08, 0))
    for y in (-0.2, 0.2):
        m.tube(np.array([-0.22, y - 0.03, 0.1]), np.array([-0.22, y + 0.03, 0.1]), 0.1, 0.1, 14)
    m.tube(np.array([-0.33, -0.2, 0.9]), np.array([-0.33, 0.2, 0.9]), 0.015, 0.015, 6)
    return m


def bicycle() -> Mesh:
    """A bicycle on its stand."""
    m = Mesh()
    for hub in (-0.52, 0.52):
        turn = np.linspace(0, 2 * np.pi, 25)
        rim = np.c_[hub + 0.34 * np.cos(turn), 0 * turn, 0.35 + 0.34 * np.sin(turn)]
        for begin, end in pairwise(rim):
            m.tube(begin, end, 0.02, 0.02, 6)
    tubes = [
        ((-0.52, 0, 0.35), (-0.1, 0, 0.3)),
        ((-0.1, 0, 0.3), (-0.2, 0, 0.9)),
        ((-0.18, 0, 0.8), (0.35, 0, 0.85)),
        ((-0.1, 0, 0.3), (0.35, 0, 0.8)),
        ((0.52, 0, 0.35), (0.33, 0, 1.0)),
        ((0.33, -0.3, 1.02), (0.33, 0.3, 1.02)),
    ]
    for a, b in tubes:
        m.tube(np.array(a), np.array(b), 0.018, 0.018, 8)
    m.box((-0.21, 0, 0.93), (0.25, 0.14, 0.06))
    m.box((-0.5, 0, 0.75), (0.4, 0.16, 0.02))
    return m


def ladder() -> Mesh:
    """A step ladder, open: rails of 5 x 2.5 cm and flat steps."""
    m = Mesh()
    for lean, steps in ((0.28, 5), (-0.28, 2)):
        foot = 1.5 * np.sin(lean)
        for y in (-0.22, 0.22):
            m.box((-foot / 2, y, 0.75), (0.05, 0.025, 1.55), (0, lean, 0))
        for k in range(1, steps + 1):
            z = 1.45 * k / (steps + 0.5)
            m.box((-foot * (1 - z / 1.5), 0, z), (0.08, 0.44, 0.025))
    m.box((0, 0, 1.52), (0.2, 0.5, 0.03))
    return m


def cones() -> Mesh:
    """Three traffic cones close to each other."""
    m = Mesh()
    for x, y, high in ((0.0, 0.0, 0.75), (0.45, 0.1, 0.5), (0.1, 0.5, 0.75)):
        m.box((x, y, 0.02), (0.36, 0.36, 0.04))
        m.tube(np.array([x, y, 0.04]), np.array([x, y, high]), 0.14, 0.025, 16)
    return m


def sign() -> Mesh:
    """A road sign on a post in a foot of two parts."""
    m = Mesh()
    m.box((0, 0, 0.05), (0.8, 0.3, 0.1))
    m.box((0.1, 0, 0.14), (0.3, 0.4, 0.09), (0, 0, 0.4))
    m.tube(np.array([0, 0, 0.1]), np.array([0.02, 0, 1.9]), 0.03, 0.03, 8)
    m.box((0.05, 0, 1.45), (0.01, 0.6, 0.6), (0.5, 0, 0))
    m.box((0.05, 0, 0.95), (0.01, 0.5, 0.25))
    return m


TARGETS = {
    "chair": chair,
    "boxes": boxes,
    "bin": bin_,
    "bicycle": bicycle,
    "ladder": ladder,
    "cones": cones,
    "sign": sign,
}


def person() -> Mesh:
    """A standing person."""
    m = Mesh()
    for y in (-0.1, 0.1):
        m.tube(np.array([0, y, 0]), np.array([0.05 * y, y, 0.85]), 0.06, 0.09)
        m.tube(np.array([0, 2.4 * y, 0.8]), np.array([0, 2.2 * y, 1.4]), 0.04, 0.05)
    m.tube(np.array([0, 0, 0.8]), np.array([0, 0, 1.45]), 0.17, 0.2)
    m.tube(np.array([0, 0, 1.5]), np.array([0, 0, 1.75]), 0.1, 0.09)
    return m


def car(rng: np.random.Generator) -> Mesh:
    """A passenger car, front towards +x, sides leaning inwards."""
    m = Mesh()
    length, width, roof = rng.uniform(3.9, 4.8), rng.uniform(1.7, 1.85), rng.uniform(1.42, 1.65)
    half = length / 2
    profile = np.array(
        [
            [-half, 0.3],
            [-half, 0.95],
            [-half + 0.5, roof - 0.1],
            [-half + 1.3, roof],
            [half - 2.2, roof],
            [half - 1.3, 0.98],
            [half - 0.15, 0.8],
            [half, 0.3],
        ]
    )
    w = width / 2 - 0.18 * np.clip(profile[:, 1] - 0.9, 0, None) / 0.6
    v = np.concatenate([np.c_[profile[:, 0], s * w, profile[:, 1]] for s in (1, -1)])
    n = len(profile)
    f = [
        t
        for i in range(n)
        for t in ((i, (i + 1) % n, (i + 1) % n + n), (i, (i + 1) % n + n, i + n))
    ]
    fan = [(0, i, i + 1) for i in range(1, n - 1)]
    m.add(v, np.array(f + fan + [(a + n, b + n, c + n) for a, b, c in fan]))
    for x in (-half + 0.85, half - 0.9):
        for y in (-1, 1):
            c = np.array([x, y * (width / 2 - 0.1), 0.31])
            half_width = np.array([0, 0.11, 0])
            m.tube(c - half_width, c + half_width, 0.31, 0.31, 16)
    return m


def facade(rng: np.random.Generator, length_m: float, height_m: float) -> Mesh:
    """A house front along x, facing -y: uneven plaster, recessed windows, a door, side walls."""
    xs, kinds = [0.0], []
    while xs[-1] < length_m - 2.5:
        gap, opening = rng.uniform(0.8, 1.8), rng.uniform(0.9, 1.6)
        xs += [xs[-1] + gap, xs[-1] + gap + opening]
        kinds += ["wall", "door" if rng.random() < 0.15 else "window"]
    xs.append(length_m)
    kinds.append("wall")
    storeys = max(1, int(height_m // STOREY_M))
    zs = [-0.5, 0.0]
    for k in range(storeys):
        zs += [STOREY_M * k + 0.95, STOREY_M * k + 2.2]
    zs.append(height_m)
    depth_m = rng.uniform(0.06, 0.25)
    phase, bump_m = rng.uniform(0, 6.3, 6), rng.uniform(0.001, 0.004)

    def plaster(x: Array, z: Array) -> Array:
        waves = np.sin(1.3 * x + phase[0]) * np.sin(1.1 * z + phase[1])
        waves += np.sin(2.9 * x + phase[2]) + 0.7 * np.sin(2.1 * z + 0.8 * x + phase[3])
        return np.asarray(bump_m * waves)

    m = Mesh()
    for (left, right), kind in zip(pairwise(xs), kinds, strict=True):
        for j, (low, high) in enumerate(pairwise(zs)):
            window = kind == "window" and j % 2 == 0 and 2 <= j <= 2 * storeys
            recessed = window or (kind == "door" and 1 <= j <= 2)
            nx = max(1, int(np.ceil((right - left) / PLASTER_CELL_M)))
            nz = max(1, int(np.ceil((high - low) / PLASTER_CELL_M)))
            x, z = np.meshgrid(np.linspace(left, right, nx + 1), np.linspace(low, high, nz + 1))
            m.sheet(x, np.full_like(x, depth_m) if recessed else plaster(x, z), z)
            if recessed:
                for jamb in (left + 0.001, right - 0.001):
                    m.box((jamb, depth_m / 2, (low + high) / 2), (0.002, depth_m, high - low))
                sill = ((left + right) / 2, depth_m / 2 - 0.03, low + 0.01)
                m.box(sill, (right - left, depth_m + 0.06, 0.02))
    for end in (0.0, length_m):
        m.box((end, 3.0, height_m / 2), (0.02, 6.0, height_m + 1))
    m.box((length_m / 2, -0.2, height_m), (length_m + 0.4, 0.5, 0.15))
    return m


def tree(rng: np.random.Generator) -> Mesh:
    """A tree: a trunk that leans a little and a crown of loose leaves."""
    m = Mesh()
    top = np.array([rng.normal(0, 0.15), rng.normal(0, 0.15), rng.uniform(2.2, 3.2)])
    m.tube(np.array([0, 0, -0.3]), top, rng.uniform(0.12, 0.22), 0.09, 12)
    p = rng.normal(size=(500, 3))
    p *= (rng.random(500) ** 0.4 / np.linalg.norm(p, axis=1))[:, None]
    m.leaves(rng, p * [1.6, 1.6, 1.3] + top + [0, 0, 0.8], 0.14)
    return m


def hedge(rng: np.random.Generator, length_m: float) -> Mesh:
    """A clipped hedge along x."""
    m = Mesh()
    n = int(500 * length_m)
    p = rng.uniform(-0.5, 0.5, (n, 3)) * [length_m, 0.8, 1.4]
    m.leaves(rng, p + np.array([0, 0, 0.7]), 0.08)
    return m


class Ground:
    """Heights on a grid.

    Args:
        xs: (nx,) ascending.
        ys: (ny,) ascending.
        heights: (nx, ny).
    """

    def __init__(self, xs: Array, ys: Array, heights: Array) -> None:
        self.xs, self.ys, self.heights = xs, ys, heights
        self._at = RegularGridInterpolator((xs, ys), heights)

    def z(self, xy: Array) -> Array:
        """Heights at points (..., 2)."""
        return np.asarray(self._at(xy))

    def place(self, xy: Array) -> Array:
        """(3,) the point of the ground at a place (2,)."""
        return np.array([*xy, self.z(xy).item()])

    def mesh(self) -> Mesh:
        """Its triangles."""
        m = Mesh()
        m.sheet(*np.meshgrid(self.xs, self.ys, indexing="ij"), self.heights)
        return m


class Grass:
    """Blades on the ground that return beams above the soil that carries the wheels.

    Args:
        rng: of the patches in which it is higher and lower.
        ground: that it grows on.
        mean_m: height of the returns above the soil.
    """

    def __init__(self, rng: np.random.Generator, ground: Ground, mean_m: float) -> None:
        patches = gaussian_filter(rng.normal(size=ground.heights.shape), 0.6 / CELL_M)
        heights = mean_m * np.exp(0.35 * patches / patches.std())
        self._soil, self._blades = ground, Ground(ground.xs, ground.ys, heights)

    def seen(
        self,
        rng: np.random.Generator,
        origin: Array,
        direction: Array,
        ranges: Array,
        cosines: Array,
    ) -> Array:
        """Ranges (n,) of rays (n, 3), those that meet soil less what they miss of it."""
        at = origin + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * direction
        low = [self._soil.xs[0], self._soil.ys[0]], [self._soil.xs[-1], self._soil.ys[-1]]
        xy = np.clip(at[:, :2], *low)
        soil = np.isfinite(ranges) & (np.abs(at[:, 2] - self._soil.z(xy)) < 0.03)
        lift = self._blades.z(xy) * rng.gamma(2.0, 0.5, len(ranges))
        # Flat beams meet blades on their way; beyond a metre they would have gone between them.
        return np.where(soil, ranges - np.minimum(lift / np.maximum(cosines, 0.03), 1.0), ranges)


def make_ground(
    rng: np.random.Generator,
    path: Array,
    style: Style,
    *,
    uneven: float,
    slope_rad: float,
    hill_m: float,
    kerbs: bool,
    crown: float,
) -> Ground:
    """Ground around a path: slope, waves, bumps and grain, a hill, for streets crown and kerbs."""
    low, high = path.min(0) - MARGIN_M, path.max(0) + MARGIN_M
    xs, ys = np.arange(low[0], high[0], CELL_M), np.arange(low[1], high[1], CELL_M)
    x, y = np.meshgrid(xs, ys, indexing="ij")
    direction = rng.uniform(0, 6.28)
    h = np.tan(slope_rad) * (x * np.cos(direction) + y * np.sin(direction))
    for _ in range(6):
        length, a = rng.uniform(6, 35), rng.uniform(0, 6.28)
        along = 2 * np.pi * (x * np.cos(a) + y * np.sin(a)) / length
        h += uneven * 0.006 * np.sqrt(length / 15) * np.sin(along + rng.uniform(0, 6.28))
    bumps = gaussian_filter(rng.normal(size=x.shape), 0.45 / CELL_M)
    h += uneven * 0.003 * bumps / bumps.std()
    grain = gaussian_filter(rng.normal(size=x.shape), 0.8)
    h += uneven * 0.0012 * grain / grain.std()
    way = path[-1] - path[0]
    length = float(np.linalg.norm(way))
    if hill_m:
        share = ((x - path[0, 0]) * way[0] + (y - path[0, 1]) * way[1]) / length**2
        h += hill_m * 0.5 * (1 - np.cos(2 * np.pi * np.clip(share, 0, 1)))
    if style == "street":
        d, _ = cKDTree(path[::5]).query(np.c_[x.ravel(), y.ravel()], distance_upper_bound=12)
        d = np.minimum(d, 12).reshape(x.shape)
        h -= crown * np.clip(d - 0.5, 0, 4.0)
        if kerbs:
            h += 0.12 * np.clip((d - 4.5) / CELL_M, 0, 1)
    return Ground(xs, ys, h)


@dataclass(frozen=True)
class Mover:
    """A body that goes to and fro on a line."""

    mesh: Mesh
    start_m: Array
    end_m: Array
    speed_m_s: float

    def pose(self, t_s: Array) -> tuple[float, Array]:
        """Yaw, the same throughout, and positions (n, 3)."""
        way = self.end_m - self.start_m
        length = np.linalg.norm(way[:2])
        share = np.abs((t_s * self.speed_m_s / length + 1) % 2 - 1)
        return float(np.arctan2(way[1], way[0])), self.start_m + share[:, None] * way


def populate(
    rng: np.random.Generator,
    ground: Ground,
    path: Array,
    yaw_rad: Array,
    style: Style,
    clear_m: float,
) -> Mesh:
    """Houses, trees, cars, poles and hedges around a path, or a hall."""
    m = Mesh()
    if style == "hall":
        _hall(rng, m, ground, path, clear_m)
        return m
    if style == "yard":
        _houses_around(rng, m, ground, path, clear_m + 4)
    if style == "street":
        _houses_along(rng, m, ground, path, yaw_rad, clear_m)
    near = cKDTree(path)
    spread = {"open": 28.0, "yard": clear_m + 2, "street": clear_m + 1}[style]
    low, high = path.min(0) - spread, path.max(0) + spread
    wide = style == "open"
    counts = {"tree": 14 if wide else 7, "car": 2 if wide else 6, "pole": 7, "hedge": 3}
    for what, count in counts.items():
        least = clear_m - (1.5 if what in ("pole", "tree") else 0.5)
        for _ in range(count):
            for _ in range(30):
                xy = rng.uniform(low, high)
                if near.query(xy)[0] > least:
                    break
            else:
                continue
            turn = rng.uniform(0, 6.28)
            m.add_mesh(_single(rng, what), ground.place(xy), turn)
    return m


def _single(rng: np.random.Generator, what: str) -> Mesh:
    if what == "tree":
        return tree(rng)
    if what == "car":
        return car(rng)
    if what == "hedge":
        return hedge(rng, rng.uniform(2, 6))
    pole = Mesh()
    pole.tube(np.array([0, 0, -0.3]), np.array([0.02, 0, rng.uniform(3, 6)]), 0.06, 0.05)
    return pole


def _houses_around(
    rng: np.random.Generator, m: Mesh, ground: Ground, path: Array, away_m: float
) -> None:
    """Adds house fronts on the four sides of a yard, not quite in line, with gaps."""
    (x0, y0), (x1, y1) = path.min(0) - away_m, path.max(0) + away_m
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length, turn = float(np.linalg.norm(b - a)), np.arctan2(b[1] - a[1], b[0] - a[0])
        along = 0.0
        while along < length - 5:
            part = min(rng.uniform(7, 14), length - along)
            back = np.array([np.sin(turn), -np.cos(turn)]) * rng.uniform(0, 3)
            near = a + (b - a) / length * along + back
            far = near + part * np.array([np.cos(turn), np.sin(turn)])
            skew = rng.normal(0, 0.05)
            # A front looks to -y of its part: turned by 180 degrees it faces the yard.
            if rng.random() < 0.8:
                house = facade(rng, part, rng.uniform(3.2, 8))
                m.add_mesh(house, ground.place(far), turn + np.pi + skew)
            along += part + rng.uniform(0, 3)


def _houses_along(
    rng: np.random.Generator, m: Mesh, ground: Ground, path: Array, yaw_rad: Array, clear_m: float
) -> None:
    """Adds house fronts on both sides of a street."""
    near = cKDTree(path)
    s = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    for side in (1, -1):
        along = -25.0
        while along < s[-1] + 25:
            part = rng.uniform(8, 15)
            middle = along + part / 2
            i = int(np.clip(np.searchsorted(s, middle), 0, len(s) - 1))
            ahead = np.array([np.cos(yaw_rad[i]), np.sin(yaw_rad[i])])
            left = np.array([-ahead[1], ahead[0]])
            place = path[i] + ahead * (middle - np.clip(middle, 0, s[-1]))
            place = place + side * left * (clear_m + rng.uniform(2, 5))
            if near.query(place)[0] > clear_m + 1 and rng.random() < 0.85:
                turn = yaw_rad[i] + (0 if side > 0 else np.pi) + rng.normal(0, 0.02)
                begin = place - part / 2 * np.array([np.cos(turn), np.sin(turn)])
                m.add_mesh(facade(rng, part, rng.uniform(4, 9)), ground.place(begin), turn)
            along += part + rng.uniform(-0.5, 4)


def _hall(rng: np.random.Generator, m: Mesh, ground: Ground, path: Array, away_m: float) -> None:
    """Adds walls, a ceiling, pillars and shelves."""
    low, high = path.min(0) - away_m, path.max(0) + away_m
    size, middle = high - low, (high + low) / 2
    x, y, z = ground.place(middle).tolist()
    for k, (sx, sy) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
        centre = (x + sx * (size[0] / 2 + 0.1), y + sy * (size[1] / 2 + 0.1), z + 1.5)
        across = (0.2 if sx else size[0] + 0.4, 0.2 if sy else size[1] + 0.4, 4.5)
        m.box(centre, across, (0, 0, 0.004 * k))
    m.box((x, y, z + 3.6), (size[0], size[1], 0.1))
    near = cKDTree(path)
    for _ in range(14):
        x, y = rng.uniform(low, high).tolist()
        if near.query((x, y))[0] <= 1.2:
            continue
        if rng.random() < 0.5:
            m.box((x, y, z + 1.5), (0.4, 0.4, 4))
        else:
            shelf = (rng.uniform(0.6, 2), 0.6, 1.8)
            m.box((x, y, z + 0.9), shelf, (0, 0, rng.uniform(0, 3)))
