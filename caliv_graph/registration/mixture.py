"""The mixture that a target is reconstructed as: E-step, and the quadratic that it puts on poses.

GMMCalib (Evangelidis & Horaud 2018 behind it) has isotropic components. A chair is seen from its
front by one LiDAR and from its back by another, 2 to 3 cm apart; isotropic components pull the two
skins together, which on the CaLiV authors' drive is 36 mrad of roll between the LiDARs. So a
component here has a normal, a variance along it and one across it, and explains only points whose
beam came from the side that its normal points to. Without normals, slides along the beams and
`ALONG_SURFACE`, and with equal variances, the formulas are those of SPEC 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caliv_graph.common.cores import parts, share_out
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, sampling_order, second_moments

NEIGHBOURS = 6
"""Components that a point may belong to: the nearest. Farther ones have no weight to speak of."""

NORMAL_METRES = 0.1
"""In the search for near components, normals that are opposite count as 2 x 0.1 m apart."""

NORMAL_CONCENTRATION = 4.0
"""Exponent of the agreement of normals: 60 degrees cost a factor of e^2."""

GRAZING = 0.05
"""Cosine between beam and surface at which visibility fades."""

STEEP = 0.1
"""Cosine between beam and surface below which it is no longer asked where the beam meets the
surface: normals are not known well enough to tell."""

REACH_SIGMAS = 3.0
"""Standard deviations of the noise along the beam beyond which a point is somewhere else. While
poses are still wrong by more than that, most points are."""

PART_POINTS = 8192
"""Points of a part of the E-step: what belongs to them stays in the processor's cache."""

PART_CLOUDS = 8
"""The same of the sums over the points of each cloud."""

PARTS_TURNED = 2
"""Parts of the components in what is lost because they turn: the same on any number of cores."""

ALONG_SURFACE = 0.07
"""Part of what a point's position *along* the surface seems to say that is believed. Components
are pieces of a surface, and how the beams fell on them differs from view to view: a LiDAR sees more
of the side of a piece that is turned to it, so that with all of it every cloud seems to be too
near, by 5 mm of a sparse LiDAR's mounting, with a precision that is not there. Edges and legs do
say something: without any of it three sparse LiDARs are a millimetre off, the other way.
"""

NORMAL_SIGMA_RAD = 0.2
"""How far the normal of a component may be from those of its points, which are blurred near edges
and have their noise from the same points."""

MAX_TURN_RAD = 0.2
"""Largest turn of a component in one M-step that is not towards the normals of its points."""

LEAST_LEVER_M = 1e-5
"""Keeps the orientation of a component defined that has its points on a line, or one alone."""

PRIOR_COUNT = 1e-12
"""Points' worth of weight that keeps an abandoned component defined. More would add up over all
components to information on where the target is, which no cloud has.
"""

POINTS_PER_COMPONENT = 10
"""There are no more components than points for this many of each: a place and an orientation are
known from three, and what they take the poses do not get."""


@dataclass(frozen=True)
class Responsibilities:
    """Which components explain which points.

    Attributes:
        component: (N, k) indices of components.
        alpha: (N, k) responsibilities times the weight of the point's cloud; the rest of each row
            belongs to the outlier class.
        inlier_ratio: (J,) part of each cloud's points that components explain.
        levers: (J, 3) what is missing in the rotations' part of a cloud's gradient, since the
            lever of a residual ends where the beam meets the surface, not at the point (`expect`).
        component_levers: (K, 3) the same, summed over the points of each component.
        slides_m: (N,) how far along its beam the surface is from each point.
    """

    component: IntArray
    alpha: Array
    inlier_ratio: Array
    levers: Array
    component_levers: Array
    slides_m: Array


