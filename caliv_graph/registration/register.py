"""Joint registration: every cloud of a placement to the latent target frame (the paper's step).

Variables: a pose `T_target_lidar` per cloud and the components of the mixture. Noise: the
mixture's own variances. Gauge: moving all clouds and the shape together changes nothing; the mean
motion of the clouds is taken out of each step, so that the frame stays where the pre-alignment
put it: origin at the target's centre, axes of the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.config.model import Config
from caliv_graph.errors import RegistrationError
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.products import Array, Mixture, Registration, TargetObservation
from caliv_graph.registration.clouds import CloudStack, merged_normals, stack_clouds
from caliv_graph.registration.mixture import (
    ShapeQuadratic,
    cell_moments,
    expect,
    maximise_shape,
    seed_mixture,
    shape_quadratic,
)

COARSE_SIGMA_M = 0.05
"""First standard deviation of the components. 3 degrees at the rim of a chair are 2 cm."""

FINE_SIGMA_M = 0.02
"""The same where a solved graph has put the clouds: their poses move by millimetres."""

ROUGH_POINTS = 400
"""Points of a cloud at most in a registration that another follows."""

ANNEALING = 0.85
"""Factor on the floor of the standard deviation, per iteration."""

FLOOR_PER_RANGE_SIGMA = 0.6
"""Final floor of the standard deviation over the noise along the beam."""

DAMPING = 1e-3
"""Levenberg-Marquardt, relative to each cloud's own information: what the shape does not tie
together (two LiDARs that saw different skins) stays where the pre-alignment had it."""

UNSEEN = 1e-6
"""The same for directions in which a cloud has no information of its own, relative to the mean of
all."""

MAX_STEP = 0.1
"""Largest step of a cloud in one iteration, radians and metres."""

STEP_TOLERANCE = (3e-4, 2e-4)
"""Radians and metres: a registration whose clouds move less has converged."""

ROUGH_TOLERANCE = (1e-3, 6e-4)
"""The same of a registration that another follows."""


def annealing_steps(sigma_m: float, sigma_range_m: float) -> int:
    """E-steps until a mixture of width `sigma_m` is as fine as the noise along the beam lets it."""
    left = FLOOR_PER_RANGE_SIGMA * sigma_range_m / sigma_m
    return max(math.ceil(math.log(left) / math.log(ANNEALING)), 0)


class JointRegistration:
    """The state of one placement's registration: clouds, mixture, and how fine it has become.

    The expectation and the two maximisations are separate, since the graph solve takes the place
    of the free M-step of the poses in `calibration`.
    """

    def __init__(
        self,
        observation: TargetObservation,
        config: Config,
        rough: bool = False,
        normals: bool = True,
        shares: Array | None = None,
    ) -> None:
        """Stacks the clouds of `observation`.

        Args:
            observation: the clouds.
            config: size of the mixture and of the clouds.
            rough: fewer points, half the components and an earlier end, for a registration that
                another follows.
            normals: False if `refine_normals` follows.
            shares: (J,) what each cloud counts beside others that saw the same; None: all fully.

        Raises:
            RegistrationError: fewer than two clouds.
        """
        if len(observation.clouds) < 2:
            raise RegistrationError(
                f"{observation.name}: {len(observation.clouds)} cloud(s) to register, needs 2"
            )
        self.observation = observation
        most = config.registration.max_points
        self.clouds: CloudStack = stack_clouds(
            observation,
            min(most, ROUGH_POINTS) if rough else most,
            config.noise.lidar_range_m,
            normals,
        )
        self._components = config.registration.components // (2 if rough else 1)
        self._gamma = config.registration.outlier_ratio
        self.tolerance = ROUGH_TOLERANCE if rough else STEP_TOLERANCE
        self._floor_end = FLOOR_PER_RANGE_SIGMA * config.noise.lidar_range_m
        self._floor = COARSE_SIGMA_M
        self._volume = 1.0
        self._mixture: Mixture | None = None
        self._expected: tuple[Array, Array, Array] | None = None
        self._inlier_ratio: Array = np.ones(self.clouds.count)
        self._shares = np.ones(self.clouds.count) if shares is None else shares
        self.weights: Array = np.ones(self.clouds.count)

    def refine_normals(self, R: Array, t: Array) -> None:
        """Surface normals anew, from the clouds of each LiDAR merged at (R, t)."""
        names = [cloud.lidar for cloud in self.observation.clouds]
        index = {name: i for i, name in enumerate(dict.fromkeys(names))}
        lidar = np.array([index[name] for name in names])
        self.clouds = merged_normals(self.clouds, R, t, lidar)

    @property
    def mixture(self) -> Mixture:
        """The current components."""
        if self._mixture is None:
            raise RegistrationError(f"{self.observation.name}: not seeded yet")
        return self._mixture

    @property
    def inlier_ratio(self) -> Array:
        """(J,) part of each cloud's points that the mixture explains."""
        return self._inlier_ratio

    @property
    def finest(self) -> bool:
        """Whether annealing has reached the noise level."""
        return self._floor <= self._floor_end

    def seed(self, R: Array, t: Array, sigma_m: float) -> None:
        """Starts a new mixture of width `sigma_m` at the given `T_target_lidar` (R, t)."""
        points = self.clouds.moved(R, t)
        low, high = np.percentile(points, [1, 99], axis=0)
        self._volume = float(np.prod(np.maximum(high - low, 0.05)))
        self._floor = max(sigma_m, self._floor_end)
        self._mixture = seed_mixture(self.clouds, R, t, self._components, self._floor)

    def expect(self, R: Array, t: Array) -> ShapeQuadratic:
        """E-step at (R, t), and the quadratic that it puts on the poses."""
        self._floor = max(self._floor * ANNEALING, self._floor_end)
        density = self._gamma / (self._volume * (self._gamma + 1.0))
        who = expect(self.clouds, R, t, self.mixture, density, self.weights * self._shares)
        self._inlier_ratio = who.inlier_ratio
        cells = cell_moments(self.clouds, who, len(self.mixture.weights))
        quadratic = shape_quadratic(self.clouds, R, t, self.mixture, cells, who)
        # Not the quadratic itself: it is as large as all the rest.
        self._expected = cells, quadratic.turnable, quadratic.torque
        return quadratic

    def maximise(self, R: Array, t: Array) -> None:
        """M-step of the components at the new poses (R, t)."""
        if self._expected is None:
            raise RegistrationError(f"{self.observation.name}: E-step missing")
        self._mixture = maximise_shape(
            self.clouds, R, t, self.mixture, self._floor, *self._expected
        )

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
        """The registration at (R, t), with information (J, 6, 6) of each cloud and of all."""
        # A cloud that no component explains has no information, but a matrix that can be inverted.
        trace = float(np.median(np.trace(blocks, axis1=1, axis2=2)))
        ridge = (1e-9 * trace + 1e-9) * np.eye(6)
        return Registration(
            observation=self.observation,
            T_target_lidar=unstack(R, t),
            information=blocks + ridge,
            information_joint=joint,
            mixture=self.mixture,
            inlier_ratio=self.inlier_ratio,
            iterations=iterations,
            converged=converged,
            last_step=last_step,
        )


