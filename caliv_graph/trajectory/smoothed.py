"""The smoothed trajectory: poses at any time, and their joint information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.conventions import key_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import cross, stack
from caliv_graph.products import Array, IntArray, Trajectory
from caliv_graph.readers.common_stamps import MERGE_NS
from caliv_graph.trajectory.build import KINDS, Estimate, build_graph, to_values
from caliv_graph.trajectory.chain import POSE, Chain, inverse_of
from caliv_graph.trajectory.correlated import MOVES, CorrelatedError
from caliv_graph.trajectory.imu import (
    DeadReckoning,
    Inertial,
    exp_so3,
    interpolate,
    log_so3,
)
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.marginals import Marginals, node_ordering
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.parameters import InputParameter, UncertainParameter, sigmas_in
from caliv_graph.trajectory.solve import LONE_YAW_SIGMA_RAD
from caliv_graph.trajectory.states import States, poses_of_vehicle, without_bias

PART_NS, PAUSE_NS = 60_000_000_000, 5_000_000_000
"""The IMU is dead reckoned over a minute at a time: over a whole drive its samples take three times
the memory that they have as they were read. After a longer pause of the stamps it begins anew."""

WINDOW_NS, OVERLAP_NS = 10_000_000_000, 2_000_000_000
"""What is asked for scan by scan is dead reckoned in windows of the drive that overlap, at times
that do not depend on what was asked before: by itself each call would begin anew, for most of its
time."""

KEPT_WINDOWS = 2
"""Windows that are kept: scans are asked for in order, by two threads at a time."""

RATE_WINDOW_NS = 50_000_000
"""Half the time over which the gyroscope is averaged for the vehicle's velocity."""


def parts_of(stamps_ns: IntArray) -> list[IntArray]:
    """Indices of the stamps (m,), in any order, of each part of the drive."""
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    minute = (ordered - ordered[:1]) // PART_NS
    cuts = np.flatnonzero((np.diff(ordered) > PAUSE_NS) | (np.diff(minute) > 0)) + 1
    return [part for part in np.split(order, cuts) if len(part)]


