"""The IMU between any two instants: cleaned samples, dead reckoning, preintegrated factors.

Between two samples the readings are linear in time. A zero-order hold would lag by half a sample,
which in a turn is a heading error that no bias explains (`README.md`, section 2).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, ImuSamples, IntArray
from caliv_graph.readers.common_stamps import MERGE_NS
from caliv_graph.trajectory.noise import ImuNoise

GAP_S = 0.1
"""A longer time without a sample is a gap, unless three median periods are longer still."""

MAX_BRIDGE_S = 2.0
"""A longer gap splits the recording: at the noise below, position is off by 3 m after it."""

MIN_FORCE_M_S2, MAX_FORCE_M_S2 = 5.0, 15.0
"""Bounds of the median specific force, 9.8 m/s^2 at rest; in units of g it is 1, without gravity
near 0."""

# Deviation of the readings in a gap from the straight line between its ends, 1 sigma: steering and
# braking of a calibration drive.
BRIDGE_GYRO_RAD_S = 0.3
BRIDGE_FORCE_M_S2 = 1.5

BRIDGE_STEP_NS = 20_000_000
"""Integration step in a gap: 50 Hz, the slowest rate of a usual IMU."""

KEPT_QUESTIONS, KEPT_INSTANTS = 8, 3000
"""Of `DeadReckoning`: how many questions it keeps the answers of, of how many instants each at
most. They are 3 MB; longer drives have other costs."""

INTEGRATION_DENSITY_M = 1e-5
"""m/sqrt(s), noise of the position alone: 3 micrometres over 0.1 s. Without it GTSAM's covariance
of one step is singular."""


def exp_so3(rotation_vectors: Array) -> Array:
    """(n, 3, 3) rotations of (n, 3) rotation vectors."""
    return np.asarray(Rotation.from_rotvec(rotation_vectors).as_matrix()).reshape(-1, 3, 3)


def log_so3(R: Array) -> Array:
    """(n, 3) rotation vectors of (n, 3, 3) rotations."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec()).reshape(-1, 3)


def interpolate(at_ns: IntArray, stamps_ns: IntArray, values: Array) -> Array:
    """Columns of (n, d) values, linear in time, at (m,) stamps; the ends are held."""
    origin = stamps_ns[0]
    x, xp = (at_ns - origin).astype(np.float64), (stamps_ns - origin).astype(np.float64)
    return np.stack([np.interp(x, xp, column) for column in values.T], axis=1)


@dataclass(frozen=True)
class Inertial:
    """Finite samples without a gap that is too long to bridge.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        gyro: (n, 3) rad/s, imu frame.
        force: (n, 3) m/s^2, imu frame.
        gaps_ns: (g, 2) bridged gaps, first and last stamp.
    """

    stamps_ns: IntArray
    gyro: Array
    force: Array
    gaps_ns: IntArray

    def part(self, samples: slice) -> Inertial:
        """Some of the samples."""
        return Inertial(
            self.stamps_ns[samples], self.gyro[samples], self.force[samples], self.gaps_ns
        )

    @property
    def begin_ns(self) -> int:
        """First stamp."""
        return int(self.stamps_ns[0])

    @property
    def end_ns(self) -> int:
        """Last stamp."""
        return int(self.stamps_ns[-1])


NO_GAPS: IntArray = np.zeros((0, 2), np.int64)
"""Of samples in which nobody has looked for gaps yet."""


def clean_inertial(imu: ImuSamples, name: str) -> tuple[Inertial, tuple[str, ...]]:
    """Drops unusable samples and selects the longest piece without a long gap.

    Returns:
        The samples, and what was left out or bridged, a line each.

    Raises:
        TrajectoryError: too little is left, or the samples are not those of an IMU at all.
    """
    stamps, gyro, force, warnings = _finite_samples(imu, name)
    inertial, more = longest_piece(Inertial(stamps, gyro, force, NO_GAPS), name, "IMU")
    return inertial, (*warnings, *more)