@dataclass(frozen=True)
class ShapeQuadratic:
    """What the points say about the poses of all clouds, with the shape estimated from them.

    As a function of left perturbations `Exp(d_j) T_target_lidar_j` (target frame; rotation then
    translation) the negative log-likelihood is `d^T H d / 2 + g^T d`, where H is `blocks` on the
    diagonal minus what is lost because place and orientation of the components come from the same
    points: both are eliminated. `blocks` alone, per-cloud information given the shape, claims more.
    In all of H a point y is the place where its beam meets the surface; the residuals in `gradient`
    and `torque` are those of the points themselves.

    A cloud moves the mean of component k by `A_jk d_j / mass_k`, A_jk (3, 6) being the sum of
    `alpha [-skew(y), I]`. So the loss is the sum over k of `A_jk^T W_k A_j'k / mass_k`; since
    `W_k = a n n^T + b I` it is two matrix products, half the work of one with the root of W.

    A component turned by v about its mean m would explain `v x (y - m)` of its points. With
    G = -skew(y - m), what all its points say of v is C = sum of `alpha G^T W G`, and
    `P_jk = sum of alpha G^T W [-skew(y), I]` couples it to the clouds: the loss is
    `P_jk^T C_k^-1 P_j'k`. Clouds that share no component say nothing of each other's rotation then.

    Attributes:
        blocks: (J, 6, 6).
        gradient: (J, 6).
        across: (K, 6 J) of the loss across the surfaces, `sqrt(|a| / mass) n^T A`.
        sign: (K,) of a, which is negative where a component is thicker than it is wide.
        along: (K, 4 J) of the rest, `sqrt(b / mass)` times the sums of alpha and alpha y.
        moments: (J, K, 10) sums of alpha h h^T, target frame.
        coupling: (K, 10, 3, 6) that makes of them the P of each cloud and component.
        turnable: (K, 3, 3) C of each component.
        torque: (K, 3) the negative gradient in v.
    """

    blocks: Array
    gradient: Array
    across: Array
    sign: Array
    along: Array
    moments: Array
    coupling: Array
    turnable: Array
    torque: Array

    def joint(self, given_orientations: bool = False) -> Array:
        """H, (6 J, 6 J), symmetric positive semidefinite.

        Args:
            given_orientations: only the means are eliminated: half the work, and no less
                information, so that a step is the same or shorter.
        """
        count = len(self.blocks)
        flat = self.sign > 0.0
        lost: list[Callable[[], Array]] = [
            lambda: self.along,
            lambda: self.across if flat.all() else self.across[flat],
        ]
        if not given_orientations:
            root = np.linalg.inv(np.linalg.cholesky(self.turnable))
            turning = np.matmul(root[:, None], self.coupling).reshape(-1, 10, 18)
            lost += [partial(self._turns, turning, own) for own in parts(len(flat), PARTS_TURNED)]
        squares = [np.empty(0)] * len(lost)

        def square(i: int) -> None:
            # Of a matrix and its own transpose: half the work, and the interpreter's lock is free.
            rows = lost[i]()
            squares[i] = rows.T @ rows

        # The longest first: the others fill the gaps.
        share_out(square, range(len(lost))[::-1])
        even, H, *turns = squares
        for turned in turns:
            H += turned
        if not flat.all():
            H -= self.across[~flat].T @ self.across[~flat]
        pairs = even.reshape(count, 4, count, 4).transpose(0, 2, 1, 3).reshape(-1, 16)
        np.negative(H, out=H)
        H4 = H.reshape(count, 6, count, 6)
        H4 -= (pairs @ _EVEN_PAIRS).reshape(count, count, 6, 6).transpose(0, 2, 1, 3)
        j = np.arange(count)
        H4[j, :, j, :] += self.blocks
        return np.asarray(H)

    def _turns(self, turning: Array, components: slice) -> Array:
        """(3 k, 6 J) what is lost because components turn, of k of them."""
        moments = self.moments[:, components].transpose(1, 0, 2)
        turns = np.matmul(moments, turning[components]).reshape(-1, len(self.blocks), 3, 6)
        return np.asarray(turns.transpose(0, 2, 1, 3).reshape(-1, 6 * len(self.blocks)))


