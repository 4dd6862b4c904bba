"""Noise of structure: what the residuals say of beams, sightings and strips."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.optimize import nnls

from caliv_graph.common.memory import give_back_freed_arrays
from caliv_graph.config.range_errors import RangeErrors, SizePrior, size_weights
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.beams import BeamErrors, mean_rows, parts_of
from caliv_graph.structure.bends import BENDS, USUAL_PER_M
from caliv_graph.structure.heavy_tails import FREEDOM, heavy_tailed, sigma_of_few
from caliv_graph.structure.layout import BIASES, Layout, Nuisances
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.residuals import Geometry
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.tilts import USUAL_RAD, first_tilts_per_m, fitted_tilts
from caliv_graph.structure.views import Views

FIRST_SIGHTING_M = 0.01
"""1 sigma of the offset of a strip from scan to scan before it is estimated: on the safe side, as
rough extrinsics are still in it."""

SIGHTING_USUAL_M = 0.002
"""1 sigma of that offset where nothing tells, which counts as one sighting."""

LEAST_M = 2e-4
"""Smallest sigma of an offset: what no LiDAR resolves."""

INCIDENCES, DISTANCES = 8, 3
"""Classes of incidence, and of distance in each, in which the scatter of patches is compared."""

LEAST_POINTS, LEAST_PATCHES = 8.0, 10
"""Points of a patch, and patches of a class, at least."""

REWEIGHTED = 4
"""Rounds of least squares, with weights from the fit of the last one."""

LEAST_VARIANCE = 1e-8
"""Smallest variance of a patch, m^2: a tenth of a millimetre."""

LEAST_RANGE_M = 1e-3
"""Smallest noise along the beam: no LiDAR for vehicles has less."""

OWN_STRIP = 10.0
"""Number of sightings that the common sigma counts as when the sigma of one strip is estimated."""

STRIP_USUAL_M = 0.003
"""1 sigma of how far a LiDAR sees a strip from where others do where nothing tells, which counts as
one strip: roughness of the surface."""

ONE_VIEW_M = 0.005
"""Smallest sigma of a strip where every LiDAR has one place only: what its beams get wrong there by
footprint and incidence looks like another extrinsic, and no difference shows it. Data sheets state
accuracies of ranges of one to three centimetres; a part of it changes from strip to strip. On a
real road at 7 m (`edgar_static`) two LiDARs agree to 0.2 mm, 5 mrad beside the truth."""

SMOOTH = 3
"""Powers of the elevation, from 0 on, that say nothing of the sizes."""

BEAM_ROUNDS = 10
"""Rounds in which their sizes are estimated: errors, and which of them are large."""

MOST_STRIP_M = 0.05
"""Its largest sigma: what is seen farther apart is no one strip."""

LEAST_BEND_PER_M, MOST_BEND_PER_M = 2e-4, 0.1
"""Smallest and largest sigma of a bend: 0.1 mm and 5 cm in the middle of 2 m."""

LEAST_JITTER_S = 1e-5
MOST_JITTER_S = 0.02
"""1 sigma of the jitter of stamps: 20 um at 2 m/s, and a fifth of a revolution."""

LEAST_SIGHTINGS = 20
"""Sightings of a LiDAR that tell how much more its offsets err than those of others, at least."""

PROBES = 20
"""Random vectors for the trace: it is then good to a few percent."""

MOST_FITTED = 0.9
"""Largest share of the offsets' variance that is taken as fitted."""


def range_sigmas(patches: DrivePatches, stated_m: float) -> Array:
    """(L,) noise along the beam of each LiDAR, from the scatter of patches about their planes.

    Noise along the beam, noise of its direction and roughness are told apart by incidence and
    distance. None of the three is assumed: with 0.3 mrad of beams that have none, walls at 30 m
    left nothing for a range noise of 9 mm, and its part in the tilt of strips stayed (S2S pitch
    0.16 mrad off at a claimed 0.05). What is stated where there are too few patches.
    """
    out = np.full(len(patches.lidars), stated_m)
    for i, found in enumerate(_scatter_parts(patches, np.ones(len(patches.scan), dtype=bool))):
        if found is not None:
            out[i] = math.sqrt(max(float(found[0]), LEAST_RANGE_M**2))
    return out


