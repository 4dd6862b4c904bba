"""Information of a planned drive on the extrinsics: clouds and ground, linearised along the drive.

Each measurement is a row of Jacobians with respect to the pose of its node (vehicle frame, right
perturbation) and the coordinates that all nodes share (`Columns`). Everything except extrinsics
and time offsets is then eliminated by Schur complements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.ground import GROUND_BIASES, TOGETHER_NS, bias_sigmas
from caliv_graph.calibration.ground_floors import sharing_places
from caliv_graph.calibration.ground_weights import TILT_RAD
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.geometry.se3 import skew
from caliv_graph.planning.assumptions import Assumptions, Ground, Source
from caliv_graph.planning.motion import NODE_NS, PlannedMotion, plan_motion
from caliv_graph.planning.sightings import (
    INDEPENDENT_PART,
    SEEN_PART,
    Placement,
    Sighting,
    ground_by_range_bias,
    placements,
    scan_stamps,
    sees_ground,
)
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drives import Route
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.targets.cloud.views import view_weights
from caliv_graph.targets.ground.measure import MAX_APART_NS
from caliv_graph.trajectory.chain import POSE, STATE, Chain

PLANE = 3
"""Number of coordinates of the ground plane: slopes along its x and y, and height."""

RAMP_HEIGHT_M = 0.02
"""Height of the ground above level from which on the vehicle does not stand on the plane."""

LEAST_HEAVE_M = 1e-4
"""Of the vehicle on its wheels, 1 sigma: `calibrate` estimates none below."""

RIDGE = 1e-6
"""Information added to targets and planes. It makes unobservable coordinates (the yaw of a round
target) regular, so that they can be eliminated."""


@dataclass
class Columns:
    """Columns of the coordinates that all nodes of one drive share, behind the six of a pose.

    Their order is: extrinsics, time offsets, targets, range biases of each LiDAR on the ground,
    ground plane, error of the vehicle's height.

    Attributes:
        lidars: the LiDARs that take part.
        offsets: whether each has a time offset.
        targets: names of the placements.
        ground: use of the ground.
    """

    lidars: Sequence[str]
    offsets: bool
    targets: Sequence[str]
    ground: Ground

    def lidar(self, name: str) -> slice:
        """Extrinsic of a LiDAR."""
        at = 6 * self.lidars.index(name)
        return slice(at, at + 6)

    def offset(self, name: str) -> int:
        """Time offset of a LiDAR."""
        return 6 * len(self.lidars) + self.lidars.index(name)

    @property
    def kept(self) -> int:
        """Number of columns that are not eliminated: extrinsics and time offsets."""
        return (6 + self.offsets) * len(self.lidars)

    def target(self, name: str) -> slice:
        """Pose of a target."""
        at = self.kept + 6 * self.targets.index(name)
        return slice(at, at + 6)

    def biases(self, name: str) -> slice:
        """What a LiDAR has in common on all ground, as `calibration.ground.bias_sigmas` has it."""
        at = self._biases + GROUND_BIASES * self.lidars.index(name)
        return slice(at, at + GROUND_BIASES)

    @property
    def all_biases(self) -> IntArray:
        """Those of all LiDARs."""
        return np.arange(self._biases, self.plane)

    @property
    def _biases(self) -> int:
        return self.kept + 6 * len(self.targets)

    @property
    def plane(self) -> int:
        """Start of the ground plane."""
        return self._biases + GROUND_BIASES * len(self.lidars) * (self.ground != "none")

    @property
    def height(self) -> int:
        """Error of the vehicle's height above the plane."""
        return self.plane + PLANE

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.plane + (PLANE if self.ground != "none" else 0) + (self.ground == "height")


