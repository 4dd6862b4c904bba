"""The problem reduced to the extrinsics: all other variables eliminated, in vehicle axes."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.linear import (
    CloudLinearisation,
    DenseSystem,
    add_shape,
    cloud_rows,
    dense_system,
    retract,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_offset
from caliv_graph.products import Array, LinearisedGraph


@dataclass
class Reduced:
    """The linearised problem with everything but the extrinsics eliminated, in vehicle axes.

    Attributes:
        D: (6n, 6n) and
        c: (6n,) of the data's quadratic `e^T D e / 2 - c^T e` in a step e of the extrinsics.
        system: the linearised graph with the clouds' quadratic in it.
        clouds: (6 J, 6 J) and (6 J,) that quadratic, in left perturbations of the clouds' poses.
        lines: derivatives of these poses with respect to the variables.
    """

    D: Array
    c: Array
    system: DenseSystem
    clouds: tuple[Array, Array]
    lines: CloudLinearisation
    _to_axes: Array
    _G: Array
    _g: Array
    _values: gtsam.Values

    def time_offsets(self, problem: Problem, cov: Array) -> dict[str, tuple[float, float]]:
        """Time offset and its sigma, in seconds, of the LiDARs that have a free one.

        `cov` is (6n, 6n) of the extrinsics, vehicle axes.
        """
        out = {}
        for i, name in enumerate(problem.lidars):
            if name in problem.offsets:
                variance = self.covariance_of(key_offset(i), cov)[0, 0]
                value = float(self._values.atVector(key_offset(i))[0])
                out[name] = (value, float(np.sqrt(variance)))
        return out

    def covariance_of(self, key: int, cov: Array) -> Array:
        """Marginal covariance of a variable that is no extrinsic; `cov` as in `time_offsets`."""
        inverse = np.linalg.inv(self._to_axes)
        return self.system.covariance_of(key, inverse @ cov @ inverse.T)

    def information_knowing(self, key: int) -> Array:
        """(6n, 6n) as D, if a variable that is no extrinsic were known exactly."""
        system, at = self.system, self.system.keys.index(key)
        keep = np.ones(len(system.b), dtype=bool)
        keep[system.offset(key) : system.offset(key) + system.sizes[at]] = False
        known = DenseSystem(
            keys=system.keys[:at] + system.keys[at + 1 :],
            sizes=system.sizes[:at] + system.sizes[at + 1 :],
            H=system.H[np.ix_(keep, keep)],
            b=system.b[keep],
            extrinsics=system.extrinsics,
        )
        D, *_ = known.schur()
        inverse = np.linalg.inv(self._to_axes)
        D = inverse.T @ D @ inverse
        return np.asarray(0.5 * (D + D.T))

    def in_tangents(self, information: Array) -> Array:
        """(6n, 6n) information of the extrinsics, vehicle axes, in tangents of the graph's."""
        return np.asarray(self._to_axes.T @ information @ self._to_axes, np.float64)

    def step_with(self, prior: Array, offset: Array) -> Array:
        """The step (6n,) that data and guesses together call for.

        `prior` (6n, 6n) is the information of the guesses, `offset` (6n,) where the estimate is
        from them.
        """
        return np.asarray(np.linalg.solve(self.D + prior, self.c - prior @ offset), np.float64)

    def move(self, step: Array) -> gtsam.Values:
        """All values after a step (6n,) of the extrinsics, the rest following."""
        return retract(self._values, self.system.keys, self._tangents(step))

    def moved_clouds(self, step: Array) -> Array:
        """(6 J,) left perturbations of the clouds' poses by `move`, to first order."""
        return np.asarray(cloud_rows(self.system, self.lines) @ self._tangents(step))

    def _tangents(self, step: Array) -> Array:
        """(M,) of all variables after a step (6n,) of the extrinsics."""
        tangent = np.linalg.solve(self._to_axes, step)
        return np.concatenate([self._g - self._G @ tangent, tangent])

    def linearised(
        self,
        problem: Problem,
        poses: CalibrationGraph,
        sound_poses: CalibrationGraph | None = None,
    ) -> LinearisedGraph:
        """The same as numbers, with the guesses' information, for score tests.

        `poses` is the graph of the vehicle's poses alone (`graph.pose_graph`), `sound_poses` that
        with the noise of sound poses at most; None: the same.
        """
        H, gradient = self.clouds
        guesses = np.zeros_like(self.system.H)
        of_extrinsics = slice(len(guesses) - len(self._to_axes), None)
        guesses[of_extrinsics, of_extrinsics] = self.in_tangents(problem.guess_information())
        pose_information, pose_gradient = self._of_poses(problem, poses)
        sound = (pose_information, pose_gradient)
        if sound_poses is not None:
            sound = self._of_poses(problem, sound_poses)
        return LinearisedGraph(
            information=self.system.H,
            gradient=self.system.b,
            information_guesses=guesses,
            cloud_jacobian=cloud_rows(self.system, self.lines),
            cloud_information=H,
            cloud_gradient=gradient,
            by_vehicle=np.array([moves[1] for moves in self.lines.jacobians]).reshape(-1, 6, 6),
            by_extrinsic=np.array([moves[-1] for moves in self.lines.jacobians]).reshape(-1, 6, 6),
            starts=self.system.starts,
            pose_information=pose_information,
            pose_gradient=pose_gradient,
            sound_pose_information=sound[0],
            sound_pose_gradient=sound[1],
            to_vehicle_axes=self._to_axes,
        )

    def _of_poses(self, problem: Problem, poses: CalibrationGraph) -> tuple[Array, Array]:
        """(M, M) and (M,) of a graph without clouds, in the coordinates of the system."""
        alone = dense_system(problem, poses, self._values)
        where = self.system.coordinates(alone.keys)
        information, gradient = np.zeros_like(self.system.H), np.zeros_like(self.system.b)
        information[np.ix_(where, where)] = alone.H
        gradient[where] = alone.b
        return information, gradient


def reduce_to_extrinsics(
    problem: Problem,
    values: gtsam.Values,
    graph: CalibrationGraph,
    clouds: tuple[Array, Array],
    lines: CloudLinearisation,
) -> Reduced:
    """Linearises a graph and the clouds' quadratic, and eliminates all but the extrinsics.

    Args:
        problem: LiDARs, poses and clouds.
        values: where to linearise.
        graph: everything but the clouds and the guesses; it may be all.
        clouds: (6 J, 6 J) and (6 J,) their quadratic in left perturbations of their poses.
        lines: how these move with the variables.

    Raises:
        SolveError: a pose or a target has no measurement.
    """
    system = add_shape(dense_system(problem, graph, values), lines, *clouds)
    D, c, G, g = system.schur()
    Q = problem.to_vehicle_axes(values)
    inverse = np.linalg.inv(Q)
    D = inverse.T @ D @ inverse
    return Reduced(
        D=0.5 * (D + D.T),
        c=inverse.T @ c,
        system=system,
        clouds=clouds,
        lines=lines,
        _to_axes=Q,
        _G=G,
        _g=g,
        _values=values,
    )
