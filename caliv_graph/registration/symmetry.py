"""Turns after which the reconstructed target looks the same, and what they take from a calibration.

A drum looks the same after any turn about its axis: no cloud of it tells the LiDAR's yaw about it.
A cube looks the same after a quarter turn: a LiDAR may be a quarter turn off about the target, if
its guess was. The shape is compared with itself as the LiDARs saw it: a part of it, turned, must be
there where a beam reached it, and must not be where a beam went through. Where no beam came near,
it is neither.

The quadratic of `mixture` does not show a drum's freedom by itself: its components tile a smooth
surface like the bumps of a golf ball, and each holds points across the surface as well as along the
normal. `marginalise_symmetry` takes out what it claims of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caliv_graph.common.cores import share_out
from caliv_graph.geometry.se3 import stack, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray, Mixture, Registration

MOST_VIEWS = 24
"""Clouds that the shape is compared in, from sides that are as different as they can be."""

MOST_COMPONENTS = 600
"""Components that are compared, evenly drawn."""

ORDERS = (2, 3, 4, 5, 6, 8)
"""Parts of a full turn that are looked at."""

BETWEEN_DEG = (10.0, 25.0, 37.0, 53.0, 80.0, 105.0, 160.0)
"""Turns that no shape of few corners passes: one that passes them all passes any."""

FEWEST_BETWEEN = 3
"""How many of them must have been seen at both ends."""

FACING = 0.35
"""Cosine between beam and surface below which a surface is not judged: it may hide itself."""

SAME_M = 0.01
"""A surface is where it was expected if it is no farther off than this, which is what registration
and the width of components leave, and `SAME_SIGMAS` of what the noise of its points leaves."""

SAME_SIGMAS = 3.0

HIDDEN_M = 0.06
"""What is this much nearer than expected stands in front, and tells nothing of what is behind."""

BESIDE_M = 0.3
"""How far beside its points a cloud is believed to show that there is nothing."""

FEWEST_COMPARED = 0.3
"""Part of what was seen of the shape that must have been seen at both ends of a turn before it is
called the same. Half a chair is not the same as the half that nobody saw."""

MOST_CONTRADICTED = 0.12
"""Part of what was compared that may differ, beyond what differs without any turn."""

MATCH_M = (0.15, 0.1, 0.07, 0.05, 0.04, 0.04, 0.04, 0.04)
MATCH_SPACINGS = (0.0, 1.0, 2.0)
"""Gates of the fit of the turned shape to itself, and the narrowest in distances of components: a
table's legs want narrow ones, a cube of few components wide ones. The best fit counts."""

NORMAL_METRES = 0.1
"""There, normals that are opposite count as 2 x 0.1 m apart."""

REFIT_SPACINGS = 1.0
"""The same where the axis is known to millimetres."""

UPRIGHT_COS = math.cos(math.radians(20.0))
"""Axes nearer to the vertical than this are the vertical."""


@dataclass(frozen=True)
class View:
    """What one cloud shows of the target.

    Attributes:
        origin_target: (3,) metres, the LiDAR, target frame.
        points_target: (N, 3) metres, target frame.
        whole: False if the edge of the field of view may cut the target off.
    """

    origin_target: Array
    points_target: Array
    whole: bool = True


@dataclass(frozen=True)
class Symmetry:
    """A turn after which a shape looks the same.

    Attributes:
        axis_target: (3,) unit vector along the axis.
        centre_target: (3,) metres, a place on the axis.
        turn_rad: the smallest such turn; its multiples are others. 0: any turn at all.
        fitted_rad: the turn that axis and centre were found by: it itself, or of a continuous
            symmetry the one that tells them best.
        compared: part of the components that were seen at both ends of the turn.
        contradicted: part of these that differ. Of several turns about an axis, both are of the one
            that differs most.
        unseen: indices of the components whose counterpart no beam came near: they might still tell
            the turned shape from the other, and could not be asked.
    """

    axis_target: Array
    centre_target: Array
    turn_rad: float
    fitted_rad: float
    compared: float
    contradicted: float
    unseen: IntArray

    @property
    def continuous(self) -> bool:
        """Whether any turn about the axis leaves the shape as it was."""
        return self.turn_rad == 0.0

    @property
    def upright(self) -> bool:
        """Whether the axis is the vertical."""
        return bool(abs(self.axis_target[2]) > UPRIGHT_COS)

    def generator(self) -> Array:
        """(6,) left perturbation (rotation then translation) that turns about the axis by 1 rad."""
        return np.concatenate([self.axis_target, np.cross(self.centre_target, self.axis_target)])


