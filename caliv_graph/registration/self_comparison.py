"""A reconstructed shape compared with itself after a rotation, against what the LiDARs saw.

A surface element, rotated, must be there where a beam reached that place, and must not be there
where a beam passed through. Where no beam came near, it is neither confirmed nor contradicted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.se3 import cross, stack, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray, Mixture, Registration

MOST_VIEWS = 24
"""Clouds that the shape is compared in, from directions as different as possible."""

MOST_COMPONENTS = 600
"""Components that are compared, evenly drawn."""

FACING = 0.35
"""Minimum cosine between beam and surface normal for a comparison: a steeper surface may hide
itself."""

SAME_M = 0.01
SAME_SIGMAS = 3.0
"""A surface is where it was expected if it is off by at most `SAME_M`, which registration and the
width of the components leave, plus `SAME_SIGMAS` of the noise of its points."""

HIDDEN_M = 0.06
"""A return nearer than expected by more than this is an occluder."""

BESIDE_M = 0.3
"""Distance beside its points up to which a cloud without returns is evidence of free space."""

MATCH_M = (0.15, 0.1, 0.07, 0.05, 0.04, 0.04, 0.04, 0.04)
MATCH_SPACINGS = (0.0, 1.0, 2.0)
"""Gates of the fit of the rotated shape to itself, and their minimum in distances between
components: the legs of a table need narrow gates, a cube of few components wide ones. The best fit
is used."""

NORMAL_METRES = 0.1
"""In that fit, opposite normals count as 2 x 0.1 m apart."""


@dataclass(frozen=True)
class View:
    """What one cloud shows of the target.

    Attributes:
        origin_target: (3,) metres, position of the LiDAR, target frame.
        points_target: (N, 3) metres, target frame.
        whole: False if the edge of the field of view may cut the target off.
    """

    origin_target: Array
    points_target: Array
    whole: bool = True


@dataclass(frozen=True)
class Comparison:
    """Whether a surface was seen where each rotated component is, (k,).

    `different`: beams pass through there, or end elsewhere. Neither: not seen.
    """

    same: BoolArray
    different: BoolArray

    @property
    def compared(self) -> float:
        """Part of the components that were seen after the rotation, 0 to 1."""
        return float((self.same | self.different).mean())

    @property
    def contradicted(self) -> float:
        """Part of those that differ, 0 to 1."""
        both = int((self.same | self.different).sum())
        return float(self.different.sum()) / both if both else 0.0


@dataclass(frozen=True)
class RotationResult:
    """A rotation that was tried: the comparison of the rotated shape with the views.

    Axis (3,), a unit vector, and centre (3,), metres, a place on it, are fitted.
    """

    angle_rad: float
    comparison: Comparison
    axis: Array
    centre: Array


def views_of(registration: Registration, most: int = MOST_VIEWS) -> tuple[View, ...]:
    """Clouds of a registration, target frame, from directions as different as possible."""
    R, t = stack(list(registration.T_target_lidar))
    explained = np.flatnonzero(registration.inlier_ratio > 0.5)
    if not len(explained):
        return ()
    towards = t[explained] / np.maximum(np.linalg.norm(t[explained], axis=1), 1e-9)[:, None]
    # Farthest-first: the choice does not depend on where most clouds are from.
    chosen = [0]
    apart = np.arccos(np.clip(towards @ towards[0], -1.0, 1.0))
    while len(chosen) < min(most, len(explained)):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.arccos(np.clip(towards @ towards[chosen[-1]], -1.0, 1.0)))
    clouds = registration.observation.clouds
    return tuple(
        View(
            R[j] @ clouds[j].seen_from_lidar + t[j],
            clouds[j].points_lidar @ R[j].T + t[j],
            not clouds[j].cut,
        )
        for j in explained[chosen].tolist()
    )


class Shape:
    """A shape and the views of it.

    Attributes:
        means: (K, 3) metres, target frame.
        normals: (K, 3) unit vectors.
        chosen: (k,) indices of the components that are compared.
        views: what was seen from where.
        tree: of means and scaled normals.
        spacing_m: median distance between neighbouring components, in the tree.
        sigma_m: noise along the beam, 1 sigma, metres.
    """

    def __init__(self, mixture: Mixture, views: Sequence[View], sigma_m: float) -> None:
        """Indexes the components that have points, and the views."""
        # Components without points may be anywhere.
        alive = np.flatnonzero(mixture.weights > 0.05 / len(mixture.weights))
        self.means, self.normals = mixture.means_target[alive], mixture.normals_target[alive]
        few = np.linspace(0, len(alive) - 1, min(MOST_COMPONENTS, len(alive))).round().astype(int)
        self.chosen: IntArray = np.sort(few)
        self.views = tuple(ViewIndex.of(view) for view in views if len(view.points_target) >= 10)
        self.tree = cKDTree(np.column_stack([self.means, NORMAL_METRES * self.normals]))
        self.spacing_m = float(np.median(np.asarray(self.tree.query(self.tree.data, k=2)[0])[:, 1]))
        self.sigma_m = sigma_m

    def rotated(self, axis: Array, angle_rad: float) -> RotationResult | None:
        """The shape compared with itself after a rotation about `axis` (3,), a unit vector.

        The place of the axis and a small tilt are fitted. None if no components of the rotated
        shape are near those of the shape.
        """
        low, high = np.percentile(self.means, [2, 98], axis=0)
        centre = np.asarray(0.5 * (low + high), np.float64)
        # Where components are dense, several of them come to the same gates.
        gates = {tuple(np.maximum(MATCH_M, s * self.spacing_m).tolist()): s for s in MATCH_SPACINGS}
        fits = [self.fit(axis, angle_rad, centre, spacings) for spacings in gates.values()]
        results = []
        for R, t in (fit for fit in fits if fit is not None):
            own, place = axis_and_centre(R, t, axis, centre)
            results.append(RotationResult(angle_rad, self.compare(R, t), own, place))
        return min(results, key=lambda result: result.comparison.contradicted, default=None)

    def fit(
        self, axis: Array, angle_rad: float, centre: Array, spacings: float
    ) -> tuple[Array, Array] | None:
        """Registers the rotated shape to itself: point-to-plane ICP with narrowing gates.

        The angle is held; `centre` (3,) is a place on `axis` (3,), metres. `spacings` is the
        minimum of the gates in distances between components.

        Returns:
            R (3, 3) and t (3,) of the rigid motion; None if under 10 pairs are near.
        """
        R = Rotation.from_rotvec(axis * angle_rad).as_matrix()
        t = centre - R @ centre
        across = tangent_axes(axis)
        for gate_m in np.maximum(MATCH_M, spacings * self.spacing_m):
            points, normals = self.means @ R.T + t, self.normals @ R.T
            distance, near = self.tree.query(
                np.column_stack([points, NORMAL_METRES * normals]), distance_upper_bound=gate_m
            )
            distance, near = np.asarray(distance), np.asarray(near)
            pair = np.flatnonzero(np.isfinite(distance))
            if len(pair) < 10:
                return None
            to = near[pair]
            n = self.normals[to]
            off = np.einsum("ni,ni->n", self.means[to] - points[pair], n)
            # Tilts of the axis and shifts; the angle itself is held.
            arm = cross(points[pair] - centre, n)
            J = np.column_stack([arm @ across.T, n])
            weight = (1.0 - np.minimum(distance[pair] / gate_m, 1.0) ** 2) ** 2
            # Undetermined directions stay small.
            normal_matrix = (J * weight[:, None]).T @ J + 1e-3 * len(pair) * np.eye(5)
            step = np.linalg.solve(normal_matrix, (J * weight[:, None]).T @ off)
            tilt = Rotation.from_rotvec(step[:2] @ across).as_matrix()
            R, t = tilt @ R, tilt @ (t - centre) + centre + step[2:]
        return R, t

    def compare(self, R: Array, t: Array) -> Comparison:
        """Compares the shape, moved by (R, t), with the views."""
        points = self.means[self.chosen] @ R.T + t
        normals = self.normals[self.chosen] @ R.T
        offsets = np.full((len(self.views), len(points)), np.nan)
        counts = np.zeros(offsets.shape)
        pierced = np.zeros(offsets.shape, dtype=bool)
        for j, view in enumerate(self.views):
            offsets[j], counts[j], pierced[j] = view.look(points, normals)
        votes = (np.isfinite(offsets) | pierced).sum(axis=0)
        # Offset of the surface: median over the views that met one near there.
        some = np.isfinite(offsets).any(axis=0)
        off = np.zeros(len(points))
        off[some] = np.abs(np.nanmedian(offsets[:, some], axis=0))
        noise = SAME_SIGMAS * self.sigma_m / np.sqrt(np.maximum(counts.sum(axis=0), 1.0))
        different = (2 * pierced.sum(axis=0) > votes) | (some & (off > SAME_M + noise))
        return Comparison(same=(votes > 0) & ~different, different=different)


@dataclass(frozen=True)
class ViewIndex:
    """A view, indexed by direction.

    Attributes:
        origin: (3,) metres, position of the LiDAR.
        points: (N, 3) metres, its returns.
        tree: of the directions to them.
        beam_rad: angle between neighbouring beams: within it a return is of the same surface.
        azimuth: (2,) rad, range of the points about `towards`.
        elevation: (2,) rad, range of the points.
        towards: (3,) metres, from the LiDAR to the middle of the points.
        whole: whether missing returns beside the points are evidence of free space.
    """

    origin: Array
    points: Array
    tree: cKDTree
    beam_rad: float
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    towards: Array
    whole: bool

    @classmethod
    def of(cls, view: View) -> ViewIndex:
        """Indexes a view of at least two points."""
        offset = view.points_target - view.origin_target
        directions = offset / np.linalg.norm(offset, axis=1)[:, None]
        tree = cKDTree(directions)
        apart = np.asarray(tree.query(directions, k=min(6, len(directions)))[0])[:, -1]
        towards = offset.mean(axis=0)
        azimuth, elevation = _angles(directions, towards)
        return cls(
            view.origin_target,
            view.points_target,
            tree,
            float(np.quantile(apart, 0.75)),
            (float(azimuth.min()), float(azimuth.max())),
            (float(elevation.min()), float(elevation.max())),
            towards,
            view.whole,
        )

    def look(self, points: Array, normals: Array) -> tuple[Array, Array, BoolArray]:
        """Compares expected surface elements, places and normals (k, 3), with this view's returns.

        Returns:
            (k,) metres from the elements to the surface that was seen, along their normals, NaN if
            none was seen near; (k,) number of its points; (k,) whether beams passed through.
        """
        offset = points - self.origin
        range_m = np.linalg.norm(offset, axis=1)
        directions = offset / range_m[:, None]
        facing = -np.einsum("ni,ni->n", directions, normals)
        asked = np.flatnonzero(facing > FACING)
        out, counts = np.full(len(points), np.nan), np.zeros(len(points))
        pierced = np.zeros(len(points), dtype=bool)
        if not len(asked):
            return out, counts, pierced
        k = min(4, len(self.points))
        apart, near = self.tree.query(directions[asked], k)
        apart, near = np.reshape(apart, (-1, k)), np.reshape(near, (-1, k))
        inside = apart <= self.beam_rad
        off = np.einsum("nki,ni->nk", self.points[near] - points[asked][:, None], normals[asked])
        # Of two surfaces side by side, the one at the expected depth.
        here = inside & (np.abs(off) <= HIDDEN_M)
        met = here.any(axis=1)
        number = here.sum(axis=1)
        out[asked[met]] = np.where(here, off, 0.0).sum(axis=1)[met] / number[met]
        counts[asked] = number
        behind = inside.any(axis=1) & ~met & ~(inside & (off > 0.0)).any(axis=1)
        free = (apart[:, 0] > 2.0 * self.beam_rad) & self._scanned(
            directions[asked], range_m[asked]
        )
        pierced[asked] = behind | free
        return out, counts, pierced

    def _scanned(self, directions: Array, range_m: Array) -> BoolArray:
        """(n,) whether the LiDAR certainly scanned these directions."""
        if not self.whole:
            return np.zeros(len(directions), dtype=bool)
        azimuth, elevation = _angles(directions, self.towards)
        beside = BESIDE_M / range_m
        # Above and below the points, the field of view or the ground may end.
        return np.asarray(
            (azimuth > self.azimuth[0] - beside)
            & (azimuth < self.azimuth[1] + beside)
            & (elevation > self.elevation[0])
            & (elevation < self.elevation[1])
        )


def _angles(directions: Array, towards: Array) -> tuple[Array, Array]:
    """Azimuth from the level direction `towards`, and elevation, of (n, 3) unit vectors."""
    level = math.atan2(towards[1], towards[0])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) - level
    azimuth = (azimuth + math.pi) % (2.0 * math.pi) - math.pi
    return np.asarray(azimuth), np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))


def axis_and_centre(R: Array, t: Array, axis: Array, centre: Array) -> tuple[Array, Array]:
    """Axis (3,) of a rotation (R, t), towards `axis`, and the place (3,) on it near `centre`."""
    # The antisymmetric part of R vanishes for half a turn.
    values, vectors = np.linalg.eigh(R + R.T)
    own = vectors[:, int(values.argmax())]
    own = own if own @ axis > 0.0 else -own
    # R (p - c) + c = R p + t, up to a translation along the axis.
    M = np.eye(3) - R + np.outer(own, own)
    place = np.linalg.solve(M, t - own * (own @ t) + own * (own @ centre))
    return np.asarray(own), np.asarray(place)
