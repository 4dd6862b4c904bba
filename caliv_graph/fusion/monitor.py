"""Has a mount moved? A sequential test that runs beside a localiser.

A localiser predicts each scan from its pose estimate and the calibrated extrinsic. The innovation
is the difference between the scan's registration and this prediction. If nothing has moved, the
innovations of a consistent estimator are white with the stated covariance (Kailath 1968). After a
knock, those of one LiDAR have a common mean. The test is the generalised likelihood ratio of a step
of unknown size and time (Willsky and Jones, 1976). Over the last n innovations of a LiDAR it is a
chi-square with six degrees of freedom, for any n.
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
"""Numbers of scans of a LiDAR that are tested together. Long windows detect small movements. The
window that begins at the knock has the largest chi-square, so it estimates time and size of the
knock. One registration may fail, so no window has a single scan, and a window alarms only if it
would alarm without any one of its scans."""

SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True)
class Innovation:
    """Innovation of a registered scan, as a movement of its LiDAR's extrinsic.

    Attributes:
        movement: (6,) right perturbation d of the extrinsic, `T_vehicle_lidar Exp(d)`, that would
            explain the scan: rotation (rad), then translation (m), lidar axes.
        cov: (6, 6) its covariance, from predicted pose, extrinsic and registration.
    """

    movement: Array
    cov: Array

    @property
    def chi2(self) -> float:
        """Squared Mahalanobis length; six degrees of freedom if nothing has moved."""
        return float(self.movement @ np.linalg.solve(self.cov, self.movement))


@dataclass(frozen=True)
class MountAlarm:
    """A mount that has moved.

    Attributes:
        lidar: its name.
        stamp_ns: stamp of the scan that raised the alarm.
        movement: (6,) estimate of the movement, vehicle axes at the LiDAR: rotation (rad), then
            translation (m).
        sigma: (6,) its standard deviation for fully correlated scans, an upper bound. Scans that
            the estimator leaves out share the error of the extrinsic they are compared with.
        scans: number of scans of the LiDAR that it is estimated from.
        chi2: chi-square of these scans, six degrees of freedom.
        alone: whether the other LiDARs agree with the prediction. If none does, an error of the
            vehicle's pose is more likely than a movement of all mounts.
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
        cov_predicted: (12, 12) joint covariance of both, right perturbations, in this order.
        T_map_lidar: the registered pose.
        cov_registration: (6, 6) its covariance, right perturbation.
    """
    # If the extrinsic has moved by d, the scan registers at Z = X M Exp(d), so r = -d.
    r, by_vehicle, by_extrinsic = lidar_pose_error(T_map_vehicle, T_vehicle_lidar, T_map_lidar)
    J = np.hstack([by_vehicle, by_extrinsic])
    cov = J @ cov_predicted @ J.T + cov_registration
    return Innovation(-r, 0.5 * (cov + cov.T))


def alarm_threshold(scans_per_hour: float, false_alarms_per_hour: float) -> float:
    """Chi-square above which a test alarms.

    Every scan is tested over each of `WINDOWS`. These tests are dependent. By Boole's inequality,
    the expected number of alarms is at most the sum of all their p-values.

    Args:
        scans_per_hour: registered scans of all LiDARs together.
        false_alarms_per_hour: upper bound of the expected rate if nothing moves.

    Raises:
        ValueError: a rate is not above zero.
    """
    if not (scans_per_hour > 0.0 and false_alarms_per_hour > 0.0):
        raise ValueError("alarm_threshold: both rates have to be above zero")
    p_value = min(1.0, false_alarms_per_hour / (scans_per_hour * len(WINDOWS)))
    return float(chdtri(DOF, p_value))


class MountMonitor:
    """Watches the innovations of the scans of a localiser.

    The innovations must come from a consistent estimator. An estimator with constant extrinsics is
    not consistent: carry them as variables (`priors.prior_factors`). The estimator must leave out
    the scans for which `suspicious` is true, otherwise they bias its pose.

    Attributes:
        threshold: chi-square above which it alarms.
    """

    def __init__(
        self,
        T_vehicle_lidar: Mapping[str, gtsam.Pose3],
        scans_per_s: float,
        false_alarms_per_hour: float = 0.1,
    ) -> None:
        """Starts without any innovation.

        Args:
            T_vehicle_lidar: calibrated extrinsic per LiDAR.
            scans_per_s: registered scans per second of all LiDARs together.
            false_alarms_per_hour: upper bound of the expected rate if nothing moves.

        Raises:
            ValueError: a rate is not above zero, or there is no LiDAR.
        """
        if not T_vehicle_lidar:
            raise ValueError("MountMonitor: needs at least one LiDAR")
        self.threshold = alarm_threshold(scans_per_s * SECONDS_PER_HOUR, false_alarms_per_hour)
        self._extrinsics = dict(T_vehicle_lidar)
        self._recent: dict[str, deque[tuple[Array, Array]]] = {
            name: deque(maxlen=WINDOWS[-1]) for name in T_vehicle_lidar
        }
        self._last_ns: dict[str, int] = {}

    def suspicious(self, innovation: Innovation) -> bool:
        """Whether the estimator should leave out this scan."""
        return innovation.chi2 > self.threshold

    def add(self, lidar: str, stamp_ns: int, innovation: Innovation) -> MountAlarm | None:
        """Adds the innovation of one scan.

        Args:
            lidar: name of the LiDAR.
            stamp_ns: stamp of the scan.
            innovation: innovation of the scan.

        Returns:
            An alarm as long as the LiDAR's last scans exceed the threshold; else None.

        Raises:
            ValueError: the LiDAR is unknown, its stamps do not increase, or the innovation is not
                finite or its covariance not positive definite.
        """
        self._check(lidar, stamp_ns, innovation)
        self._last_ns[lidar] = stamp_ns
        recent = self._recent[lidar]
        certainty: Array = np.asarray(np.linalg.inv(innovation.cov), dtype=np.float64)
        recent.append((certainty, certainty @ innovation.movement))
        found = _most_significant(tuple(recent), self.threshold)
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
                _most_significant(tuple(others), self.threshold) is None
                for name, others in self._recent.items()
                if name != lidar
            ),
        )

    def reset(self, lidar: str, T_vehicle_lidar: gtsam.Pose3) -> None:
        """Drops the innovations of a LiDAR and sets its new extrinsic.

        Raises:
            ValueError: the LiDAR is unknown.
        """
        if lidar not in self._extrinsics:
            raise ValueError(self._unknown(lidar))
        self._extrinsics[lidar] = T_vehicle_lidar
        self._recent[lidar].clear()

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


def _most_significant(
    recent: Sequence[tuple[Array, Array]], threshold: float
) -> tuple[float, int, Array, Array] | None:
    """The window with the largest chi-square of a common movement.

    Args:
        recent: (6, 6) information and (6,) gradient per scan, the last scan last.
        threshold: chi-square that a window must exceed, also without any one of its scans.

    Returns:
        Its chi-square and length, the movement (6,) and its covariance (6, 6), lidar axes; None if
        no window exceeds the threshold.
    """
    lengths = [scans for scans in WINDOWS if scans <= len(recent)]
    if not lengths:
        return None
    sums = [np.cumsum(of, axis=0) for of in zip(*reversed(recent), strict=True)]
    informations, pulls = (of[np.array(lengths) - 1] for of in sums)
    # All windows at once: such a small system takes less time than a call.
    means = np.linalg.solve(informations, pulls[..., None])[..., 0]
    best: tuple[float, int, Array, Array] | None = None
    for scans, information, pull, mean in zip(lengths, informations, pulls, means, strict=True):
        chi2 = float(pull @ mean)
        if chi2 <= threshold or (best is not None and chi2 <= best[0]):
            continue
        if _without_any_one(recent[-scans:], information, pull) > threshold:
            best = chi2, scans, mean, np.asarray(np.linalg.inv(information), dtype=np.float64)
    return best


def _without_any_one(
    recent: Sequence[tuple[Array, Array]], information: Array, pull: Array
) -> float:
    """The smallest chi-square of a window without one of its scans."""
    rest = information - np.array([certainty for certainty, _ in recent])
    pulls = pull - np.array([gradient for _, gradient in recent])
    means = np.linalg.solve(rest, pulls[..., None])[..., 0]
    return float(np.einsum("ni,ni->n", pulls, means).min())