@dataclass(frozen=True)
class _Comparison:
    """What became of every component after a turn: seen the same, seen different, or not seen."""

    same: BoolArray
    different: BoolArray

    @property
    def compared(self) -> float:
        return float((self.same | self.different).mean())

    @property
    def contradicted(self) -> float:
        both = int((self.same | self.different).sum())
        return float(self.different.sum()) / both if both else 0.0


def views_of(registration: Registration, most: int = MOST_VIEWS) -> tuple[View, ...]:
    """The clouds of a registration in its target frame, from sides as different as can be.

    Args:
        registration: as `register_jointly` or the solved graph left it.
        most: how many at most.
    """
    R, t = stack(list(registration.T_target_lidar))
    believed = np.flatnonzero(registration.inlier_ratio > 0.5)
    if not len(believed):
        return ()
    towards = t[believed] / np.maximum(np.linalg.norm(t[believed], axis=1), 1e-9)[:, None]
    # Farthest first; in an order that does not depend on which clouds are many.
    chosen = [0]
    apart = np.arccos(np.clip(towards @ towards[0], -1.0, 1.0))
    while len(chosen) < min(most, len(believed)):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.arccos(np.clip(towards @ towards[chosen[-1]], -1.0, 1.0)))
    clouds = registration.observation.clouds
    return tuple(
        View(t[j], clouds[j].points_lidar @ R[j].T + t[j], not clouds[j].cut)
        for j in believed[chosen].tolist()
    )


def symmetries(
    mixture: Mixture, views: Sequence[View], sigma_range_m: float
) -> tuple[Symmetry, ...]:
    """Turns after which a reconstructed shape looks the same, within its noise.

    Looked at are the vertical and the two main level directions of its surfaces, about each any
    turn and the parts of a full one in `ORDERS`. The axis goes through where the turned shape fits
    itself best. A component contradicts a turn if, where it would then be, beams pass through or
    end elsewhere by more than the noise; what nobody looked at contradicts nothing, and is named
    (`Symmetry.unseen`).

    Args:
        mixture: the shape, target frame.
        views: what the LiDARs saw of it from where (`views_of`).
        sigma_range_m: noise along the beam, metres.

    Returns:
        Those found, the vertical first; of each axis the smallest turn.
    """
    if not views or len(mixture.weights) < 20:
        return ()
    shape = _Shape.of(mixture, views, sigma_range_m)
    identity = shape.compare(np.eye(3), np.zeros(3))
    axes = _axes(mixture)
    found: list[Symmetry | None] = [None] * len(axes)

    def look(i: int) -> None:
        found[i] = _about(shape, axes[i], identity)

    share_out(look, range(len(axes)))
    return tuple(symmetry for symmetry in found if symmetry is not None)


def refit(symmetry: Symmetry, mixture: Mixture) -> Symmetry:
    """The axis of a symmetry again, as the shape now is.

    An axis that is off by millimetres would leave what `marginalise_symmetry` is to take out.

    Args:
        symmetry: its axis is right to some degrees.
        mixture: the shape, target frame.
    """
    shape = _Shape.of(mixture, (), 0.0)
    fits = []
    for signed in (symmetry.fitted_rad, -symmetry.fitted_rad):
        fit = shape.fit(symmetry.axis_target, signed, symmetry.centre_target, REFIT_SPACINGS)
        if fit is not None:
            fits.append(_axis_and_centre(*fit, symmetry.axis_target, symmetry.centre_target))
    if not fits:
        return symmetry
    axis = np.mean([axis for axis, _ in fits], axis=0)
    return replace(
        symmetry,
        axis_target=axis / np.linalg.norm(axis),
        centre_target=np.mean([centre for _, centre in fits], axis=0),
    )