def drive_information(
    scenario: Scenario,
    drive: Route,
    sightings: Sequence[Sighting],
    lidars: Sequence[str],
    assumptions: Assumptions,
) -> Array:
    """Information of one drive on extrinsics and time offsets; everything else is eliminated.

    Returns:
        (6n, 6n) vehicle axes, or (7n, 7n) with a time offset per LiDAR after all extrinsics.
    """
    used = [s for s in sightings if len(s.used)]
    # Two clouds of each LiDAR stay: one alone tells nothing where the place of a target is free.
    stride = min([assumptions.stride, *(max(len(s.used) // 2, 1) for s in used)])
    used = [replace(s, used=s.used[stride // 2 :: stride]) for s in used]
    at_targets = np.unique(np.concatenate([s.stamps_ns[s.used] for s in used]))
    everywhere = assumptions.ground_everywhere and assumptions.ground != "none"
    stamps = at_targets
    if everywhere:
        stamps = np.unique(
            np.concatenate([scan_stamps(scenario, n, drive.duration_s) for n in scenario.lidars])
        )
    motion = plan_motion(
        drive, scenario, stamps, source_of(scenario, assumptions), NODE_NS * stride
    )
    columns = Columns(
        lidars,
        assumptions.time_offset,
        list(dict.fromkeys(s.placement for s in used)),
        assumptions.ground,
    )
    n, k = len(motion.nodes_ns), columns.size
    # Per node, information on pose (vehicle frame, heave included) and shared coordinates.
    H = np.zeros((n, POSE + k, POSE + k))
    by_name = {p.name: p for p in placements(scenario)}
    for sighting in used:
        add_clouds(H, motion, scenario, sighting, by_name[sighting.placement], columns)
    if assumptions.ground != "none":
        add_ground(H, motion, scenario, drive, stamps, columns, assumptions)
    H = stride * eliminate_heave(H, assumptions.heave_sigma_m)
    diagonal = motion.diagonal.copy()
    turn = motion.to_vehicle
    diagonal[:, :POSE, :POSE] += turn.T @ H[:, :POSE, :POSE] @ turn
    border = np.zeros((n, STATE, k))
    border[:, :POSE] = turn.T @ H[:, :POSE, POSE:]
    corner = H[:, POSE:, POSE:].sum(axis=0)
    rest = np.arange(columns.kept, k)
    corner[rest, rest] += RIDGE
    corner[columns.all_biases, columns.all_biases] += bias_information(columns, assumptions)
    if assumptions.ground == "height":
        corner[columns.height, columns.height] += height_sigma_of(scenario, assumptions) ** -2.0
    last = Chain(diagonal, motion.coupling, border, corner).only(np.array([n - 1]))
    edge = last.border[0]
    common = last.corner - edge.T @ np.linalg.solve(last.diagonal[0], edge)
    return eliminated(common, columns.kept)


def source_of(scenario: Scenario, assumptions: Assumptions) -> Source:
    """Where the vehicle's poses come from."""
    if assumptions.source is not None:
        return assumptions.source
    aided = scenario.gnss.enabled or scenario.velocity.enabled
    return "sensors" if scenario.imu.enabled and aided else "poses"


def height_sigma_of(scenario: Scenario, assumptions: Assumptions) -> float:
    """1 sigma of the vehicle's height above ground, metres, above zero."""
    sigma = assumptions.ground_height_sigma_m
    return max(scenario.suspension.height_sigma_m if sigma is None else sigma, 1e-5)


def bias_information(columns: Columns, assumptions: Assumptions) -> Array:
    """Prior information of `Columns.all_biases`."""
    count = len(columns.all_biases) // GROUND_BIASES
    return np.tile(bias_sigmas(assumptions.ranges) ** -2.0, count)


def eliminated(H: Array, keep: int) -> Array:
    """Schur complement: information (keep, keep) on the first coordinates."""
    if keep == len(H):
        return H
    rest = H[keep:, keep:]
    scale = 1.0 / np.sqrt(np.diagonal(rest))
    even = rest * np.outer(scale, scale)
    cross = H[keep:, :keep] * scale[:, None]
    out = H[:keep, :keep] - cross.T @ np.linalg.solve(even, cross)
    return np.asarray(0.5 * (out + out.T))


def add_clouds(
    H: Array,
    motion: PlannedMotion,
    scenario: Scenario,
    sighting: Sighting,
    placement: Placement,
    columns: Columns,
) -> None:
    """Adds the registered clouds of one LiDAR.

    The measurement is `Z = C X E`, with left perturbations at the target's centre.

    Args:
        H: (n, 6 + k, 6 + k) information per node, changed in place.
        motion: the planned motion with n nodes.
        scenario: the LiDARs.
        sighting: the clouds; those `used` are added.
        placement: the target.
        columns: the k shared coordinates.
    """
    nodes = motion.nodes_of(sighting.stamps_ns[sighting.used])
    model = scenario.lidars[sighting.lidar]
    independent = sighting.points[sighting.used] * INDEPENDENT_PART / SEEN_PART
    info = placement.information(independent, model.range_sigma_m)
    info *= view_weights(sighting.centres_lidar[sighting.used])[:, None, None]
    R = motion.R_map_vehicle[nodes]
    # Adjoint of C X: the target frame has map axes and its origin at the target.
    by_pose = np.zeros((len(nodes), 6, 6))
    by_pose[:, :3, :3] = by_pose[:, 3:, 3:] = R
    by_pose[:, 3:, :3] = skew(motion.position_map[nodes] - placement.centre_map) @ R
    J = np.zeros((len(nodes), 6, H.shape[1]))
    J[:, :, :POSE] = by_pose
    J[:, :, _behind(columns.lidar(sighting.lidar))] = by_pose @ _to_origin(model.mounting)
    J[:, :, _behind(columns.target(sighting.placement))] = np.eye(6)
    if columns.offsets:
        # With stamps late by d, the pose of the cloud is that of a time d later.
        twist = np.einsum("nij,nj->ni", by_pose, motion.twist[nodes])
        J[:, :, POSE + columns.offset(sighting.lidar)] = -twist
    np.add.at(H, nodes, np.swapaxes(J, 1, 2) @ info @ J)


def _behind(columns: slice) -> slice:
    return slice(POSE + columns.start, POSE + columns.stop)


def _to_origin(extrinsic: PoseConfig) -> Array:
    """(6, 6) from an extrinsic's perturbation in vehicle axes to one at the vehicle's origin.

    A rotation w of the LiDAR about its own origin moves a point at the vehicle's origin by -w x t.
    """
    t = extrinsic.pose().translation()
    out = np.eye(6)
    out[3:, :3] = skew(t)
    return out


def add_ground(
    H: Array,
    motion: PlannedMotion,
    scenario: Scenario,
    drive: Route,
    stamps_ns: IntArray,
    columns: Columns,
    assumptions: Assumptions,
    only: frozenset[str] | None = None,
) -> None:
    """Adds the ground: the plane that each LiDAR measures, and the plane under the wheels.

    Args:
        H: see `add_clouds`.
        motion: the planned motion.
        scenario: the LiDARs.
        drive: the drive.
        stamps_ns: times at which the ground is measured.
        columns: the shared coordinates.
        assumptions: sigmas of the ground, and its use.
        only: LiDARs that measure planes; None: all that see the ground.
    """
    R_plane_map = _plane_axes(motion, drive)
    level = _level(motion, scenario, drive, R_plane_map)
    nodes = motion.nodes_of(stamps_ns)
    # Of the vehicle in axes of the plane.
    R = R_plane_map @ motion.R_map_vehicle
    place = (motion.position_map - motion.position_map[nodes].mean(axis=0)) @ R_plane_map.T
    tilt_sigma, distance_sigma = (
        assumptions.ground_tilt_sigma_rad,
        assumptions.ground_distance_sigma_m,
    )
    stood = np.zeros(len(level), dtype=np.bool_)
    for name in columns.lidars:
        model = scenario.lidars[name]
        if not sees_ground(model) or (only is not None and name not in only):
            continue
        scans = scan_stamps(scenario, name, drive.duration_s)
        if not len(scans):
            continue
        nearest = np.abs(scans[None] - motion.nodes_ns[nodes][:, None]).min(axis=1)
        near = (nearest <= MAX_APART_NS) & level[nodes]
        at = nodes[near]
        # A scan between two poses has another heave than both, so its variance counts twice.
        info = np.tile([tilt_sigma, tilt_sigma, distance_sigma], (len(at), 1)) ** -2.0
        heave_variance = 2.0 * assumptions.heave_sigma_m**2
        later = nearest[near] > TOGETHER_NS
        info[later, 2] = 1.0 / (distance_sigma**2 + heave_variance)
        info *= view_weights(motion.position_map[at])[:, None]
        stood[at] = True
        J = np.zeros((len(at), 3, H.shape[1]))
        _seen_plane(J, R[at], place[at], model, name, columns)
        np.add.at(H, at, np.swapaxes(J, 1, 2) @ (info[:, :, None] * J))
    if assumptions.ground == "height":
        _add_contact(H, np.flatnonzero(stood), R, place, columns, assumptions)


def _seen_plane(
    J: Array,
    R: Array,
    place: Array,
    model: LidarModel,
    name: str,
    columns: Columns,
) -> None:
    """Fills the derivatives (m, 3, 6 + k) of the plane that a LiDAR sees from m nodes.

    Two of its normal, one of its distance, in axes of the plane, as is the vehicle: rotation `R`
    (m, 3, 3), `place` (m, 3) metres.
    """
    t = model.mounting.pose().translation()
    arm = place + R @ t
    lidar = _behind(columns.lidar(name)).start
    plane = POSE + columns.plane
    # Residual of the normal: LiDAR tilt minus slopes of the plane.
    tilt = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]) @ R
    J[:, :2, :3] = J[:, :2, lidar : lidar + 3] = tilt
    J[:, 0, plane] = J[:, 1, plane + 1] = -1.0
    J[:, 2, :3] = -R[:, 2] @ skew(t)
    J[:, 2, 3:6] = J[:, 2, lidar + 3 : lidar + 6] = R[:, 2]
    J[:, 2, plane : plane + 2] = -arm[:, :2]
    J[:, 2, plane + 2] = -1.0
    # Predicted less measured: where the ground seems to rise, its normal leans back.
    changed = ground_by_range_bias(model)
    biases = _behind(columns.biases(name))
    lift = np.zeros((*tilt.shape[:2], 1))
    J[:, :2, biases] = np.concatenate([R[:, :2, :2] @ changed[:2], tilt, lift], axis=2)
    J[:, 2, biases] = [*changed[2], 0.0, 0.0, 0.0, 1.0]


def _add_contact(
    H: Array, at: IntArray, R: Array, place: Array, columns: Columns, assumptions: Assumptions
) -> None:
    """Adds that the vehicle stands on the plane, at the nodes `at`; see `_seen_plane`."""
    R, place = R[at], place[at]
    # Waves below the vehicle count once per place, as in `calibration.ground`.
    waves = assumptions.ground_distance_sigma_m**2 * sharing_places(place, np.ones(len(place)))
    variances = max(assumptions.heave_sigma_m, LEAST_HEAVE_M) ** 2 + waves
    J = np.zeros((len(at), 1, H.shape[1]))
    J[:, 0, 3:6] = R[:, 2]
    J[:, 0, POSE + columns.plane : POSE + columns.plane + 2] = -place[:, :2]
    J[:, 0, POSE + columns.plane + 2] = J[:, 0, POSE + columns.height] = -1.0
    H[at] += np.swapaxes(J, 1, 2) @ J / variances[:, None, None]


def _plane_axes(motion: PlannedMotion, drive: Route) -> Array:
    """R_plane_map (3, 3): axes of the ground plane, z along its normal, x as near to map x.

    Where no terrain is stated (a recorded drive), the plane is that of most poses. It may have a
    slope, as in `calibration.ground_weights`.
    """
    if drive.terrain is not None:
        return np.eye(3)
    normal = np.median(motion.R_map_vehicle[:, :, 2], axis=0)
    normal /= np.linalg.norm(normal)
    along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    return np.array([along, np.cross(normal, along), normal])


def _level(motion: PlannedMotion, scenario: Scenario, drive: Route, R_plane_map: Array) -> Array:
    """(n,) whether the vehicle stands on the plane, not on a ramp."""
    # x and y of the normal in the vehicle frame.
    tilt = np.einsum("i,nij->nj", R_plane_map[2], motion.R_map_vehicle)[:, :2]
    if drive.terrain is None:
        off = np.linalg.norm(tilt - np.median(tilt, axis=0), axis=1)
        return np.asarray(off < math.sin(TILT_RAD[0]))
    low = motion.position_map[:, 2] - scenario.world.ground.height_m < RAMP_HEIGHT_M
    return np.asarray((np.linalg.norm(tilt, axis=1) < math.sin(TILT_RAD[0])) & low)


def eliminate_heave(H: Array, sigma_m: float) -> Array:
    """Information (n, m, m) after eliminating the heave of each node, along the vehicle's z.

    All measurements at a stamp share its heave. The trajectory does not contain it.
    """
    if sigma_m <= 0.0:
        return H
    z = 5
    row = H[:, z]
    return np.asarray(
        H - row[:, :, None] * row[:, None, :] / (row[:, z] + sigma_m**-2.0)[:, None, None]
    )
