"""A calibration as native GTSAM factors, for localisers that carry the extrinsics as variables."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from caliv_graph.errors import ExportError
from caliv_graph.products import Array, Calibration
from caliv_graph.trajectory.factors import marginal_factor

ExtrinsicKey = Callable[[str], int]
"""Function from the name of a LiDAR to the key of its variable `T_vehicle_lidar`."""

DEFAULT_LETTER = "m"
"""Default letter of the keys. LIO-SAM and GLIM use X, V, B, G, E and Y."""

_LEAST_EIGENVALUE = 1e-10
"""Lower bound of the eigenvalues of a covariance scaled to a unit diagonal: files keep twelve
digits, so smaller eigenvalues are rounding errors."""


def lettered_keys(calibration: Calibration, letter: str = DEFAULT_LETTER) -> ExtrinsicKey:
    """Keys `letter` 0, 1, ... in the order of the calibration's LiDARs.

    Args:
        calibration: the calibration.
        letter: one character.

    Raises:
        ExportError: it is not one ASCII letter, as GTSAM's symbols need.
    """
    if not (len(letter) == 1 and letter.isascii() and letter.isalpha()):
        raise ExportError(f"letter {letter!r}: expected one letter, a to z or A to Z")
    names = list(calibration.lidars)
    return lambda name: int(gtsam.symbol(letter, names.index(name)))


def prior_factors(
    calibration: Calibration,
    key: ExtrinsicKey,
    joint: bool = True,
    lidars: Sequence[str] | None = None,
) -> gtsam.NonlinearFactorGraph:
    """The calibrated extrinsics as priors on variables of a localiser's graph.

    All factors are native and can be serialised. Along undetermined directions they hold the
    initial guess with its sigma, as the calibration's covariance does.

    Args:
        calibration: the result.
        key: key of the variable `T_vehicle_lidar` of each LiDAR.
        joint: one `LinearContainerFactor` over all extrinsics, which keeps their correlation: the
            relative pose of two LiDARs is known better than each pose. It is a quadratic about the
            calibrated extrinsics, valid for movements of some degrees. Else one
            `PriorFactorPose3` each, without the correlation.
        lidars: LiDARs to include; absent: all.

    Raises:
        ExportError: a LiDAR is unknown, keys collide, or a sigma is zero.
    """
    names = list(calibration.lidars) if lidars is None else list(lidars)
    unknown = [name for name in names if name not in calibration.lidars]
    if unknown or not names:
        raise ExportError(
            f"lidar {', '.join(map(repr, unknown)) or '(none)'}: is not in the calibration. "
            f"Name some of {', '.join(calibration.lidars)}"
        )
    keys = [key(name) for name in names]
    if len(set(keys)) < len(keys):
        raise ExportError(
            f"keys of {', '.join(names)} are not different: give each LiDAR its own variable"
        )
    order = list(calibration.lidars)
    rows = [6 * order.index(name) + axis for name in names for axis in range(6)]
    cov = calibration.cov_joint[np.ix_(rows, rows)]
    poses = tuple(calibration.lidars[name].T_vehicle_lidar for name in names)
    graph = gtsam.NonlinearFactorGraph()
    if joint:
        graph.add(marginal_factor(keys, _information(cov), poses))
        return graph
    for i, (number, pose) in enumerate(zip(keys, poses, strict=True)):
        block = cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        noise = gtsam.noiseModel.Gaussian.Information(_information(block))
        graph.add(gtsam.PriorFactorPose3(number, pose, noise))
    return graph


def extrinsic_values(calibration: Calibration, key: ExtrinsicKey) -> gtsam.Values:
    """The calibrated extrinsics as values of the variables of `prior_factors`."""
    values = gtsam.Values()
    for name, lidar in calibration.lidars.items():
        values.insert(key(name), lidar.T_vehicle_lidar)
    return values


def _information(cov: Array) -> Array:
    """Inverse of a covariance whose entries differ by orders of magnitude."""
    sigma = np.sqrt(np.diag(cov))
    if not np.all(sigma > 0.0):
        raise ExportError(
            "joint.covariance: has a sigma of zero, so its information is infinite. Calibrate "
            "without lidars.<name>.fixed, or hold the variable constant"
        )
    values, vectors = np.linalg.eigh(cov / np.outer(sigma, sigma))
    half = vectors / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE)) / sigma[:, None]
    return np.asarray(half @ half.T)
