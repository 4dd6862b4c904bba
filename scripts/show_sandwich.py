"""Covariance of the registration: claimed, sandwich, and scatter over repeated simulations.

    .venv/bin/python scripts/show_sandwich.py
    .venv/bin/python scripts/show_sandwich.py --runs 50 --clouds 60 --out sandwich.json

A figure-eight past a chair, vehicle poses exact, no ground, nothing but the chair's points: what is
left is the estimating equation of the registration (`registration.quadratic`), solved for the
extrinsics of two LiDARs. Each run draws the noise of the ranges and the start of the iteration. In
`noise` that is all. In `sampling` the path is also displaced and turned by a little, so that the
beams meet other spots of the chair. In `still` moreover half of the clouds of each LiDAR are from
one place, and have the weights of `targets.cloud.views` for what they share.

Columns, 1 sigma per axis: `scatter` of the estimates over the runs and their `mean` error; `A^-1`
as claimed; `scaled`, the same times the scale that the residuals of the clouds ask for;
`sandwich` A^-1 B A^-1 with B from the scores of single clouds, and of groups of neighbouring
clouds; `profile`, the sandwich with the derivative of the equation in the place of A, the shape
estimated again at displaced extrinsics (of the first run). `caliv_graph/registration/README.md`
derives them and quotes the tables.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # for the modules beside this script, run from anywhere

from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import RegistrationError
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    skew,
    stack,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, IntArray, Mixture, TargetCloud, TargetObservation
from caliv_graph.registration.clouds import CloudStack, merged_normals, stack_clouds
from caliv_graph.registration.heights import HeightNoise
from caliv_graph.registration.mixture import (
    REACH_SIGMAS,
    expect,
    maximise_shape,
    seed_mixture,
)
from caliv_graph.registration.moments import (
    JACOBIAN,
    MOMENTS,
    NORMALS,
    SURFACE_MOMENTS,
    Responsibilities,
    cell_moments,
    mass_and_means,
    to_target,
)
from caliv_graph.registration.quadratic import (
    NORMAL_SIGMA_RAD,
    ShapeQuadratic,
    shape_quadratic,
)
from caliv_graph.registration.register import (
    ANNEALING,
    FINE_SIGMA_M,
    FLOOR_PER_RANGE_SIGMA,
    TILES_SETTLE,
)
from caliv_graph.registration.surfels import STEEP
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.scenario.world import make_world
from caliv_graph.simulation.lidar import SimulatedLidar
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.targets.cloud.views import TYPICAL_SHARED, views, weights_of_views
from scripts._command import exit_code_of, positive

TARGET = "chair"
GAMMA = 0.05
"""`registration.outlier_ratio`, as the config has it."""

MIN_POINTS = 50
ITERATIONS = 24
START_SIGMAS = np.array([1e-3] * 3 + [5e-3] * 3)
"""Of what the iteration starts from: a little more than the registration is known to."""

SHIFT_M, TURN_RAD = 0.1, 0.1
"""Largest displacement of the path in `sampling`: several spacings of the beams at the chair."""

GROUP = 3
"""Neighbouring clouds of a LiDAR that are one cluster in the second sandwich."""

SHAPE_ROUNDS = 6
"""Rounds of EM of the shape at displaced extrinsics."""

CASES = ("noise", "sampling", "still")


@dataclass(frozen=True)
class Clouds:
    """The clouds of one run, and where the vehicle was.

    Attributes:
        stack: their points.
        lidar: (J,) index of the LiDAR of each.
        order: (J,) number of the scan of each.
        T_target_vehicle: of each, exact.
        views: (J,) how many clouds have the view of each.
        sigma_range_m: noise along the beam.
    """

    stack: CloudStack
    lidar: IntArray
    order: IntArray
    T_target_vehicle: tuple[gtsam.Pose3, ...]
    views: Array
    sigma_range_m: float


class Scene:
    """The chair, the LiDARs and the path."""

    def __init__(self, scenario: Scenario, clouds: int) -> None:
        self.scenario = scenario
        self.world = make_world(scenario.world)
        self._caster = RayCaster(self.world, 1)
        self._object = self.world.names.index(TARGET)
        self.centre, self._radius_m = self.world.bounding_sphere(TARGET)
        self.names = tuple(scenario.lidars)
        self.truth = tuple(model.mounting.pose() for model in scenario.lidars.values())
        drive = make_drive(scenario.drive)
        stamps = np.arange(0, round(1e9 * drive.duration_s), 100_000_000)
        poses = drive.poses(stamps, self.world.ground_z_map)
        rng = np.random.default_rng(0)
        self.scans: list[list[tuple[int, gtsam.Pose3]]] = []
        for name in self.names:
            lidar = self._lidar(name, rng)
            seen = [i for i, X in enumerate(poses) if self._sees(name, lidar, X, rng)]
            chosen = np.linspace(0, len(seen) - 1, min(clouds, len(seen))).round().astype(int)
            self.scans.append([(seen[i], poses[seen[i]]) for i in np.unique(chosen)])

    def _lidar(self, name: str, rng: np.random.Generator) -> SimulatedLidar:
        return SimulatedLidar(self.scenario.lidars[name], self.world, self._caster, None, rng)

    def _sees(
        self, name: str, lidar: SimulatedLidar, X: gtsam.Pose3, rng: np.random.Generator
    ) -> bool:
        """Whether the whole chair is in the field of view, with enough points."""
        model = self.scenario.lidars[name]
        c = X.compose(lidar.T_vehicle_lidar).transformTo(self.centre)
        reach = math.degrees(math.asin(min(self._radius_m / float(np.linalg.norm(c)), 1.0))) + 1.0
        azimuth = np.degrees(np.arctan2(c[1], c[0]))
        elevation = np.degrees(np.arctan2(c[2], np.hypot(c[0], c[1])))
        for angle, (low, high) in (
            (azimuth, model.horizontal_fov_deg),
            (elevation, model.vertical_fov_deg),
        ):
            if not low + reach < angle < high - reach:
                return False
        return len(self._points(lidar, X, rng)) >= 2 * MIN_POINTS

    def _points(self, lidar: SimulatedLidar, X: gtsam.Pose3, rng: np.random.Generator) -> Array:
        R, t = X.rotation().matrix()[None], X.translation()[None]
        beams = np.flatnonzero(lidar.beams_towards(R, t, [(self.centre, self._radius_m)]))
        returns = lidar.sweep_of(beams, R, t, np.zeros(1), rng)
        points: Array = returns.points_lidar[returns.objects == self._object]
        return points

    def draw(self, case: str, seed: int, max_points: int) -> Clouds:
        """The clouds of a run."""
        rng = np.random.default_rng([seed, CASES.index(case)])
        displaced = gtsam.Pose3()
        if case != "noise":
            about = gtsam.Pose3(gtsam.Rot3(), self.centre)
            shift = np.append(rng.uniform(-SHIFT_M, SHIFT_M, 2), 0.0)
            turn = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-TURN_RAD, TURN_RAD)), shift)
            displaced = about.compose(turn).compose(about.inverse())
        observed, lidars, order, poses, alike = [], [], [], [], []
        for a, name in enumerate(self.names):
            lidar, scans = self._lidar(name, rng), self.scans[a]
            if case == "still":
                half, stop = len(scans) // 2, scans[len(scans) // 3]
                scans = sorted([*scans[::2], *[stop] * half], key=lambda scan: scan[0])
            places = []
            for i, X in scans:
                X = displaced.compose(X)
                points = self._points(lidar, X, rng)
                observed.append(TargetCloud(name, 0, i, points, name))
                lidars.append(a)
                order.append(i)
                poses.append(gtsam.Pose3(gtsam.Rot3(), -self.centre).compose(X))
                places.append(X.compose(self.truth[a]).transformTo(self.centre))
            alike.append(views(np.array(places)))
        sigma_m = next(iter(self.scenario.lidars.values())).range_sigma_m
        observation = TargetObservation(0, TARGET, self.centre, tuple(observed))
        return Clouds(
            stack_clouds(observation, max_points, sigma_m, normals=False),
            np.array(lidars),
            np.array(order),
            tuple(poses),
            np.concatenate(alike),
            sigma_m,
        )


@dataclass(frozen=True)
class Equation:
    """The estimating equation of the extrinsics at one place.

    Attributes:
        quadratic: of the clouds' poses.
        cells: `cell_moments`.
        who: responsibilities.
        noise: of the heights, in this E-step.
        J: (J, 6, 6 n) left perturbations of the clouds' poses by the extrinsics, vehicle axes.
        R: (J, 3, 3) of T_target_lidar.
        t: (J, 3) of it.
    """

    quadratic: ShapeQuadratic
    cells: Array
    who: Responsibilities
    noise: HeightNoise
    J: Array
    R: Array
    t: Array

    @property
    def score(self) -> Array:
        """(6 n,) gradient of what is minimised."""
        return np.asarray(np.einsum("jab,ja->b", self.J, self.quadratic.gradient))

    @property
    def sensitivity(self) -> Array:
        """(6 n, 6 n) A as coded."""
        rows = self.J.reshape(-1, self.J.shape[2])
        return np.asarray(rows.T @ self.quadratic.joint() @ rows)

    def scale(self, weights: Array) -> float:
        """Root mean square of the clouds' residuals, each by itself and given the shape.

        Args:
            weights: (J,) of the clouds, which one by itself does not have.
        """
        blocks, gradient = self.quadratic.blocks, self.quadratic.gradient_given_shape
        pulls = np.linalg.solve(blocks, gradient[..., None])[..., 0]
        squares = np.sum(pulls * gradient, axis=1) / weights
        return float(np.sqrt(squares.sum() / (gradient.size - self.J.shape[2])))


class Estimator:
    """EM with exact vehicle poses, as `calibration.refine` does it with a graph."""

    def __init__(self, clouds: Clouds, truth: Sequence[gtsam.Pose3], components: int) -> None:
        self.clouds, self.truth = clouds, truth
        self._components = components
        self._floor_end = FLOOR_PER_RANGE_SIGMA * clouds.sigma_range_m
        self._floor, self._by_beams_for = FINE_SIGMA_M, 0
        self._stack = clouds.stack
        self._depth_m = 1.0
        self._noise = self._configured = HeightNoise.configured(
            self._stack.lidars, clouds.sigma_range_m, self._floor
        )
        self._shared = np.full(self._stack.lidars, TYPICAL_SHARED)
        self._prior = np.diag(np.tile(PoseSigmaConfig().sigmas() ** -2.0, len(truth)))

    @property
    def weights(self) -> Array:
        """(J,) of the clouds, for what they share with others of the same view."""
        return weights_of_views(self.clouds.views, self._shared[self._stack.lidar])

    @property
    def prior(self) -> Array:
        """(6 n, 6 n) of the guesses: holds the height, which exact poses do not determine."""
        return self._prior

    def poses(self, T: Sequence[gtsam.Pose3]) -> tuple[Array, Array, Array]:
        """Poses of the clouds (J, 3, 3), (J, 3) and their derivatives (J, 6, 6 n)."""
        J = np.zeros((len(self.clouds.lidar), 6, 6 * len(T)))
        predicted = []
        for j, (a, X) in enumerate(
            zip(self.clouds.lidar.tolist(), self.clouds.T_target_vehicle, strict=True)
        ):
            Z = X.compose(T[a])
            predicted.append(Z)
            J[j, :, 6 * a : 6 * a + 6] = Z.AdjointMap() @ right_to_vehicle_axes(T[a]).T
        return (*stack(predicted), J)

    def begin(self, T: Sequence[gtsam.Pose3]) -> Mixture:
        """A new shape, with normals of the clouds as they lie now."""
        R, t, _ = self.poses(T)
        self._stack = merged_normals(self._stack, R, t)
        points = self._stack.moved(R, t)
        low, high = np.percentile(points, [1, 99], axis=0)
        self._depth_m = float(np.linalg.norm(np.maximum(high - low, 0.05)))
        self._floor, self._by_beams_for = FINE_SIGMA_M, 0
        distinct = float((self._stack.sizes / self.clouds.views).sum())
        return seed_mixture(
            self._stack, R, t, self._components, FINE_SIGMA_M, distinct, everywhere=True
        )

    @property
    def _settled(self) -> bool:
        """Whether tiles and noise stay, as in the joint loop."""
        return self._by_beams_for > TILES_SETTLE

    def at(self, T: Sequence[gtsam.Pose3], mixture: Mixture) -> Equation:
        """E-step; at the end of annealing the noise of the heights as well."""
        self._floor = max(self._floor * ANNEALING, self._floor_end)
        R, t, J = self.poses(T)
        density = GAMMA / (self._depth_m * (GAMMA + 1.0))
        noise = replace(self._noise, floor_m=self._floor)
        finest = self._floor <= self._floor_end
        self._by_beams_for += int(finest)
        who = expect(self._stack, R, t, mixture, noise, density, self.weights, by_beams=finest)
        cells = cell_moments(self._stack, who, len(mixture.weights))
        quadratic = shape_quadratic(self._stack, R, t, mixture, cells, who)
        if finest and not self._settled:
            taken_up = quadratic.shape_parameters()
            self._noise = noise.fitted(who.heights, taken_up, self._configured)
            self._shared = self._noise.shared_part(who.heights)
        return Equation(quadratic, cells, who, noise, J, R, t)

    def shape(self, T: Sequence[gtsam.Pose3], mixture: Mixture, equation: Equation) -> Mixture:
        """M-step of the shape."""
        R, t, _ = self.poses(T)
        sums = equation.cells, equation.who.counts, equation.quadratic.turns
        return maximise_shape(
            self._stack, R, t, mixture, self._floor, *sums, tiles_held=self._settled
        )

    def solve(self, T: list[gtsam.Pose3]) -> tuple[list[gtsam.Pose3], Mixture, Equation]:
        """Iterates from T."""
        mixture = self.begin(T)
        for _ in range(ITERATIONS):
            equation = self.at(T, mixture)
            pull = -equation.score - self._prior @ self.error(T)
            step = np.asarray(np.linalg.solve(equation.sensitivity + self._prior, pull), np.float64)
            T = [retract_vehicle_axes(p, d) for p, d in zip(T, step.reshape(-1, 6), strict=True)]
            mixture = self.shape(T, mixture, equation)
        return T, mixture, self.at(T, mixture)

    def error(self, T: Sequence[gtsam.Pose3]) -> Array:
        """(6 n,) vehicle axes."""
        pairs = zip(T, self.truth, strict=True)
        return np.concatenate([vehicle_axes_difference(a, b) for a, b in pairs])

    def scores(self, mixture: Mixture, equation: Equation) -> Array:
        """(J, 6 n) what each cloud adds to the score, place and normal of the surfels free.

        Raises:
            RegistrationError: they do not add up to it.
        """
        clouds, who, q = self._stack, equation.who, equation.quadratic
        K, J = len(mixture.weights), equation.J
        cloud, k = clouds.cloud[:, None], who.component
        y = clouds.moved(equation.R, equation.t)[:, None]
        beam = clouds.rotated(equation.R, clouds.beams)[:, None]
        n = mixture.normals_target[k]
        # As in the E-step: height above the surface, and how far along the beam that is.
        height = np.einsum("nkc,nkc->nk", n, y - mixture.means_target[k])
        facing = -np.einsum("nkc,nkc->nk", n, np.broadcast_to(beam, n.shape))
        slide = height * np.maximum(facing, 0.0) / np.maximum(facing, STEEP) ** 2
        reach_m = REACH_SIGMAS * equation.noise.largest_m()
        place = y + np.clip(slide, -reach_m, reach_m)[..., None] * beam
        carry = to_target(clouds, equation.R, equation.t)
        on_surface = np.matmul(equation.cells[..., SURFACE_MOMENTS], carry).sum(axis=0)
        mass, middle = mass_and_means(on_surface, mixture)
        force = (who.weight * height)[..., None] * n
        own = np.concatenate([np.cross(place, force), force], axis=2)
        by_pose = clouds.sum_per_cloud(own.sum(axis=1))
        # The priors of the normals turn with the clouds that have a part in them.
        normals = np.matmul(equation.cells[..., NORMALS], np.swapaxes(equation.R, 1, 2))
        size = np.maximum(np.linalg.norm(normals.sum(axis=0), axis=1), 1e-300)
        mean = normals.sum(axis=0) / size[:, None]
        part = np.einsum("jka,ka->jk", normals, mean) / size
        axis = np.cross(mixture.normals_target, mean)
        sine = np.linalg.norm(axis, axis=1)
        angle = np.arctan2(sine, np.einsum("ka,ka->k", mixture.normals_target, mean))
        known = size / mass / NORMAL_SIGMA_RAD**2
        of_prior = part[..., None] * (known * angle / np.maximum(sine, 1e-300))[:, None] * axis
        by_pose[:, :3] += of_prior.sum(axis=1)
        out = np.einsum("jab,ja->jb", J, by_pose)
        # What the clouds together move the place and the normal of each surfel by.
        of_places = np.einsum("jkc,cae,jeb->kab", q.moments[..., :4], JACOBIAN, J, optimize=True)
        of_turns = np.einsum("jkq,kqae,jeb->kab", q.moments, q.coupling, J, optimize=True)
        cell = (cloud * K + k).ravel()

        def per_cell(values: Array) -> Array:
            columns = [np.bincount(cell, v.ravel(), q.moments.shape[0] * K) for v in values]
            return np.stack(columns, axis=1, dtype=np.float64).reshape(-1, K, 3)

        pulls = per_cell(np.moveaxis(force, 2, 0)) / mass[:, None]
        turns = per_cell(np.moveaxis(np.cross(place - middle[k], force), 2, 0)) + of_prior
        turns = np.asarray(
            np.linalg.solve(q.orientation_information, turns[..., None])[..., 0], np.float64
        )
        out -= np.einsum("jka,kab->jb", pulls, of_places)
        out -= np.einsum("jka,kab->jb", turns, of_turns)
        scatter = np.sqrt(np.sum(out**2, axis=0))
        if (np.abs(out.sum(axis=0) - equation.score) > 1e-6 * scatter).any():
            raise RegistrationError("the clouds' scores do not add up to the gradient")
        return np.asarray(out)

    def variance_ratio(self, mixture: Mixture, equation: Equation) -> float:
        """Variance of the force of a cloud on a surfel over what A claims.

        One if heights are independent with the variance that they are taken to have.
        """
        clouds, who, K = self._stack, equation.who, len(mixture.weights)
        k = who.component
        n = mixture.normals_target[k]
        moments = np.matmul(equation.cells[..., MOMENTS], to_target(clouds, equation.R, equation.t))
        mass, means = mass_and_means(moments.sum(axis=0), mixture)
        r = clouds.moved(equation.R, equation.t)[:, None] - means[k]
        height = np.einsum("nkc,nkc->nk", n, r)
        cell = (clouds.cloud[:, None] * K + k).ravel()

        def summed(values: Array) -> Array:
            columns = np.bincount(cell, (who.weight * values).ravel(), len(moments) * K)
            return np.asarray(columns.reshape(-1, K), np.float64)

        own = summed(np.ones(k.shape))
        # The place of the surfel is free: a cloud that has it to itself exerts no force.
        left = own * (1.0 - own / mass)
        return float(np.sum(summed(height) ** 2) / np.sum(left))

    def profile_sensitivity(
        self, T: Sequence[gtsam.Pose3], mixture: Mixture, steps: Array
    ) -> Array:
        """(6 n, 6 n) derivative of the score, responsibilities and shape following.

        Args:
            T: the estimate.
            mixture: its shape.
            steps: (6 n,) how far to go along each axis.
        """
        out = np.zeros((len(steps), len(steps)))
        for i, size in enumerate(steps.tolist()):
            for sign in (1.0, -1.0):
                d = np.zeros((len(T), 6))
                d.reshape(-1)[i] = sign * size
                there = [retract_vehicle_axes(p, e) for p, e in zip(T, d, strict=True)]
                shape = mixture
                for _ in range(SHAPE_ROUNDS):
                    shape = self.shape(there, shape, self.at(there, shape))
                out[:, i] += sign * self.at(there, shape).score / (2.0 * size)
        return out


def reported(truth: Sequence[gtsam.Pose3]) -> tuple[tuple[str, ...], Array]:
    """Names and (m, 12) rows of what is looked at: S2S of the two LiDARs, and S2V of the second.

    The height to the vehicle is left out: without the ground, exact poses do not determine it.
    """
    arm = truth[0].translation() - truth[1].translation()
    pair = np.hstack([np.eye(6), -np.eye(6)])
    # When the second turns by w, what is fixed to it moves by w x arm at the origin of the first.
    pair[3:, 6:9] = skew(arm)
    vehicle = np.hstack([np.zeros((5, 6)), np.eye(6)[:5]])
    names = [f"S2S {axis}" for axis in AXES] + [f"S2V {axis}" for axis in AXES[:5]]
    return tuple(names), np.vstack([pair, vehicle])


def grouped(scores: Array, clouds: Clouds, size: int) -> Array:
    """Sums of scores of neighbouring clouds of a LiDAR; clouds of one place are one group."""
    sums: list[Array] = []
    for a in np.unique(clouds.lidar):
        own = np.flatnonzero(clouds.lidar == a)
        own = own[np.argsort(clouds.order[own], kind="stable")]
        places, place = np.unique(clouds.order[own], return_inverse=True)
        group = np.minimum(place // size, max(len(places) // size, 1) - 1)
        sums += [scores[own[group == number]].sum(axis=0) for number in np.unique(group)]
    return np.array(sums)


@dataclass(frozen=True)
class Run:
    """What came of one run: error, and covariances of all extrinsics."""

    error: Array
    claimed: Array
    scale: float
    sandwich: Array
    grouped: Array
    profile: Array | None
    ratio: float
    noise: HeightNoise


def run(scene: Scene, case: str, seed: int, options: argparse.Namespace) -> Run:
    """Draws, estimates, and works out what is claimed."""
    clouds = scene.draw(case, seed, options.points)
    estimator = Estimator(clouds, scene.truth, options.components)
    rng = np.random.default_rng([seed, 99])
    start = [retract_vehicle_axes(T, START_SIGMAS * rng.standard_normal(6)) for T in scene.truth]
    T, mixture, equation = estimator.solve(start)
    claimed = np.asarray(np.linalg.inv(equation.sensitivity + estimator.prior), np.float64)
    scores = estimator.scores(mixture, equation)
    groups = grouped(scores, clouds, GROUP)

    def sandwiched(bread: Array, pushes: Array) -> Array:
        # Scores of the clusters add up to (nearly) zero: one degree of freedom less.
        B = pushes.T @ pushes * len(pushes) / (len(pushes) - 1)
        return np.asarray(bread @ B @ bread.T)

    profile = None
    if seed == 0:
        steps = 0.5 * np.minimum(np.sqrt(np.diag(claimed)), np.tile(START_SIGMAS, 2))
        sensitivity = estimator.profile_sensitivity(T, mixture, steps) + estimator.prior
        profile = sandwiched(np.asarray(np.linalg.inv(sensitivity), np.float64), scores)
    return Run(
        estimator.error(T),
        claimed,
        equation.scale(estimator.weights),
        sandwiched(claimed, scores),
        sandwiched(claimed, groups),
        profile,
        estimator.variance_ratio(mixture, equation),
        equation.noise,
    )


def table(case: str, runs: Sequence[Run], names: Sequence[str], rows: Array) -> Iterator[str]:
    """The lines of a table."""
    errors = np.array([rows @ r.error for r in runs])
    scale = float(np.sqrt(np.mean([r.scale**2 for r in runs])))

    def sigma(covariances: Sequence[Array]) -> Array:
        each = [np.diag(rows @ cov @ rows.T) for cov in covariances]
        return np.asarray(np.sqrt(np.mean(each, axis=0)))

    claimed = sigma([r.claimed for r in runs])
    columns = {
        "mean": errors.mean(axis=0),
        "scatter": errors.std(axis=0, ddof=1),
        "A^-1": claimed,
        "scaled": scale * claimed,
        "sandwich": sigma([r.sandwich for r in runs]),
        "groups": sigma([r.grouped for r in runs]),
        "profile": sigma([r.profile for r in runs if r.profile is not None]),
    }
    yield f"{case}: {len(runs)} runs, scale {scale:.2f}"
    yield f"{'mrad, mm':12s}" + "".join(f"{name:>10s}" for name in columns)
    for i, name in enumerate(names):
        yield f"{name:12s}" + "".join(f"{1e3 * column[i]:10.3f}" for column in columns.values())
    scatter = columns["scatter"]
    for name in ("A^-1", "scaled", "sandwich", "groups", "profile"):
        ratio = np.exp(np.mean(np.log(scatter / columns[name])))
        yield f"scatter over {name}: {ratio:.2f} (geometric mean of the axes)"
    ratio = np.mean([r.ratio for r in runs])
    yield f"variance of a cloud's force on a surfel: {ratio:.2f} of A"
    for part in ("range", "roughness"):
        sigma_mm = 1e3 * np.mean([np.sqrt(getattr(r.noise, f"{part}_m2")) for r in runs], axis=0)
        yield f"{part} sigma of each LiDAR, mm: " + " ".join(f"{s:.2f}" for s in sigma_mm)


def main() -> int:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", type=Path, default=None, help="default: figure_eight.yaml")
    parser.add_argument("--runs", type=positive, default=24, help="of each case (24)")
    parser.add_argument("--clouds", type=positive, default=30, help="of each LiDAR (30)")
    parser.add_argument("--points", type=positive, default=400, help="of a cloud at most (400)")
    parser.add_argument("--components", type=positive, default=500, help="at most (500)")
    parser.add_argument("--case", choices=CASES, action="append", help="default: all")
    parser.add_argument("--out", type=Path, help="JSON file of errors and sigmas")
    options = parser.parse_args()
    path = options.scenario or REPOSITORY / "configs" / "scenarios" / "figure_eight.yaml"
    scene = Scene(load_scenario(path), options.clouds)
    names, rows = reported(scene.truth)
    kept: dict[str, list[dict[str, object]]] = {}
    for case in options.case or CASES:
        begun = time.perf_counter()
        runs = [run(scene, case, seed, options) for seed in range(options.runs)]
        print("\n".join(table(case, runs, names, rows)))
        print(f"{time.perf_counter() - begun:.0f} s\n", flush=True)
        kept[case] = [
            {"error": (rows @ r.error).tolist(), "claimed": (rows @ r.claimed @ rows.T).tolist()}
            for r in runs
        ]
    if options.out:
        options.out.write_text(json.dumps({"names": names, "cases": kept}), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