def roughness_m(patches: DrivePatches, of: BoolArray) -> Array:
    """(L,) scatter of the surface itself across some patches (N,); nan where too few are seen."""
    parts = _scatter_parts(patches, of)
    return np.array([math.nan if found is None else math.sqrt(found[2]) for found in parts])


def _scatter_parts(patches: DrivePatches, of: BoolArray) -> list[Array | None]:
    """Per LiDAR the (3,) variances of `_variance_parts` in patches (N,); None where too few.

    The variance of a patch is `sigma_r^2 cos^2 + (d sigma_b)^2 sin^2 + roughness^2`, d the
    distance. Medians of classes, as patches of leaves scatter more.
    """
    centres = patches.centres_lidar
    distance = np.linalg.norm(centres, axis=1)
    cos = np.abs(np.einsum("ni,ni->n", centres, patches.normal_lidar)) / distance
    free = np.maximum(patches.points - 3.0, 1.0)
    # The median of a variance of few degrees of freedom is below its mean (Wilson, Hilferty).
    variance = patches.scatter_m**2 / (1.0 - 2.0 / (9.0 * free)) ** 3
    of = of & (patches.points >= LEAST_POINTS)
    out: list[Array | None] = []
    for i in range(len(patches.lidars)):
        own = np.flatnonzero(of & (patches.scan_lidar[patches.scan] == i))
        if len(own) < LEAST_PATCHES * INCIDENCES * DISTANCES:
            out.append(None)
            continue
        medians = [
            [np.median(of_class[part]) for of_class in (cos, distance, variance)]
            for group in np.array_split(own[np.argsort(cos[own], kind="stable")], INCIDENCES)
            for part in np.array_split(group[np.argsort(distance[group], kind="stable")], DISTANCES)
        ]
        out.append(_variance_parts(*np.array(medians).T))
    return out


def _variance_parts(cos: Array, distance_m: Array, variance: Array) -> Array:
    """(3,) variances along the beam, of its direction and across the surface, by least squares.

    Relative ones: variances (n,) err in proportion to their size.
    """
    A = np.column_stack([cos**2, distance_m**2 * (1.0 - cos**2), np.ones(len(cos))])
    expected = np.full(len(variance), np.median(variance))
    for _ in range(REWEIGHTED):
        expected = np.maximum(expected, LEAST_VARIANCE)
        found, _ = nnls(A / expected[:, None], variance / expected)
        expected = A @ found
    return np.asarray(found)


def offset_variances(sightings: Sightings, sigma_m: Array) -> Array:
    """(Q,) variance of the offset of each sighting."""
    return np.asarray(1.0 / sightings.moments[:, 3, 3] + sigma_m**2)


