"""Joint registration of all clouds of a placement to the latent target frame (paper III-D.2).

Variables: a pose `T_target_lidar` per cloud and the components of the mixture. Gauge: the mean
motion of the clouds is removed from each step, so that the target frame stays where the
pre-alignment put it: origin at the target's centre, axes of the map. `README.md` of this folder
derives the steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS, stated_sigmas
from caliv_graph.config.model import Config
from caliv_graph.errors import RegistrationError
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.products import (
    Array,
    IntArray,
    Mixture,
    Registration,
    Surface,
    TargetObservation,
)
from caliv_graph.registration.centring import depth_of, middles_of
from caliv_graph.registration.clouds import CloudStack, merged_normals, stack_clouds
from caliv_graph.registration.heights import HeightNoise, scatter_of_neighbours
from caliv_graph.registration.mixture import expect, maximise_shape, seed_mixture
from caliv_graph.registration.moments import Responsibilities, cell_moments
from caliv_graph.registration.placing import placed_by_motion
from caliv_graph.registration.quadratic import ShapeQuadratic, shape_quadratic
from caliv_graph.registration.starts import best_starts, suspicious
from caliv_graph.targets.cloud.views import TYPICAL_SHARED, weights_of_views

COARSE_SIGMA_M = 0.05
"""Initial roughness, and width of the surfels. 3 degrees at the rim of a chair are 2 cm."""

FINE_SIGMA_M = 0.02
"""The same from poses of a solved graph, which are right to some millimetres."""

ROUGH_POINTS = 400
"""Points of a cloud at most in the coarse pass."""

ANNEALING = 0.75
"""Factor on the floor of the roughness, per iteration."""

FLOOR_PER_RANGE_SIGMA = 0.3
"""Final floor of the roughness, over the sigma of the noise along the beam: from then on the
roughness is what the heights say."""

TRUSTED_WEIGHT = 0.5
"""Robust weight below which a cloud gets no surfels of its own."""

HELD_ALONG_M = 0.05
"""1 sigma that a point is held with along the surface at the others of its surfel, where no graph
holds the clouds: one of a flat side would slide along it to where noise fits best. It is a bias,
towards where the beams of all clouds fell; the joint loop does without."""

DAMPING = 1e-3
"""Levenberg-Marquardt damping, relative to the block of each cloud. Clouds that share no component
(two LiDARs that saw different skins) keep the relative pose of the pre-alignment."""

NEIGHBOURS_HELD = 4
"""E-steps by beams that look at the surfels which the last search found, before the next one. From
one to the next surfels and clouds move by a millimetre, a twentieth of what surfels are apart; the
search takes half of an E-step."""

TILES_SETTLE = 3
"""Iterations by beams after which the surfels stay where they are along the surface, and the noise
of the heights is what it is. A surface looks the same wherever it is cut into tiles; left free the
tiles wander over it for hundreds of iterations, and take the poses along by 0.3 standard
deviations."""

LEFT_OUT = 1e-9
"""Weight of a cloud that shall neither shape the target nor move."""

UNSEEN = 1e-6
"""Damping of directions in which a cloud has no information, relative to the mean of all."""

MAX_STEP = 0.1
"""Largest step of a cloud in one iteration, rad and m."""

STEP_TOLERANCE = (3e-4, 2e-4)
"""Median step of a cloud, rad and m, below which a registration has converged."""

ROUGH_TOLERANCE = (1e-3, 6e-4)
"""Tolerance of the coarse pass."""

STEP_SIGMAS = 0.2
"""Or else: the median step of a cloud in standard deviations of its own pose, the shape held."""

STEADY_ITERATIONS, STEADY_FALL, STEADY_SIGMAS = 4, 0.8, 1.0
"""Or else: over this many iterations the median step, in these standard deviations, has a mean that
is no longer this much smaller than over as many before, and is below this. Where clouds are sparse
the steps stay at 0.3 to 0.5, since the nearest surfels of points change. The graph, which averages
over clouds, gains nothing from going on."""


def annealing_steps(sigma_m: float, sigma_range_m: float) -> int:
    """Number of E-steps from a roughness of `sigma_m` to the final floor."""
    factor = FLOOR_PER_RANGE_SIGMA * sigma_range_m / sigma_m
    return max(math.ceil(math.log(factor) / math.log(ANNEALING)), 0)


class JointRegistration:
    """State of the registration of one placement: clouds, mixture, annealing.

    E-step and M-step of the components are separate calls: in `calibration` the graph solve is the
    M-step of the poses, in `register_jointly` it is `free_step`.

    Attributes:
        observation: the clouds as they were extracted.
        clouds: the same, thinned and stacked.
        tolerance: (rad, m) of `register_jointly`.
        held_along: what holds points along surfaces, per square metre; 0 where a graph does.
        by_beams: at the end of annealing the beams tell the surfels, not the points' normals; and
            surfels begin where normals are not reliable, too (`seed_mixture`).
        weights: (J,) robust weight of each cloud, set from outside.
        noise: of the heights of the points of each LiDAR, estimated at the end of annealing.
        inlier_ratio: (J,) part of each cloud's points that are inliers, 0 to 1, of the last E-step.
    """

    def __init__(
        self,
        observation: TargetObservation,
        config: Config,
        rough: bool = False,
        normals: bool = True,
        views: Array | None = None,
    ) -> None:
        """Stacks the clouds of `observation`.

        Args:
            observation: the clouds.
            config: size of the mixture and of the clouds.
            rough: the coarse pass: fewer points, half the components, a wider tolerance.
            normals: False if `refine_normals` follows.
            views: (J,) clouds that have the view of each (`targets.cloud.views`); None: 1.

        Raises:
            RegistrationError: fewer than two clouds.
        """
        if len(observation.clouds) < 2:
            raise RegistrationError(
                f"{observation.name}: {len(observation.clouds)} cloud(s) to register, needs 2. "
                "Lower extraction.min_points, or widen target.min and target.max"
            )
        self.observation = observation
        most = config.registration.max_points
        self._names = list(dict.fromkeys(cloud.lidar for cloud in observation.clouds))
        stated_m, told_m = config.noise.lidar_range_m, observation.range_noise_m
        sigmas_m = np.array([max(stated_m, told_m.get(name, 0.0)) for name in self._names])
        self.clouds: CloudStack = stack_clouds(
            observation, min(most, ROUGH_POINTS) if rough else most, sigmas_m, normals
        )
        self._components = config.registration.components // (2 if rough else 1)
        self._gamma = config.registration.outlier_ratio
        self._guess_sigmas = {name: stated_sigmas(of) for name, of in config.lidars.items()}
        self.tolerance = ROUGH_TOLERANCE if rough else STEP_TOLERANCE
        self._floor_end = FLOOR_PER_RANGE_SIGMA * float(sigmas_m.min())
        self._floor = COARSE_SIGMA_M
        self._depth_m = 1.0
        self._mixture: Mixture | None = None
        self._expected: tuple[Array, Array, Array] | None = None
        self._near: IntArray | None = None
        self._near_held = 0
        self.inlier_ratio: Array = np.ones(self.clouds.count)
        self._slides: tuple[Array, Array] | None = None
        self._views = np.ones(self.clouds.count) if views is None else views
        self.noise = self._configured = HeightNoise.configured(
            self.clouds.lidars, sigmas_m, self._floor
        )
        # Until the noise is known, as much is taken to be shared as is typical.
        self._shared = np.full(self.clouds.lidars, TYPICAL_SHARED)
        self.weights: Array = np.ones(self.clouds.count)
        self.held_along = HELD_ALONG_M**-2.0
        self.by_beams = False
        self._by_beams_for = 0

    def refine_normals(self, R: Array, t: Array) -> None:
        """Estimates surface normals again, from the clouds of each LiDAR merged at (R, t)."""
        self.clouds = merged_normals(self.clouds, R, t)

    @property
    def mixture(self) -> Mixture:
        """The current components."""
        if self._mixture is None:
            raise RegistrationError(f"{self.observation.name}: not seeded yet")
        return self._mixture

    @property
    def finest(self) -> bool:
        """Whether annealing has reached the noise level."""
        return self._floor <= self._floor_end

    @property
    def view_weights(self) -> Array:
        """(J,) weight of each cloud for what it shares with others of the same view."""
        return weights_of_views(self._views, self._shared[self.clouds.lidar])

    def only(self, which: IntArray) -> JointRegistration:
        """The same state with the clouds at these indices alone; this one stays."""
        part = copy(self)
        part.clouds, part.weights = self.clouds.only(which), self.weights[which]
        part._views, part.inlier_ratio = self._views[which], self.inlier_ratio[which]
        part._expected = None
        if self._near is not None:
            part._near = self._near[self.clouds.points_of(which)]
        return part

    def placed(self, R: Array, t: Array) -> Array:
        """(J, 3) where the clouds begin, metres: the target's centre is the origin.

        Args:
            R: (J, 3, 3) rotations map from lidar, of the prealigned clouds.
            t: (J, 3) metres.
        """
        clouds = self.observation.clouds
        middles = middles_of(self.clouds, R, t, [cloud.cut for cloud in clouds])
        known = self._guess_sigmas
        sigmas = np.array([known.get(name, DEFAULT_GUESS_SIGMAS) for name in self._names])
        largest = sigmas.reshape(-1, 2, 3).max(axis=2)
        apart = placed_by_motion(middles, R, t, self.clouds.lidar, largest)
        return np.asarray(apart - np.einsum("jab,jb->ja", R, middles.points))

    def seed(self, R: Array, t: Array, sigma_m: float, draw: int = 0) -> None:
        """Begins a new mixture of width `sigma_m` (metres) at `T_target_lidar` (R, t).

        Another `draw` begins on other points.
        """
        self._depth_m = depth_of(self.clouds.moved(R, t))
        self._near = None
        self._by_beams_for = 0
        self._floor = max(sigma_m, self._floor_end)
        distinct = float((self.clouds.sizes * self.view_weights).sum())
        trusted = self.weights > TRUSTED_WEIGHT
        self._mixture = seed_mixture(
            self.clouds,
            R,
            t,
            self._components,
            self._floor,
            distinct,
            trusted if trusted.sum() >= 2 else None,
            self.by_beams,
            draw,
        )

    def expect(self, R: Array, t: Array) -> ShapeQuadratic:
        """E-step at `T_target_lidar` (R, t), and the quadratic on the poses that follows."""
        return self.quadratic(R, t, self.responsibilities(R, t))

    def responsibilities(self, R: Array, t: Array) -> Responsibilities:
        """The E-step alone."""
        self._floor = max(self._floor * ANNEALING, self._floor_end)
        density = self._gamma / (self._depth_m * (self._gamma + 1.0))
        weights = self.weights * self.view_weights
        by_beams = self.by_beams and self.finest
        noise, held = self._noise_now(), self.held_along
        if not by_beams or self._near_held == NEIGHBOURS_HELD:
            self._near = None
        self._near_held = 0 if self._near is None else self._near_held + 1
        near, clouds = self._near, self.clouds
        who = expect(clouds, R, t, self.mixture, noise, density, weights, held, by_beams, near)
        self._near = who.component if by_beams else None
        return who

    def quadratic(self, R: Array, t: Array, who: Responsibilities) -> ShapeQuadratic:
        """The quadratic on the poses that follows from an E-step at `T_target_lidar` (R, t)."""
        self.inlier_ratio = who.inlier_ratio
        cells = cell_moments(self.clouds, who, len(self.mixture.weights))
        self._slides = who.slides_m, who.explained
        quadratic = shape_quadratic(self.clouds, R, t, self.mixture, cells, who)
        if self.finest and not self.settled:
            taken_up = quadratic.shape_parameters()
            self.noise = self._noise_now().fitted(who.heights, taken_up, self._configured)
            self._shared = self.noise.shared_part(who.heights)
        # Not the quadratic itself: it is as large as all the rest.
        self._expected = cells, who.counts, quadratic.turns
        return quadratic

    @property
    def settled(self) -> bool:
        """Whether tiles and noise are what they are (`TILES_SETTLE`)."""
        return self._by_beams_for >= TILES_SETTLE

    def surface(self) -> Surface | None:
        """Whether the clouds show a surface; None before annealing has reached the noise."""
        if not self.finest or self._slides is None:
            return None
        scatter_m = scatter_of_neighbours(self.clouds, *self._slides).tolist()
        told_m = np.sqrt(self._configured.range_m2).tolist()
        return Surface(
            {n: of for n, of in zip(self._names, scatter_m, strict=True) if math.isfinite(of)},
            dict(zip(self._names, told_m, strict=True)),
        )

    def _noise_now(self) -> HeightNoise:
        """The noise of the heights, annealed."""
        return replace(self.noise, floor_m=0.0 if self.finest else self._floor)

    def maximise(self, R: Array, t: Array) -> None:
        """M-step of the components at the new `T_target_lidar` (R, t)."""
        if self._expected is None:
            raise RegistrationError(f"{self.observation.name}: E-step missing")
        mixture, held = self.mixture, self.settled
        self._mixture = maximise_shape(
            self.clouds, R, t, mixture, self._floor, *self._expected, tiles_held=held
        )
        if self.by_beams and self.finest:
            self._by_beams_for += 1
        self._expected = None  # as large as all the rest

    def result(
        self,
        R: Array,
        t: Array,
        blocks: Array,
        joint: Array,
        iterations: int,
        converged: bool,
        last_step: tuple[float, float],
    ) -> Registration:
        """Packs the registration at `T_target_lidar`, R (J, 3, 3) and t (J, 3) metres.

        `blocks` (J, 6, 6) is the information of each pose given the shape, `joint` (6 J, 6 J) that
        of all poses, the shape eliminated; `last_step` in rad and m.
        """
        # A cloud without inliers has no information; its matrix must be invertible nevertheless.
        trace = float(np.median(np.trace(blocks, axis1=1, axis2=2)))
        ridge = (1e-9 * trace + 1e-9) * np.eye(6)
        return Registration(
            observation=self.observation,
            T_target_lidar=unstack(R, t),
            information=blocks + ridge,
            information_joint=joint,
            view_weights=self.view_weights,
            mixture=self.mixture,
            inlier_ratio=self.inlier_ratio,
            iterations=iterations,
            converged=converged,
            last_step=last_step,
            surface=self.surface(),
        )


def left_step(R: Array, t: Array, d: Array) -> tuple[Array, Array]:
    """Applies left perturbations (J, 6) to (R, t) of shape (J, 3, 3), (J, 3)."""
    dR, dt = stack([gtsam.Pose3.Expmap(dj) for dj in d])
    return dR @ R, np.einsum("jab,jb->ja", dR, t) + dt


def free_step(quadratic: ShapeQuadratic) -> Array:
    """M-step of the poses without a graph: damped Newton step on the joint quadratic.

    (J, 6) left perturbations, mean zero (the gauge); NaN if there is no solution.
    """
    count = len(quadratic.blocks)
    H = quadratic.joint(given_orientations=True)
    H4 = H.reshape(count, 6, count, 6)
    j = np.arange(count)
    H4[j, :, j, :] += DAMPING * quadratic.blocks
    # A cloud without inliers has no information and stays. So does a cloud that sees one plane,
    # along that plane.
    diagonal = np.arange(len(H))
    H[diagonal, diagonal] += UNSEEN * max(float(np.trace(H)) / len(H), 1.0)
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        return np.full((count, 6), np.nan)
    d = -scipy.linalg.cho_solve(factor, quadratic.gradient.ravel()).reshape(count, 6)
    d -= d.mean(axis=0)  # the gauge
    largest = _sizes(d).max()
    return np.asarray(d * min(1.0, MAX_STEP / largest) if largest > 0 else d)


def _sizes(d: Array) -> Array:
    """(2, J) rad and m, of steps (J, 6)."""
    return np.asarray(np.linalg.norm(d.reshape(-1, 2, 3), axis=2).T)


def register_jointly(
    state: JointRegistration,
    T_target_lidar: Sequence[gtsam.Pose3],
    max_iterations: int,
    coarse: bool = True,
    other_starts: bool = True,
) -> Registration:
    """Registers all clouds of a placement to one reconstructed target (paper III-D.2).

    GMMCalib alternates between poses and means. Here one step solves for the poses of all clouds
    with the means eliminated: tens of iterations instead of hundreds.

    Args:
        state: the clouds; its mixture is seeded here.
        T_target_lidar: pre-alignment, a pose per cloud; right to about 10 degrees, at any position.
        max_iterations: at most.
        coarse: False if the pre-alignment is right to 1 or 2 cm: the clouds then begin there, and
            annealing begins finer.
        other_starts: False if a few clouds may end at a wrong place.

    Raises:
        RegistrationError: the clouds could not be brought together.
    """
    R, t = stack(list(T_target_lidar))
    if coarse:
        t = state.placed(R, t)
    state.seed(R, t, COARSE_SIGMA_M if coarse else FINE_SIGMA_M)
    if coarse and other_starts:
        run = _from_other_starts(state, R, t, max_iterations)
    else:
        run = _alternated(state, R, t, max_iterations)
    quadratic = state.expect(run.R, run.t)
    joint = quadratic.joint()
    return state.result(
        run.R, run.t, quadratic.blocks, joint, run.iterations, run.converged, run.last_step
    )


@dataclass(frozen=True)
class _Run:
    """Where an alternation of E-step and M-step ended: see `Registration`."""

    R: Array
    t: Array
    iterations: int
    converged: bool
    last_step: tuple[float, float]


def _alternated(
    state: JointRegistration, R: Array, t: Array, max_iterations: int, to_finest: bool = False
) -> _Run:
    """E-step and M-step in turn until the poses stay, or `to_finest`: until annealing has ended."""
    converged, step = False, (np.inf, np.inf)
    iteration, fine_sigmas = 0, list[float]()
    while iteration < max_iterations and not (converged or (to_finest and state.finest)):
        iteration += 1
        quadratic = state.expect(R, t)
        d = free_step(quadratic)
        if not np.isfinite(d).all():
            raise RegistrationError(
                f"{state.observation.name}: the clouds do not overlap enough to register "
                f"({state.clouds.count} clouds, {len(state.clouds.points)} points). Check the "
                "guesses with 'caliv-graph inspect --html', and drive around the target"
            )
        R, t = left_step(R, t, d)
        state.maximise(R, t)
        # The median cloud: one sparse cloud that slides along a surface does not matter.
        turn, shift = np.median(_sizes(d), axis=1).tolist()
        step = (turn, shift)
        fine = step[0] < state.tolerance[0] and step[1] < state.tolerance[1]
        sigmas = np.sqrt(np.einsum("ja,jab,jb->j", d, quadratic.blocks, d))
        if state.finest:
            fine_sigmas.append(float(np.median(sigmas)))
            converged = fine or fine_sigmas[-1] < STEP_SIGMAS or _steady(fine_sigmas)
    return _Run(R, t, iteration, converged, step)


def _steady(sigmas: Sequence[float]) -> bool:
    """Whether median steps, in sigmas, an iteration each, no longer become smaller."""
    n = STEADY_ITERATIONS
    if len(sigmas) < 2 * n:
        return False
    before, now = float(np.mean(sigmas[-2 * n : -n])), float(np.mean(sigmas[-n:]))
    return STEADY_FALL * before < now < STEADY_SIGMAS


def _from_other_starts(state: JointRegistration, R: Array, t: Array, max_iterations: int) -> _Run:
    """`_alternated`, with better places for clouds that show less of the target than the rest."""
    # Whether a cloud is lower or narrower shows before sparse clouds have come to rest.
    annealed = _alternated(state, R, t, max_iterations, to_finest=True)
    found = suspicious(state.clouds, annealed.R, annealed.t)
    if len(found.clouds):
        trial = copy(state)
        trial.weights = state.weights.copy()
        trial.weights[found.clouds] *= LEFT_OUT
        trial.seed(annealed.R, annealed.t, COARSE_SIGMA_M)
        others = _alternated(trial, annealed.R, annealed.t, max_iterations)
        R, t, moved = best_starts(
            trial.clouds, trial.mixture, trial.noise, others.R, others.t, found, left_step
        )
        if moved.any():
            R_all, t_all = others.R.copy(), others.t.copy()
            R_all[found.clouds], t_all[found.clouds] = R, t
            state.seed(R_all, t_all, FINE_SIGMA_M)
            again = _alternated(state, R_all, t_all, max_iterations)
            before = annealed.iterations + others.iterations
            return replace(again, iterations=before + again.iterations)
    if annealed.converged:
        return annealed
    rest = _alternated(state, annealed.R, annealed.t, max_iterations - annealed.iterations)
    if not rest.iterations:
        return annealed
    return replace(rest, iterations=annealed.iterations + rest.iterations)
