"""The quadratic that the points of all clouds put on the poses of the clouds.

The M-step of the poses, with places and orientations of the components eliminated. It is an
estimating equation: residuals are those of the points, levers are those of where the beams meet the
surface. `README.md` of this folder derives each term.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from caliv_graph.common.cores import parts, share_out
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, Mixture
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.registration.mixture import information_weights
from caliv_graph.registration.moments import (
    COLUMN,
    HALF_DIAGONAL,
    JACOBIAN,
    MOMENTS,
    ROW,
    SURFACE_MOMENTS,
    Responsibilities,
    cross,
    mass_and_means,
    scatter_about,
    to_target,
)

ORIENTATION_PARTS = 2
"""Parts in which the information lost to the components' orientations is summed. The same on any
number of cores: so are the bits of the sums."""

LEAST_LEVER_M = 1e-5
"""Keeps the orientation of a component defined whose points are on a line, or one alone."""


@dataclass(frozen=True)
class ShapeQuadratic:
    """Information and gradient over the poses of all clouds, the shape eliminated.

    An estimating equation (`caliv_graph/registration/README.md`), not one likelihood: a step d of
    left perturbations `Exp(d_j) T_target_lidar_j` (target frame; rotation then translation)
    minimises `d^T H d / 2 + g^T d`. H is `blocks` on the diagonal minus what
    is lost since mean and orientation of each component are estimated from the same points: two
    Schur complements, which couple clouds. Clouds that share no component are independent of each
    other.

    Attributes:
        blocks: (J, 6, 6) information of each cloud given the shape.
        gradient: (J, 6) g of the estimating equation.
        across: (K, 6 J) root of the loss to the means across the surface.
        sign: (K,) of a, negative where `var_normal > var_tangent / ALONG_SURFACE`.
        along: (K, 4 J) root of the rest of the loss to the means.
        moments: (J, K, 10) sums of alpha h h^T, h = (1, y), target frame.
        coupling: (K, 10, 3, 6) linear map from the moments of a cloud and component to the coupling
            of its orientation and the cloud.
        orientation_information: (K, 3, 3) of each component.
        torque: (K, 3) negative gradient with respect to the rotation of each component.
    """

    blocks: Array
    gradient: Array
    across: Array
    sign: Array
    along: Array
    moments: Array
    coupling: Array
    orientation_information: Array
    torque: Array

    def joint(self, given_orientations: bool = False) -> Array:
        """H, (6 J, 6 J), symmetric positive semidefinite.

        With `given_orientations` the means alone are eliminated: half the work, and never less
        information, so that a step is the same or shorter.
        """
        count = len(self.blocks)
        flat = self.sign > 0.0
        lost: list[Callable[[], Array]] = [
            lambda: self.along,
            lambda: self.across if flat.all() else self.across[flat],
        ]
        if not given_orientations:
            root = np.linalg.inv(np.linalg.cholesky(self.orientation_information))
            whitened = np.matmul(root[:, None], self.coupling).reshape(-1, 10, 18)
            lost += [
                partial(self._lost_to_orientations, whitened, own)
                for own in parts(len(flat), ORIENTATION_PARTS)
            ]
        squares = [np.empty(0)] * len(lost)

        def square(i: int) -> None:
            # Of a matrix and its own transpose: half the work, and the interpreter's lock is free.
            rows = lost[i]()
            squares[i] = rows.T @ rows

        # The longest first: the others fill the gaps.
        share_out(square, range(len(lost))[::-1])
        along, H, *orientations = squares
        for square_of_part in orientations:
            H += square_of_part
        if not flat.all():
            H -= self.across[~flat].T @ self.across[~flat]
        pairs = along.reshape(count, 4, count, 4).transpose(0, 2, 1, 3).reshape(-1, 16)
        np.negative(H, out=H)
        H4 = H.reshape(count, 6, count, 6)
        H4 -= (pairs @ _PAIRS).reshape(count, count, 6, 6).transpose(0, 2, 1, 3)
        j = np.arange(count)
        H4[j, :, j, :] += self.blocks
        return np.asarray(H)

    def _lost_to_orientations(self, whitened: Array, components: slice) -> Array:
        """(3 k, 6 J) root of what is lost to the orientations of k components."""
        moments = self.moments[:, components].transpose(1, 0, 2)
        P = np.matmul(moments, whitened[components]).reshape(-1, len(self.blocks), 3, 6)
        return np.asarray(P.transpose(0, 2, 1, 3).reshape(-1, 6 * len(self.blocks)))


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

_PAIRS = np.einsum("ace,bcf->abef", JACOBIAN, JACOBIAN).reshape(16, 36)
"""`A_j^T A_j'` of the first moments of two clouds."""


def shape_quadratic(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, cells: Array, who: Responsibilities
) -> ShapeQuadratic:
    """Linearises the negative log-likelihood at the current poses.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the components of the E-step.
        cells: (J, K, 23) `cell_moments` of the responsibilities.
        who: the responsibilities; their lever corrections enter.
    """
    count, K = stack.count, len(mixture.weights)
    carry = to_target(stack, R, t)
    points = np.matmul(cells[..., MOMENTS], carry)
    moments = np.matmul(cells[..., SURFACE_MOMENTS], carry)
    total = points.sum(axis=0)
    mass, means = mass_and_means(total, mixture)
    n = mixture.normals_target
    a, b = information_weights(mixture)
    W = a[:, None, None] * n[:, :, None] * n[:, None, :] + b[:, None, None] * np.eye(3)
    halves = W[:, *np.triu_indices(3)]
    by_cloud = np.swapaxes(points, 1, 2)
    pull = by_cloud[:, :4] @ np.einsum("kab,kb->ka", W, means)
    gradient = (by_cloud @ halves).reshape(count, 60) @ _GRADIENTS
    gradient -= np.einsum("jac,ace->je", pull, JACOBIAN)
    gradient[:, :3] += who.levers
    on_surface = moments.sum(axis=0)
    surface_means = mass_and_means(on_surface, mixture)[1]
    coupling = _coupling(W, surface_means)
    both = scatter_about(total, means) @ W
    torque = both[:, [1, 2, 0], [2, 0, 1]] - both[:, [2, 0, 1], [1, 2, 0]] + who.component_levers
    C = _orientation_information(scatter_about(on_surface, surface_means), mass, W)
    rotation = np.linalg.solve(C, torque[..., None])[..., 0]
    lost = np.einsum("kqae,ka->kqe", coupling, rotation)
    gradient -= moments.reshape(count, 10 * K) @ lost.reshape(10 * K, 6)
    sums = moments[..., :4].transpose(1, 0, 2)
    across = np.empty((K, count, 6))
    root = n * np.sqrt(np.abs(a) / mass)[:, None]
    across[..., :3] = cross(sums[..., 1:], root[:, None])
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
        orientation_information=C,
        torque=np.asarray(torque),
    )


def _coupling(W: Array, means: Array) -> Array:
    """(K, 10, 3, 6) `ShapeQuadratic.coupling`, components about `means`."""
    K = len(means)
    P = (W[:, *np.triu_indices(3)] @ _ROTATION_ROWS).reshape(K, 10, 3, 6)
    # Rotations are about the mean, not about the origin: first moments, which come first.
    about = (-skew(means) @ W).reshape(-1, 3) @ JACOBIAN.transpose(1, 0, 2).reshape(3, 24)
    P[:, :4] += about.reshape(K, 3, 4, 6).transpose(0, 2, 1, 3)
    return np.asarray(P)


def _orientation_information(scatter: Array, mass: Array, W: Array) -> Array:
    """(K, 3, 3) of `ShapeQuadratic`, from the scatter (K, 3, 3) about the mean and mass (K,)."""
    K = len(mass)
    C = scatter.reshape(K, 1, 9) @ (W.reshape(K, 9) @ _SKEW_W_SKEW).reshape(K, 9, 9)
    C = C.reshape(K, 3, 3)
    C += (LEAST_LEVER_M**2 * mass * np.trace(W, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(C)