def fitted_noise(
    geometry: Geometry,
    seen: Array,
    sightings: Sightings,
    group: IntArray,
    lidar: IntArray,
    views: Views,
    weights: Array,
    solve: Callable[[Array], Array],
    covariance: Callable[[IntArray], Array],
    layout: Layout,
    nuisances: Nuisances,
    errors: Array,
    ranges: RangeErrors,
    level: BoolArray,
    tilts: bool,
) -> Nuisances:
    """Noise levels from the residuals at an estimate (REML: what was fitted is counted).

    Args:
        geometry: residuals at the estimate.
        seen: (D, PROBES) `seen_signs` of the system that was solved.
        sightings: Q of them.
        group: (Q,) a number for scan and surface of each.
        lidar: (Q,) index of the LiDAR of each.
        views: which scans are from one place.
        weights: (Q,) robust, of the system that was solved.
        solve: gives H^-1 times some columns (D, ...) of the system that was solved.
        covariance: gives a block of H^-1, of coordinates that no surface owns.
        layout: its coordinates.
        nuisances: the levels that it was solved with.
        errors: (D,) estimated errors of the LiDARs.
        ranges: what is stated of the errors of the ranges.
        level: (K,) which strips are ground; it bends otherwise than walls.
        tilts: whether errors of tilts have sizes of their own; else those of offsets.
    """
    offsets = geometry.offsets_m(sightings)
    asked = _Asked.of(solve, layout, seen)
    fitted = float((seen * asked.of_offsets).sum() / PROBES / max(weights.sum(), 1.0))
    free = 1.0 - min(fitted, MOST_FITTED)
    of_points = 1.0 / sightings.moments[:, 3, 3]
    of_lidar = nuisances.of_lidar(sightings.strip, lidar, level) ** 2
    point = of_points + of_lidar
    told = free * float(weights.sum())
    total_sigma = sigma_of_few(common_sigma(offsets, point, free), told, SIGHTING_USUAL_M)
    limit = 3.0 * np.sqrt(point + total_sigma**2)
    shared = _shared_variance(np.clip(offsets, -limit, limit), group) / free
    shared = float(np.clip(shared, LEAST_M**2, 0.9 * total_sigma**2 + LEAST_M**2))
    common = math.sqrt(max(total_sigma**2 - shared, LEAST_M**2))
    square = np.clip(offsets, -limit, limit) ** 2 / free - point - shared
    total = np.bincount(sightings.strip, square, layout.strips)
    count = np.bincount(sightings.strip, minlength=layout.strips)
    one = len(np.unique(views.of_scan)) <= layout.lidars
    # The estimate takes up the rest of the offsets, which then seem small. `ONE_VIEW_M` bounds them
    # where there is one place.
    left = 1.0 if one else free
    own = (OWN_STRIP * common**2 + left * total) / (OWN_STRIP + left * count)
    view = views.of_scan[sightings.scan] * layout.strips + sightings.strip
    again = _shared_variance(np.clip(offsets, -limit, limit), view) / free
    sighting = np.sqrt(np.maximum(own, (ONE_VIEW_M if one else LEAST_M) ** 2))
    every = common**2 + shared + float(of_lidar.mean())
    known = of_points + shared + sighting[sightings.strip] ** 2
    own_level = level[sightings.strip]
    lidar_offsets = _lidar_offsets(offsets, known, lidar, own_level, free, layout.lidars)
    if one or not tilts:
        strip = _strip_sigmas(asked, layout, nuisances.strip, errors, np.ones(layout.strips))
        strip = np.maximum(strip, ONE_VIEW_M if one else LEAST_M)
        per_m = first_tilts_per_m(level)
        sizes = sighting * per_m, strip * per_m, nuisances.tilt_times
    else:
        sizes = fitted_tilts(
            sightings, geometry, lidar, weights, level, sighting, nuisances, layout.lidars
        )
        of_tilts = _of_usual(sizes[1], level)
        strip = _strip_sigmas(asked, layout, nuisances.strip, errors, of_tilts)
    own_tilt, strip_tilt, tilt_times = sizes
    return replace(
        nuisances,
        sighting=sighting,
        sighting_tilt=own_tilt,
        strip_tilt=strip_tilt,
        tilt_times=tilt_times,
        lidar_offsets=lidar_offsets,
        shared=math.sqrt(shared),
        bias=_bias_sigma(asked, layout, nuisances.bias, errors, ranges),
        surface=_surface_sigma(asked, layout, nuisances.surface, errors, ranges.surface_m),
        strip=strip,
        repeated=1.0 if one else float(np.clip(again / every, 0.0, 1.0)),
        beams=_beam_sigmas(covariance, layout, nuisances.beams, errors, ranges),
        bend=_bend_sigmas(asked, layout, nuisances.bend, errors, level, one),
        jitter_s=_jitter_sigma(asked, layout, nuisances.jitter_s, errors),
    )


def seen_signs(
    geometry: Geometry,
    sightings: Sightings,
    weights: Array,
    layout: Layout,
    sigma_m: Array,
) -> Array:
    """(D, PROBES) `J^T W^1/2` times random signs, by which `tr(J H^-1 J^T W)` is estimated.

    `sigma_m` (Q,) are the offsets' errors from scan to scan, the shared ones included;
    `geometry` is where the system was linearised. Of derivatives elsewhere a part is in directions
    that it does not determine, such as a turn of everything about a standing vehicle.

    That over `sum(w)` is the share of the offsets' variance that the estimate takes up. W is that
    of the system: an outlier without weight says nothing. By random signs (Hutchinson): the exact
    trace costs as much as all else together.
    """
    J = geometry.offset_rows(sightings, layout.size)
    root = np.sqrt(weights / offset_variances(sightings, sigma_m))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (sightings.count, PROBES))
    return np.asarray(J.T @ (root[:, None] * signs))


