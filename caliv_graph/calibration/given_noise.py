"""Noise of given poses from what structure says of them, with a target and without.

Walls that wander as the poses do tell white and slow errors of these (`README.md`, "Noise levels").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg

from caliv_graph.calibration.noise import (
    KNOWN_PART,
    PoseResiduals,
    expected_noise,
    first_pose_noise,
)
from caliv_graph.calibration.problem import slow_stated
from caliv_graph.calibration.structure_evidence import ToldErrors
from caliv_graph.calibration.variance_components import Observed
from caliv_graph.calibration.vehicle_parameters import pose_clock_prior
from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray, PoseNoise
from caliv_graph.trajectory.noise import given_pose_covariances
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory, twists_at


def noise_by_structure(
    told: ToldErrors,
    stamps_ns: Mapping[int, IntArray],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
) -> PoseNoise:
    """White and slow errors of the given poses of all drives, where structure tells them.

    The arguments are those of `residuals_of_structure`.
    """
    walls = residuals_of_structure(told, stamps_ns, trajectories, config)
    if walls is None:
        return first_pose_noise(config.noise)
    stated = [_stated(trajectories[drive], stamps_ns[drive], config) for drive in told.of_drives]
    return expected_noise(
        [walls],
        config.noise,
        open_levels=(walls.unstated, True),
        of_messages=None if walls.unstated else np.concatenate(stated),
        slow_stated=slow_stated(trajectories),
    )


def residuals_of_structure(
    told: ToldErrors,
    stamps_ns: Mapping[int, IntArray],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
) -> PoseResiduals | None:
    """What structure says of the given poses of all drives; None: nothing.

    With information S and gradient h of a drive's structure on its poses, extrinsics and surfaces
    eliminated, `W = S^1/2` and the poses' errors e with effect B, `W^-1 h = W B e + n`, n white of
    unit variance: the noise of e is a sum of variance components of these residuals.

    Args:
        told: S and h of each drive, right perturbations of the given poses.
        stamps_ns: drive -> (k,) of these poses.
        trajectories: of all drives.
        config: what it states is kept.
    """
    if not told.of_drives:
        return None
    residuals, late, effects, known, times, stated = [], [], [], [], [], []
    for drive, (information, gradient) in told.of_drives.items():
        trajectory, stamps = trajectories[drive], stamps_ns[drive]
        assert isinstance(trajectory, GivenTrajectory)
        values, axes = np.linalg.eigh(information)
        seen = values > KNOWN_PART * values[-1]
        root = np.sqrt(values[seen])
        residuals.append(axes[:, seen].T @ gradient / root)
        white = root[:, None] * axes[:, seen].T
        late.append(white @ twists_at(trajectory, stamps.tolist()).ravel())
        # An error of the position is along the map's axes, a right perturbation along the pose's.
        effect = white.reshape(len(white), -1, 6).copy()
        R, _ = trajectory.poses_at(stamps)
        effect[..., 3:] = np.einsum("nki,kji->nkj", effect[..., 3:], R)
        effects.append(effect)
        of_message = _stated(trajectory, stamps, config)
        stated.append(of_message)
        known.append(np.eye(len(white)) + np.einsum("nki,kij,mkj->nm", effect, of_message, effect))
        times.append(1e-9 * (stamps - stamps[0]))
    clock = pose_clock_prior(config)
    ridge = 1.0 if clock is None else float(1.0 / clock.cov[0, 0])
    column = np.concatenate(late)[:, None] * (clock is not None)
    observed = Observed(
        np.concatenate(residuals), column, np.array([ridge]), scipy.linalg.block_diag(*known)
    )

    def of_drives(correlation: Sequence[Array]) -> tuple[Array, Array]:
        rotation, position = (
            scipy.linalg.block_diag(
                *(
                    np.einsum("nki,kl,mli->nm", e[..., part], corr, e[..., part], optimize=True)
                    for e, corr in zip(effects, correlation, strict=True)
                )
            )
            for part in (slice(0, 3), slice(3, 6))
        )
        return rotation, position

    def slow(time_s: float) -> tuple[Array, Array]:
        return of_drives([np.exp(-np.abs(t[:, None] - t) / time_s) for t in times])

    by_message = [of.any(axis=(1, 2)) for of in stated]
    white_parts = of_drives([np.diag(np.where(of, 0.0, 1.0)) for of in by_message])
    every = bool(np.concatenate(by_message).all())
    return PoseResiduals(observed, white_parts, slow, unstated=not every)


def _stated(trajectory: VehicleTrajectory, stamps_ns: IntArray, config: Config) -> Array:
    """(n, 6, 6) white errors that messages state for given poses; zero where none does."""
    assert isinstance(trajectory, GivenTrajectory)
    cov = given_pose_covariances(trajectory.error_covariances(stamps_ns), config)
    return np.zeros((len(stamps_ns), 6, 6)) if cov is None else np.nan_to_num(cov)
