"""Residuals by kind of measurement, and the down-weighted clouds with the reason."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.calibration.kernels import KERNELS
from caliv_graph.calibration.robust import explained_part
from caliv_graph.config.model import RobustConfig
from caliv_graph.products import Array, IntArray, Solution
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

NOTABLE_WEIGHT = 0.9
"""Clouds with a lower weight are listed."""

_MRAD, _MM, _MM_S = ("mrad", 1e3), ("mm", 1e3), ("mm/s", 1e3)

_SOLUTION_KINDS = {
    "given_pose": (
        "given poses, white error",
        {"rotation": (_MRAD, 0, 3), "position": (_MM, 3, 6)},
    ),
    "pose_error_step": (
        "given poses, change of the Gauss-Markov error",
        {"rotation": (_MRAD, 0, 3), "position": (_MM, 3, 6)},
    ),
    "ground_plane": (
        "ground, as the LiDARs see it",
        {"tilt": (_MRAD, 0, 2), "distance": (_MM, 2, 3)},
    ),
    "standing": ("ground, height of the vehicle above it", {"height": (_MM, 0, 1)}),
    "parallel": ("ground, vehicle parallel to it", {"tilt": (_MRAD, 0, 2)}),
}
"""Per kind of factor, its name and the parts of its residual."""

_TRAJECTORY_KINDS = {
    "gnss": ("GNSS fixes", {"position": (_MM, 0, 3)}),
    "orientation": ("orientation", {"rotation": (_MRAD, 0, 3)}),
    "velocity": ("velocity", {"velocity": (_MM_S, 0, 3)}),
    "imu": (
        "IMU, preintegrated between nodes",
        {"rotation": (_MRAD, 0, 3), "position": (_MM, 3, 6), "velocity": (_MM_S, 6, 9)},
    ),
}


@dataclass(frozen=True)
class Residuals:
    """Residuals of one kind of measurement at the estimate.

    Attributes:
        kind: what was measured.
        whitened: (n, k), divided by the assumed noise. N(0, 1) if that noise is right and the fit
            has few parameters; narrower with more parameters.
        physical: quantity -> (unit, (m,) values in it).
    """

    kind: str
    whitened: Array
    physical: Mapping[str, tuple[str, Array]]

    @property
    def rms(self) -> float:
        """Root mean square of the whitened residuals."""
        return float(np.sqrt(np.mean(self.whitened**2)))

    @property
    def beyond_three(self) -> float:
        """Part of the whitened residuals beyond three sigma; 0.0027 of a normal distribution."""
        return float(np.mean(np.abs(self.whitened) > 3.0))


@dataclass(frozen=True)
class CloudVerdict:
    """A down-weighted cloud of a target.

    Attributes:
        weight: robust weight: 1 is full weight, 0 is dropped.
        rotation_rad: norm of the rotation residual.
        position_m: norm of the position residual, at the target.
        reason: why the weight is low, as text.
    """

    lidar: str
    target: str
    drive: int
    stamp_ns: int
    source: str
    weight: float
    rotation_rad: float
    position_m: float
    reason: str


def solution_residuals(solution: Solution) -> tuple[Residuals, ...]:
    """Residuals of the calibration's graph, by kind: clouds, given poses, ground.

    Dropped clouds are left out. The residuals of down-weighted clouds do not include the weight.
    """
    found: dict[str, list[gtsam.NonlinearFactor]] = defaultdict(list)
    for index, kind in enumerate(solution.factor_kinds):
        if kind in _SOLUTION_KINDS:
            found[kind].append(solution.graph.at(index))
    out = [_of_clouds(solution)]
    out += [
        _of_factors(*_SOLUTION_KINDS[kind], found[kind], solution.values)
        for kind in _SOLUTION_KINDS
        if kind in found
    ]
    return tuple(r for r in out if len(r.whitened))


def trajectory_residuals(trajectory: SmoothedTrajectory) -> tuple[Residuals, ...]:
    """Residuals of a smoothed trajectory, by sensor, without dropped GNSS fixes."""
    found: dict[str, list[gtsam.NonlinearFactor]] = defaultdict(list)
    estimate = trajectory.estimate()
    for index, kind in enumerate(estimate.graph.kinds):
        found[kind].append(estimate.graph.factors.at(index))
    return tuple(
        _of_factors(*_TRAJECTORY_KINDS[kind], found[kind], estimate.values)
        for kind in _TRAJECTORY_KINDS
        if kind in found
    )


def all_residuals(solution: Solution, record: RunRecord) -> tuple[Residuals, ...]:
    """Residuals of the calibration's graph and of every smoothed trajectory, by kind."""
    out = list(solution_residuals(solution))
    for name, trajectory in zip(record.drives, record.trajectories, strict=True):
        if isinstance(trajectory, SmoothedTrajectory):
            for r in trajectory_residuals(trajectory):
                kind = f"{r.kind} (recording '{name}')" if len(record.drives) > 1 else r.kind
                out.append(replace(r, kind=kind))
    return tuple(out)