def marginalise_symmetry(H: Array, gradient: Array, symmetry: Symmetry) -> tuple[Array, Array]:
    """A joint quadratic over cloud poses that knows nothing of turns about a shape's axis.

    Each cloud may have been turned about the axis by an angle of its own: these angles are
    eliminated (Schur complement), so that what is left is the same whatever they are.

    Args:
        H: (6 J, 6 J) information of left perturbations of `T_target_lidar`, or (6, 6) of one.
        gradient: (6 J,) likewise.
        symmetry: a continuous one.

    Returns:
        Information and gradient of the same shapes, zero along every turn.
    """
    count = len(H) // 6
    turn = np.kron(np.eye(count), symmetry.generator()[:, None])
    along = H @ turn
    own = turn.T @ along
    # A cloud without information has nothing to be taken from.
    own += np.eye(count) * max(1e-12 * float(np.trace(own)), 1e-12)
    pulled = np.linalg.solve(own, np.column_stack([along.T, turn.T @ gradient]))
    H = H - along @ pulled[:, :-1]
    return 0.5 * (H + H.T), gradient - along @ pulled[:, -1]


def alarming(symmetry: Symmetry, sigma_rad: float) -> bool:
    """Whether a symmetry may spoil a calibration whose guesses have this sigma of rotation."""
    return symmetry.continuous or 3.0 * sigma_rad >= 0.5 * symmetry.turn_rad


# ------------------------------------------------------------------ turns of one axis


def _axes(mixture: Mixture) -> list[Array]:
    """The vertical, and the two level directions that most of the steep surfaces face."""
    level = mixture.normals_target[:, :2]
    angle = np.radians(np.arange(0.0, 90.0, 1.0))
    axes = np.stack([np.cos(angle), np.sin(angle)])
    # The fourth power: equal faces at right angles have no preferred direction in the second.
    crossed = np.stack([-np.sin(angle), np.cos(angle)])
    facing = np.sum((level @ axes) ** 4 + (level @ crossed) ** 4, axis=0)
    best = float(angle[int(facing.argmax())])
    c, s = math.cos(best), math.sin(best)
    return [np.array([0.0, 0.0, 1.0]), np.array([c, s, 0.0]), np.array([-s, c, 0.0])]


@dataclass(frozen=True)
class _Turn:
    """A turn that was looked at: how it went, and the centre that fits best."""

    angle_rad: float
    comparison: _Comparison
    axis: Array
    centre: Array


def _about(shape: _Shape, axis: Array, identity: _Comparison) -> Symmetry | None:
    """The smallest turn about an axis after which the shape is the same, or None."""
    limit = identity.contradicted + MOST_CONTRADICTED

    def seen(signed_rad: float) -> _Turn | None:
        """A turn; None if it was hardly seen at both ends."""
        turn = shape.turned(axis, signed_rad)
        least = FEWEST_COMPARED * identity.compared
        return None if turn is None or turn.comparison.compared <= least else turn

    def looked_at(angle_rad: float, enough: float = math.inf) -> _Turn | None:
        """A turn and its opposite, the worse of the two.

        None if either was hardly seen. If the first is contradicted by more than `enough`, the
        other is not looked at.
        """
        worst: _Turn | None = None
        for signed in (angle_rad,) if angle_rad == math.pi else (angle_rad, -angle_rad):
            turn = seen(signed)
            if turn is None:
                return None
            if worst is None or turn.comparison.contradicted > worst.comparison.contradicted:
                worst = turn
            if turn.comparison.contradicted > enough:
                break
        return worst

    turns: list[_Turn] = []
    for degrees in BETWEEN_DEG:
        turn = looked_at(math.radians(degrees))
        if turn is not None and turn.comparison.contradicted > limit:
            turns = []
            break
        turns += [] if turn is None else [turn]
    # From one side only small turns of a drum can be seen at both ends.
    if len(turns) >= FEWEST_BETWEEN:
        worst = max(turns, key=lambda t: t.comparison.contradicted)
        # What a fit is off by counts for the centre by 1 / (2 sin(angle / 2)).
        wide = max(turns, key=lambda t: abs(t.angle_rad))
        return _symmetry(replace(worst, axis=wide.axis, centre=wide.centre), 0.0, wide.angle_rad)
    smallest, refuted = None, set[int]()
    for order in sorted(ORDERS):
        # What is the same after a part of a full turn is so after twice the part: a quarter turn
        # need not be looked at where half a turn is another shape.
        if any(order % part == 0 for part in refuted):
            continue
        turn = looked_at(2.0 * math.pi / order, limit)
        if turn is not None and turn.comparison.contradicted > limit:
            refuted.add(order)
        elif turn is not None:
            smallest = _symmetry(turn, 2.0 * math.pi / order, turn.angle_rad)
    return smallest