def longest_piece(samples: Inertial, name: str, sensor: str) -> tuple[Inertial, tuple[str, ...]]:
    """The longest piece of the samples of a `sensor` without a gap that is too long to bridge.

    Also what was left out or bridged, a line each.

    Raises:
        TrajectoryError: no two samples are close enough.
    """
    stamps, gyro, force = samples.stamps_ns, samples.gyro, samples.force
    warnings: list[str] = []
    steps = np.diff(stamps)
    longest = max(GAP_S, 3e-9 * float(np.median(steps)))
    split = max(MAX_BRIDGE_S, longest)
    cuts = np.flatnonzero(steps > 1e9 * split) + 1
    bounds = [0, *cuts.tolist(), len(stamps)]
    pieces = [(int(stamps[b - 1] - stamps[a]), a, b) for a, b in itertools.pairwise(bounds)]
    duration_ns, a, b = max(pieces)
    if len(pieces) > 1:
        warnings.append(
            f"{name}: {len(cuts)} gap(s) of more than {split:g} s in the "
            f"{sensor}, the longest {steps.max() * 1e-9:.1f} s: only the longest piece is used, "
            f"{duration_ns * 1e-9:.1f} s of {(stamps[-1] - stamps[0]) * 1e-9:.1f} s"
        )
    stamps, gyro, force = stamps[a:b], gyro[a:b], force[a:b]
    if b - a < 2:
        raise TrajectoryError(
            f"{name}: the {sensor}'s messages are all more than 2 s apart. Record them faster, or "
            "choose another topic"
        )
    at_gap = np.flatnonzero(np.diff(stamps) > 1e9 * longest)
    gaps = np.stack([stamps[at_gap], stamps[at_gap + 1]], axis=1).reshape(-1, 2)
    if len(gaps):
        lost_s = float((gaps[:, 1] - gaps[:, 0]).sum()) * 1e-9
        warnings.append(
            f"{name}: {len(gaps)} gap(s) in the {sensor}, {lost_s:.2f} s together: bridged, poses "
            "there are less certain"
        )
    return Inertial(stamps, gyro, force, gaps), tuple(warnings)


def _finite_samples(imu: ImuSamples, name: str) -> tuple[IntArray, Array, Array, list[str]]:
    """Stamps (n,), angular velocities and specific forces (n, 3) that are finite; warnings."""
    finite = np.asarray(np.isfinite(imu.angular_velocity).all(axis=1))
    finite_force = np.asarray(np.isfinite(imu.specific_force).all(axis=1))
    for what, usable in (("angular velocity", finite), ("linear acceleration", finite_force)):
        if len(usable) and not usable.any():
            raise TrajectoryError(
                f"{name}: no IMU message has a finite {what}: the trajectory needs gyroscope and "
                "accelerometer. Choose another topics.imu"
            )
    finite &= finite_force
    stamps = np.asarray(imu.stamps_ns, dtype=np.int64)
    # The samples themselves where all are usable: a copy per smoothing is a third of a MB per
    # minute.
    if not finite.all():
        stamps = stamps[finite]
    warnings = []
    if not finite.all():
        warnings.append(
            f"{name}: {int((~finite).sum())} of {len(finite)} IMU messages are not finite, left out"
        )
    if len(stamps) < 2:
        raise TrajectoryError(
            f"{name}: {len(stamps)} usable IMU message(s), needs at least 2. Choose another "
            "topics.imu"
        )
    steps = np.diff(stamps)
    if (steps <= 0).any():
        at = int(np.argmax(steps <= 0))
        raise TrajectoryError(
            f"{name}: IMU stamps do not increase: {stamps[at]} ns, then {stamps[at + 1]} ns. "
            "Sort the messages by stamp, or choose another topics.imu"
        )
    gyro, force = imu.angular_velocity, imu.specific_force
    if not finite.all():
        gyro, force = gyro[finite], force[finite]
    median = float(np.median(np.linalg.norm(force, axis=1)))
    if not MIN_FORCE_M_S2 < median < MAX_FORCE_M_S2:
        raise TrajectoryError(
            f"{name}: the IMU's median linear acceleration is {median:.2f} m/s^2, at rest it "
            "should be 9.8: gravity is taken out, or the unit is not m/s^2. Choose another "
            "topics.imu"
        )
    return stamps, gyro, force, warnings


def _prefix_products(R: Array) -> Array:
    """(n + 1, 3, 3): identity, R_0, R_0 R_1, ...; two products for each, in sqrt(n) calls twice."""
    count = len(R) + 1
    size = math.isqrt(count - 1) + 1
    out = np.tile(np.eye(3), (size, size, 1, 1))
    out.reshape(-1, 3, 3)[1:count] = R
    for i in range(1, size):  # within all blocks at once
        out[:, i] = out[:, i - 1] @ out[:, i]
    for i in range(1, size):
        out[i] = out[i - 1, -1] @ out[i]
    return np.asarray(out.reshape(-1, 3, 3)[:count])