def within_span(
    stamps_ns: Sequence[int] | IntArray, span_ns: tuple[int, int], whose: str
) -> IntArray:
    """The stamps (m,) as an array, in their order; `whose` span it is, for the message.

    Raises:
        TrajectoryError: a stamp is outside.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    begin, end = span_ns
    outside = (stamps < begin) | (stamps > end)
    if outside.any():
        at = int(stamps[np.argmax(outside)])
        raise TrajectoryError(
            f"trajectory: stamp {at} ns is outside {whose}, {begin} to {end} ns. Check the clocks "
            "with 'caliv-graph inspect'"
        )
    return stamps


@dataclass(frozen=True)
class JointInformation:
    """A Gaussian on m poses of the vehicle and p coordinates of parameters, about its estimate.

    Minus its logarithm is `d^T information d / 2 - gradient^T d`, d the right perturbations of the
    poses (rotation then translation, rad and m) and after them the moves of the parameters.

    Attributes:
        information: (6 m + p, 6 m + p), without the priors of the parameters.
        gradient: (6 m + p,); of the poses it is zero but for the solver's tolerance, if
            the trajectory is not linearised elsewhere.
        T_map_vehicle: the m poses at the estimate.
        parameters: names of the parameters, in order.
    """

    information: Array
    gradient: Array
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    parameters: tuple[str, ...]


@dataclass(frozen=True)
class SmoothedTrajectory:
    """The vehicle's motion over one drive, as a Gaussian.

    Attributes:
        trajectory: poses, covariances, velocities at the wanted stamps within the span.
        lost_ns: wanted stamps outside the span of the IMU.
        warnings: about data that were left out or look wrong, a line each.
        noise_sources: sensor -> where its noise figures are from.
        nodes_ns: (n,) stamps of the nodes.
        pose_sigmas: (6,) 1 sigma of the vehicle's pose, right perturbation, rotation then
            translation, rad and m, median over the nodes: known where no stamp is wanted, too.
        states: estimates at the nodes.
        T_vehicle_imu: extrinsic that was used.
        gravity_m_s2: magnitude that was used, along -z of the map.
        yaw_bias: (value, sigma) in radians of the orientation source, if estimated.
        gnss_rejected: (k,) stamps of fixes that were dropped as outliers.
        origin_deg_m: latitude, longitude and altitude of the map's origin, None without GNSS.
        built_with: whose biases integrated and carried the measurements of the graph.
        chain: the graph's information at the estimate.
        inertial: the IMU samples used.
        data: the input as it was used, its parameters and the noise of the fixes as estimated.
        gnss_dropped: (k,) indices of the fixes that the graph is without.
        factor_kinds: of each factor of the graph, in order (`build.TrajectoryGraph`).
        parameters: of the input, in the chain after the yaw bias (`parameters.py`).
        parameter_cov: (p, p) of the first p coordinates of `parameters`: those that were estimated.
        correlated: errors of sensors that are correlated over time. States and chain contain them,
            the chain as the last coordinates of every state; the graph does not.
        errors: (n, 3 e) their estimates at the nodes, metres or radians, map axes.
        elsewhere: the chain is linearised elsewhere than at the estimate of these data
            (`about_poses`): its gradient is not zero.
        chain_nodes: (m,) indices of the nodes whose states the chain has, ascending, all others
            being eliminated; None: it has all.
    """

    trajectory: Trajectory
    lost_ns: tuple[int, ...]
    warnings: tuple[str, ...]
    noise_sources: Mapping[str, str]
    nodes_ns: IntArray
    pose_sigmas: Array
    states: States
    T_vehicle_imu: gtsam.Pose3
    gravity_m_s2: float
    yaw_bias: tuple[float, float] | None
    gnss_rejected: IntArray
    origin_deg_m: tuple[float, float, float] | None
    built_with: States = field(repr=False)
    chain: Chain = field(repr=False)
    inertial: Inertial = field(repr=False)
    data: SmootherInput = field(repr=False)
    gnss_dropped: IntArray = field(repr=False)
    factor_kinds: tuple[str, ...] = field(default=(), repr=False)
    parameters: tuple[UncertainParameter, ...] = ()
    parameter_cov: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    correlated: tuple[CorrelatedError, ...] = ()
    errors: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    elsewhere: bool = False
    chain_nodes: IntArray | None = field(default=None, repr=False)

    @property
    def heading_sigma_rad(self) -> float:
        """1 sigma of the heading by the motion data, median over the nodes."""
        return float(self.pose_sigmas[2])

    @property
    def heading_is_wide(self) -> bool:
        """Whether it is too wide to be used, unless walls tell it."""
        return self.heading_sigma_rad > LONE_YAW_SIGMA_RAD

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp at which there is a pose."""
        return int(self.nodes_ns[0]), int(self.nodes_ns[-1])

    @property
    def open_kinds(self) -> list[str]:
        """Sensors whose errors may be correlated over time; none where such errors are in use."""
        return [] if self.correlated else [kind for kind in MOVES if kind in self.factor_kinds]

    def estimate(self, kinds: Set[str] = KINDS) -> Estimate:
        """The factors of some kinds, and the estimate as values; made anew at every call.

        Over T_map_imu (i), velocity (v), bias (b), yaw bias (y). A graph takes 4 MB per minute of
        drive: who needs it shall not keep it.
        """
        graph = build_graph(
            self.data,
            self.nodes_ns,
            self.built_with,
            self.gnss_dropped,
            self.data.config.robust.kernel,
            kinds,
        )
        return Estimate(self.states, graph, to_values(self.states, self.data), self.built_with)

    def _dead(self, begin_ns: int, end_ns: int) -> DeadReckoning:
        """The IMU alone, from the last sample before a time to the first one after another.

        Or over the whole window that both are in.
        """
        number = (begin_ns - int(self.nodes_ns[0])) // WINDOW_NS
        first_ns = int(self.nodes_ns[0]) + number * WINDOW_NS
        last_ns = first_ns + WINDOW_NS + OVERLAP_NS
        if end_ns > last_ns:
            return self._dead_between(begin_ns, end_ns)
        dead = self._windows.get(number)
        if dead is None:
            dead = self._dead_between(first_ns, last_ns)
            for old in list(self._windows)[: 1 - KEPT_WINDOWS]:
                self._windows.pop(old, None)
            self._windows[number] = dead
        return dead

    @cached_property
    def _windows(self) -> dict[int, DeadReckoning]:
        """Of the last windows, by their numbers."""
        return {}

    def _dead_between(self, begin_ns: int, end_ns: int) -> DeadReckoning:
        stamps = self.inertial.stamps_ns
        first = int(np.searchsorted(stamps, begin_ns, "right")) - 1
        last = int(np.searchsorted(stamps, end_ns, "right")) + 1
        some = slice(max(min(first, len(stamps) - 2), 0), max(last, 2))
        return without_bias(self.inertial.part(some), self.nodes_ns, self.states)

    def poses_at(self, stamps_ns: Sequence[int] | IntArray) -> tuple[Array, Array]:
        """R_map_vehicle (m, 3, 3) and t_map_vehicle (m, 3), metres, at any times within the span.

        Raises:
            TrajectoryError: a stamp is outside the span.
        """
        R, p, _ = self._imu_states(within_span(stamps_ns, self.span_ns, "its span"))
        R_iv, t_iv = stack([self.T_vehicle_imu.inverse()])
        return R @ R_iv[0], p + R @ t_iv[0]

    def states_at(self, stamps_ns: IntArray) -> States:
        """The estimate at any times (m,) within the span: where another smoothing begins.

        Raises:
            TrajectoryError: a stamp is outside the span.
        """
        R, p, v = self._imu_states(within_span(stamps_ns, self.span_ns, "its span"))
        force_bias = interpolate(stamps_ns, self.nodes_ns, self.states.force_bias)
        gyro_bias = interpolate(stamps_ns, self.nodes_ns, self.states.gyro_bias)
        return States(R, p, v, force_bias, gyro_bias, self.states.yaw_bias_rad)

    def _imu_states(self, stamps: IntArray) -> tuple[Array, Array, Array]:
        """R_map_imu, its origin and its velocity in the map."""
        R, p, v = (
            np.empty((len(stamps), 3, 3)),
            np.empty((len(stamps), 3)),
            np.empty((len(stamps), 3)),
        )
        for part in parts_of(stamps):
            R[part], p[part], v[part] = self._imu_states_of(stamps[part])
        return R, p, v

    def _imu_states_of(self, stamps: IntArray) -> tuple[Array, Array, Array]:
        i = np.clip(np.searchsorted(self.nodes_ns, stamps, "right") - 1, 0, len(self.nodes_ns) - 2)
        R, p, v = self._carried(i, stamps)
        miss_R, miss_p, miss_v = self._misses
        # Dead reckoning misses the next node. The difference is distributed over the interval:
        # linearly in rotation, as a cubic in position, so that position and velocity agree at both
        # nodes.
        T = (self.nodes_ns[i + 1] - self.nodes_ns[i])[:, None] * 1e-9
        s = (stamps - self.nodes_ns[i])[:, None] * 1e-9 / T
        R = R @ exp_so3(s * miss_R[i])
        p = p + s**2 * (3.0 - 2.0 * s) * miss_p[i] + T * s**2 * (s - 1.0) * miss_v[i]
        v = v + 6.0 * s * (1.0 - s) / T * miss_p[i] + s * (3.0 * s - 2.0) * miss_v[i]
        return R, p, v

    def _carried(self, i: IntArray, stamps: IntArray) -> tuple[Array, Array, Array]:
        at_node = self.nodes_ns[i]
        dead = self._dead(int(at_node.min()), int(stamps.max()))
        dR, dv, dp = dead.between(at_node, stamps)
        dt = (stamps - self.nodes_ns[i])[:, None] * 1e-9
        g = np.array([0.0, 0.0, -self.gravity_m_s2])
        R, v = self.states.R_map_imu[i], self.states.velocity_map[i]
        moved = self.states.p_map_imu[i] + v * dt + 0.5 * g * dt**2
        p = moved + np.einsum("nij,nj->ni", R, dp)
        return R @ dR, p, v + g * dt + np.einsum("nij,nj->ni", R, dv)

    @cached_property
    def _misses(self) -> tuple[Array, Array, Array]:
        after = self.nodes_ns[1:]
        out = np.empty((3, len(after), 3))
        for part in parts_of(after):
            R, p, v = self._carried(part, after[part])
            out[0, part] = log_so3(np.swapaxes(R, 1, 2) @ self.states.R_map_imu[part + 1])
            out[1, part] = self.states.p_map_imu[part + 1] - p
            out[2, part] = self.states.velocity_map[part + 1] - v
        return out[0], out[1], out[2]

    def velocities_at(self, stamps_ns: Sequence[int] | IntArray) -> tuple[Array, Array]:
        """Velocity (m, 3) m/s of the vehicle's origin and angular velocity (m, 3) rad/s.

        Both in vehicle axes. The gyroscope is averaged over 0.1 s.
        """
        stamps = within_span(stamps_ns, self.span_ns, "its span")
        R, _, v = self._imu_states(stamps)
        rates = np.empty((len(stamps), 3))
        for part in parts_of(stamps):
            own = stamps[part]
            dead = self._dead(int(own.min()) - RATE_WINDOW_NS, int(own.max()) + RATE_WINDOW_NS)
            rates[part] = dead.rates(own, RATE_WINDOW_NS)
        R_vi = self.T_vehicle_imu.rotation().matrix()
        arm = self.T_vehicle_imu.inverse().translation()
        at_origin = np.einsum("nji,nj->ni", R, v) + cross(rates, arm)
        return at_origin @ R_vi.T, rates @ R_vi.T

    def sigmas_of(self, name: str) -> Array | None:
        """(p,) 1 sigma of an estimated parameter, by the motion data alone and its prior."""
        return sigmas_in(self.parameters, self.parameter_cov, name)

    def bias_sigmas(self) -> tuple[Array, Array]:
        """1 sigma of the biases at the nodes: (n, 3) m/s^2 and (n, 3) rad/s, imu frame."""
        n = len(self.nodes_ns)
        estimate = self.estimate()
        linear = estimate.graph.factors.linearize(estimate.values)
        marginals = Marginals(linear, node_ordering(n, self.yaw_bias is not None))
        cov = marginals.covariances([key_bias(i) for i in range(n)])
        sigmas = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        return sigmas[:, :3], sigmas[:, 3:]

    def node_indices(self, stamps_ns: Sequence[int] | IntArray) -> IntArray:
        """(m,) nodes at wanted stamps (m,), increasing.

        Raises:
            KeyError: a stamp has no node.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        i = nearest_node(self.nodes_ns, stamps)
        missing = np.abs(self.nodes_ns[i] - stamps) > MERGE_NS
        if missing.any():
            raise KeyError(int(stamps[np.argmax(missing)]))
        if (np.diff(i) <= 0).any():
            raise ValueError("stamps must increase, with a node for each")
        return i

    def joint_information(
        self, stamps_ns: Sequence[int] | IntArray
    ) -> tuple[Array, tuple[gtsam.Pose3, ...]]:
        """The joint Gaussian of the vehicle's poses at wanted stamps (m,), increasing.

        Returns:
            Information (6 m, 6 m), right perturbations, rotation then translation, rad and m, all
            else eliminated; and its mean, m T_map_vehicle.

        Raises:
            KeyError: a stamp has no node.
        """
        joint = self.joint(stamps_ns)
        return joint.information, joint.T_map_vehicle

    def joint(
        self, stamps_ns: Sequence[int] | IntArray, parameters: Sequence[str] = ()
    ) -> JointInformation:
        """The joint Gaussian of the vehicle's poses at wanted stamps (m,) and named parameters.

        Parameters that are not named are eliminated under their prior; those without a prior are
        held. The prior of a named parameter is not in the result: it is one for all drives.

        Raises:
            KeyError: a stamp has no node, or the chain does not have a parameter (`columns`).
        """
        i = self.node_indices(stamps_ns)
        m, names = len(i), [p.parameter.name for p in self.parameters]
        missing = sorted(set(parameters) - set(names))
        if missing:
            raise KeyError(missing[0])
        # A parameter that moves T_vehicle_imu moves the vehicle: it is eliminated after the change
        # of variables, not before.
        free = [
            p for p in self.parameters if p.parameter.name in parameters or p.sigmas is not None
        ]
        free.sort(key=lambda p: _place(parameters, p.parameter.name))
        joint = self._over_imu(i, [p.parameter.name for p in free])
        by_vehicle = self._substitution(m, [p.parameter for p in free])
        information = by_vehicle.T @ joint[:-1, :-1] @ by_vehicle
        gradient = by_vehicle.T @ joint[:-1, -1]
        keep = POSE * m + sum(p.parameter.size for p in free if p.parameter.name in parameters)
        prior = [p for p in free if p.parameter.name not in parameters]
        if prior:
            information, gradient = _eliminated_under_prior(information, gradient, keep, prior)
        return JointInformation(
            information=np.asarray(0.5 * (information + information.T)),
            gradient=np.asarray(gradient),
            T_map_vehicle=poses_of_vehicle(self.states, i, self.T_vehicle_imu),
            parameters=tuple(parameters),
        )

    def _over_imu(self, nodes: IntArray, names: Sequence[str]) -> Array:
        """Joint information of the IMU's poses, named parameters, and the right-hand side."""
        at, start = {}, 0 if self.yaw_bias is None else 1
        for p in self.parameters:
            at[p.parameter.name] = list(range(start, start + p.parameter.size))
            start += p.parameter.size
        kept = [k for name in names for k in at[name]]
        held = [k for name in at if name not in names for k in at[name]]
        if self.chain_nodes is not None:
            places = np.searchsorted(self.chain_nodes, nodes)
            there = self.chain_nodes[np.minimum(places, len(self.chain_nodes) - 1)] == nodes
            if not there.all():
                raise KeyError(int(self.nodes_ns[nodes[np.argmin(there)]]))
            nodes = np.asarray(places, np.int64)
        return self.chain.pose_information(nodes, [*kept, start], held)

    def _substitution(self, m: int, parameters: Sequence[InputParameter]) -> scipy.sparse.csr_array:
        """From perturbations of m vehicle's poses and parameters to those of the IMU and them.

        `I = X T_vehicle_imu`, hence `xi_imu = Ad(T_imu_vehicle) xi_vehicle + moves d`, d moving
        T_vehicle_imu.
        """
        back = np.asarray(self.T_vehicle_imu.inverse().AdjointMap())
        moves = [np.zeros((POSE, 0)), *(p.imu_moves(self.data) for p in parameters)]
        together = np.hstack(moves)
        size = together.shape[1]
        # Per pose its own block and the moves; at the end the parameters themselves.
        own, moved = np.indices((m, POSE, POSE)), np.indices((m, POSE, size))
        last = POSE * m + np.arange(size)
        entries = np.concatenate(
            [np.tile(back.ravel(), m), np.tile(together.ravel(), m), np.ones(size)]
        )
        rows = np.concatenate([(POSE * at[0] + at[1]).ravel() for at in (own, moved)])
        columns = np.concatenate([(POSE * own[0] + own[2]).ravel(), POSE * m + moved[2].ravel()])
        where = np.concatenate([rows, last]), np.concatenate([columns, last])
        shape = (POSE * m + size, POSE * m + size)
        return scipy.sparse.csr_array((entries, where), shape=shape)


def _place(names: Sequence[str], name: str) -> int:
    """Index of a name; after all if it is not there."""
    return list(names).index(name) if name in names else len(names)


def _eliminated_under_prior(
    information: Array, gradient: Array, keep: int, prior: Sequence[UncertainParameter]
) -> tuple[Array, Array]:
    """Adds the priors of the coordinates after the first `keep`, and eliminates these."""
    weight = np.concatenate([np.asarray(p.sigmas) ** -2.0 for p in prior])
    offset = np.concatenate(
        [np.zeros(p.parameter.size) if p.offset is None else p.offset for p in prior]
    )
    inverse = inverse_of(information[keep:, keep:] + np.diag(weight))
    to_keep = information[:keep, keep:] @ inverse
    rest = gradient[keep:] - weight * offset
    return (
        information[:keep, :keep] - to_keep @ information[keep:, :keep],
        gradient[:keep] - to_keep @ rest,
    )