def _symmetry(turn: _Turn, smallest_rad: float, fitted_rad: float) -> Symmetry:
    seen = turn.comparison.same | turn.comparison.different
    return Symmetry(
        axis_target=turn.axis,
        centre_target=turn.centre,
        turn_rad=smallest_rad,
        fitted_rad=fitted_rad,
        compared=turn.comparison.compared,
        contradicted=turn.comparison.contradicted,
        unseen=np.flatnonzero(~seen),
    )


# ------------------------------------------------------------------ a shape against itself


@dataclass(frozen=True)
class _Shape:
    """A shape, and what of it was seen.

    Attributes:
        means: (K, 3) metres, target frame.
        normals: (K, 3) unit vectors.
        chosen: (k,) components that are compared.
        views: what was seen from where.
        tree: of means and normals.
        spacing_m: distance of a component from the next, in the tree.
        sigma_m: noise along the beam.
    """

    means: Array
    normals: Array
    chosen: IntArray
    views: tuple[_Seen, ...]
    tree: cKDTree
    spacing_m: float
    sigma_m: float

    @classmethod
    def of(cls, mixture: Mixture, views: Sequence[View], sigma_m: float) -> _Shape:
        means, normals = mixture.means_target, mixture.normals_target
        # Abandoned components lie about anywhere.
        alive = np.flatnonzero(mixture.weights > 0.05 / len(mixture.weights))
        few = np.linspace(0, len(alive) - 1, min(MOST_COMPONENTS, len(alive))).round().astype(int)
        tree = cKDTree(np.column_stack([means[alive], NORMAL_METRES * normals[alive]]))
        seen = tuple(_Seen.of(view) for view in views if len(view.points_target) >= 10)
        chosen = np.sort(few)
        spacing_m = float(np.median(np.asarray(tree.query(tree.data, k=2)[0])[:, 1]))
        return cls(means[alive], normals[alive], chosen, seen, tree, spacing_m, sigma_m)

    def turned(self, axis: Array, angle_rad: float) -> _Turn | None:
        """The shape compared with itself after a turn, about where that fits best.

        None if the turned shape meets itself nowhere.
        """
        low, high = np.percentile(self.means, [2, 98], axis=0)
        centre = np.asarray(0.5 * (low + high), np.float64)
        # Where components are dense, several of them come to the same gates.
        gates = {tuple(np.maximum(MATCH_M, s * self.spacing_m).tolist()): s for s in MATCH_SPACINGS}
        fits = [self.fit(axis, angle_rad, centre, spacings) for spacings in gates.values()]
        turns = []
        for R, t in (fit for fit in fits if fit is not None):
            own, place = _axis_and_centre(R, t, axis, centre)
            turns.append(_Turn(angle_rad, self.compare(R, t), own, place))
        return min(turns, key=lambda turn: turn.comparison.contradicted, default=None)

    def fit(
        self, axis: Array, angle_rad: float, centre: Array, spacings: float
    ) -> tuple[Array, Array] | None:
        """Rotation and translation of a turn that lay the shape best on itself, or None."""
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
            # Tilts of the axis and shifts; never the turn itself: it is what is asked about.
            arm = np.cross(points[pair] - centre, n)
            J = np.column_stack([arm @ across.T, n])
            weight = (1.0 - np.minimum(distance[pair] / gate_m, 1.0) ** 2) ** 2
            # Shifts along the surface, and those that nothing resists, stay small.
            normal_matrix = (J * weight[:, None]).T @ J + 1e-3 * len(pair) * np.eye(5)
            step = np.linalg.solve(normal_matrix, (J * weight[:, None]).T @ off)
            tilt = Rotation.from_rotvec(step[:2] @ across).as_matrix()
            R, t = tilt @ R, tilt @ (t - centre) + centre + step[2:]
        return R, t

    def compare(self, R: Array, t: Array) -> _Comparison:
        """The shape, moved by (R, t), against what the views show."""
        points = self.means[self.chosen] @ R.T + t
        normals = self.normals[self.chosen] @ R.T
        offsets = np.full((len(self.views), len(points)), np.nan)
        counts = np.zeros(offsets.shape)
        pierced = np.zeros(offsets.shape, dtype=bool)
        for j, view in enumerate(self.views):
            offsets[j], counts[j], pierced[j] = view.look(points, normals)
        votes = (np.isfinite(offsets) | pierced).sum(axis=0)
        # Where the surface is, by the median of the views that met one near there.
        some = np.isfinite(offsets).any(axis=0)
        off = np.zeros(len(points))
        off[some] = np.abs(np.nanmedian(offsets[:, some], axis=0))
        noise = SAME_SIGMAS * self.sigma_m / np.sqrt(np.maximum(counts.sum(axis=0), 1.0))
        different = (2 * pierced.sum(axis=0) > votes) | (some & (off > SAME_M + noise))
        return _Comparison(same=(votes > 0) & ~different, different=different)