@dataclass(frozen=True)
class DeadReckoning:
    """Motion by the IMU alone, in the IMU's frame at its first sample, gravity not included.

    `R' = R skew(w)`, `v' = R f`, `p' = v`, with bias removed. The motion between any two instants,
    forward or backward in time, follows from the states at the two.

    Attributes:
        stamps_ns: (n,) of the samples.
        gyro: (n, 3) rad/s, bias removed.
        force: (n, 3) m/s^2, bias removed.
    """

    stamps_ns: IntArray
    gyro: Array
    force: Array

    def _step(self, k: IntArray, tau: Array) -> tuple[Array, Array, Array]:
        """Rotation, velocity and displacement from sample k, in its frame, (m,) seconds on."""
        dt = (self.stamps_ns[k + 1] - self.stamps_ns[k])[:, None] * 1e-9
        tau = tau[:, None]
        w0, f0 = self.gyro[k], self.force[k]
        w_rate, f_rate = (self.gyro[k + 1] - w0) / dt, (self.force[k + 1] - f0) / dt
        turn = w0 * tau + 0.5 * w_rate * tau**2
        # f(s) = f0 + f_rate s, rotated by w s, to second order in the step.
        bend = cross(w0 + 0.5 * w_rate * tau, f0 + 0.5 * f_rate * tau)
        velocity = f0 * tau + (0.5 * f_rate + 0.5 * bend) * tau**2
        displacement = 0.5 * f0 * tau**2 + (f_rate + bend) * tau**3 / 6.0
        return exp_so3(turn), velocity, displacement

    @cached_property
    def _cumulative(self) -> tuple[Array, Array, Array]:
        k = np.arange(len(self.stamps_ns) - 1)
        dt: Array = np.diff(self.stamps_ns) * np.float64(1e-9)
        dR, dv, dp = self._step(k, dt)
        R = _prefix_products(dR)
        v = np.zeros((len(dt) + 1, 3))
        np.cumsum(np.einsum("nij,nj->ni", R[:-1], dv), axis=0, out=v[1:])
        p = np.zeros_like(v)
        np.cumsum(v[:-1] * dt[:, None] + np.einsum("nij,nj->ni", R[:-1], dp), axis=0, out=p[1:])
        return R, v, p

    @cached_property
    def _known(self) -> dict[bytes, tuple[Array, Array, Array]]:
        """What `_at` was asked for last: parameters of the input move readings, not instants."""
        return {}

    def _at(self, stamps_ns: IntArray) -> tuple[Array, Array, Array]:
        if len(stamps_ns) > KEPT_INSTANTS:
            return self._worked_out(stamps_ns)
        asked = np.asarray(stamps_ns, np.int64).tobytes()
        found = self._known.get(asked)
        if found is None:
            while len(self._known) >= KEPT_QUESTIONS:
                # Threads ask at once: another one may have taken it out.
                self._known.pop(next(iter(tuple(self._known)), asked), None)
            found = self._known[asked] = self._worked_out(stamps_ns)
        return found

    def _worked_out(self, stamps_ns: IntArray) -> tuple[Array, Array, Array]:
        # Nodes are asked for once per measurement near them.
        starts = np.flatnonzero(np.diff(stamps_ns)) + 1
        if 2 * (len(starts) + 1) < len(stamps_ns):
            starts = np.concatenate([[0], starts])
            each = np.diff(starts, append=len(stamps_ns))
            R, v, p = (np.repeat(of, each, axis=0) for of in self._worked_out(stamps_ns[starts]))
            return R, v, p
        R, v, p = self._cumulative
        k = np.searchsorted(self.stamps_ns, stamps_ns, "right") - 1
        if np.array_equal(self.stamps_ns[k], stamps_ns):  # as of what came with the samples
            return R[k], v[k], p[k]
        k = np.clip(k, 0, len(R) - 2)
        # Beyond the ends the line through the first or last two readings is extended.
        tau: Array = np.asarray(stamps_ns - self.stamps_ns[k], dtype=np.float64) * 1e-9
        dR, dv, dp = self._step(k, tau)
        v_at = v[k] + np.einsum("nij,nj->ni", R[k], dv)
        p_at = p[k] + v[k] * tau[:, None] + np.einsum("nij,nj->ni", R[k], dp)
        return R[k] @ dR, v_at, p_at

    def between(self, from_ns: IntArray, to_ns: IntArray) -> tuple[Array, Array, Array]:
        """Relative motion from (m,) to (m,) instants.

        Returns:
            Rotation (m, 3, 3), velocity change (m, 3) and displacement (m, 3), in the IMU's frame
            at `from_ns`: `R_to = R dR`, `v_to = v + g dt + R dv`,
            `p_to = p + v dt + g dt^2 / 2 + R dp`.
        """
        R0, v0, p0 = self._at(from_ns)
        R1, v1, p1 = self._at(to_ns)
        dt = ((to_ns - from_ns) * 1e-9)[:, None]
        back = np.swapaxes(R0, 1, 2)
        return (
            back @ R1,
            np.einsum("nij,nj->ni", back, v1 - v0),
            np.einsum("nij,nj->ni", back, p1 - p0 - v0 * dt),
        )

    def rates(self, stamps_ns: IntArray, half_window_ns: int = 0) -> Array:
        """(m, 3) rad/s in the IMU's frame, averaged over a window about each instant."""
        if half_window_ns == 0:
            return interpolate(stamps_ns, self.stamps_ns, self.gyro)
        # At the ends the window shrinks on both sides alike: it stays centred on the instant.
        room = np.minimum(stamps_ns - self.stamps_ns[0], self.stamps_ns[-1] - stamps_ns)
        half = np.minimum(np.maximum(room, 1_000_000), half_window_ns)
        R, _, _ = self.between(stamps_ns - half, stamps_ns + half)
        return np.asarray(log_so3(R) / (2e-9 * half)[:, None])


