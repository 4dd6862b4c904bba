"""Distances between LiDARs on strips that a solve did not use, and what is to be expected of them.

The solve of the other strips determines poses, extrinsics and range biases to a joint covariance.
On a strip that it did not use the sightings determine a plane and the distances of the other
LiDARs from it, by least squares. These distances are linear in the errors of all that, and in
those of the sightings themselves, so that their joint covariance is known (README of
`validation`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.bends import BENDS
from caliv_graph.structure.elimination import factor_of, solved
from caliv_graph.structure.layout import Layout, Nuisances, State, stepped
from caliv_graph.structure.noise import OWN_STRIP, range_sigmas
from caliv_graph.structure.problem import (
    Problem,
    alike,
    geometry_at,
    groups_of,
    layout_of,
    placed_patches,
    placed_sightings,
)
from caliv_graph.structure.residuals import Geometry
from caliv_graph.structure.rows import PLACE_PRIOR_M, TILT_PRIOR_RAD, Rows, whitened
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.solve import GATES_M, Solved
from caliv_graph.structure.strips import Strips, find_strips
from caliv_graph.structure.thickness import thickness_m, weighted_alike
from caliv_graph.structure.weights import robust_weights

OWN_SIGHTINGS = 3
"""Fewest sightings of a strip with which a LiDAR's distance is measured."""

IRREGULAR = 3.0
"""Strips whose sightings scatter more than so many times the usual are not tested: leaves, or
something that moved away."""

DRAWS = 60
"""Random errors of which the expected thickness is the root mean square: good to some percent."""

Propagated = Callable[[Array], Array]
"""D C D^T of derivatives D by the coordinates of a solve, whose covariance is C."""


@dataclass(frozen=True)
class Measured:
    """Strips under one set of extrinsics; K strips, m distances.

    Attributes:
        distances_m: (m,) signed, of a LiDAR from the surface of the strip's first LiDAR; positive
            towards the side that is seen.
        cov_m2: (m, m) of them, from known errors alone; None: not computed.
        thickness_m: (K,) how far single scans see the strip from one plane, root mean square.
        expected_m: (K,) of that, from known errors alone; None: not computed.
    """

    distances_m: Array
    cov_m2: Array | None
    thickness_m: Array
    expected_m: Array | None


@dataclass(frozen=True)
class OtherStrips:
    """Strips beside those of a solve: found, weighted and measured at its estimate.

    Attributes:
        used: the solve, which did not use them.
        problem: the same drive with the patches of these strips.
        strips: K of them.
        sightings: Q of them, at the estimate of the solve.
        weights: (Q,) robust, about the median of their own LiDAR on the strip.
        nuisances: noise levels.
        layout: the coordinates; the first `layout.plane` are those of the solve.
        range_sigma_m: (L,) noise along the beam of each LiDAR.
        hub: (K,) index of the LiDAR that the others are compared with; -1: none sees it well.
        strip_of: (m,) strip of each distance.
        lidar_of: (m,) the LiDAR whose distance from the hub it is.
        regular: (K,) whether its sightings scatter no more than usual.
        scans: (K, L) number of sightings with weight.
    """

    used: Solved
    problem: Problem
    strips: Strips
    sightings: Sightings
    weights: Array
    nuisances: Nuisances
    layout: Layout
    range_sigma_m: Array
    hub: IntArray
    strip_of: IntArray
    lidar_of: IntArray
    regular: BoolArray
    scans: IntArray