@dataclass(frozen=True)
class _Asked:
    """What noise levels are fitted by: H^-1 times some columns.

    Attributes:
        of_offsets: (D, PROBES) those of `seen_signs`.
        of_biases: (n, n) block of H^-1 of the biases of the LiDARs' ranges.
        of_signs: first coordinate of some errors -> random signs (n, PROBES) on them, and H^-1
            times these, there.
    """

    of_offsets: Array
    of_biases: Array
    of_signs: Mapping[int, tuple[Array, Array]]

    @classmethod
    def of(cls, solve: Callable[[Array], Array], layout: Layout, seen: Array) -> _Asked:
        """Asks for all at once: a solve takes a pass over the surfaces, for one column or many."""
        biases = biases_of(layout)
        errors = [slice(layout.surface_error, layout.strip_error)]
        errors.append(slice(layout.strip_error, layout.size))
        if layout.bent:
            errors.append(slice(layout.bend, layout.surface_error))
        if layout.jitters:
            errors.append(slice(layout.jitter, layout.plane))
        units = np.zeros((layout.size, len(biases)))
        units[biases, np.arange(len(biases))] = 1.0
        columns = [seen, units]
        for own in errors:
            signs = np.zeros((layout.size, PROBES))
            signs[own] = np.random.default_rng(1).choice([-1.0, 1.0], signs[own].shape)
            columns.append(signs)
        ends = np.cumsum([of.shape[1] for of in columns])[:-1]
        of_offsets, of_units, *of_errors = np.split(solve(np.hstack(columns)), ends, axis=1)
        known = zip(errors, columns[2:], of_errors, strict=True)
        of_signs = {own.start: (signs[own], found[own]) for own, signs, found in known}
        return cls(of_offsets, of_units[biases], of_signs)


def biases_of(layout: Layout) -> IntArray:
    """(n,) coordinates of the biases of the LiDARs' ranges."""
    return np.arange(layout.error, layout.beam, BIASES)


def _lidar_offsets(
    offsets: Array, known: Array, lidar: IntArray, level: BoolArray, free: float, lidars: int
) -> Array:
    """(L, 2) `Nuisances.lidar_offsets`: the sum of squares of each LiDAR is as expected.

    Beyond that of the LiDAR that has the least: what all have is the strips'. Else the two would
    be told apart by nothing, and one of them go to zero.

    Args:
        offsets: (Q,) of the sightings.
        known: (Q,) variances of these without it.
        lidar: (Q,) the LiDAR of each.
        level: (Q,) whether it is of ground.
        free: share of the variance that the estimate has not taken up.
        lidars: L.
    """
    out = np.zeros((lidars, 2))
    for kind, of in enumerate((level, ~level)):
        own = [of & (lidar == i) for i in range(lidars)]
        told = [i for i in range(lidars) if np.count_nonzero(own[i]) >= LEAST_SIGHTINGS]
        for i in told:
            out[i, kind] = common_sigma(offsets[own[i]], known[own[i]], free)
        if told:
            out[told, kind] = np.sqrt(out[told, kind] ** 2 - out[told, kind].min() ** 2)
    return out


