"""What a drive will determine, before it is driven (SPEC 4 and 8).

No measurement is drawn: the graph that `calibrate` would solve is linearised along the planned
drive, and all but the extrinsics is eliminated from its information. Poses, clouds and ground
make a chain in time whose states share a few coordinates (extrinsics, targets, the ground's
plane), so this takes a tenth of a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from caliv_graph.calibration.graph import OFFSET_SIGMA_S
from caliv_graph.calibration.ground import TOGETHER_NS
from caliv_graph.calibration.ground_weights import TILT_RAD
from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.calibration.solve import OFFSET_DETERMINED_S
from caliv_graph.config.model import ExtractionConfig, PoseConfig, PoseSigmaConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import ConfigError, TargetError
from caliv_graph.geometry.se3 import skew
from caliv_graph.planning.motion import NODE_NS, PlannedMotion, Source, plan_motion
from caliv_graph.planning.sightings import (
    INDEPENDENT_PART,
    SEEN_PART,
    Placement,
    Sighting,
    placements,
    scan_stamps,
    sees_ground,
    sight,
    thinned,
)
from caliv_graph.products import Array, Direction, IntArray
from caliv_graph.scenario.drives import Drive, make_drive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.terrain import make_terrain
from caliv_graph.targets.cloud.views import view_weights
from caliv_graph.targets.ground.measure import MAX_APART_NS
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD
from caliv_graph.trajectory.chain import POSE, STATE, Chain
from caliv_graph.uncertainty.predicted import (
    PredictedCovariance,
    predict_covariance,
)
from caliv_graph.wording.directions import named_prediction
from caliv_graph.wording.offsets import undetermined_offset_sentences

Ground = Literal["none", "plane", "height"]
"""What is made of the ground: nothing; a plane of unknown height; one that the vehicle stands on at
a known height (SPEC 3, roles a and b)."""

UNIFORM_TO_SIGMA = 1.0 / math.sqrt(3.0)
"""Half width of a uniform error to its standard deviation."""

PLANE = 3
"""Slopes along map x and y, and height."""

RAMP_HEIGHT_M = 0.02
"""Where the ground is higher than this above level, the vehicle does not stand on the plane."""

RIDGE = 1e-6
"""Information on targets and planes that nothing tells of (a round target's yaw), so that they can
be eliminated."""

OPPOSITE_DEG = 120.0
"""LiDARs that see a target from directions farther apart than this share little of its surface."""


@dataclass(frozen=True)
class Assumptions:
    """What is taken for granted about how the drive will be recorded and calibrated.

    Attributes:
        ground: what is made of it.
        ground_height_sigma_m: of the vehicle's height above it; None: the scenario's.
        heave_sigma_m: of the vehicle and its LiDARs at each stamp.
        ground_tilt_sigma_rad: of the plane's normal in one scan. Asphalt; a simulated ground is
            flatter.
        ground_distance_sigma_m: of the LiDAR's distance from the plane in one scan.
        source: where poses are from; None: raw sensors if the scenario has them.
        time_offset: a time offset of each LiDAR is estimated as well.
        extraction: how many points and scans are used.
        stride: for a quick look: only every so many-th cloud is looked at, and counts as often.
        ground_everywhere: the ground is measured at every scan, not only at those that see a
            target, which is what `calibrate` does.
    """

    ground: Ground = "height"
    ground_height_sigma_m: float | None = None
    heave_sigma_m: float = HEAVE_SIGMA_M
    ground_tilt_sigma_rad: float = NORMAL_FLOOR_RAD
    ground_distance_sigma_m: float = DISTANCE_FLOOR_M
    source: Source | None = None
    time_offset: bool = False
    extraction: ExtractionConfig = field(default_factory=ExtractionConfig)
    ground_everywhere: bool = False
    stride: int = 1


@dataclass(frozen=True)
class Prediction:
    """What a planned drive, or several of one vehicle, will tell.

    Attributes:
        names: of the drives.
        outlook: sigmas, covariance, directions.
        sightings: which LiDAR sees which target when, per drive.
        space_m: sides of the rectangle along the map's axes that holds the path and the targets,
            the largest of each over the drives.
        duration_s: of all drives together.
        warnings: what a person should know, a line each.
    """

    names: tuple[str, ...]
    outlook: PredictedCovariance
    sightings: tuple[tuple[Sighting, ...], ...]
    space_m: tuple[float, float]
    duration_s: float
    warnings: tuple[str, ...]

    @property
    def sigma_s2v(self) -> Mapping[str, Array]:
        """LiDAR -> (6,) 1 sigma of its mounting, vehicle axes, rotation then translation."""
        return self.outlook.sigma_s2v

    @property
    def sigma_s2s(self) -> Mapping[tuple[str, str], Array]:
        """(from, to) -> (6,) 1 sigma of the one against the other, likewise, at `from`'s origin."""
        return self.outlook.sigma_s2s

    @property
    def undetermined(self) -> tuple[Direction, ...]:
        """Directions that the drive will not tell."""
        return self.outlook.undetermined


def predict(
    scenario: Scenario,
    others: Sequence[Scenario] = (),
    assumptions: Assumptions | None = None,
) -> Prediction:
    """Predicts what calibrating a drive will tell, from its geometry and the noise of its sensors.

    Args:
        scenario: the drive.
        others: more drives of the same vehicle, to be solved together with it.
        assumptions: how it will be recorded and calibrated.

    Raises:
        ConfigError: the scenario has no target, or the drives are not of the same vehicle.
        TargetError: no LiDAR ever sees one.
        TrajectoryError: its sensors do not determine the vehicle's motion.
    """
    assumptions = assumptions or Assumptions()
    scenarios = (scenario, *others)
    for other in others:
        if other.lidars.keys() != scenario.lidars.keys() or any(
            other.lidars[n].mounting != scenario.lidars[n].mounting for n in scenario.lidars
        ):
            raise ConfigError(
                f"scenario '{other.name}': its lidars are not those of '{scenario.name}': several "
                "drives have to be of one vehicle"
            )
    planned = [(s, make_drive(s.drive, make_terrain(s.world.ground))) for s in scenarios]
    return predict_drives(planned, assumptions)


def predict_drives(
    planned: Sequence[tuple[Scenario, Drive]], assumptions: Assumptions
) -> Prediction:
    """The same of drives that no scenario can describe.

    Args:
        planned: scenarios of one vehicle, and the drive that takes the place of each one's own.
        assumptions: how they will be recorded and calibrated.

    Raises:
        ConfigError, TargetError, TrajectoryError: as for `predict`.
    """
    first = planned[0][0]
    seen = [_sightings(scenario, drive, assumptions) for scenario, drive in planned]
    lidars = tuple(
        name
        for name in first.lidars
        if any(len(s.used) for of in seen for s in of if s.lidar == name)
    )
    if not lidars:
        raise TargetError(_nobody(planned, seen, assumptions.extraction))
    n = len(lidars)
    size = (7 if assumptions.time_offset else 6) * n
    information = np.zeros((size, size))
    for (scenario, drive), sightings in zip(planned, seen, strict=True):
        if any(len(s.used) for s in sightings):
            information += _information(scenario, drive, sightings, lidars, assumptions)
    sigmas = _guess_sigmas(first)
    D, offsets_s = _without_offsets(information, lidars, np.diag(np.tile(sigmas, n) ** -2.0))
    outlook = predict_covariance(
        D,
        lidars,
        first.reference if first.reference in lidars else lidars[0],
        {name: model.mounting.pose() for name, model in first.lidars.items()},
        dict.fromkeys(first.lidars, sigmas),
        {name: sum(len(s.used) for of in seen for s in of if s.lidar == name) for name in lidars},
        offsets_s,
    )
    return Prediction(
        names=tuple(scenario.name for scenario, _ in planned),
        outlook=named_prediction(outlook),
        sightings=tuple(seen),
        space_m=space(planned),
        duration_s=sum(drive.duration_s for _, drive in planned),
        warnings=(
            *_warnings(planned, seen, lidars, assumptions.time_offset),
            *undetermined_offset_sentences(offsets_s, OFFSET_DETERMINED_S),
        ),
    )


# ------------------------------------------------------------------ who sees what


def _sightings(scenario: Scenario, drive: Drive, assumptions: Assumptions) -> tuple[Sighting, ...]:
    """All LiDARs against all placements, and which clouds are used."""
    if not scenario.world.targets:
        raise ConfigError(
            f"scenario '{scenario.name}': world.targets names no target to plan with: add an "
            "object and its name there"
        )
    extraction = assumptions.extraction
    out = []
    for placement in placements(scenario):
        alike = [sight(drive, scenario, name, placement, extraction) for name in scenario.lidars]
        seeing = sum(len(s.stamps_ns) >= extraction.min_scans for s in alike)
        for s in alike:
            used = thinned(view_weights(s.centres_lidar), seeing, extraction)
            out.append(replace(s, used=used))
    return tuple(out)


def _nobody(
    planned: Sequence[tuple[Scenario, Drive]],
    seen: Sequence[Sequence[Sighting]],
    extraction: ExtractionConfig,
) -> str:
    best = max((s for of in seen for s in of), key=lambda s: len(s.stamps_ns))
    names = ", ".join(f"'{scenario.name}'" for scenario, _ in planned)
    return (
        f"scenario {names}: no LiDAR sees a target: '{best.lidar}' would have '{best.placement}' "
        f"in view in {len(best.stamps_ns)} of {best.scans} scans with {extraction.min_points} "
        f"points or more, and {extraction.min_scans} are needed. Move the target nearer to the "
        "path, or drive longer"
    )


def _warnings(
    planned: Sequence[tuple[Scenario, Drive]],
    seen: Sequence[Sequence[Sighting]],
    lidars: Sequence[str],
    time_offset: bool,
) -> Iterable[str]:
    for name in planned[0][0].lidars:
        if name not in lidars:
            yield f"lidar '{name}' never sees a target often enough: its mounting stays the guess"
    for scenario, _ in planned:
        for placement in placements(scenario):
            if placement.is_round:
                yield (
                    f"target '{placement.name}' looks the same after any turn: it tells no "
                    "heading. Take a chair, or anything without symmetry"
                )
    yield from _unshared(seen, lidars)
    if not time_offset:
        for scenario, _ in planned:
            for name, lidar in scenario.lidars.items():
                if lidar.time_offset_s:
                    yield (
                        f"the stamps of lidar '{name}' are off by {1e3 * lidar.time_offset_s:+.0f} "
                        "ms, which is in no sigma here: let its time offset be estimated "
                        "(--time-offset; solve.time_offset)"
                    )
    for scenario, _ in planned:
        if scenario.imu.enabled and scenario.imu.orientation.yaw_bias_deg:
            yield (
                f"the heading of the orientation source is off by "
                f"{scenario.imu.orientation.yaw_bias_deg:g} degrees: so will be the yaw of every "
                "LiDAR, which is in no sigma here"
            )


def _unshared(seen: Sequence[Sequence[Sighting]], lidars: Sequence[str]) -> Iterable[str]:
    """A line per pair of LiDARs that see a target from opposite sides only."""
    for i, a in enumerate(lidars):
        for b in lidars[i + 1 :]:
            apart = []
            for sightings in seen:
                of = {(s.lidar, s.placement): s.towards_deg[s.used] for s in sightings}
                for placement in {s.placement for s in sightings}:
                    one, other = of[a, placement], of[b, placement]
                    if len(one) and len(other):
                        angle = np.abs((one[:, None] - other[None] + 180.0) % 360.0 - 180.0)
                        apart.append(float(angle.min()))
            if apart and min(apart) > OPPOSITE_DEG:
                yield (
                    f"lidars '{a}' and '{b}' see a target from sides at least {min(apart):.0f} "
                    "degrees apart: they share little of its surface, and what is predicted for "
                    "the one against the other is too good. Let both pass the same side of it"
                )


def space(planned: Sequence[tuple[Scenario, Drive]]) -> tuple[float, float]:
    """Sides of the rectangles about path and targets, the largest of each."""
    sides = []
    for scenario, drive in planned:
        stamps = np.linspace(0, drive.duration_s * 1e9, 200).astype(np.int64)
        places = [
            drive.motion(stamps).xy_map,
            *(p.centre_map[None, :2] for p in placements(scenario)),
        ]
        sides.append(np.ptp(np.concatenate(places), axis=0))
    x, y = np.max(sides, axis=0).tolist()
    return (x, y)


# ------------------------------------------------------------------ information


@dataclass
class _Columns:
    """Where the common coordinates of one drive stand behind the six of a pose."""

    lidars: Sequence[str]
    offsets: bool
    targets: Sequence[str]
    ground: Ground

    def lidar(self, name: str) -> slice:
        at = 6 * self.lidars.index(name)
        return slice(at, at + 6)

    def offset(self, name: str) -> int:
        return 6 * len(self.lidars) + self.lidars.index(name)

    @property
    def kept(self) -> int:
        return (6 + self.offsets) * len(self.lidars)

    def target(self, name: str) -> slice:
        at = self.kept + 6 * self.targets.index(name)
        return slice(at, at + 6)

    @property
    def plane(self) -> int:
        return self.kept + 6 * len(self.targets)

    @property
    def height(self) -> int:
        return self.plane + PLANE

    @property
    def size(self) -> int:
        return self.plane + (PLANE if self.ground != "none" else 0) + (self.ground == "height")


def _information(
    scenario: Scenario,
    drive: Drive,
    sightings: Sequence[Sighting],
    lidars: Sequence[str],
    assumptions: Assumptions,
) -> Array:
    """Information of one drive on extrinsics (and time offsets), vehicle axes, all else eliminated.

    Returns:
        (6n, 6n), or (7n, 7n) with a time offset per LiDAR after all extrinsics.
    """
    stride = assumptions.stride
    used = [replace(s, used=s.used[stride // 2 :: stride]) for s in sightings]
    used = [s for s in used if len(s.used)]
    at_targets = np.unique(np.concatenate([s.stamps_ns[s.used] for s in used]))
    everywhere = assumptions.ground_everywhere and assumptions.ground != "none"
    stamps = at_targets
    if everywhere:
        stamps = np.unique(
            np.concatenate([scan_stamps(scenario, n, drive.duration_s) for n in scenario.lidars])
        )
    motion = plan_motion(
        drive, scenario, stamps, _source(scenario, assumptions), NODE_NS * assumptions.stride
    )
    columns = _Columns(
        lidars,
        assumptions.time_offset,
        list(dict.fromkeys(s.placement for s in used)),
        assumptions.ground,
    )
    n, k = len(motion.nodes_ns), columns.size
    # Of pose (vehicle frame, heave included) and common coordinates, at each node.
    H = np.zeros((n, POSE + k, POSE + k))
    by_name = {p.name: p for p in placements(scenario)}
    for sighting in used:
        _add_clouds(H, motion, scenario, sighting, by_name[sighting.placement], columns)
    if assumptions.ground != "none":
        _add_ground(H, motion, scenario, drive, stamps, columns, assumptions)
    H = stride * _with_heave(H, assumptions.heave_sigma_m)
    diagonal = motion.diagonal.copy()
    turn = motion.to_vehicle
    diagonal[:, :POSE, :POSE] += turn.T @ H[:, :POSE, :POSE] @ turn
    border = np.zeros((n, STATE, k))
    border[:, :POSE] = turn.T @ H[:, :POSE, POSE:]
    corner = H[:, POSE:, POSE:].sum(axis=0)
    rest = np.arange(columns.kept, k)
    corner[rest, rest] += RIDGE
    if assumptions.ground == "height":
        sigma = assumptions.ground_height_sigma_m
        sigma = scenario.suspension.height_sigma_m if sigma is None else sigma
        corner[columns.height, columns.height] += max(sigma, 1e-5) ** -2.0
    last = Chain(diagonal, motion.coupling, border, corner).only(np.array([n - 1]))
    edge = last.border[0]
    common = last.corner - edge.T @ np.linalg.solve(last.diagonal[0], edge)
    return _eliminated(common, columns.kept)


def _source(scenario: Scenario, assumptions: Assumptions) -> Source:
    if assumptions.source is not None:
        return assumptions.source
    aided = scenario.gnss.enabled or scenario.velocity.enabled
    return "sensors" if scenario.imu.enabled and aided else "poses"


def _eliminated(H: Array, keep: int) -> Array:
    """Information (keep, keep) on the first coordinates, the others eliminated."""
    if keep == len(H):
        return H
    rest = H[keep:, keep:]
    scale = 1.0 / np.sqrt(np.diagonal(rest))
    even = rest * np.outer(scale, scale)
    cross = H[keep:, :keep] * scale[:, None]
    out = H[:keep, :keep] - cross.T @ np.linalg.solve(even, cross)
    return np.asarray(0.5 * (out + out.T))


def _add_clouds(
    H: Array,
    motion: PlannedMotion,
    scenario: Scenario,
    sighting: Sighting,
    placement: Placement,
    columns: _Columns,
) -> None:
    """Registered clouds of one LiDAR: `Z = C X E`, left perturbations at the target's centre."""
    nodes = motion.nodes_of(sighting.stamps_ns[sighting.used])
    model = scenario.lidars[sighting.lidar]
    independent = sighting.points[sighting.used] * INDEPENDENT_PART / SEEN_PART
    info = placement.information(independent, model.range_sigma_m)
    info *= view_weights(sighting.centres_lidar[sighting.used])[:, None, None]
    R = motion.R_map_vehicle[nodes]
    # Adjoint of C X: the target's frame has map axes, its origin at the target.
    by_pose = np.zeros((len(nodes), 6, 6))
    by_pose[:, :3, :3] = by_pose[:, 3:, 3:] = R
    by_pose[:, 3:, :3] = skew(motion.position_map[nodes] - placement.centre_map) @ R
    J = np.zeros((len(nodes), 6, H.shape[1]))
    J[:, :, :POSE] = by_pose
    J[:, :, _behind(columns.lidar(sighting.lidar))] = by_pose @ _to_origin(model.mounting)
    J[:, :, _behind(columns.target(sighting.placement))] = np.eye(6)
    if columns.offsets:
        # Stamps that are late by d have the pose of d later.
        twist = np.einsum("nij,nj->ni", by_pose, motion.twist[nodes])
        J[:, :, POSE + columns.offset(sighting.lidar)] = -twist
    np.add.at(H, nodes, np.swapaxes(J, 1, 2) @ info @ J)


def _behind(columns: slice) -> slice:
    return slice(POSE + columns.start, POSE + columns.stop)


def _to_origin(mounting: PoseConfig) -> Array:
    """(6, 6) a mounting's perturbation in vehicle axes at its own origin, as one at the vehicle's.

    Turning a LiDAR about itself by w moves what is at the vehicle's origin by -w x t.
    """
    t = mounting.pose().translation()
    out = np.eye(6)
    out[3:, :3] = skew(t)
    return out


def _add_ground(
    H: Array,
    motion: PlannedMotion,
    scenario: Scenario,
    drive: Drive,
    stamps_ns: IntArray,
    columns: _Columns,
    assumptions: Assumptions,
) -> None:
    """The plane as each LiDAR sees it (role a), and as the vehicle stands on it (role b)."""
    level = _level(motion, scenario, drive)
    nodes = motion.nodes_of(stamps_ns)
    anchor = motion.position_map[nodes].mean(axis=0)
    tilt_sigma, distance_sigma = (
        assumptions.ground_tilt_sigma_rad,
        assumptions.ground_distance_sigma_m,
    )
    stood = np.zeros(len(level), dtype=np.bool_)
    for name in columns.lidars:
        model = scenario.lidars[name]
        if not sees_ground(model):
            continue
        scans = scan_stamps(scenario, name, drive.duration_s)
        if not len(scans):
            continue
        nearest = np.abs(scans[None] - motion.nodes_ns[nodes][:, None]).min(axis=1)
        near = (nearest <= MAX_APART_NS) & level[nodes]
        at = nodes[near]
        # A scan between two poses sees another heave; how much another is only known afterwards.
        info = np.tile([tilt_sigma, tilt_sigma, distance_sigma], (len(at), 1)) ** -2.0
        heave_variance = 2.0 * assumptions.heave_sigma_m**2
        later = nearest[near] > TOGETHER_NS
        info[later, 2] = 1.0 / (distance_sigma**2 + heave_variance)
        info *= view_weights(motion.position_map[at])[:, None]
        stood[at] = True
        t = model.mounting.pose().translation()
        R, place = motion.R_map_vehicle[at], motion.position_map[at]
        arm = place + R @ t - anchor
        J = np.zeros((len(at), 3, H.shape[1]))
        lidar = _behind(columns.lidar(name)).start
        plane = POSE + columns.plane
        # The normal, in map axes, turns against the LiDAR and with the slopes.
        tilt = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]) @ R
        J[:, :2, :3] = J[:, :2, lidar : lidar + 3] = tilt
        J[:, 0, plane] = J[:, 1, plane + 1] = -1.0
        J[:, 2, :3] = -R[:, 2] @ skew(t)
        J[:, 2, 3:6] = J[:, 2, lidar + 3 : lidar + 6] = R[:, 2]
        J[:, 2, plane : plane + 2] = -arm[:, :2]
        J[:, 2, plane + 2] = -1.0
        np.add.at(H, at, np.swapaxes(J, 1, 2) @ (info[:, :, None] * J))
    if assumptions.ground != "height":
        return
    at = np.flatnonzero(stood)
    R, place = motion.R_map_vehicle[at], motion.position_map[at] - anchor
    J = np.zeros((len(at), 1, H.shape[1]))
    J[:, 0, 3:6] = R[:, 2]
    J[:, 0, POSE + columns.plane : POSE + columns.plane + 2] = -place[:, :2]
    J[:, 0, POSE + columns.plane + 2] = J[:, 0, POSE + columns.height] = -1.0
    H[at] += np.swapaxes(J, 1, 2) @ J / HEAVE_SIGMA_M**2


def _level(motion: PlannedMotion, scenario: Scenario, drive: Drive) -> Array:
    """(n,) whether the vehicle stands on the plane: not on a ramp."""
    upright = motion.R_map_vehicle[:, 2, 2] > math.cos(TILT_RAD[0])
    low = motion.position_map[:, 2] - scenario.world.ground.height_m < RAMP_HEIGHT_M
    return np.asarray(upright & low) if drive.terrain is not None else np.asarray(upright)


def _with_heave(H: Array, sigma_m: float) -> Array:
    """Information (n, m, m) with each node's own heave, along the vehicle's z, eliminated.

    What is measured at a stamp shares its heave; the trajectory knows nothing of it.
    """
    if sigma_m <= 0.0:
        return H
    z = 5
    row = H[:, z]
    return np.asarray(
        H - row[:, :, None] * row[:, None, :] / (row[:, z] + sigma_m**-2.0)[:, None, None]
    )


# ------------------------------------------------------------------ sigmas


def _guess_sigmas(scenario: Scenario) -> Array:
    """(6,) of a guess, vehicle axes, as the config that `simulate` writes states them."""
    guess, usual = scenario.initial_guess, PoseSigmaConfig(xyz=0.058, rpy_deg=1.73)
    turn = math.radians(guess.rotation_deg) * UNIFORM_TO_SIGMA
    shift = guess.translation_m * UNIFORM_TO_SIGMA
    return np.array(
        [*([turn] * 3 if turn else usual.rpy_rad()), *([shift] * 3 if shift else usual.xyz_m())]
    )


def _without_offsets(
    information: Array, lidars: Sequence[str], prior: Array
) -> tuple[Array, dict[str, float]]:
    """Information on extrinsics alone, and the sigma of each time offset, if there are any.

    As `calibrate` does, an offset that the drive does not tell is not freed.
    """
    size = 6 * len(lidars)
    if len(information) == size:
        return information, {}
    both = information.copy()
    offsets = np.arange(size, len(both))
    both[offsets, offsets] += OFFSET_SIGMA_S**-2.0
    known = both.copy()
    known[:size, :size] += prior
    scale = 1.0 / np.sqrt(np.diagonal(known))
    cov = np.linalg.inv(known * np.outer(scale, scale)) * np.outer(scale, scale)
    sigma = np.sqrt(np.diagonal(cov))[offsets]
    kept = np.append(np.arange(size), offsets[sigma < OFFSET_DETERMINED_S])
    D = _eliminated(both[np.ix_(kept, kept)], size)
    return D, dict(zip(lidars, sigma.tolist(), strict=True))


def sigma_of(prediction: Prediction, key: str) -> dict[str, float]:
    """Predicted sigmas that a limit such as `s2v_yaw_deg` or `s2s_x_m` is about.

    Args:
        prediction: of a drive.
        key: as in `limits` of a config.

    Returns:
        What it is of ("'front'", "'front' to 'rear'") -> sigma in the key's unit.
    """
    kind, axis, unit = key.split("_", 2)
    index = AXES.index(axis)
    factor = math.degrees(1.0) if unit == "deg" else 1.0
    if kind == "s2v":
        return {f"'{n}'": float(s[index]) * factor for n, s in prediction.sigma_s2v.items()}
    return {
        f"'{a}' to '{b}'": float(s[index]) * factor for (a, b), s in prediction.sigma_s2s.items()
    }