def other_strips(used: Solved, problem: Problem) -> OtherStrips | None:
    """The strips of the patches of `problem` at the estimate of `used`; None if there are none."""
    placed = placed_patches(problem, used.state)
    strips = find_strips(placed.moments_map, placed.normals_map, problem.patches.scan, GATES_M[-1])
    if not strips.count:
        return None
    sigma = range_sigmas(problem.patches, problem.range_sigma_m)
    layout = replace(layout_of(problem, strips), jitters=used.layout.jitters)
    sightings = placed_sightings(problem, placed, strips, sigma)
    geometry = geometry_at(problem, _on(used.state, strips, layout), sightings, layout)
    lidar = problem.patches.scan_lidar[sightings.scan]
    own = _about_own_mean(geometry.offsets_m(sightings), sightings, lidar, strips.count)
    usual = float(np.median(used.nuisances.sighting))
    shared = used.nuisances.shared
    of_lidar = used.nuisances.of_lidar(sightings.strip, lidar, strips.level)
    spread = own**2 - 1.0 / sightings.moments[:, 3, 3] - shared**2 - of_lidar**2
    count = np.bincount(sightings.strip, minlength=strips.count)
    total = np.bincount(sightings.strip, spread, strips.count)
    least = 0.5 * usual
    sighting = np.sqrt(np.maximum((OWN_STRIP * usual**2 + total) / (OWN_STRIP + count), least**2))
    strip = np.full(strips.count, np.median(used.nuisances.strip))
    levels = used.levels()
    nuisances = replace(
        used.nuisances,
        sighting=sighting,
        sighting_tilt=sighting * np.where(strips.level, *levels.tilt_per_m),
        strip=strip,
        strip_tilt=np.where(strips.level, *levels.strip_tilt_rad),
        tilt_times=levels.tilt_times,
        bend=np.where(strips.level, *levels.bend_per_m),
    )
    sigma_m = nuisances.offsets(sightings.strip, lidar, strips.level)
    weights = robust_weights(own, sightings, sigma_m, shared)
    scans = np.zeros((strips.count, layout.lidars), dtype=np.int64)
    np.add.at(scans, (sightings.strip, lidar), weights > 0.0)
    enough = scans >= OWN_SIGHTINGS
    hub = np.where(enough.any(axis=1), scans.argmax(axis=1), -1)
    others = enough & (np.arange(layout.lidars) != hub[:, None])
    strip_of, lidar_of = np.nonzero(others)
    return OtherStrips(
        used=used,
        problem=problem,
        strips=strips,
        sightings=sightings,
        weights=weights,
        nuisances=nuisances,
        layout=layout,
        range_sigma_m=sigma,
        hub=hub,
        strip_of=strip_of,
        lidar_of=lidar_of,
        regular=sighting < IRREGULAR * usual,
        scans=scans,
    )