def gnss_residuals(trajectory: SmoothedTrajectory) -> tuple[IntArray, Array]:
    """Stamps (k,) of the nodes with GNSS fixes, and residuals (k, 3) in metres, map axes."""
    nodes, residuals = [], []
    estimate = trajectory.estimate(frozenset({"gnss"}))
    for index, kind in enumerate(estimate.graph.kinds):
        if kind == "gnss":
            factor = estimate.graph.factors.at(index)
            nodes.append(gtsam.symbolIndex(factor.keys()[0]))
            residuals.append(_errors(factor, estimate.values)[1])
    stamps = trajectory.nodes_ns[np.array(nodes, dtype=np.int64)]
    return stamps, np.array(residuals).reshape(-1, 3)


def cloud_residuals(solution: Solution, placement: int) -> Array:
    """(J, 6) residuals of a placement's clouds, not whitened; rad and m, target frame."""
    information = solution.registrations[placement].information
    root = np.linalg.cholesky(information / solution.registration_scale**2)
    white = solution.residuals[placement]
    return np.asarray(np.linalg.solve(np.swapaxes(root, 1, 2), white[..., None])[..., 0])


def down_weighted(solution: Solution, robust: RobustConfig) -> tuple[CloudVerdict, ...]:
    """The clouds with a weight below `NOTABLE_WEIGHT`, lowest weight first."""
    out = []
    kernel = KERNELS[robust.kernel](robust)
    for m, registration in enumerate(solution.registrations):
        r = cloud_residuals(solution, m)
        ratio = registration.inlier_ratio
        explained = explained_part(ratio) if kernel.drops else np.ones(len(r))
        typical = float(np.median(ratio))
        for j, cloud in enumerate(registration.observation.clouds):
            weight = float(solution.cloud_weights[m][j])
            if weight >= NOTABLE_WEIGHT:
                continue
            reasons = []
            if explained[j] < 1.0:
                reasons.append(
                    f"only {ratio[j]:.0%} of its points lie on the target "
                    f"(median of all clouds: {typical:.0%})"
                )
            by_residual = weight / max(float(explained[j]), 1e-9)
            if by_residual <= 0.99:
                reasons.append(kernel.reason(by_residual))
            out.append(
                CloudVerdict(
                    cloud.lidar,
                    registration.observation.name,
                    cloud.drive,
                    cloud.stamp_ns,
                    cloud.source,
                    weight,
                    float(np.linalg.norm(r[j, :3])),
                    float(np.linalg.norm(r[j, 3:])),
                    "; ".join(reasons),
                )
            )
    return tuple(sorted(out, key=lambda cloud: cloud.weight))


def _of_clouds(solution: Solution) -> Residuals:
    white, physical = [np.zeros((0, 6))], [np.zeros((0, 6))]
    for m, weights in enumerate(solution.cloud_weights):
        used = weights > 0.01
        white.append(solution.residuals[m][used])
        physical.append(cloud_residuals(solution, m)[used])
    r = np.concatenate(physical)
    return Residuals(
        "target clouds, pose of each",
        np.concatenate(white),
        {"rotation": ("mrad", 1e3 * r[:, :3].ravel()), "position": ("mm", 1e3 * r[:, 3:].ravel())},
    )


def _of_factors(
    kind: str,
    parts: Mapping[str, tuple[tuple[str, float], int, int]],
    factors: Sequence[gtsam.NonlinearFactor],
    values: gtsam.Values,
) -> Residuals:
    pairs = [_errors(factor, values) for factor in factors]
    white, raw = (np.array(errors) for errors in zip(*pairs, strict=True))
    return Residuals(
        kind,
        white,
        {
            name: (unit, scale * raw[:, first:last].ravel())
            for name, ((unit, scale), first, last) in parts.items()
        },
    )


def _errors(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> tuple[Array, Array]:
    """Residual of a factor, whitened and not whitened."""
    if isinstance(factor, gtsam.NoiseModelFactor):
        return factor.whitenedError(values), factor.unwhitenedError(values)
    # A linear factor has no error function; its residual is minus the right-hand side.
    linear = factor.linearize(values)
    assert isinstance(linear, gtsam.JacobianFactor)
    return -linear.jacobian()[1], -linear.jacobianUnweighted()[1]
