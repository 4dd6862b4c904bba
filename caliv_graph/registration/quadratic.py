"""The quadratic that the points of all clouds put on the poses of the clouds.

The M-step of the poses, with places and orientations of the surfels eliminated. Residuals are
heights of points over the surfels, levers are those of where the beams meet the surface: the
gradient of the likelihood of the ranges. `README.md` of this folder derives each term.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from caliv_graph.common.cores import parts, shared_map
from caliv_graph.geometry.se3 import cross, skew, tangent_axes
from caliv_graph.products import Array, Mixture
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.registration.moments import (
    ALONG_MOMENTS,
    COLUMN,
    HALF_DIAGONAL,
    JACOBIAN,
    MOMENTS,
    NORMALS,
    ROW,
    SURFACE_MOMENTS,
    Responsibilities,
    mass_and_means,
    scatter_about,
    to_target,
)

ORIENTATION_PARTS = 2
"""Parts in which the information lost to the components' orientations is summed. The same on any
number of cores: so are the bits of the sums."""

NORMAL_SIGMA_RAD = 0.2
"""Prior of a surfel's normal about the mean normal of its points, 1 sigma, where these are reliable
and agree. Normals are blurred near edges, and their noise is that of the same points."""

ALONG_PART = 1e-6
"""Surfels with less than this part of the largest weight along the surface have none to
lose."""

SEEN_SIGMA_RAD = 1.0
"""The same where they are not: a surfel faces the beams that it was seen by."""


@dataclass(frozen=True)
class ShapeQuadratic:
    """Information and gradient over the poses of all clouds, the shape eliminated.

    Of the likelihood of the ranges (`caliv_graph/registration/README.md`): a step d of
    left perturbations `Exp(d_j) T_target_lidar_j` (target frame; rotation then translation)
    minimises `d^T H d / 2 + g^T d`. H is `blocks` on the diagonal minus what
    is lost since place and orientation of each surfel are estimated from the same points: two
    Schur complements, which couple clouds. Clouds that share no surfel are independent of each
    other.

    Attributes:
        blocks: (J, 6, 6) information of each cloud given the shape.
        gradient: (J, 6) g.
        gradient_given_shape: (J, 6) the same where the shape is held: that of `blocks`.
        across: (K', 6 J) roots of the loss to the places of the surfels: across the surface of all,
            along it where points are held there.
        moments: (J, K, q) sums of weight h h^T, h = (1, m), target frame; then the part of the
            prior of each normal that turns with the cloud, q = 11; then, where points are held
            along the surface, the sums with the weights along it, q = 21.
        coupling: (K, q, 3, 6) linear map from the moments of a cloud and surfel to the coupling
            of its orientation and the cloud.
        prior_turns: (J, J) information of the priors on turns of the clouds, per axis.
        orientation_information: (K, 3, 3) of each surfel, the prior of its normal included.
        turns: (K, 3) rotation of each surfel that it asks for at these poses.
        normal_information: (K,) of the prior of each normal.
        normals: (K, 3) of the surfels; None where points are held along the surface, so that turns
            of a surfel about its normal are coupled to the points.
    """

    blocks: Array
    gradient: Array
    gradient_given_shape: Array
    across: Array
    moments: Array
    coupling: Array
    prior_turns: Array
    orientation_information: Array
    turns: Array
    normal_information: Array
    normals: Array | None = None

    def joint(self, given_orientations: bool = False) -> Array:
        """H, (6 J, 6 J), symmetric positive semidefinite.

        With `given_orientations` the places alone are eliminated: half the work, and never less
        information, so that a step is the same or shorter.
        """
        count = len(self.blocks)
        lost: list[Callable[[], Array]] = [lambda: self.across]
        if not given_orientations:
            whitened = self._whitened_coupling()
            lost += [
                partial(self._lost_to_orientations, whitened, own)
                for own in parts(len(self.coupling), ORIENTATION_PARTS)
            ]

        def square(of: Callable[[], Array]) -> Array:
            # Of a matrix and its own transpose: half the work, and the interpreter's lock is free.
            rows = of()
            return np.asarray(rows.T @ rows)

        # The longest first: the others fill the gaps.
        squares = shared_map(square, lost[::-1])[::-1]
        H = squares[0]
        for square_of_part in squares[1:]:
            H += square_of_part
        np.negative(H, out=H)
        H4 = H.reshape(count, 6, count, 6)
        j = np.arange(count)
        H4[j, :, j, :] += self.blocks
        for axis in range(3):
            H4[:, axis, :, axis] += self.prior_turns
        if self.normals is not None and not given_orientations:
            about = self._lost_to_turns_about_normals(self.normals)
            H4[:, :3, :, :3] -= (about.T @ about).reshape(count, 3, count, 3)
        return np.asarray(H)

    def along(self, J: Array) -> Array:
        """(m, m) information on what moves the clouds' poses by J (J, 6, m): `J^T H J`.

        Without H itself: its cost grows with the square of the clouds.
        """
        H = np.einsum("jam,jab,jbn->mn", J, self.blocks, J, optimize=True)
        for axis in range(3):
            H += J[:, axis].T @ self.prior_turns @ J[:, axis]
        across = self.across @ J.reshape(-1, J.shape[2])
        H -= across.T @ across
        moved = np.tensordot(self.moments, J, axes=(0, 0))
        P = np.einsum("kqae,kqem->kam", self.coupling, moved, optimize=True)
        H -= np.einsum("kam,kan->mn", P, np.linalg.solve(self.orientation_information, P))
        return np.asarray(0.5 * (H + H.T))

    def _whitened_coupling(self) -> Array:
        """(K, q, r, 6) `coupling` over the root of the information; r = 2: tilts alone, else 3."""
        axes = np.eye(3)[None] if self.normals is None else tangent_axes(self.normals)
        information = axes @ self.orientation_information @ np.swapaxes(axes, 1, 2)
        root = np.linalg.inv(np.linalg.cholesky(information)) @ axes
        return np.asarray(np.matmul(root[:, None], self.coupling))

    def _lost_to_orientations(self, whitened: Array, surfels: slice) -> Array:
        """(r k, 6 J) root of what is lost to the orientations of k surfels."""
        moments, maps = self.moments[:, surfels].transpose(1, 0, 2), whitened[surfels]
        k, r = len(maps), maps.shape[2]
        out = np.empty((r, k, len(self.blocks), 6))
        for i in range(r):
            np.matmul(moments, maps[:, :, i], out=out[i])
        return out.reshape(r * k, -1)

    def _lost_to_turns_about_normals(self, normals: Array) -> Array:
        """(K, 3 J) root of what is lost to these turns: by the priors alone, on rotations alone."""
        root = self.moments[:, :, 10].T / np.sqrt(self.normal_information)[:, None]
        return np.asarray((root[..., None] * normals[:, None]).reshape(len(normals), -1))

    def shape_parameters(self) -> float:
        """How many parameters of the shape the points determine, of three per surfel."""
        known = np.linalg.inv(self.orientation_information)
        prior = self.normal_information * np.trace(known, axis1=1, axis2=2)
        # The turn about the normal itself has the prior alone.
        return float(np.sum(1.0 + 3.0 - prior))


# Constant tensors: what the M-step sums over points, as linear maps of moments and weights.

_SYMMETRIC = np.zeros((6, 3, 3))
"""W = sum of its upper triangle times these."""
for _q, (_c, _d) in enumerate(zip(*np.triu_indices(3), strict=True)):
    _SYMMETRIC[_q, [_c, _d], [_d, _c]] = 1.0

_JWJ = np.einsum("ace,qcd,bdf->abqef", JACOBIAN, _SYMMETRIC, JACOBIAN)[ROW, COLUMN]
_BLOCKS = (HALF_DIAGONAL[:, None, None, None] * (_JWJ + np.swapaxes(_JWJ, 2, 3))).reshape(60, 36)
"""`J^T W J` of the ten moments times the six entries of W, J = [-skew(y), I]."""

_ROTATION_ROWS = _BLOCKS.reshape(10, 6, 6, 6)[:, :, :3].transpose(1, 0, 2, 3).reshape(6, 180)
"""The rows of the rotations of `J^T W J`, for all components at once."""

_SKEW_W_SKEW = np.einsum("ipa,jqb->pqijab", skew(np.eye(3)), skew(np.eye(3))).reshape(9, 81)
"""`skew(v)^T W skew(v)` of W times `v v^T`."""

_JWY = np.zeros((4, 4, 6, 6))
_JWY[:, 1:] = np.einsum("ace,qcd->adqe", JACOBIAN, _SYMMETRIC)
_JWY = (_JWY + np.swapaxes(_JWY, 0, 1))[ROW, COLUMN]
_GRADIENTS = (HALF_DIAGONAL[:, None, None] * _JWY).reshape(60, 6)
"""`J^T W y` of the ten moments times the six entries of W."""


def shape_quadratic(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, cells: Array, who: Responsibilities
) -> ShapeQuadratic:
    """Linearises the negative log-likelihood at the current poses.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the surfels of the E-step.
        cells: `cell_moments` of the responsibilities.
        who: the responsibilities; their lever corrections enter.
    """
    carry = to_target(stack, R, t)
    points = np.matmul(cells[..., MOMENTS], carry)
    # What `ShapeQuadratic.moments` holds: written once, it is as large as all the rest.
    held = who.weight_along is not None
    turning = np.empty((*cells.shape[:2], 21 if held else 11))
    moments = turning[..., :10]
    np.matmul(cells[..., SURFACE_MOMENTS], carry, out=moments)
    blocks, given_shape = _given_shape(points, moments, mixture, who)
    total, on_surface = points.sum(axis=0), moments.sum(axis=0)
    mass, means = mass_and_means(total, mixture)
    surface_means = mass_and_means(on_surface, mixture)[1]
    n = mixture.normals_target
    W = n[:, :, None] * n[:, None, :]
    # Each surfel moves to its points, and turns into their plane.
    move = np.einsum("ka,ka->k", n, means - mixture.means_target)[:, None] * n
    taken = np.swapaxes(moments, 1, 2)[:, :4] @ move
    gradient = given_shape - np.einsum("jac,ace->je", taken, JACOBIAN)
    both = scatter_about(total, means) @ W
    torque = both[:, [1, 2, 0], [2, 0, 1]] - both[:, [2, 0, 1], [1, 2, 0]] + who.component_levers
    torque -= mass[:, None] * cross(surface_means - means, move)
    C = _orientation_information(scatter_about(on_surface, surface_means), W)
    towards, reliability, parts_of_normal = _normal_prior(cells, R, mass, mixture)
    known, seen = reliability / NORMAL_SIGMA_RAD**2, 1.0 / SEEN_SIGMA_RAD**2
    torque += known[:, None] * towards
    C += (known + seen)[:, None, None] * np.eye(3)
    # The normals of the points and the beams turn with their clouds: so do the priors.
    # They add up to one also of a surfel with hardly a point: else a turn of all clouds together,
    # which the points say nothing of, would not be free.
    parts_of_weight = points[..., 0] / np.maximum(total[:, 0], 1e-300)
    by_normals = known * parts_of_normal
    turning[..., 10] = by_normals + seen * parts_of_weight
    coupling = [_coupling(W, surface_means)]
    roots, sums = [n / np.sqrt(mass)[:, None]], [moments[..., :4].transpose(1, 0, 2)]
    if held:
        np.matmul(cells[..., ALONG_MOMENTS], carry, out=turning[..., 11:])
        along = _Along.of(turning[..., 11:], mixture, W)
        along_blocks, along_gradient = along.quadratic()
        blocks += along_blocks
        gradient += along_gradient
        C += along.orientation_information()
        coupling.append(_coupling(along.projection, along.means)[:, :10])
        along_roots, along_sums = along.lost(n)
        roots += along_roots
        sums += along_sums
    turns = np.linalg.solve(C, torque[..., None])[..., 0]
    gradient[:, :3] += by_normals @ towards
    quadratic = ShapeQuadratic(
        blocks=blocks,
        gradient=gradient,
        gradient_given_shape=given_shape,
        across=_lost(roots, sums),
        moments=turning,
        coupling=np.concatenate(coupling, axis=1),
        prior_turns=by_normals @ parts_of_normal.T + seen * parts_of_weight @ parts_of_weight.T,
        orientation_information=C,
        turns=np.asarray(turns),
        normal_information=known + seen,
        normals=None if held else n,
    )
    lost = np.einsum("kqae,ka->kqe", quadratic.coupling, turns).reshape(-1, 6)
    gradient -= quadratic.moments.reshape(stack.count, len(lost)) @ lost
    return quadratic


def quadratic_given_shape(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, cells: Array, who: Responsibilities
) -> tuple[Array, Array]:
    """(J, 6, 6) information and (J, 6) gradient of each cloud on a shape that is held.

    Those of `shape_quadratic` where no points are held along the surface, without the rest of it.
    """
    carry = to_target(stack, R, t)
    points = np.matmul(cells[..., MOMENTS], carry)
    return _given_shape(points, np.matmul(cells[..., SURFACE_MOMENTS], carry), mixture, who)


def _given_shape(
    points: Array, moments: Array, mixture: Mixture, who: Responsibilities
) -> tuple[Array, Array]:
    """`quadratic_given_shape` of moments (J, K, 10) of points and of where their beams end."""
    count = len(points)
    n = mixture.normals_target
    W = n[:, :, None] * n[:, None, :]
    halves = W[:, *np.triu_indices(3)]
    by_cloud = np.swapaxes(points, 1, 2)
    pull = by_cloud[:, :4] @ np.einsum("kab,kb->ka", W, mixture.means_target)
    gradient = (by_cloud @ halves).reshape(count, 60) @ _GRADIENTS
    gradient -= np.einsum("jac,ace->je", pull, JACOBIAN)
    gradient[:, :3] += who.levers
    blocks = (np.swapaxes(moments, 1, 2) @ halves).reshape(count, 60) @ _BLOCKS
    return blocks.reshape(count, 6, 6), np.asarray(gradient)


def _lost(roots: Sequence[Array], sums: Sequence[Array]) -> Array:
    """(K', 6 J) roots of the loss to the places of surfels.

    Of directions (K, 3) over the root of the weight, and sums (K, J, 4) over points, several of
    each.
    """
    clouds = sums[0].shape[1]
    out = np.empty((sum(map(len, roots)), clouds, 6))
    start = 0
    for root, of_clouds in zip(roots, sums, strict=True):
        moves = (root @ JACOBIAN.transpose(1, 0, 2).reshape(3, 24)).reshape(-1, 4, 6)
        np.matmul(of_clouds, moves, out=out[start : start + len(root)])
        start += len(root)
    return out.reshape(len(out), 6 * clouds)


@dataclass(frozen=True)
class _Along:
    """What holds points along the surface, at the mean of all points of their surfel.

    Attributes:
        moments: (J, K, 10) with the weights along the surface.
        projection: (K, 3, 3) on the surface.
        mass: (K,) weight of each surfel's points.
        means: (K, 3) their means.
    """

    moments: Array
    projection: Array
    mass: Array
    means: Array

    @classmethod
    def of(cls, moments: Array, mixture: Mixture, W: Array) -> _Along:
        """Of moments (J, K, 10) and projections (K, 3, 3) on the normals."""
        return cls(moments, np.eye(3) - W, *mass_and_means(moments.sum(axis=0), mixture))

    def quadratic(self) -> tuple[Array, Array]:
        """(J, 6, 6) information and (J, 6) gradient of each cloud, the means held."""
        count = len(self.moments)
        halves = self.projection[:, *np.triu_indices(3)]
        by_cloud = np.swapaxes(self.moments, 1, 2)
        sums = (by_cloud @ halves).reshape(count, 60)
        pull = by_cloud[:, :4] @ np.einsum("kab,kb->ka", self.projection, self.means)
        gradient = sums @ _GRADIENTS - np.einsum("jac,ace->je", pull, JACOBIAN)
        return (sums @ _BLOCKS).reshape(count, 6, 6), np.asarray(gradient)

    def orientation_information(self) -> Array:
        """(K, 3, 3) information on the orientations of the surfels."""
        scatter = scatter_about(self.moments.sum(axis=0), self.means)
        return _orientation_information(scatter, self.projection)

    def lost(self, normals: Array) -> tuple[list[Array], list[Array]]:
        """What `_lost` makes of the places along the surface, where points are held."""
        own_mass = self.moments[..., 0].sum(axis=0)
        taking = np.flatnonzero(own_mass > ALONG_PART * own_mass.max())
        sums = self.moments[:, taking, :4].transpose(1, 0, 2)
        axes = tangent_axes(normals[taking]) / np.sqrt(self.mass[taking])[:, None, None]
        return [axes[:, 0], axes[:, 1]], [sums, sums]


def _normal_prior(
    cells: Array, R: Array, mass: Array, mixture: Mixture
) -> tuple[Array, Array, Array]:
    """The mean normal of each surfel's points, as a prior of its own.

    (K, 3) rotation of the normal to it; (K,) its reliability, 0 to 1: the mean flatness, less where
    the normals differ; (J, K) part that each cloud has in it, which adds up to one.
    """
    by_cloud = np.matmul(cells[..., NORMALS], np.swapaxes(R, 1, 2))
    summed = by_cloud.sum(axis=0)
    size = np.linalg.norm(summed, axis=1)
    mean = summed / np.maximum(size, 1e-300)[:, None]
    axis = cross(mixture.normals_target, mean)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ka,ka->k", mixture.normals_target, mean))
    towards = axis * (angle / np.maximum(sine, 1e-300))[:, None]
    part = np.einsum("jka,ka->jk", by_cloud, mean) / np.maximum(size, 1e-300)
    return towards, size / mass, part


def _coupling(W: Array, means: Array) -> Array:
    """(K, 11, 3, 6) `ShapeQuadratic.coupling`, components about `means`."""
    K = len(means)
    P = np.zeros((K, 11, 3, 6))
    P[:, :10] = (W[:, *np.triu_indices(3)] @ _ROTATION_ROWS).reshape(K, 10, 3, 6)
    # Rotations are about the mean, not about the origin: first moments, which come first.
    about = (-skew(means) @ W).reshape(-1, 3) @ JACOBIAN.transpose(1, 0, 2).reshape(3, 24)
    P[:, :4] += about.reshape(K, 3, 4, 6).transpose(0, 2, 1, 3)
    P[:, 10, :, :3] = np.eye(3)
    return np.asarray(P)


def _orientation_information(scatter: Array, W: Array) -> Array:
    """(K, 3, 3) information of the points on the orientations, scatter (K, 3, 3) about the mean."""
    K = len(W)
    C = scatter.reshape(K, 1, 9) @ (W.reshape(K, 9) @ _SKEW_W_SKEW).reshape(K, 9, 9)
    return np.asarray(C.reshape(K, 3, 3))
