"""The measurement factors of the trajectory, one function per kind (`README.md`, section 3).

Variables beside node i: I_i = T_map_imu (right perturbation), V_i velocity of the IMU's origin in
the map. All Jacobians are analytic; the tests check them numerically.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from caliv_graph.geometry.chart import PoseChart
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.states import States

NoiseModel = gtsam.noiseModel.Base

IDENTITY = np.eye(3)
"""Made once: there are many fixes and messages of wheels."""

SKEW = np.array([skew(axis) for axis in IDENTITY]).transpose(1, 2, 0)
"""`SKEW @ v` is `skew(v)`, in a third of the time."""

POSE_SIZE, ROTATION_SIZE = 6, 3
"""Coordinates of the tangent of a pose, and of a rotation."""


def position_factor(
    key_imu: int,
    key_velocity: int,
    position_map: Array,
    offset_imu: Array,
    delay_s: float,
    gravity_m_s2: float,
    noise: NoiseModel,
) -> gtsam.NoiseModelFactor:
    """A position of the GNSS antenna: `r = p + V dt + g dt^2 / 2 + R q - z`, map axes.

    Args:
        key_imu: of I_i.
        key_velocity: of V_i.
        position_map: (3,) measured z, metres.
        offset_imu: (3,) q, metres: displacement since the node and lever arm, imu frame at the
            node.
        delay_s: dt, of the measurement after the node. Zero gives GTSAM's own factor.
        gravity_m_s2: along -z of the map.
        noise: of r, 3 dimensions.
    """
    if delay_s == 0.0:
        return gtsam.GPSFactorArm(key_imu, position_map, offset_imu, noise)
    shift = np.array([0.0, 0.0, -0.5 * gravity_m_s2 * delay_s**2]) - position_map
    known = np.array([*offset_imu, *shift, delay_s])
    error = partial(_position_error, key_imu, key_velocity, known)
    return gtsam.CustomFactor(noise, [key_imu, key_velocity], error)


def _position_error(
    key_imu: int,
    key_velocity: int,
    known: Array,
    _: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    """Residual (3,) of `position_factor`; `known` (7,) are q, what is added, and dt.

    One array each: there are ten such factors to the second of a drive, and what they consist of
    stays in pieces when they are gone.
    """
    offset_imu, shift, delay_s = known[:3], known[3:6], known[6]
    T = values.atPose3(key_imu).matrix()  # one call of GTSAM: it takes as long as a product
    R = T[:3, :3]
    if jacobians is not None:
        J = np.empty((3, 6))
        J[:, :3] = R @ (SKEW @ -offset_imu)
        J[:, 3:] = R
        jacobians[0] = J
        jacobians[1] = delay_s * IDENTITY
    velocity = values.atVector(key_velocity)
    return np.asarray(T[:3, 3] + delay_s * velocity + R @ offset_imu + shift)


def velocity_factor(
    key_imu: int,
    key_velocity: int,
    velocity_imu: Array,
    delay_s: Array,
    gravity_m_s2: float,
    noise: NoiseModel,
    scale: float = 1.0,
) -> gtsam.CustomFactor:
    """Velocities of the IMU's origin, carried to the node: `r = k (R^T V + D R^T g) - z`, imu axes.

    `velocity_imu` is z, (3,) m/s; `delay_s` is D, (3, 3) s, the mean time that gravity acts until
    the measurements (`measurements.NodeVelocities`); `noise` has the 3 dimensions of r; `scale` is
    k, measured over true velocity.
    """
    known = np.vstack([scale * gravity_m_s2 * delay_s, velocity_imu])
    error = partial(_velocity_error, key_imu, key_velocity, known, scale)
    return gtsam.CustomFactor(noise, [key_imu, key_velocity], error)


def _velocity_error(
    key_imu: int,
    key_velocity: int,
    known: Array,
    scale: float,
    _: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    """Residual (3,) of `velocity_factor`; `known` (4, 3) are k g D, and z."""
    gained, velocity_imu = known[:3], known[3]
    back = values.atPose3(key_imu).matrix()[:3, :3].T
    moving, down = scale * (back @ values.atVector(key_velocity)), -back[:, 2]
    if jacobians is not None:
        out = np.zeros((3, 6))
        out[:, :3] = SKEW @ moving + gained @ (SKEW @ down)
        jacobians[0] = out
        jacobians[1] = scale * back
    return np.asarray(moving + gained @ down - velocity_imu)


def position_residuals(
    states: States,
    nodes: IntArray,
    position_map: Array,
    offset_imu: Array,
    delay_s: Array,
    gravity_m_s2: float,
) -> Array:
    """(m, 3) residuals of `position_factor` of m fixes at their `nodes` (m,), all at once."""
    turned = np.einsum("mij,mj->mi", states.R_map_imu[nodes], offset_imu)
    out = states.p_map_imu[nodes] + delay_s[:, None] * states.velocity_map[nodes] + turned
    out[:, 2] -= 0.5 * gravity_m_s2 * delay_s**2
    return np.asarray(out - position_map)


def velocity_residuals(
    states: States,
    nodes: IntArray,
    velocity_imu: Array,
    delay_s: Array,
    gravity_m_s2: float,
    scale: float = 1.0,
) -> Array:
    """(m, 3) residuals of `velocity_factor` of m velocities at their `nodes` (m,), all at once.

    `delay_s` is (m, 3, 3).
    """
    R = states.R_map_imu[nodes]
    seen = np.einsum("mji,mj->mi", R, states.velocity_map[nodes])
    seen -= gravity_m_s2 * np.einsum("mij,mj->mi", delay_s, R[:, 2])
    return np.asarray(scale * seen - velocity_imu)


def biased_orientation_factor(
    key_imu: int, key_yaw_bias: int, R_map_imu: gtsam.Rot3, noise: NoiseModel
) -> gtsam.CustomFactor:
    """An orientation whose source has a yaw bias b: `r = Log(Z^T Rz(b) R)`, imu axes.

    The source measures the true orientation rotated by b, a vector of 1, radians, about the map's z
    axis. `R_map_imu` is the measured Z; `noise` has the 3 dimensions of r.
    """
    Z_inverse = R_map_imu.inverse()

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R = values.atPose3(key_imu).rotation()
        bias = float(values.atVector(key_yaw_bias)[0])
        r = gtsam.Rot3.Logmap(Z_inverse.compose(gtsam.Rot3.Rz(bias)).compose(R))
        if jacobians is not None:
            D = np.asarray(gtsam.Rot3.LogmapDerivative(r))
            J = np.zeros((3, 6))
            J[:, :3] = D
            jacobians[0] = J
            jacobians[1] = D @ R.matrix().T[:, 2:]
        return np.asarray(r)

    return gtsam.CustomFactor(noise, [key_imu, key_yaw_bias], error)


def orientation_factor(
    key_imu: int, R_map_imu: gtsam.Rot3, noise: NoiseModel
) -> gtsam.NoiseModelFactor:
    """An orientation, `r = Log(Z^T R)`, 3 dimensions, imu axes; GTSAM's own factor."""
    return gtsam.PoseRotationPrior3D(key_imu, R_map_imu, noise)