@dataclass(frozen=True)
class _Seen:
    """A view, ready to be asked.

    Attributes:
        origin: (3,) the LiDAR.
        points: (N, 3) what it saw.
        tree: of the directions to them.
        beam_rad: angle to the nearest points that the surface between two beams may be off.
        azimuth: (2,) radians from the middle of the points, of the first and last.
        elevation: (2,) radians.
        towards: (3,) to the middle of the points.
        whole: whether nothing beside them means that there is nothing.
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
    def of(cls, view: View) -> _Seen:
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
        """What this view says of surface elements.

        Args:
            points: (k, 3) where they would be.
            normals: (k, 3) which way they would face.

        Returns:
            (k,) metres that the surface was seen in front of them, along their normals, NaN if none
            was seen about there; (k,) from how many points; (k,) whether beams went through them.
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
        # Of two surfaces beside one another, the one that was expected.
        here = inside & (np.abs(off) <= HIDDEN_M)
        met = here.any(axis=1)
        number = here.sum(axis=1)
        out[asked[met]] = np.where(here, off, 0.0).sum(axis=1)[met] / number[met]
        counts[asked] = number
        behind = inside.any(axis=1) & ~met & ~(inside & (off > 0.0)).any(axis=1)
        nothing = (apart[:, 0] > 2.0 * self.beam_rad) & self._looked_at(
            directions[asked], range_m[asked]
        )
        pierced[asked] = behind | nothing
        return out, counts, pierced

    def _looked_at(self, directions: Array, range_m: Array) -> BoolArray:
        """(n,) whether beams certainly went into these directions."""
        if not self.whole:
            return np.zeros(len(directions), dtype=bool)
        azimuth, elevation = _angles(directions, self.towards)
        beside = BESIDE_M / range_m
        # Above and below them the field of view, or the ground, may have ended.
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


def _axis_and_centre(R: Array, t: Array, axis: Array, centre: Array) -> tuple[Array, Array]:
    """Axis (3,) of a turn (R, t), on the side of `axis`, and the place (3,) on it near `centre`."""
    # The turn may be half a turn, for which the antisymmetric part vanishes.
    values, vectors = np.linalg.eigh(R + R.T)
    own = vectors[:, int(values.argmax())]
    own = own if own @ axis > 0.0 else -own
    # R (p - c) + c = R p + t, but for what slides along the axis.
    M = np.eye(3) - R + np.outer(own, own)
    place = np.linalg.solve(M, t - own * (own @ t) + own * (own @ centre))
    return np.asarray(own), np.asarray(place)