def common_sigma(offsets: Array, point: Array, free: float) -> float:
    """1 sigma of the offsets beside the noise of points: the sum of squares is as expected."""
    low, high = math.log(LEAST_M), math.log(1.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        t = offsets**2 / (point + math.exp(2.0 * middle))
        # Outliers count as three sigmas.
        low, high = (middle, high) if np.minimum(t, 9.0).mean() > free else (low, middle)
    return math.exp(0.5 * (low + high))


def _shared_variance(offsets: Array, group: IntArray) -> float:
    """Mean product of two offsets of a group, m^2; 0 where no group has two."""
    _, number, count = np.unique(group, return_inverse=True, return_counts=True)
    total = np.bincount(number.ravel(), offsets)
    pairs = float((count * (count - 1.0)).sum())
    return float((total**2).sum() - (offsets**2).sum()) / pairs if pairs else 0.0


def _known(asked: _Asked, own: slice, before: Array | float) -> Array:
    """How much of each error the data know: 1 less its variance by the prior's.

    By random signs (Hutchinson). `own` are the coordinates, `before` is their sigma or, again and
    again, (n,) sigmas; the result is (..., n).
    """
    signs, solved = asked.of_signs[own.start]
    variance = (signs * solved).mean(axis=1)
    return np.asarray(1.0 - variance.reshape(-1, np.size(before)) / before**2)


def _jitter_sigma(asked: _Asked, layout: Layout, before_s: float, errors: Array) -> float:
    """1 sigma of the jitter of stamps: a fixed-point step of its likelihood; 0 stays."""
    own = slice(layout.jitter, layout.plane)
    if before_s == 0.0 or not layout.jitters:
        return before_s
    known = float(_known(asked, own, before_s).sum())
    found = math.sqrt(float((errors[own] ** 2).sum()) / max(known, 1.0))
    return float(np.clip(found, LEAST_JITTER_S, MOST_JITTER_S))


def _bias_sigma(
    asked: _Asked,
    layout: Layout,
    before: float,
    errors: Array,
    ranges: RangeErrors,
) -> float:
    """1 sigma of the biases of the LiDARs' ranges: the root mean square of its posterior.

    A LiDAR for whose bias its place makes up says nothing of it.
    """
    own = biases_of(layout)
    known = np.linalg.inv(asked.of_biases)
    information = known - before**-2.0 * np.eye(len(own))
    kinds = np.zeros(len(own), dtype=np.int64)
    prior = ranges.offsets
    weights = size_weights(information, known @ errors[own], kinds, [prior])
    return math.sqrt(float(weights @ prior.sigmas**2))


def _surface_sigma(
    asked: _Asked, layout: Layout, before: float, errors: Array, usual: float
) -> float:
    """1 sigma of the biases of LiDARs on surfaces: a fixed-point step of its likelihood.

    The usual one counts as one bias beside those that the drive determines.
    """
    own = slice(layout.surface_error, layout.strip_error)
    known = max(float(_known(asked, own, before).sum()), 0.0)
    total = usual**2 + float((errors[own] ** 2).sum())
    return math.sqrt(total / (1.0 + known))


def _beam_sigmas(
    covariance: Callable[[IntArray], Array],
    layout: Layout,
    before: Array,
    errors: Array,
    ranges: RangeErrors,
) -> Array:
    """(E,) 1 sigma of each error of the beams of the LiDARs: `beam_sigmas` of a system."""
    if not len(before):
        return before
    own = np.arange(layout.beam, layout.ground_frame)
    give_back_freed_arrays()  # of the other noise levels
    known = np.linalg.inv(covariance(own))
    J, _ = mean_rows(layout.beams, 0, errors[own])
    mean = (J.T @ J).toarray()
    data = known - np.diag(before**-2.0) - mean
    return beam_sigmas(data, mean, known @ errors[own], before, layout.beams, ranges)


def beam_sigmas(
    data: Array,
    mean: Array,
    pull: Array,
    before: Array,
    beams: Sequence[BeamErrors],
    ranges: RangeErrors,
) -> Array:
    """(E,) 1 sigma of each error of the beams of some LiDARs.

    For each LiDAR and kind the root mean square of the posterior of their common size, all else
    integrated out: errors of the elevations hide behind those of the ranges, and behind the pitch
    of the LiDAR, so that steps of their squares would end near zero. About it the errors have a t
    distribution: leaves that one elevation sees, or a kerb that one channel falls on in every scan,
    are no error of all channels. Two that are large count as a large size of all at first, so that
    it goes round.

    Args:
        data: (E, E) information on the errors, all else eliminated, without their priors.
        mean: (E, E) that of `mean_rows`.
        pull: (E,) of the data, at no errors.
        before: (E,) the sigmas before.
        beams: of each LiDAR.
        ranges: what is stated of the ranges.
    """
    priors = ranges.beam_priors
    sigma = before.copy()
    for _ in range(BEAM_ROUNDS):
        joint = np.asarray(np.linalg.inv(data + mean + np.diag(sigma**-2.0)), dtype=np.float64)
        found = joint @ pull
        after = np.zeros_like(sigma)
        for _, kind, at in parts_of(beams):
            cov, error = joint[at, at], found[at]
            common = _common_size(cov, error, sigma[at], priors[kind])
            share = np.clip(1.0 - np.diag(cov) / sigma[at] ** 2, 0.0, 1.0)
            variance = (FREEDOM * common**2 + error**2) / (FREEDOM + share)
            after[at] = np.sqrt(variance)
        sigma = after
    return sigma


def _common_size(cov: Array, error: Array, sigma: Array, prior: SizePrior) -> float:
    """Root mean square of the posterior of the common size of some errors (n,).

    They are estimated with a covariance (n, n) under their own sigmas (n,), whose ratios stay.
    What is smooth in the elevation says nothing of it: the mean is held at zero or looks like a
    turn, and what changes evenly or bends is how ranges err with incidence, heights, or the noise
    of points that tilts what is seen: known to a few per cent, which passes for channels of 1.5
    mrad where ground is seen by some rings at 70 degrees only (random drive 633: pitch 8 mrad off).
    """
    known = np.linalg.inv(cov)
    shape = sigma / float(np.median(sigma))
    smooth = np.linspace(-1.0, 1.0, len(shape))[None] ** np.arange(SMOOTH)[:, None]
    free = scipy.linalg.null_space(shape * smooth)
    if not free.shape[1]:
        return prior.usual
    by = shape[:, None] * free
    information = by.T @ (known - np.diag(sigma**-2.0)) @ by
    kinds = np.zeros(free.shape[1], dtype=np.int64)
    weights = size_weights(information, by.T @ (known @ error), kinds, [prior])
    return math.sqrt(float(weights @ prior.sigmas**2))


def _of_usual(strip_tilt: Array, level: BoolArray) -> Array:
    """(K,) ratios of the sigmas of tilts to the median of their kind, level strips or others.

    At least 1: a step between two parallel faces has an offset and no tilt. `USUAL_RAD` counts as
    one more strip of each kind.
    """
    out = np.array(strip_tilt)
    for of in (level, ~level):
        out[of] /= np.median(np.append(out[of], USUAL_RAD))
    return np.maximum(out, 1.0)


def _strip_sigmas(
    asked: _Asked, layout: Layout, before: Array, errors: Array, of_tilts: Array
) -> Array:
    """(K,) 1 sigma of how far LiDARs see each strip apart: a fixed-point step of its likelihood.

    The offsets have a t distribution (EM: each strip has a variance of its own about the common
    one): strips with a reveal in them are seen centimetres apart, others a millimetre. Where one
    LiDAR has a piece of another face in its patches, they are tilted and shifted. So the common
    sigma is multiplied by `of_tilts` (K,), how much more the tilts of a strip differ between LiDARs
    than usual: its offset may be all that tells a coordinate, and no residual then.
    """
    own = slice(layout.strip_error, layout.size)
    known = np.clip(_known(asked, own, before), 0.0, 1.0).sum(axis=0)
    square = (errors[own].reshape(layout.lidars, -1) ** 2).sum(axis=0)
    limits = LEAST_M, MOST_STRIP_M
    usual = heavy_tailed(known, square / of_tilts**2, before / of_tilts, STRIP_USUAL_M, limits)
    return np.clip(of_tilts * usual, *limits)


def _bend_sigmas(
    asked: _Asked,
    layout: Layout,
    before: Array,
    errors: Array,
    level: BoolArray,
    one_view: bool,
) -> Array:
    """(K,) 1 sigma of the bends of each strip, in the same way; ground and others apart.

    Seen from one place a bend looks like another extrinsic: it is at least as large as usual.
    """
    if not layout.bent:
        return before
    own = slice(layout.bend, layout.surface_error)
    known = np.clip(_known(asked, own, before), 0.0, 1.0).sum(axis=0)
    square = (errors[own].reshape(BENDS, -1) ** 2).sum(axis=0)
    limits = (USUAL_PER_M if one_view else LEAST_BEND_PER_M, MOST_BEND_PER_M)
    out = np.array(before)
    for of in (level, ~level):
        if of.any():
            out[of] = heavy_tailed(known[of], square[of], before[of], USUAL_PER_M, limits)
    return out
