"""Is a LiDAR still mounted where it was? A sequential test that runs beside a localiser.

A localiser predicts each scan: the pose by everything else that it knows, the mounting by the
calibration. What the scan's registration says beyond that is its innovation. As long as nothing has
moved, the innovations of a consistent estimator are white, with the covariance that it states
(Kailath 1968). After a knock, those of one LiDAR have a common mean. The test is the generalised
likelihood ratio of a step of unknown size and time (Willsky and Jones, 1976): over the last n
innovations of a LiDAR it is a chi-square of six degrees of freedom, whatever n is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import chdtri

from caliv_graph.fusion.factors import lidar_pose_error
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array

DOF = 6

WINDOWS = range(2, 33)
"""Scans of a LiDAR that are tested together. Long ones find what is too small to be seen in a few,
and of all the one that begins at the knock is the loudest, which tells when it was and how far.
There is none of one scan, and none alarms that would not without any one of its scans: a
registration may fail once."""

SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True)
class Innovation:
    """What a registered scan says of its LiDAR's mounting, beyond what was predicted.

    Attributes:
        movement: (6,) right perturbation d of the mounting, `T_vehicle_lidar Exp(d)`, that would
            explain the scan: rotation (rad), then translation (m), lidar axes.
        cov: (6, 6) of it: of the predicted pose, the mounting and the registration together.
    """

    movement: Array
    cov: Array

    @property
    def chi2(self) -> float:
        """Squared length in sigmas; six degrees of freedom if nothing has moved."""
        return float(self.movement @ np.linalg.solve(self.cov, self.movement))


@dataclass(frozen=True)
class MountAlarm:
    """A mount that is no longer where it was.

    Attributes:
        lidar: its name.
        stamp_ns: of the scan that told.
        movement: (6,) estimate of the movement, vehicle axes at the LiDAR: rotation (rad), then
            translation (m).
        sigma: (6,) of it, if these scans all err alike: those that the estimator does without share
            the error of the mounting that they are held against. Never too small.
        scans: how many scans of the LiDAR it is taken from.
        chi2: of these, six degrees of freedom.
        alone: whether the other LiDARs agree with the prediction. If none does, the vehicle's pose
            is more likely wrong than all mounts at once.
    """

    lidar: str
    stamp_ns: int
    movement: Array
    sigma: Array
    scans: int
    chi2: float
    alone: bool


def extrinsic_innovation(
    T_map_vehicle: gtsam.Pose3,
    T_vehicle_lidar: gtsam.Pose3,
    cov_predicted: Array,
    T_map_lidar: gtsam.Pose3,
    cov_registration: Array,
) -> Innovation:
    """The innovation of a scan that was registered to a map.

    Args:
        T_map_vehicle: predicted without the scan.
        T_vehicle_lidar: predicted without the scan.
        cov_predicted: (12, 12) of both together, right perturbations, in this order.
        T_map_lidar: as registered.
        cov_registration: (6, 6) of it, right perturbation.
    """
    # A mounting that is off by d lets the scan register at Z = X M Exp(d): r = -d.
    r, by_vehicle, by_extrinsic = lidar_pose_error(T_map_vehicle, T_vehicle_lidar, T_map_lidar)
    J = np.hstack([by_vehicle, by_extrinsic])
    cov = J @ cov_predicted @ J.T + cov_registration
    return Innovation(-r, 0.5 * (cov + cov.T))


def alarm_threshold(scans_per_hour: float, false_alarms_per_hour: float) -> float:
    """Chi-square above which a test alarms.

    Every scan is tested over each of `WINDOWS`. These tests are not independent of one another, but
    by Boole's inequality the alarms to be expected are at most the sum of all their p-values.

    Args:
        scans_per_hour: registered scans of all LiDARs together.
        false_alarms_per_hour: to be expected at most, if nothing moves.

    Raises:
        ValueError: a rate is not above zero.
    """
    if not (scans_per_hour > 0.0 and false_alarms_per_hour > 0.0):
        raise ValueError("alarm_threshold: both rates have to be above zero")
    p_value = min(1.0, false_alarms_per_hour / (scans_per_hour * len(WINDOWS)))
    return float(chdtri(DOF, p_value))


class MountMonitor:
    """Watches the innovations of the scans of a localiser.

    The innovations must come from a consistent estimator. One that holds the calibrated extrinsics
    constant is not: carry them as variables (`priors.prior_factors`). Leave the scans that
    `suspicious` rejects out of that estimator, or it bends the pose until they fit.

    Attributes:
        threshold: chi-square above which it alarms.
    """

    def __init__(
        self,
        T_vehicle_lidar: Mapping[str, gtsam.Pose3],
        scans_per_s: float,
        false_alarms_per_hour: float = 0.1,
    ) -> None:
        """Starts with nothing heard.

        Args:
            T_vehicle_lidar: calibrated mounting per LiDAR.
            scans_per_s: registered scans per second of all LiDARs together.
            false_alarms_per_hour: to be expected at most, if nothing moves.

        Raises:
            ValueError: a rate is not above zero, or there is no LiDAR.
        """
        if not T_vehicle_lidar:
            raise ValueError("MountMonitor: needs at least one LiDAR")
        self.threshold = alarm_threshold(scans_per_s * SECONDS_PER_HOUR, false_alarms_per_hour)
        self._extrinsics = dict(T_vehicle_lidar)
        self._heard: dict[str, deque[tuple[Array, Array]]] = {
            name: deque(maxlen=WINDOWS[-1]) for name in T_vehicle_lidar
        }
        self._last_ns: dict[str, int] = {}

    def suspicious(self, innovation: Innovation) -> bool:
        """Whether one scan is so far off that the estimator should do without it."""
        return innovation.chi2 > self.threshold

    def add(self, lidar: str, stamp_ns: int, innovation: Innovation) -> MountAlarm | None:
        """Hears of one more scan.

        Args:
            lidar: whose.
            stamp_ns: of the scan.
            innovation: of the scan.

        Returns:
            An alarm while the LiDAR's last scans call for one; None: nothing to be said.

        Raises:
            ValueError: the LiDAR is unknown, its stamps do not increase, or the innovation is not
                finite or its covariance not positive definite.
        """
        self._check(lidar, stamp_ns, innovation)
        self._last_ns[lidar] = stamp_ns
        heard = self._heard[lidar]
        certainty: Array = np.asarray(np.linalg.inv(innovation.cov), dtype=np.float64)
        heard.append((certainty, certainty @ innovation.movement))
        found = _loudest(tuple(heard), self.threshold)
        if found is None:
            return None
        chi2, scans, mean, cov = found
        axes = right_to_vehicle_axes(self._extrinsics[lidar])
        return MountAlarm(
            lidar=lidar,
            stamp_ns=stamp_ns,
            movement=axes @ mean,
            sigma=np.sqrt(scans * np.diag(axes @ cov @ axes.T)),
            scans=scans,
            chi2=chi2,
            alone=all(
                _loudest(tuple(others), self.threshold) is None
                for name, others in self._heard.items()
                if name != lidar
            ),
        )

    def reset(self, lidar: str, T_vehicle_lidar: gtsam.Pose3) -> None:
        """Forgets what it heard of a LiDAR, whose mounting is known anew.

        Raises:
            ValueError: the LiDAR is unknown.
        """
        if lidar not in self._extrinsics:
            raise ValueError(self._unknown(lidar))
        self._extrinsics[lidar] = T_vehicle_lidar
        self._heard[lidar].clear()

    def _unknown(self, lidar: str) -> str:
        return f"lidar '{lidar}': is not watched; those are {', '.join(self._extrinsics)}"

    def _check(self, lidar: str, stamp_ns: int, innovation: Innovation) -> None:
        if lidar not in self._extrinsics:
            raise ValueError(self._unknown(lidar))
        last_ns = self._last_ns.get(lidar)
        if last_ns is not None and stamp_ns <= last_ns:
            raise ValueError(f"lidar '{lidar}': stamps do not increase: {last_ns}, then {stamp_ns}")
        if not (np.isfinite(innovation.movement).all() and np.isfinite(innovation.cov).all()):
            raise ValueError(f"lidar '{lidar}' at {stamp_ns} ns: the innovation is not finite")
        if np.linalg.eigvalsh(innovation.cov)[0] <= 0.0:
            raise ValueError(
                f"lidar '{lidar}' at {stamp_ns} ns: the innovation's covariance is not positive "
                "definite"
            )


def _loudest(
    heard: Sequence[tuple[Array, Array]], threshold: float
) -> tuple[float, int, Array, Array] | None:
    """The window whose scans speak loudest of a common movement.

    Args:
        heard: (6, 6) information and (6,) gradient per scan, the last scan last.
        threshold: chi-square that a window has to exceed, even if one of its scans were missing.

    Returns:
        Its chi-square and length, the movement (6,) and its covariance (6, 6), lidar axes; None if
        none is loud enough.
    """
    best: tuple[float, int, Array, Array] | None = None
    information, pull = np.zeros((DOF, DOF)), np.zeros(DOF)
    for scans, (certainty, gradient) in enumerate(reversed(heard), start=1):
        information, pull = information + certainty, pull + gradient
        if scans not in WINDOWS:
            continue
        mean: Array = np.asarray(np.linalg.solve(information, pull), dtype=np.float64)
        chi2 = float(pull @ mean)
        if chi2 <= threshold or (best is not None and chi2 <= best[0]):
            continue
        if _without_any_one(heard[-scans:], information, pull) > threshold:
            best = chi2, scans, mean, np.asarray(np.linalg.inv(information), dtype=np.float64)
    return best


def _without_any_one(
    heard: Sequence[tuple[Array, Array]], information: Array, pull: Array
) -> float:
    """The smallest chi-square of a window if one of its scans is left out."""
    rest = information - np.array([certainty for certainty, _ in heard])
    pulls = pull - np.array([gradient for _, gradient in heard])
    means = np.linalg.solve(rest, pulls[..., None])[..., 0]
    return float(np.einsum("ni,ni->n", pulls, means).min())
