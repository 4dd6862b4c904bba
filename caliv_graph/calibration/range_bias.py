"""Biases of the ranges on a target: eliminated, their sizes found by what they contradict.

The ranges of real LiDARs are off by some millimetres, by material, incidence and unit: the same for
all points of one LiDAR on one target, or slowly changing over it, and so no noise that averages
out. An offset moves all clouds of a LiDAR on a target along their mean beams; what grows with the
incidence moves and turns each as its faces stand to its beams; a smooth error moves and tilts those
of one side. All are nuisances with normal priors (`caliv_graph/calibration/README.md`, "Bias of the
ranges").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from caliv_graph.calibration.linear import cloud_rows
from caliv_graph.calibration.reduced import Reduced
from caliv_graph.config.range_errors import (
    OFFSETS_M,
    SizePrior,
    flat,
    growth,
    incidence_prior,
    log_normal,
    offset_prior,
    size_weights,
)
from caliv_graph.geometry.quadratic import without_errors
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.registration.heights import LEAST_SIGMA_M
from caliv_graph.registration.quadratic import ShapeQuadratic
from caliv_graph.registration.register import JointRegistration
from caliv_graph.registration.surfels import GRAZING
from caliv_graph.structure.elimination import marginal

TYPICAL_SMOOTH = 0.5
"""Median of the prior of the smooth errors' sigma, over the roughness: what repeated scans of the
target share is partly the same for neighbouring beams. Between none and all."""

SMOOTHS = np.geomspace(0.02, 5.0, 12)
"""Sigmas of the smooth errors in the integral, over the roughness."""

VIEW_RAD = math.radians(20.0)
"""Angle between views, about the target, at which their smooth errors are alike by e^-1/2: what
depends on incidence changes by a third from 30 to 50 degrees."""

HARDLY_SHOWN = 1e-6
"""Ridge, relative to what a cloud's faces show of its motion in all directions: a cloud of one face
does not seem to slide along it or to turn in it. Grazing faces count up to 400 times as much as
others, which have to count beside them."""

RANK_PART = 1e-4
"""Eigenvectors of the correlation of views with less than this part of the largest eigenvalue are
left out: numerical."""

PASSES = 2
"""Times that the size of each LiDAR is found beside those of the others."""

SURE = 0.99
"""Probability with which the offsets are at least `BiasSizes.least_m`."""


@dataclass(frozen=True)
class BiasSizes:
    """1 sigma of the biases.

    Attributes:
        offset_m: of each LiDAR on each target, metres.
        smooth: of the smooth errors, over the roughness.
        least_m: the offsets' is at least this, by the data, metres (`SURE`).
        incidence_m: (2 B,) of the growths with the incidence, of each LiDAR on each target, metres;
            one number: of all.
    """

    offset_m: float
    smooth: float
    least_m: float = 0.0
    incidence_m: tuple[float, ...] = (0.0,)


UNKNOWN = BiasSizes(float(OFFSETS_M[0]), 0.0)
"""Before they are estimated: shapes that were made with large biases contradict nothing."""


@dataclass(frozen=True)
class RangeBiases:
    """How the poses of J clouds seem to move by biases of their ranges, left perturbations.

    Attributes:
        offsets: (6 J, B) by a metre of the offset of each LiDAR and placement.
        incidence: (6 J, 2 B) by a metre of each growth with the incidence, of the same.
        lidar: (2 B,) index of the LiDAR that each of these is of, over all placements.
        smooth: (6 J, C) by smooth errors of the size of the roughness, as independent ones.
    """

    offsets: Array
    incidence: Array
    lidar: IntArray
    smooth: Array

    def directions(self, sizes: BiasSizes) -> Array:
        """(6 J, 3 B + C) by biases of sigma 1."""
        of_lidars = [sizes.offset_m * self.offsets, np.array(sizes.incidence_m) * self.incidence]
        return np.hstack([*of_lidars, sizes.smooth * self.smooth])


@dataclass(frozen=True)
class OwnRanges:
    """How biases of its ranges seem to move each of J clouds, in the frame of its LiDAR.

    The same at all poses.

    Attributes:
        beams: (J, 3) mean of the unit vectors.
        radii: (J,) per axis at right angles to these: root mean square distance to the middle.
    """

    beams: Array
    radii: Array

    @classmethod
    def of(cls, clouds: CloudStack) -> OwnRanges:
        """Of all clouds of a placement."""
        beams = clouds.mean_beams
        views = beams / np.linalg.norm(beams, axis=1)[:, None]
        along = np.einsum("na,na->n", clouds.centred, views[clouds.cloud])
        across = clouds.centred - along[:, None] * views[clouds.cloud]
        # An error of its size there, in the root mean square.
        radii = np.sqrt(0.5 * clouds.sum_per_cloud((across**2).sum(axis=1)) / clouds.sizes)
        return cls(beams, radii)


def range_biases(
    states: Sequence[JointRegistration],
    poses: Sequence[tuple[Array, Array]],
    quadratics: Sequence[ShapeQuadratic],
    own: Sequence[OwnRanges] | None = None,
) -> RangeBiases:
    """Of all placements, at `T_target_lidar` (J, 3, 3), (J, 3) of each, and the quadratic there.

    `own` is `OwnRanges` of each, for many poses.
    """
    own = [OwnRanges.of(state.clouds) for state in states] if own is None else own
    each = zip(states, poses, quadratics, own, strict=True)
    both = [_of_placement(state, R, t, of, ranges) for state, (R, t), of, ranges in each]
    offsets, incidence, smooth = (scipy.linalg.block_diag(*of) for of in zip(*both, strict=True))
    names = [name for state in states for name in _lidars_of(state)]
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    lidar = np.repeat([index[name] for name in names], 2)
    return RangeBiases(offsets, incidence, lidar, smooth)


def _lidars_of(state: JointRegistration) -> list[str]:
    """The LiDARs of a placement, in the order of their columns."""
    _, first = np.unique(state.clouds.lidar, return_index=True)
    return [state.observation.clouds[j].lidar for j in first.tolist()]


def _of_placement(
    state: JointRegistration, R: Array, t: Array, quadratic: ShapeQuadratic, ranges: OwnRanges
) -> tuple[Array, Array, Array]:
    """`RangeBiases.offsets`, `.incidence` and `.smooth` of a placement."""
    clouds = state.clouds
    beams = _turned(R, ranges.beams)
    each = np.arange(clouds.count)
    offsets = np.zeros((clouds.count, 6, clouds.lidars))
    offsets[each, 3:, clouds.lidar] = beams
    views = beams / np.linalg.norm(beams, axis=1)[:, None]
    middles = _turned(R, clouds.centres) + t
    incidence = np.zeros((clouds.count, 6, clouds.lidars, 2))
    sensors = _turned(R, clouds.seen_from) + t
    incidence[each, :, clouds.lidar] = _by_incidence(
        quadratic, sensors, state.mixture.normals_target
    )
    roughness = np.sqrt(np.maximum(state.noise.roughness_m2 - LEAST_SIGMA_M**2, 0.0))
    smooth = [np.zeros((clouds.count, 6, 0))]
    for a in np.flatnonzero(roughness > 0.0).tolist():
        own = np.flatnonzero(clouds.lidar == a)
        moves = np.zeros((len(own), 6, 4))
        moves[:, 3:, 0] = views[own]
        tilts = np.eye(3) - views[own, :, None] * views[own, None, :]
        moves[:, :3, 1:] = tilts / max(float(np.median(ranges.radii[own])), LEAST_SIGMA_M)
        moves[:, 3:, 1:] = skew(middles[own]) @ moves[:, :3, 1:]
        root = roughness[a] * _root_of_views(views[own])
        out = np.zeros((clouds.count, 6, 4 * root.shape[1]))
        out[own] = np.einsum("jac,jk->jack", moves, root).reshape(len(own), 6, -1)
        smooth.append(out)
    kinds = (offsets, incidence, np.concatenate(smooth, axis=2))
    of_offsets, of_incidence, of_smooth = (of.reshape(6 * clouds.count, -1) for of in kinds)
    return of_offsets, of_incidence, of_smooth


def _turned(R: Array, vectors: Array) -> Array:
    """(J, 3) vectors of the clouds, turned by R (J, 3, 3)."""
    return np.asarray(np.einsum("jab,jb->ja", R, vectors))


def _by_incidence(quadratic: ShapeQuadratic, t: Array, normals: Array) -> Array:
    """(J, 6, 2) motion of each cloud that growths of its ranges by a metre seem to be.

    The one that fits best by the weights of the registration, given the shape: what a cloud shows
    of its motion is what such ranges move. Sensors are at t (J, 3), `normals` (K, 3) the surfels'.
    """
    blocks = quadratic.blocks
    ridge = HARDLY_SHOWN * np.trace(blocks, axis1=1, axis2=2) + 1e-9
    pulled = _pulled_by_incidence(quadratic.moments[..., :4], t, normals)
    return np.asarray(np.linalg.solve(blocks + ridge[:, None, None] * np.eye(6), pulled))


def _pulled_by_incidence(sums: Array, t: Array, normals: Array) -> Array:
    """(J, 6, 2) what the gradients given the shape lose by a metre of each `growth` of the ranges.

    A range that is too long by that puts its point its cosine times that behind the surface. It
    pulls as any residual does: most where the beams graze, as their noise is along them.

    Args:
        sums: (J, K, 4) of the weights w and of w y of the points of a cloud and surfel.
        t: (J, 3) the sensors.
        normals: (K, 3) of the surfels.
    """
    # A cloud touches a third of the surfels.
    cloud, surfel = np.nonzero(sums[..., 0] > 0.0)
    weight, *places = sums[cloud, surfel].T
    n, origin = normals.T[:, surfel], t.T[:, cloud]
    beams = [places[a] - weight * origin[a] for a in range(3)]
    away = np.sqrt(beams[0] ** 2 + beams[1] ** 2 + beams[2] ** 2)
    facing = -(n[0] * beams[0] + n[1] * beams[1] + n[2] * beams[2])
    # A normal is not known better than what is taken for grazing.
    cosine = np.clip(facing / np.maximum(away, np.finfo(float).tiny), GRAZING, 1.0)
    arms = [places[b] * n[c] - places[c] * n[b] for b, c in ((1, 2), (2, 0), (0, 1))]
    parts = [*arms, *(weight * n)]
    out = np.empty((len(sums), 6, 2))
    for kind, of_kind in enumerate(growth(cosine).T):
        behind = -cosine * of_kind
        for axis, part in enumerate(parts):
            out[:, axis, kind] = np.bincount(cloud, behind * part, len(sums))
    return out


def _root_of_views(views: Array) -> Array:
    """(J, r) root of the correlation of smooth errors in views (J, 3), unit vectors."""
    angles = np.arccos(np.clip(views @ views.T, -1.0, 1.0))
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (angles / VIEW_RAD) ** 2))
    kept = values > RANK_PART * values[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def without_bias(
    H: Array, gradient: Array, directions: Array, applied: Array | None = None
) -> tuple[Array, Array]:
    """(6 J, 6 J) and (6 J,) of the clouds with biases of sigma 1 along `directions` eliminated.

    `applied` (B,) are biases with which the clouds were moved back before; None: none.
    """
    return without_errors(H, gradient, directions, _pull(gradient, directions, applied))


def most_likely_biases(
    H: Array, gradient: Array, directions: Array, applied: Array, moved: Array
) -> Array:
    """(B,) the biases of sigma 1 that `without_bias` eliminates, the clouds at a step (6 J,)."""
    both = np.eye(directions.shape[1]) + directions.T @ H @ directions
    pull = _pull(gradient + H @ moved, directions, applied)
    return np.asarray(applied + np.linalg.solve(both, pull))


def _pull(gradient: Array, directions: Array, applied: Array | None) -> Array:
    """(B,) of the quadratic in the biases: longer ranges move the poses that fit back."""
    pull = directions.T @ gradient
    return np.asarray(pull if applied is None else pull - applied)


def moved_back(
    states: Sequence[JointRegistration],
    poses: Sequence[tuple[Array, Array]],
    offsets_m: Array,
) -> list[tuple[Array, Array]]:
    """Poses (J, 3, 3) and (J, 3) of each placement at which clouds with biased ranges fit.

    `offsets_m` (B,) are the biases of `RangeBiases.offsets`: where ranges are too long, the cloud
    fits nearer to the LiDAR.
    """
    out, first = [], 0
    for state, (R, t) in zip(states, poses, strict=True):
        clouds = state.clouds
        own_m = offsets_m[first : first + clouds.lidars]
        first += clouds.lidars
        out.append((R, t - own_m[clouds.lidar][:, None] * _turned(R, clouds.mean_beams)))
    return out


def fit_bias_sizes(
    reduced: Reduced, biases: RangeBiases, prior: Array, offset_m: float | None = None
) -> BiasSizes:
    """The sigmas of the biases: root mean squares of their posterior.

    By the restricted likelihood: extrinsics, poses, targets and shape are integrated out, so that a
    bias that a mounting can make up for says nothing. What the offsets of two LiDARs are drawn from
    is one data sheet's accuracy. How an echo at a slant is timed is of each model: the growth of
    each LiDAR has a size of its own, or one that grows would hide among those that do not.

    Args:
        reduced: the linearised problem with the clouds' quadratic, no bias eliminated.
        biases: of the same clouds.
        prior: (6n, 6n) information of the guesses, tangents of the graph's extrinsics.
        offset_m: 1 sigma of the offsets, if the user knows it.
    """
    offsets = offset_prior(offset_m)
    incidences = incidence_prior(offset_m)
    unit = biases.directions(BiasSizes(1.0, 1.0, incidence_m=(1.0,)))
    information, pull = _information(reduced, unit, prior)
    smooths = log_normal(SMOOTHS, TYPICAL_SMOOTH) if biases.smooth.shape[1] else flat(np.zeros(1))
    count = biases.offsets.shape[1]
    kinds = np.repeat([0, 1, 2], [count, biases.incidence.shape[1], biases.smooth.shape[1]])
    weights = size_weights(information, pull, kinds, (offsets, incidences, smooths))
    of_offsets = weights.sum(axis=(1, 2))
    least = int(np.searchsorted(np.cumsum(of_offsets), 1.0 - SURE))
    sizes = BiasSizes(
        offset_m=float(np.sqrt(of_offsets @ offsets.sigmas**2)),
        smooth=float(np.sqrt(weights.sum(axis=(0, 1)) @ smooths.sigmas**2)),
        least_m=float(offsets.sigmas[least]) if offset_m is None else 0.0,
        incidence_m=(float(np.sqrt(weights.sum(axis=(0, 2)) @ incidences.sigmas**2)),),
    )
    own_m = _of_each_lidar(information, pull, biases, sizes, incidences)
    return replace(sizes, incidence_m=tuple(own_m[biases.lidar].tolist()))


def _of_each_lidar(
    information: Array, pull: Array, biases: RangeBiases, sizes: BiasSizes, prior: SizePrior
) -> Array:
    """(L,) sizes of the incidence of each LiDAR, those of the others as they are.

    `information` (B, B) and `pull` (B,) are of all biases; `sizes` has one size for all LiDARs.
    """
    own_m = np.full(biases.lidar.max(initial=-1) + 1, sizes.incidence_m[0])
    first = biases.offsets.shape[1]
    column = np.full(len(pull), -1)
    column[first : first + len(biases.lidar)] = biases.lidar
    sigmas = np.repeat(
        [sizes.offset_m, 0.0, sizes.smooth], [first, len(biases.lidar), biases.smooth.shape[1]]
    )
    for _ in range(PASSES):
        for lidar in range(len(own_m)):
            sigmas[column >= 0] = own_m[biases.lidar]
            own, others = np.flatnonzero(column == lidar), np.flatnonzero(column != lidar)
            known = information.copy()
            known[others, others] += sigmas[others] ** -2.0
            left = marginal(known, pull, own, others)
            weights = size_weights(*left, np.zeros(len(own), np.int64), (prior,))
            own_m[lidar] = math.sqrt(weights @ prior.sigmas**2)
    return own_m


def _information(reduced: Reduced, directions: Array, prior: Array) -> tuple[Array, Array]:
    """(B, B) and (B,) of the biases along `directions`, all other variables eliminated."""
    H, gradient = reduced.clouds
    system = reduced.system
    rows = cloud_rows(system, reduced.lines)
    seen = H @ directions
    across = rows.T @ seen
    full = system.H.copy()
    full[-len(prior) :, -len(prior) :] += prior
    full[np.diag_indices_from(full)] *= 1.0 + 1e-9
    factor = scipy.linalg.cho_factor(full, lower=True)
    information = directions.T @ seen - across.T @ scipy.linalg.cho_solve(factor, across)
    # Minus the gradient of the negative logarithm, what the other variables follow taken off.
    pull = -(directions.T @ gradient) - across.T @ scipy.linalg.cho_solve(factor, system.b)
    # Positive semidefinite but for rounding.
    own, axes = np.linalg.eigh(0.5 * (information + information.T))
    return (axes * np.maximum(own, 0.0)) @ axes.T, pull