def centre_clouds(clouds: CloudStack, R: Array, t: Array) -> Array:
    """Translations that put the middle of every cloud's extent at the origin.

    A wrong initial guess moves the target by up to a metre (3 degrees at 20 m), but all clouds of
    a target have about the same extent, whatever the density of their points.

    Returns:
        (J, 3) new translations.
    """
    points = clouds.moved(R, t)
    out = t.copy()
    ends = np.append(clouds.starts, len(points))
    for j in range(clouds.count):
        low, high = np.percentile(points[ends[j] : ends[j + 1]], [2, 98], axis=0)
        out[j] -= 0.5 * (low + high)
    return out


def left_step(R: Array, t: Array, d: Array) -> tuple[Array, Array]:
    """Applies left perturbations (J, 6) to (R, t) of shape (J, 3, 3), (J, 3)."""
    dR, dt = stack([gtsam.Pose3.Expmap(dj) for dj in d])
    return dR @ R, np.einsum("jab,jb->ja", dR, t) + dt


def free_step(quadratic: ShapeQuadratic) -> Array:
    """M-step of the poses when nothing else is known of them.

    Returns:
        (J, 6) left perturbations; NaN if there is no solution.
    """
    count = len(quadratic.blocks)
    H = quadratic.joint(given_orientations=True)
    H4 = H.reshape(count, 6, count, 6)
    j = np.arange(count)
    H4[j, :, j, :] += DAMPING * quadratic.blocks
    # A cloud that no component explains says nothing, and stays; so does one along the plane that
    # is all it sees.
    diagonal = np.arange(len(H))
    H[diagonal, diagonal] += UNSEEN * max(float(np.trace(H)) / len(H), 1.0)
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        return np.full((count, 6), np.nan)
    d = -scipy.linalg.cho_solve(factor, quadratic.gradient.ravel()).reshape(count, 6)
    d -= d.mean(axis=0)  # the gauge
    largest = np.abs(d).max()
    return np.asarray(d * min(1.0, MAX_STEP / largest) if largest > 0 else d)


def register_jointly(
    state: JointRegistration,
    T_target_lidar: Sequence[gtsam.Pose3],
    max_iterations: int,
    coarse: bool = True,
) -> Registration:
    """Registers all clouds of a placement to one reconstructed target (SPEC 3, paper III-D.2).

    Unlike GMMCalib's alternation, the poses of all clouds are solved for at once with the means
    of the components eliminated: tens of iterations instead of hundreds, and clouds that share no
    component do not pretend to be tied to each other.

    Args:
        state: the clouds; its mixture is seeded here.
        T_target_lidar: pre-alignment, a pose per cloud; right to about 10 degrees, any position.
        max_iterations: at most.
        coarse: False if the pre-alignment is right to a centimetre or two: the clouds are then not
            centred first, and annealing starts finer.

    Returns:
        A pose and a 6x6 information per cloud, and the reconstructed target.

    Raises:
        RegistrationError: the clouds could not be brought together.
    """
    R, t = stack(list(T_target_lidar))
    if coarse:
        t = centre_clouds(state.clouds, R, t)
    state.seed(R, t, COARSE_SIGMA_M if coarse else FINE_SIGMA_M)
    converged, step = False, (np.inf, np.inf)
    iteration = 0
    while iteration < max_iterations and not converged:
        iteration += 1
        quadratic = state.expect(R, t)
        d = free_step(quadratic)
        if not np.isfinite(d).all():
            raise RegistrationError(
                f"{state.observation.name}: the clouds do not overlap enough to register "
                f"({state.clouds.count} clouds, {len(state.clouds.points)} points)"
            )
        R, t = left_step(R, t, d)
        state.maximise(R, t)
        # The median cloud: one sparse cloud that slides along a surface is no reason to go on.
        step = (
            float(np.median(np.abs(d[:, :3]).max(axis=1))),
            float(np.median(np.abs(d[:, 3:]).max(axis=1))),
        )
        fine = step[0] < state.tolerance[0] and step[1] < state.tolerance[1]
        converged = state.finest and fine
    quadratic = state.expect(R, t)
    joint = quadratic.joint()
    return state.result(R, t, quadratic.blocks, joint, iteration, converged, step)