# A point's position in homogeneous coordinates, h = (1, y), makes all that follows linear in the
# second moments of h, ten numbers: the upper triangle of h h^T, row by row.

_ROW, _COLUMN = np.triu_indices(4)

_MOVES = np.zeros((4, 3, 6))
"""J = [-skew(y), I] = h_0 E_0 + h_1 E_1 + h_2 E_2 + h_3 E_3: the E."""
_MOVES[0, :, 3:] = np.eye(3)
_MOVES[1:, :, :3] = -skew(np.eye(3))

_SYMMETRIC = np.zeros((6, 3, 3))
"""W = sum of its upper triangle times these."""
for _q, (_c, _d) in enumerate(zip(*np.triu_indices(3), strict=True)):
    _SYMMETRIC[_q, [_c, _d], [_d, _c]] = 1.0

_TWICE = np.where(_ROW == _COLUMN, 0.5, 1.0)

_TURNED = np.einsum("ace,qcd,bdf->abqef", _MOVES, _SYMMETRIC, _MOVES)[_ROW, _COLUMN]
_BLOCKS = (_TWICE[:, None, None, None] * (_TURNED + np.swapaxes(_TURNED, 2, 3))).reshape(60, 36)
"""`J^T W J` of the ten moments times the six entries of W."""

_TURNS = _BLOCKS.reshape(10, 6, 6, 6)[:, :, :3].transpose(1, 0, 2, 3).reshape(6, 180)
"""The rows of the rotations of `J^T W J`, for all components at once."""

_SPUN = np.einsum("ipa,jqb->pqijab", skew(np.eye(3)), skew(np.eye(3))).reshape(9, 81)
"""`skew(v)^T W skew(v)` of W times `v v^T`."""

_PULLED = np.zeros((4, 4, 6, 6))
_PULLED[:, 1:] = np.einsum("ace,qcd->adqe", _MOVES, _SYMMETRIC)
_PULLED = (_PULLED + np.swapaxes(_PULLED, 0, 1))[_ROW, _COLUMN]
_PULLS = (_TWICE[:, None, None] * _PULLED).reshape(60, 6)
"""`J^T W y` of the same."""

_EVEN_PAIRS = np.einsum("ace,bcf->abef", _MOVES, _MOVES).reshape(16, 36)
"""`A_j^T A_j'` of the first moments of two clouds."""