def preintegrate(
    inertial: Inertial,
    nodes_ns: IntArray,
    biases: Sequence[gtsam.imuBias.ConstantBias],
    noise: ImuNoise,
    gravity_m_s2: float,
) -> list[gtsam.PreintegratedCombinedMeasurements]:
    """Preintegrated measurements of the imu frame from each node to the next, n - 1.

    Nodes (n,) increase strictly, within the samples; the ends of bridged gaps are among them. A
    bias is the linearisation point of the interval that begins at its node. Gravity is along -z of
    the map.
    """
    plain = _parameters(noise, gravity_m_s2, 0.0)
    fill = [
        np.arange(a + BRIDGE_STEP_NS, b, BRIDGE_STEP_NS, dtype=np.int64)
        for a, b in inertial.gaps_ns.tolist()
    ]
    inner = inertial.stamps_ns[
        (inertial.stamps_ns > nodes_ns[0]) & (inertial.stamps_ns < nodes_ns[-1])
    ]
    edges = np.unique(np.concatenate([inner, nodes_ns, *fill]))
    edges = edges[(edges >= nodes_ns[0]) & (edges <= nodes_ns[-1])]
    gyro = interpolate(edges, inertial.stamps_ns, inertial.gyro)
    force = interpolate(edges, inertial.stamps_ns, inertial.force)
    dt = np.diff(edges) * 1e-9
    middle_gyro = 0.5 * (gyro[1:] + gyro[:-1])
    middle_force = 0.5 * (force[1:] + force[:-1])
    half_turn = exp_so3(0.5 * middle_gyro * dt[:, None])
    middle_force = np.einsum("nij,nj->ni", half_turn, middle_force)
    first = np.searchsorted(edges, nodes_ns)
    out = []
    for i, gap_s in enumerate(bridged_s(inertial, nodes_ns).tolist()):
        parameters = plain if gap_s == 0.0 else _parameters(noise, gravity_m_s2, gap_s)
        measured = gtsam.PreintegratedCombinedMeasurements(parameters, biases[i])
        for k in range(first[i], first[i + 1]):
            measured.integrateMeasurement(middle_force[k], middle_gyro[k], float(dt[k]))
        out.append(measured)
    return out


def bridged_s(inertial: Inertial, nodes_ns: IntArray) -> Array:
    """(n - 1,) length in seconds of the gap in which an interval lies, 0: none."""
    out = np.zeros(len(nodes_ns) - 1)
    for a, b in inertial.gaps_ns.tolist():
        # In place of a gap's end there may be a scan's node (`nodes.place_nodes`).
        inside = (nodes_ns[:-1] >= a - MERGE_NS) & (nodes_ns[1:] <= b + MERGE_NS)
        out[inside] = (b - a) * 1e-9
    return out


def _parameters(
    noise: ImuNoise, gravity_m_s2: float, gap_s: float
) -> gtsam.PreintegrationCombinedParams:
    """Squared densities; in a gap those of an error that is constant over the whole gap."""
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity_m_s2)
    gyro = noise.gyro_density + BRIDGE_GYRO_RAD_S**2 * gap_s * np.eye(3)
    force = noise.force_density + BRIDGE_FORCE_M_S2**2 * gap_s * np.eye(3)
    parameters.setGyroscopeCovariance(gyro)
    parameters.setAccelerometerCovariance(force)
    parameters.setIntegrationCovariance(INTEGRATION_DENSITY_M**2 * np.eye(3))
    parameters.setBiasOmegaCovariance(np.diag(noise.gyro_walk**2))
    parameters.setBiasAccCovariance(np.diag(noise.force_walk**2))
    return parameters