def _about_own_mean(offsets_m: Array, sightings: Sightings, lidar: IntArray, strips: int) -> Array:
    """(Q,) offsets less the median of their LiDAR's on the strip.

    About the strip's plane a LiDAR with a wrong extrinsic would lose its weight, and be no longer
    seen.
    """
    group = lidar * strips + sightings.strip
    order = np.lexsort((offsets_m, group))
    _, first, count = np.unique(group[order], return_index=True, return_counts=True)
    sorted_m = offsets_m[order]
    middle = 0.5 * (sorted_m[first + (count - 1) // 2] + sorted_m[first + count // 2])
    _, number = np.unique(group, return_inverse=True)
    return np.asarray(offsets_m - middle[number.ravel()])


def _on(state: State, strips: Strips, layout: Layout) -> State:
    """An estimate with other strips; the biases of the LiDARs stay."""
    errors = np.zeros(layout.size)
    of_lidars = slice(layout.error, layout.plane)
    errors[of_lidars] = state.errors[of_lidars]
    return replace(
        state, centres_map=strips.centres_map, normals_map=strips.normals_map, errors=errors
    )


def at_the_solve(other: OtherStrips) -> Measured:
    """At the estimate of the solve, with its covariance."""
    used = other.used
    factor = used.factor
    rng = np.random.default_rng(0)
    draws = _draws(factor, rng.standard_normal((len(factor[0]), DRAWS)))
    return _measured(other, used.state, lambda D: D @ solved(factor, D.T), draws, rng)


def at_extrinsics(
    other: OtherStrips,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    offsets_s: Mapping[str, float],
    cov: Array,
) -> Measured:
    """At given extrinsics; poses and biases as the strips of the solve have them with these.

    Args:
        other: the strips.
        T_vehicle_lidar: of every LiDAR.
        offsets_s: time offsets; none is zero.
        cov: (o + 6 n, o + 6 n) joint covariance of the free time offsets, in the order of the
            problem, and of right perturbations of the extrinsics. Their errors are taken as
            independent of those of the solve.
    """
    layout, H = other.layout, other.used.system.H
    given = np.arange(layout.offset, layout.error)
    rest = np.setdiff1d(np.arange(layout.plane), given)
    factor = factor_of(H[np.ix_(rest, rest)])
    follow = solved(factor, H[np.ix_(rest, given)])
    state = other.used.state
    names = other.problem.patches.lidars
    away = [
        np.array([offsets_s.get(names[i], 0.0) - state.offsets_s[i] for i in layout.offsets]),
        *(
            T.localCoordinates(T_vehicle_lidar[name])
            for name, T in zip(names, state.T_vehicle_lidar, strict=True)
        ),
    ]
    d = np.zeros(layout.plane)
    d[given] = np.concatenate(away)
    d[rest] = solved(factor, other.used.system.b[rest]) - follow @ d[given]

    def propagated(D: Array) -> Array:
        by_given = D[:, given] - D[:, rest] @ follow
        return np.asarray(by_given @ cov @ by_given.T + D[:, rest] @ solved(factor, D[:, rest].T))

    rng = np.random.default_rng(0)
    draws = np.zeros((layout.plane, DRAWS))
    draws[given] = _drawn(cov, rng)
    draws[rest] = _draws(factor, rng.standard_normal((len(rest), DRAWS))) - follow @ draws[given]
    return _measured(other, _moved(other, state, d), propagated, draws, rng)


def at_extrinsics_on_the_poses(
    other: OtherStrips,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    offsets_s: Mapping[str, float],
    cov: Array,
) -> Measured:
    """At given extrinsics, on the poses and biases of the solve; see `at_extrinsics`.

    For poses that hang on the extrinsics alone: those that the given ones ask for would hide that
    these are wrong. The errors of the solve and of the given extrinsics are taken as independent.
    """
    layout, used = other.layout, other.used
    factor = used.factor
    given = np.arange(layout.offset, layout.error)
    rest = np.setdiff1d(np.arange(layout.plane), given)

    def propagated(D: Array) -> Array:
        by_rest = D.copy()
        by_rest[:, given] = 0.0
        return np.asarray(D[:, given] @ cov @ D[:, given].T + by_rest @ solved(factor, by_rest.T))

    rng = np.random.default_rng(0)
    draws = np.zeros((layout.plane, DRAWS))
    draws[given] = _drawn(cov, rng)
    draws[rest] = _draws(factor, rng.standard_normal((layout.plane, DRAWS)))[rest]
    names = other.problem.patches.lidars
    offsets = np.array([offsets_s.get(name, 0.0) for name in names])
    state = replace(
        used.state,
        T_vehicle_lidar=tuple(T_vehicle_lidar[name] for name in names),
        offsets_s=offsets,
    )
    return _measured(other, state, propagated, draws, rng)


def at_guesses(other: OtherStrips) -> Measured:
    """With the guesses of the extrinsics, on the poses of the solve."""
    state = other.used.state
    offsets = np.zeros_like(state.offsets_s)
    guessed = replace(state, T_vehicle_lidar=other.problem.guesses, offsets_s=offsets)
    return _measured(other, guessed, None, None, np.random.default_rng(0))


def _draws(factor: tuple[Array, Array], white: Array) -> Array:
    """Errors (D, ...) with the covariance H^-1, from white noise."""
    scale, L = factor
    turned = scipy.linalg.solve_triangular(L, white, lower=True, trans=1, check_finite=False)
    return np.asarray(turned / scale[:, None])


def _drawn(cov: Array, rng: np.random.Generator) -> Array:
    """(k, DRAWS) errors with a covariance (k, k), which may be singular."""
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root @ rng.standard_normal((len(cov), DRAWS)))


def _moved(other: OtherStrips, state: State, d: Array) -> State:
    """The estimate after a step (`layout.plane`,) of what is not the strips' own."""
    layout = other.used.layout
    whole = np.zeros(layout.size)
    whole[: len(d)] = d
    return stepped(state, layout, whole)


def _measured(
    other: OtherStrips,
    state: State,
    propagated: Propagated | None,
    draws: Array | None,
    rng: np.random.Generator,
) -> Measured:
    """Distances and thickness at an estimate.

    `propagated` gives D C D^T for derivatives D (m, `layout.plane`), `draws` are errors with the
    covariance C.
    """
    problem, layout, strips = other.problem, other.layout, other.strips
    placed = placed_patches(problem, state)
    seen = placed_sightings(problem, placed, strips, other.range_sigma_m)
    sightings, weights = weighted_alike(seen, other.sightings, other.weights)
    here = _on(state, strips, layout)
    geometry = geometry_at(problem, here, sightings, layout)
    group = groups_of(sightings, strips)
    repeated = problem.views.count[sightings.scan]
    same = alike(problem, sightings)
    lidar = problem.patches.scan_lidar[sightings.scan]
    own = other.nuisances.errors(sightings.strip, lidar, strips.level)
    rows = whitened(
        geometry, sightings, group, repeated, same, own, other.nuisances, weights, layout
    )
    found = _Distances(other, rows)
    offsets, by_plane = geometry.offsets_m(sightings), geometry.plane_rows(sightings)
    thickness = thickness_m(by_plane, sightings, weights, offsets, strips.count)
    if propagated is None or draws is None:
        return Measured(found.distances_m, None, thickness, None)
    drawn = _drawn_offsets(other, geometry, sightings, group, draws, rng)
    each = thickness_m(by_plane, sightings, weights, drawn, strips.count)
    return Measured(
        found.distances_m,
        found.covariance(propagated(found.by_solve)),
        thickness,
        np.sqrt((each**2).mean(axis=1)),
    )


def _drawn_offsets(
    other: OtherStrips,
    geometry: Geometry,
    sightings: Sightings,
    group: IntArray,
    draws: Array,
    rng: np.random.Generator,
) -> Array:
    """(Q, DRAWS) offsets of all sightings by random errors of everything."""
    layout, nuisances = other.layout, other.nuisances
    errors = np.zeros((layout.size, DRAWS))
    errors[: layout.plane] = draws
    bend = np.tile(nuisances.bend, BENDS * layout.bent)[:, None]
    bends = slice(layout.bend, layout.surface_error)
    errors[bends] = bend * rng.standard_normal((len(bend), DRAWS))
    for first, last, sigma in (
        (layout.surface_error, layout.strip_error, nuisances.surface),
        (layout.strip_error, layout.size, nuisances.strip[0]),
    ):
        errors[first:last] = sigma * rng.standard_normal((last - first, DRAWS))
    _, number = np.unique(group, return_inverse=True)
    shared = nuisances.shared * rng.standard_normal((int(number.max()) + 1, DRAWS))
    lidar = other.problem.patches.scan_lidar[sightings.scan]
    sigma_m = nuisances.offsets(sightings.strip, lidar, other.strips.level)
    own = np.sqrt(1.0 / sightings.moments[:, 3, 3] + sigma_m**2)
    noise = own[:, None] * rng.standard_normal((sightings.count, DRAWS))
    by_all = geometry.offset_rows(sightings, layout.size)
    return np.asarray(by_all @ errors + shared[number.ravel()] + noise)


class _Distances:
    """Planes and distances of all strips by least squares, and what errors make of these."""

    def __init__(self, other: OtherStrips, rows: Rows) -> None:
        layout = other.layout
        self._other = other
        # Of what belongs to no surface the rows are not asked for: most of the work.
        H = (rows.J[:, layout.plane :].T @ rows.J).tocsr()
        right = rows.of_noise - rows.J.T @ rows.r
        shared = (rows.J.T @ rows.shared).tocsr()
        m = len(other.strip_of)
        self.distances_m = np.zeros(m)
        self.by_solve = np.zeros((m, layout.plane))
        self._noise = np.zeros((m, m))
        self._by_surface = np.zeros((m, layout.strip_error - layout.surface_error))
        by_shared = [scipy.sparse.csr_array((0, shared.shape[1]))]
        surface = slice(layout.surface_error, layout.strip_error)
        for k in np.unique(other.strip_of):
            at = np.flatnonzero(other.strip_of == k)
            plane = layout.plane + 3 * k + np.arange(3)
            bends = layout.bend + layout.strips * np.arange(BENDS * layout.bent) + k
            own = layout.strip_error + layout.strips * other.lidar_of[at] + k
            columns = np.concatenate([plane, bends, own])
            part = H[columns - layout.plane]
            A = part[:, columns].toarray()
            sigmas = [TILT_PRIOR_RAD] * 2 + [PLACE_PRIOR_M]
            sigmas += [other.nuisances.bend[k]] * len(bends) + [PLACE_PRIOR_M] * len(at)
            A += np.diag(np.array(sigmas) ** -2.0)
            inverse = np.linalg.inv(A)
            first = len(plane) + len(bends)
            gain = inverse[first:]
            self.distances_m[at] = -(gain @ right[columns])
            self.by_solve[at] = gain @ part[:, : layout.plane].toarray()
            self._by_surface[at] = gain @ part[:, surface].toarray()
            self._noise[np.ix_(at, at)] = inverse[first:, first:]
            # The hub errs on the strip as the others do.
            strip = other.nuisances.strip[k] ** 2 * (np.eye(len(at)) + 1.0)
            self._noise[np.ix_(at, at)] += strip
            by_shared.append(scipy.sparse.csr_array(gain) @ shared[columns])
        self._by_shared = scipy.sparse.vstack(by_shared).tocsr()

    def covariance(self, of_solve: Array) -> Array:
        """(m, m) of the distances; `of_solve` is what errors of the solve make of it."""
        surface = self._other.nuisances.surface
        out = of_solve + self._noise + (self._by_shared @ self._by_shared.T).toarray()
        out = out + surface**2 * self._by_surface @ self._by_surface.T
        return np.asarray(0.5 * (out + out.T))