def level_factor(
    key_imu: int, up_map: Array, leaning_rad: Array, noise: NoiseModel
) -> gtsam.CustomFactor:
    """Level ground under the frame: `r = (R^T n)_xy - l`, n = `up_map` (3,) its normal in the map.

    Nose up is positive x, left side up positive y, radians. l = `leaning_rad` (2,) is how the body
    leans on its springs; `noise` has the 2 dimensions of r.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        up = values.atPose3(key_imu).rotation().matrix().T @ up_map
        if jacobians is not None:
            J = np.zeros((2, 6))
            J[:, :3] = skew(up)[:2]
            jacobians[0] = J
        return np.asarray(up[:2] - leaning_rad)

    return gtsam.CustomFactor(noise, [key_imu], error)


def heading_factor(
    key_imu: int, direction_imu: Array, azimuth_rad: float, noise: NoiseModel
) -> gtsam.CustomFactor:
    """The azimuth of a direction: `r = atan2(d_y, d_x) - z`, `d = R u`, u (3,) of the imu frame.

    Within half a turn; z counts from the map's x to the left. `noise` has the 1 dimension of r.
    """
    turn = skew(direction_imu)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R = values.atPose3(key_imu).rotation().matrix()
        x, y, _z = R @ direction_imu
        if jacobians is not None:
            across = np.array([-y, x, 0.0]) / (x * x + y * y)
            J = np.zeros((1, 6))
            J[0, :3] = -across @ R @ turn
            jacobians[0] = J
        return np.array([math.remainder(math.atan2(y, x) - azimuth_rad, math.tau)])

    return gtsam.CustomFactor(noise, [key_imu], error)


def baseline_factor(
    key_imu: int, baseline_imu: Array, vector_map: Array, noise: NoiseModel
) -> gtsam.CustomFactor:
    """A vector between two antennas: `r = R b - z`, metres, map axes; b (3,) of the imu frame.

    `vector_map` (3,) is z; `noise` has the 3 dimensions of r.
    """
    turn = skew(baseline_imu)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R = values.atPose3(key_imu).rotation().matrix()
        if jacobians is not None:
            J = np.zeros((3, 6))
            J[:, :3] = -R @ turn
            jacobians[0] = J
        return np.asarray(R @ baseline_imu - vector_map)

    return gtsam.CustomFactor(noise, [key_imu], error)


def tangent_size(value: gtsam.Pose3 | gtsam.Rot3 | Array) -> int:
    """Coordinates of the tangent of a pose, a rotation or a vector."""
    if isinstance(value, gtsam.Pose3):
        return POSE_SIZE
    return ROTATION_SIZE if isinstance(value, gtsam.Rot3) else len(value)


@dataclass(frozen=True)
class Gaussian:
    """A Gaussian on several variables at once: a quadratic in right perturbations about its means.

    Twice its error is `d^T information d - 2 gradient^T d + constant`, where d has `log(T0^-1 T)`
    of poses and rotations (of poses rotation then translation) and differences of vectors. In their
    place, poses of the vehicle about means without heave have coordinates of a `chart`, and those
    of which a LiDAR on it tells coordinates behind that (`carried`): one of both, or none.

    Attributes:
        keys: its variables.
        means: of each.
        information: (n, n), n all coordinates.
        gradient: (n,).
        constant: what makes the error positive.
        chart: of its poses, all the vehicle's; None: their logarithms.
        carried: key of an extrinsic E among `keys`, which begin with the vehicle's poses. Where a
            LiDAR is, X E, is what is known: X has the coordinates
            `Ad(E0) (log((X0 E0)^-1 X E) - log(E0^-1 E))`, to the first order those of X alone. A
            turn of the vehicle frame, `X a` and `a^-1 E`, and a motion of the map, `b X`, are
            straight lines in them at once. None: no such extrinsic.
    """

    keys: tuple[int, ...]
    means: tuple[gtsam.Pose3 | gtsam.Rot3 | Array, ...]
    information: Array
    gradient: Array
    constant: float = 0.0
    chart: PoseChart | None = None
    carried: int | None = None

    def factor(self) -> gtsam.LinearContainerFactor:
        """As one native factor; see `at` for what it is away from the means."""
        return marginal_factor(
            self.keys, self.information, self.means, self.gradient, self.constant
        )

    def at(self, values: gtsam.Values) -> tuple[Array, Array]:
        """H (n, n) and b (n,) of `d^T H d / 2 - b^T d` in right perturbations of `values`.

        The native factor takes the derivative of d for 1, which is off by half of what
        a pose is turned. Where a direction is open, all poses move together by hundredths of a
        radian, and what is known to hundredths of a milliradian would seem to tell of it.
        """
        d, blocks, by_extrinsic = self._apart(values)
        pull = self.gradient - self.information @ d
        half = _by_blocks(blocks, self.information)
        H = _by_blocks(blocks, half.T)
        b = _by_blocks(blocks, pull[:, None])[:, 0]
        if self.carried is not None:
            # J has blocks on its diagonal, and below E a column C for the poses.
            own = self._rows(self.carried)
            poses = slice(len(by_extrinsic))
            across = half[:, poses] @ by_extrinsic
            H[:, own] += across
            H[own] += across.T
            H[own, own] += by_extrinsic.T @ self.information[poses, poses] @ by_extrinsic
            b[own] += by_extrinsic.T @ pull[poses]
        return 0.5 * (H + H.T), b

    def chi_square(self, values: gtsam.Values) -> float:
        """Twice its error at `values`, which those of `factor` have in logarithms of all poses.

        A vehicle that is turned by 50 mrad and shifted by a metre seems to heave by 25 mm there.
        """
        d, *_ = self._apart(values)
        return float(d @ self.information @ d - 2.0 * self.gradient @ d + self.constant)

    def _rows(self, key: int) -> slice:
        """Where the coordinates of a variable are."""
        at = self.keys.index(key)
        first = sum(map(tangent_size, self.means[:at]))
        return slice(first, first + tangent_size(self.means[at]))

    def _apart(self, values: gtsam.Values) -> tuple[Array, list[Array], Array]:
        """Coordinates d (n,) from the means; derivatives by right perturbations, in blocks.

        And those of the first poses by the extrinsic that is `carried`, (6 m, 6); none without.
        """
        apart, blocks = [], []
        for key, mean in zip(self.keys, self.means, strict=True):
            if isinstance(mean, gtsam.Pose3):
                T = mean.between(values.atPose3(key))
                if self.chart is None:
                    apart.append(gtsam.Pose3.Logmap(T))
                    blocks.append(gtsam.Pose3.LogmapDerivative(T))
                else:
                    apart.append(self.chart.coordinates(T))
                    blocks.append(np.empty((6, 6)))  # all at once, below
            elif isinstance(mean, gtsam.Rot3):
                turn = gtsam.Rot3.Logmap(mean.between(values.atRot3(key)))
                apart.append(turn)
                blocks.append(gtsam.Rot3.LogmapDerivative(turn))
            else:
                apart.append(values.atVector(key) - mean)
                blocks.append(np.eye(len(mean)))
        if self.chart is not None:
            poses = [k for k, mean in enumerate(self.means) if isinstance(mean, gtsam.Pose3)]
            moved = np.array([apart[k] for k in poses]).reshape(-1, 6)
            for k, block in zip(poses, self.chart.derivatives(moved), strict=True):
                blocks[k] = block
        by_extrinsic = np.zeros((0, POSE_SIZE))
        if self.carried is not None:
            by_extrinsic = self._behind(self.carried, values, apart, blocks)
        return np.concatenate(apart), blocks, by_extrinsic

    def _behind(
        self, carried: int, values: gtsam.Values, apart: list[Array], blocks: list[Array]
    ) -> Array:
        """Puts the poses before `carried` into its coordinates; (6 m, 6) derivatives by it."""
        at = self.keys.index(carried)
        first, E = self.means[at], values.atPose3(carried)
        assert isinstance(first, gtsam.Pose3)
        turned, back = np.asarray(first.AdjointMap()), np.asarray(E.inverse().AdjointMap())
        of_own = turned @ blocks[at]
        out = []
        for k, (key, mean) in enumerate(zip(self.keys[:at], self.means[:at], strict=True)):
            if not isinstance(mean, gtsam.Pose3):
                break
            T = mean.compose(first).between(values.atPose3(key).compose(E))
            by_lidar = turned @ gtsam.Pose3.LogmapDerivative(T)
            apart[k] = turned @ (gtsam.Pose3.Logmap(T) - apart[at])
            blocks[k] = by_lidar @ back
            out.append(by_lidar - of_own)
        return np.concatenate(out) if out else np.zeros((0, POSE_SIZE))


def _by_blocks(blocks: Sequence[Array], rows: Array) -> Array:
    """(n, k) `J^T rows` of rows (n, k), J block diagonal: a sparse product takes several times it.

    Blocks of one size in a row are multiplied together.
    """
    out, start = np.empty(rows.shape), 0
    for size, some in itertools.groupby(blocks, key=len):
        own = np.array(list(some))
        part = slice(start, start + size * len(own))
        start = part.stop
        of_blocks = rows[part].reshape(len(own), size, -1)
        out[part] = np.matmul(np.swapaxes(own, 1, 2), of_blocks).reshape(-1, rows.shape[1])
    return out


def marginal_factor(
    keys: Sequence[int],
    information: Array,
    means: Sequence[gtsam.Pose3 | gtsam.Rot3 | Array],
    gradient: Array | None = None,
    constant: float = 0.0,
) -> gtsam.LinearContainerFactor:
    """A Gaussian on several variables at once as one native factor of a nonlinear graph.

    `information` is their joint one, square, of right perturbations (of poses rotation then
    translation) about `means`, poses, rotations and vectors. With a `gradient`, one number per
    coordinate, twice the error is `d^T information d - 2 gradient^T d + constant`.
    """
    sizes = [tangent_size(mean) for mean in means]
    starts = np.cumsum([0, *sizes]).tolist()
    parts = [slice(a, b) for a, b in itertools.pairwise(starts)]
    linear = np.zeros(starts[-1]) if gradient is None else gradient
    graph = gtsam.GaussianFactorGraph()
    # HessianFactor takes three keys at most from Python: a sum over pairs, merged by GTSAM.
    for i, (key, own) in enumerate(zip(keys, parts, strict=True)):
        f = constant if i == 0 else 0.0
        graph.add(gtsam.HessianFactor(key, information[own, own], linear[own], f))
        for j in range(i + 1, len(keys)):
            graph.add(
                gtsam.HessianFactor(
                    key,
                    keys[j],
                    np.zeros((sizes[i], sizes[i])),
                    information[own, parts[j]],
                    np.zeros(sizes[i]),
                    np.zeros((sizes[j], sizes[j])),
                    np.zeros(sizes[j]),
                    0.0,
                )
            )
    point = gtsam.Values()
    for key, mean in zip(keys, means, strict=True):
        point.insert(key, mean)
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(graph), point)