def seed_mixture(stack: CloudStack, R: Array, t: Array, components: int, sigma_m: float) -> Mixture:
    """A first mixture: components on points drawn where normals can be trusted.

    Every cloud gives the same number of points, so that a near cloud with many does not take all
    components. Which points are drawn does not depend on the poses (`sampling_order`).

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of current `T_target_lidar`.
        components: how many; fewer if there are few points.
        sigma_m: first standard deviation along and across the normal.
    """
    points = stack.moved(R, t)
    normals = stack.rotated(R, stack.normals)
    components = max(min(components, len(points) // POINTS_PER_COMPONENT), 1)
    usable = np.flatnonzero(stack.flatness > 0.5)
    if len(usable) < 2 * components:
        usable = np.arange(len(points))
    order = usable[np.argsort(sampling_order(stack.points[usable]))]
    # The rank of each point in its own cloud: all first ones, then all second ones, ...
    cloud = stack.cloud[order]
    by_cloud = np.argsort(cloud, kind="stable")
    starts = np.searchsorted(cloud[by_cloud], cloud[by_cloud], side="left")
    rank = np.empty(len(order), dtype=np.int64)
    rank[by_cloud] = np.arange(len(order)) - starts
    chosen = order[np.argsort(rank, kind="stable")[:components]]
    count = len(chosen)
    return Mixture(
        means_target=points[chosen].copy(),
        normals_target=normals[chosen].copy(),
        var_normal=np.full(count, sigma_m**2),
        var_tangent=np.full(count, sigma_m**2),
        weights=np.full(count, 1.0 / count),
    )


def expect(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    outlier_density: float,
    cloud_weights: Array,
) -> Responsibilities:
    """E-step: the responsibilities of SPEC 3, of the nearest components only.

    How far along the surface a point is from a component is measured where its beam meets the
    component's plane. The noise is along the beam; on a slanted surface it moves a point along the
    surface too, and would choose the component: at the far edge of a face the last component would
    get the points that the noise made too far, at the near edge those that it made too near, and
    every face would turn about its middle, and with it a LiDAR by half a milliradian.

    The lever on which a residual turns the cloud reaches to that place too. The point's own is
    longer where the residual is larger, or shorter: least squares would turn all surfaces edge-on
    to their beams, where the noise shows less. For a point y at height h above a plane of normal n,
    seen along b, it reaches to `y - h b / (n^T b)`.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of current `T_target_lidar`.
        mixture: the current components.
        outlier_density: gamma / (h (gamma + 1)), per cubic metre.
        cloud_weights: (J,) robust weight of each cloud.
    """
    k = min(NEIGHBOURS, len(mixture.weights))
    near = np.empty((len(stack.points), k), dtype=np.int64)
    alpha = np.empty((len(stack.points), k))
    forces, seen = np.empty(alpha.shape), np.empty(stack.points.shape)
    levers, slides = np.empty(stack.points.shape), np.empty(len(stack.points))
    centres = np.column_stack([mixture.means_target, NORMAL_METRES * mixture.normals_target])
    # Components lie on surfaces: boxes halved in the middle fit them better than those halved in
    # number, and the search is a sixth faster.
    tree = cKDTree(centres, balanced_tree=False)
    constant = (
        np.log(mixture.weights)
        - 1.5 * np.log(2.0 * np.pi)
        - 0.5 * np.log(mixture.var_normal)
        - np.log(mixture.var_tangent)
    )
    aside, above = -0.5 / mixture.var_tangent, -0.5 / mixture.var_normal
    reach_m = REACH_SIGMAS * stack.sigma_range_m
    across = _across(mixture)
    means, directions = mixture.means_target.T.copy(), mixture.normals_target.T.copy()

    def of_part(part: slice) -> None:
        cloud = stack.cloud[part]
        turn = R[cloud]
        points = np.einsum("nij,nj->ni", turn, stack.points[part]) + t[cloud]
        normals = np.einsum("nij,nj->ni", turn, stack.normals[part])
        beams = np.einsum("nij,nj->ni", turn, stack.beams[part])
        _, found = tree.query(np.column_stack([points, NORMAL_METRES * normals]), k)
        found = np.reshape(found, (-1, k))
        height, all2, agreement, facing, depth = (np.zeros(found.shape) for _ in range(5))
        for axis in range(3):
            n = directions[axis][found]
            offset = points[:, axis, None] - means[axis][found]
            height += offset * n
            all2 += offset * offset
            agreement += n * normals[:, axis, None]
            facing -= n * beams[:, axis, None]
            depth += offset * beams[:, axis, None]
        # From the point along its beam to the surface.
        slide = height * np.maximum(facing, 0.0) / np.maximum(facing, STEEP) ** 2
        slide = np.clip(slide, -reach_m, reach_m)
        aside2 = all2 + slide * (2.0 * depth + slide) - (height - facing * slide) ** 2
        log_alpha = constant[found]
        log_alpha += above[found] * height**2
        log_alpha += aside[found] * np.maximum(aside2, 0.0)
        log_alpha += NORMAL_CONCENTRATION * stack.flatness[part, None] * (agreement - 1.0)
        visible = np.clip((facing + GRAZING) / (2.0 * GRAZING), 1e-3, 1.0)
        likelihood = np.exp(log_alpha) * visible
        explained = likelihood.sum(axis=1)
        slides[part] = np.einsum("nk,nk->n", likelihood, slide) / np.maximum(explained, 1e-300)
        likelihood /= explained[:, None] + outlier_density
        near[part], alpha[part] = found, likelihood
        force = likelihood * across[found] * height * slide * cloud_weights[cloud][:, None]
        summed = [np.einsum("nk,nk->n", force, directions[axis][found]) for axis in range(3)]
        levers[part] = _cross(beams, np.column_stack(summed))
        forces[part], seen[part] = force, beams

    # Every part is computed by itself, so that the result is the same on any number of cores.
    share_out(of_part, parts(len(near), len(near) // PART_POINTS + 1))
    inlier = stack.sum_per_cloud(alpha.sum(axis=1)) / np.diff(
        np.append(stack.starts, len(stack.points))
    )
    pulled = [
        np.bincount(near.ravel(), (forces * seen[:, axis, None]).ravel(), len(mixture.weights))
        for axis in range(3)
    ]
    return Responsibilities(
        component=near,
        alpha=alpha * cloud_weights[stack.cloud][:, None],
        inlier_ratio=inlier,
        levers=stack.sum_per_cloud(levers),
        component_levers=_cross(np.column_stack(pulled), mixture.normals_target),
        slides_m=slides,
    )


def cell_moments(stack: CloudStack, who: Responsibilities, components: int) -> Array:
    """What the M-steps need of the points: sums per cloud and component ("cell").

    Args:
        stack: the clouds.
        who: responsibilities of the components for their points.
        components: how many there are, K.

    Returns:
        (J, K, 23): sums of `alpha h h^T`, upper triangle, h = (1, p), p the point in the frame of
        its LiDAR less its cloud's centre; of alpha times flatness times normal, lidar frame; and as
        the first ten with the place where the point's beam meets the surface for the point.
    """
    width = who.component.shape[1]
    ends = np.append(stack.starts, len(stack.points))
    features = stack.features
    sums = np.empty((stack.count, components, 23))

    def of_clouds(first: int) -> None:
        last = min(first + PART_CLOUDS, stack.count)
        own, count = slice(ends[first], ends[last]), ends[last] - ends[first]
        cells = (stack.cloud[own, None] - first) * components + who.component[own]
        # A column per point, an entry per component it may belong to: the product is one pass.
        belongs = scipy.sparse.csc_array(
            (
                who.alpha[own].ravel(),
                cells.ravel().astype(np.int32),
                np.arange(0, count * width + 1, width, dtype=np.int32),
            ),
            shape=((last - first) * components, count),
        )
        met = second_moments(stack.centred[own] + who.slides_m[own, None] * stack.beams[own])
        part = sums[first:last].reshape(-1, 23)
        part[:, :13] = np.asarray(belongs @ features[own])
        part[:, 13:] = np.asarray(belongs @ met)

    share_out(of_clouds, range(0, stack.count, PART_CLOUDS))
    return sums


def _carried(stack: CloudStack, R: Array, t: Array) -> Array:
    """(J, 10, 10) that, from the right, carry moments from the lidar to the target frame."""
    A = np.zeros((stack.count, 4, 4))
    A[:, 0, 0] = 1.0
    A[:, 1:, 0] = np.einsum("jab,jb->ja", R, stack.centres) + t
    A[:, 1:, 1:] = R
    both = np.einsum("jac,jbd->jcdab", A, A)[..., _ROW, _COLUMN]
    both = both + np.swapaxes(both, 1, 2)
    return np.asarray(_TWICE[:, None] * both[:, _ROW, _COLUMN])


def _across(mixture: Mixture) -> Array:
    """(K,) a of `W = a n n^T + b I`."""
    return np.asarray(1.0 / mixture.var_normal - ALONG_SURFACE / mixture.var_tangent)


def shape_quadratic(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, cells: Array, who: Responsibilities
) -> ShapeQuadratic:
    """The quadratic of `ShapeQuadratic` at the current poses, means and orientations eliminated.

    A point y of cloud j contributes `alpha (y - mu)^T W (y - mu)`, with `dy = [-skew(y), I] d_j`
    and `W = n n^T / var_normal + ALONG_SURFACE (I - n n^T) / var_tangent` of its component. The
    levers in what multiplies d reach to where the beam meets the surface: to the point, they would
    be longer by the noise wherever a surface is slanted, and go with its residual.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of current `T_target_lidar`.
        mixture: the components of the E-step.
        cells: (J, K, 23) `cell_moments` of the responsibilities.
        who: these; their levers count.
    """
    count, K = stack.count, len(mixture.weights)
    carried = _carried(stack, R, t)
    points, moments = np.matmul(cells[..., :10], carried), np.matmul(cells[..., 13:], carried)
    total = points.sum(axis=0)
    mass, means = _mass_and_means(total, mixture)
    n = mixture.normals_target
    a, b = _across(mixture), ALONG_SURFACE / mixture.var_tangent
    W = a[:, None, None] * n[:, :, None] * n[:, None, :] + b[:, None, None] * np.eye(3)
    halves = W[:, *np.triu_indices(3)]
    by_cloud = np.swapaxes(points, 1, 2)
    pull = by_cloud[:, :4] @ np.einsum("kab,kb->ka", W, means)
    gradient = (by_cloud @ halves).reshape(count, 60) @ _PULLS
    gradient -= np.einsum("jac,ace->je", pull, _MOVES)
    gradient[:, :3] += who.levers
    met = moments.sum(axis=0)
    middles = _mass_and_means(met, mixture)[1]
    coupling = _coupling(W, middles)
    both = _scatter(total, means) @ W
    torque = both[:, [1, 2, 0], [2, 0, 1]] - both[:, [2, 0, 1], [1, 2, 0]] + who.component_levers
    turnable = _turnable(_scatter(met, middles), mass, W)
    turned = np.linalg.solve(turnable, torque[..., None])[..., 0]
    pulled = np.einsum("kqae,ka->kqe", coupling, turned)
    gradient -= moments.reshape(count, 10 * K) @ pulled.reshape(10 * K, 6)
    sums = moments[..., :4].transpose(1, 0, 2)
    across = np.empty((K, count, 6))
    root = n * np.sqrt(np.abs(a) / mass)[:, None]
    across[..., :3] = _cross(sums[..., 1:], root[:, None])
    across[..., 3:] = sums[..., :1] * root[:, None]
    return ShapeQuadratic(
        blocks=((np.swapaxes(moments, 1, 2) @ halves).reshape(count, 60) @ _BLOCKS).reshape(
            count, 6, 6
        ),
        gradient=np.asarray(gradient),
        across=across.reshape(K, 6 * count),
        sign=np.sign(a),
        along=(np.sqrt(b / mass)[:, None, None] * sums).reshape(K, 4 * count),
        moments=moments,
        coupling=coupling,
        turnable=turnable,
        torque=np.asarray(torque),
    )


def _coupling(W: Array, means: Array) -> Array:
    """(K, 10, 3, 6) that makes P of `ShapeQuadratic` of the moments of a cloud and component."""
    K = len(means)
    P = (W[:, *np.triu_indices(3)] @ _TURNS).reshape(K, 10, 3, 6)
    # The turn is about the mean, not about the origin: first moments, which come first.
    about = (-skew(means) @ W).reshape(-1, 3) @ _MOVES.transpose(1, 0, 2).reshape(3, 24)
    P[:, :4] += about.reshape(K, 3, 4, 6).transpose(0, 2, 1, 3)
    return np.asarray(P)


def _turnable(scatter: Array, mass: Array, W: Array) -> Array:
    """C (K, 3, 3) of `ShapeQuadratic`.

    Args:
        scatter: (K, 3, 3) of the places where the beams meet the surface, about their mean.
        mass: (K,) of all clouds together.
        W: (K, 3, 3).
    """
    K = len(mass)
    C = scatter.reshape(K, 1, 9) @ (W.reshape(K, 9) @ _SPUN).reshape(K, 9, 9)
    C = C.reshape(K, 3, 3)
    C += (LEAST_LEVER_M**2 * mass * np.trace(W, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(C)


def _mass_and_means(moments: Array, mixture: Mixture) -> tuple[Array, Array]:
    """(K,) weight and (K, 3) mean of each component's points from their (K, 10) moments."""
    mass = moments[:, 0] + PRIOR_COUNT
    return mass, (moments[:, 1:4] + PRIOR_COUNT * mixture.means_target) / mass[:, None]


def _scatter(moments: Array, means: Array) -> Array:
    """(K, 3, 3) sums of `alpha (y - m) (y - m)^T` from (K, 10) moments and (K, 3) means."""
    full = np.empty((len(means), 4, 4))
    full[:, _ROW, _COLUMN] = full[:, _COLUMN, _ROW] = moments
    offset = np.zeros((len(means), 3, 4))  # of y - m in h
    offset[:, :, 0] = -means
    offset[:, :, 1:] = np.eye(3)
    return np.asarray(offset @ full @ np.swapaxes(offset, 1, 2))


def _cross(a: Array, b: Array) -> Array:
    """Cross products of (..., 3); numpy's own takes several times as long."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def maximise_shape(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    sigma_floor_m: float,
    cells: Array,
    turnable: Array,
    torque: Array,
) -> Mixture:
    """M-step of the components at new poses: means, normals, variances, priors.

    A normal is where the points have the component turn, measured along their beams where the
    E-step saw them, and the normals of the points are its prior. By these alone, slanted and
    frontal views of a narrow face would not agree on where it is.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of the new `T_target_lidar`.
        t: (J, 3) translations of the new `T_target_lidar`.
        mixture: the components of the E-step.
        sigma_floor_m: smallest standard deviation; annealed from coarse to the noise level.
        cells: (J, K, 23) `cell_moments` of its responsibilities.
        turnable: (K, 3, 3) of the quadratic of the E-step.
        torque: (K, 3) of it.
    """
    carried = _carried(stack, R, t)
    moments = np.matmul(cells[..., :10], carried).sum(axis=0)
    mass, means = _mass_and_means(moments, mixture)
    trusted = np.matmul(cells[..., 10:13], np.swapaxes(R, 1, 2)).sum(axis=0)
    normals = PRIOR_COUNT * mixture.normals_target + trusted
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    normals = _turned(mixture.normals_target, normals, turnable, torque)
    scatter = _scatter(moments, means)
    along2 = np.einsum("ka,kab,kb->k", normals, scatter, normals)
    # Along the surface the noise of a slanted beam would make a component wider.
    met = np.matmul(cells[..., 13:], carried).sum(axis=0)
    scatter = _scatter(met, _mass_and_means(met, mixture)[1])
    aside2 = np.trace(scatter, axis1=1, axis2=2) - np.einsum(
        "ka,kab,kb->k", normals, scatter, normals
    )
    floor = sigma_floor_m**2
    return Mixture(
        means_target=means,
        normals_target=normals,
        var_normal=np.maximum(along2 / mass, floor),
        var_tangent=np.maximum(aside2 / (2.0 * mass), floor),
        weights=mass / mass.sum(),
    )


def _turned(normals: Array, trusted: Array, turnable: Array, torque: Array) -> Array:
    """(K, 3) normals, turned to where they are most probable.

    A turn v costs `v^T C v / 2 - torque^T v`, and `|v - w|^2 / 2` in units of the prior, w being
    the turn that leads to the trusted normals.
    """
    axis = _cross(normals, trusted)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ka,ka->k", normals, trusted))
    turn = axis * (angle / np.maximum(sine, 1e-300))[:, None]
    left = torque - np.einsum("kab,kb->ka", turnable, turn)
    more = np.linalg.solve(turnable + np.eye(3) / NORMAL_SIGMA_RAD**2, left[..., None])[..., 0]
    size = np.linalg.norm(more, axis=1)
    turn += more * np.minimum(1.0, MAX_TURN_RAD / np.maximum(size, 1e-300))[:, None]
    turned = Rotation.from_rotvec(turn).apply(normals)
    return np.asarray(turned / np.linalg.norm(turned, axis=1)[:, None])
