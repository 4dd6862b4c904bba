"""The variables of a calibration: LiDARs, poses, clouds, and their keys in the graph."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Protocol

import gtsam
import numpy as np

from caliv_graph.calibration.factors import STILL, CloudMotion
from caliv_graph.calibration.heave import poses_with_heave
from caliv_graph.calibration.vehicle_parameters import (
    KEYS,
    POSE_TIME_OFFSET,
    MotionTerm,
    ParameterPrior,
    ParameterValue,
    motion_term,
    parameter_priors,
    pose_clock_prior,
    rates_of_errors,
)
from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS, configured_guess
from caliv_graph.config.model import Config
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import (
    NANOSECONDS_PER_SECOND,
    key_extrinsic,
    key_offset,
    key_pose_error,
    key_rates,
    key_sensor,
    key_target,
    key_vehicle,
)
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import right_to_vehicle_axes, unstack
from caliv_graph.products import Array, BoolArray, IntArray, TargetCloud, TargetObservation
from caliv_graph.targets.cloud.views import views
from caliv_graph.targets.ground.planes import ground_floors
from caliv_graph.trajectory.noise import given_pose_covariances
from caliv_graph.trajectory.rates import rate_rows_of_drives, turn_variances
from caliv_graph.trajectory.select import (
    GivenTrajectory,
    VehicleTrajectory,
    accelerations_at,
    twists_at,
)
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

HEAVE_SIGMA_M = 0.005
"""1 sigma of the heave, the height of the body on its springs, at each stamp, where neither config
nor data give it: that of a car at walking pace on asphalt. The smoothed trajectory does not contain
it; given poses do."""


def usual_heave_m() -> float:
    """1 sigma of the heave of a vehicle of which nothing else is known."""
    return HEAVE_SIGMA_M


@dataclass(frozen=True)
class Problem:
    """The bookkeeping of one calibration; arrays over clouds are in order of placement, cloud.

    Attributes:
        lidars: names of the LiDARs that take part, in the config's order.
        reference: name of the reference LiDAR, one of `lidars`.
        guesses: initial guess of T_vehicle_lidar per LiDAR.
        prior_sigmas: (6,) per LiDAR, vehicle axes.
        fixed: names of the LiDARs whose guess is trusted.
        poses: (drive, stamp_ns) of every pose used, ascending.
        T_map_vehicle: the given or smoothed pose of each, its map's origin moved to `origins_map`.
        origins_map: (3,) per drive, metres: where the problem's map begins in the drive's. Poses in
            a national grid are too far from its origin for double precision.
        cloud_lidar: (J,) index into `lidars`.
        cloud_pose: (J,) index into `poses`.
        cloud_placement: (J,) index of the placement.
        placements: number of placements.
        motion: per drive with a smoothed trajectory the (6 m, 6 m) information of the motion data
            on its m poses, right perturbations, parameters of the vehicle eliminated. The poses of
            the other drives were given.
        motion_terms: the same with these parameters, of the drives whose poses depend on any.
        parameters: the prior of each of them, one for all drives.
        given_rates: (n, 6) what a second of lateness is as an error of each given pose
            (`factors.given_pose_factor`), zero of the others; None: their clock is exact, or no
            pose was given.
        offsets: names of the LiDARs whose time offset is to be estimated.
        twists: (n, 6) velocity of the vehicle at each pose, a right perturbation per second; None
            if no offset is, and no points were moved.
        accelerations: (n, 6) their change per second; None if no offset is free.
        stated_cov: (n, 6, 6) covariance of the white error of each given pose as its message states
            it, rotation in vehicle axes, position in map axes; NaN: not stated. None: no pose has
            one.
        slow_stated: 1 sigma of the slow errors of given poses, rotation (rad) and position (m),
            that their messages state; None: nothing.
        views: (J,) clouds of its LiDAR that have the view of each (`targets.cloud.views`); None:
            all differ.
        heave_m: 1 sigma of the heave at each pose.
        floors: (3,) 1 sigma of (a, b, distance) of the ground at a place against the plane of its
            drive: its waves.
        rate_rows: per drive the (RATES, 6 m) derivatives of the errors of its rates by its m poses
            (`trajectory.rates`); none where an odometry gave them.
        cloud_apart_s: (J,) mean time of the points of each cloud after its stamp, to which they
            were moved with the rates of the trajectory, seconds; None: zero.
        cloud_turn_rad: (J, 3) 1 sigma of what the gyroscope turned from the stamp of each cloud to
            `cloud_apart_s`, vehicle axes; None: zero.
        moved_with: T_vehicle_lidar with which they were moved; the guess, of one that it has not.
    """

    lidars: tuple[str, ...]
    reference: str
    guesses: Mapping[str, gtsam.Pose3]
    prior_sigmas: Mapping[str, Array]
    fixed: frozenset[str]
    poses: tuple[tuple[int, int], ...]
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    origins_map: Mapping[int, Array]
    cloud_lidar: IntArray
    cloud_pose: IntArray
    cloud_placement: IntArray
    placements: int
    motion: Mapping[int, Array] = field(default_factory=dict)
    motion_terms: Mapping[int, MotionTerm] = field(default_factory=dict)
    parameters: Mapping[str, ParameterPrior] = field(default_factory=dict)
    given_rates: Array | None = None
    offsets: frozenset[str] = frozenset()
    twists: Array | None = None
    accelerations: Array | None = None
    stated_cov: Array | None = None
    slow_stated: tuple[float | None, float | None] = (None, None)
    views: Array | None = None
    heave_m: float = field(default_factory=usual_heave_m)
    floors: Array = field(default_factory=partial(ground_floors, NoiseConfig()))
    rate_rows: Mapping[int, Array] = field(default_factory=dict)
    cloud_apart_s: Array | None = None
    cloud_turn_rad: Array | None = None
    moved_with: Mapping[str, gtsam.Pose3] = field(default_factory=dict)

    @property
    def clouds(self) -> int:
        """Number of clouds."""
        return len(self.cloud_lidar)

    def with_clouds(self, kept: BoolArray) -> Problem:
        """With a part of the clouds, a mask (J,), and all poses."""

        def of(values: Array | None) -> Array | None:
            return None if values is None else values[kept]

        return replace(
            self,
            cloud_lidar=self.cloud_lidar[kept],
            cloud_pose=self.cloud_pose[kept],
            cloud_placement=self.cloud_placement[kept],
            views=of(self.views),
            cloud_apart_s=of(self.cloud_apart_s),
            cloud_turn_rad=of(self.cloud_turn_rad),
        )

    @cached_property
    def motion_cov(self) -> dict[int, Array]:
        """Per drive the (m, m, 6, 6) covariance of `motion`: its inverse, right perturbations."""
        out: dict[int, Array] = {}
        for drive, information in self.motion.items():
            m = len(information) // 6
            cov = np.asarray(np.linalg.inv(information), np.float64)
            out[drive] = cov.reshape(m, 6, m, 6).swapaxes(1, 2)
        return out

    def clouds_of_placements(self) -> list[slice]:
        """Where the clouds of each placement are among all clouds."""
        ends = np.searchsorted(self.cloud_placement, np.arange(self.placements + 1)).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    def all_views(self) -> Array:
        """(J,) `views`, also where all differ."""
        return np.ones(self.clouds) if self.views is None else self.views

    def views_of(self, placement: int) -> Array:
        """How many clouds have the view of each of the clouds of a placement."""
        return self.all_views()[self.clouds_of_placements()[placement]]

    def extrinsic_keys_of(self, lidar: str) -> tuple[int, ...]:
        """Keys whose product is T_vehicle_lidar: E, and S_a unless it is the reference."""
        if lidar == self.reference:
            return (key_extrinsic(),)
        return (key_extrinsic(), key_sensor(self.lidars.index(lidar)))

    def extrinsic_keys(self) -> tuple[int, ...]:
        """E, then S_a of every other LiDAR in order."""
        others = [self.extrinsic_keys_of(n)[1] for n in self.lidars if n != self.reference]
        return (key_extrinsic(), *others)

    def pose_keys(self) -> tuple[int, ...]:
        """X_i of every pose used."""
        return tuple(key_vehicle(i) for i in range(len(self.poses)))

    def pose_error_keys(self) -> tuple[int, ...]:
        """b_i of every given pose used."""
        return tuple(key_pose_error(int(i)) for i in np.flatnonzero(self.given()))

    def target_keys(self) -> tuple[int, ...]:
        """C of every placement."""
        return tuple(key_target(m) for m in range(self.placements))

    def cloud_keys(self, j: int) -> tuple[int, ...]:
        """Keys of C, X_i, of `cloud_motion`, E and S_a of cloud j, in that order."""
        lidar = self.lidars[self.cloud_lidar[j]]
        motion = self.cloud_motion(j)
        offset = (key_offset(int(self.cloud_lidar[j])),) if motion.offset else ()
        rates = (key_rates(self.poses[self.cloud_pose[j]][0]),) if motion.apart_s else ()
        return (
            key_target(int(self.cloud_placement[j])),
            key_vehicle(int(self.cloud_pose[j])),
            *offset,
            *rates,
            *self.extrinsic_keys_of(lidar),
        )

    def cloud_motion(self, j: int) -> CloudMotion:
        """How cloud j moves with the time offset of its LiDAR, if it is free, and with rates."""
        if self.twists is None:
            return STILL
        pose, lidar = int(self.cloud_pose[j]), self.lidars[self.cloud_lidar[j]]
        twist, offset = np.asarray(self.twists[pose]), lidar in self.offsets
        a = np.zeros(6) if self.accelerations is None else np.asarray(self.accelerations[pose])
        R_map_vehicle = self.T_map_vehicle[pose].rotation().matrix()
        swept = self.cloud_apart_s is not None and self.poses[pose][0] in self.rate_rows
        if self.cloud_apart_s is None or not swept or not self.cloud_apart_s[j]:
            return CloudMotion(twist, R_map_vehicle, offset, acceleration=a)
        extrinsic = self.moved_with.get(lidar, self.guesses[lidar])
        apart_s = float(self.cloud_apart_s[j])
        return CloudMotion(twist, R_map_vehicle, offset, apart_s, extrinsic, a)

    def swept_drives(self) -> set[int]:
        """Drives with a cloud whose points were moved with the rates of its trajectory."""
        moved = (j for j in range(self.clouds) if self.cloud_motion(j).apart_s)
        return {self.poses[self.cloud_pose[j]][0] for j in moved}

    def offset_keys(self) -> tuple[int, ...]:
        """Time offsets that are free."""
        return tuple(key_offset(i) for i, name in enumerate(self.lidars) if name in self.offsets)

    def parameter_values(self) -> dict[int, ParameterValue]:
        """Parameters by key: as the smoother of the first drive found, that of given poses zero."""
        out: dict[int, ParameterValue] = {}
        if self.given_rates is not None:
            out[KEYS[POSE_TIME_OFFSET]] = np.zeros(1)
        for term in self.motion_terms.values():
            for name, value in term.values.items():
                out.setdefault(KEYS[name], value)
        return out

    def guess_information(self) -> Array:
        """(6n, 6n) information of the guesses, vehicle axes; trusted ones with default sigmas.

        The trust is among the data (`prior_graph`).
        """
        return np.diag(np.concatenate([self.guess_sigmas(n) for n in self.lidars]) ** -2.0)

    def guess_sigmas(self, lidar: str) -> Array:
        """(6,) sigmas of the guess of a LiDAR, vehicle axes; the defaults for a trusted one."""
        return DEFAULT_GUESS_SIGMAS if lidar in self.fixed else self.prior_sigmas[lidar]

    def times_s(self) -> Array:
        """(n,) times of the poses in seconds; comparable within a drive only."""
        first = self.poses[0][1]
        return np.array([(stamp - first) / NANOSECONDS_PER_SECOND for _, stamp in self.poses])

    def given(self) -> BoolArray:
        """(n,) whether each pose was given, not smoothed from motion data."""
        return ~np.isin(self.drives(), list(self.motion))

    def stated(self) -> BoolArray:
        """(n,) whether each pose is given with the covariance of its white error."""
        if self.stated_cov is None:
            return np.zeros(len(self.poses), dtype=bool)
        return np.asarray(np.isfinite(self.stated_cov).all(axis=(1, 2)))

    def drives(self) -> IntArray:
        """(n,) drive of each pose."""
        return np.array([drive for drive, _ in self.poses], dtype=np.int64)

    def extrinsic(self, values: gtsam.Values, lidar: str) -> gtsam.Pose3:
        """T_vehicle_lidar at given values."""
        pose = values.atPose3(key_extrinsic())
        for key in self.extrinsic_keys_of(lidar)[1:]:
            pose = pose.compose(values.atPose3(key))
        return pose

    def extrinsics(self, values: gtsam.Values) -> dict[str, gtsam.Pose3]:
        """T_vehicle_lidar of every LiDAR at given values, in the order of `lidars`."""
        return {name: self.extrinsic(values, name) for name in self.lidars}

    def to_vehicle_axes(self, values: gtsam.Values) -> Array:
        """(6n, 6n) from tangents of `extrinsic_keys` (E, S_a, ...) to vehicle axes of `lidars`."""
        keys = self.extrinsic_keys()
        out = np.zeros((6 * len(self.lidars), 6 * len(keys)))
        for i, name in enumerate(self.lidars):
            axes = right_to_vehicle_axes(self.extrinsic(values, name))
            for key in self.extrinsic_keys_of(name):
                block = axes
                if key == key_extrinsic() and name != self.reference:
                    S = values.atPose3(self.extrinsic_keys_of(name)[1])
                    block = axes @ S.inverse().AdjointMap()
                column = 6 * keys.index(key)
                out[6 * i : 6 * i + 6, column : column + 6] = block
        return out


def usable(observations: Sequence[TargetObservation]) -> list[TargetObservation]:
    """Placements of which there are two clouds to register, numbered from 0."""
    used = [o for o in observations if len(o.clouds) >= 2]
    return [replace(o, placement=m) for m, o in enumerate(used)]


def moved_map(T_map_vehicle: gtsam.Pose3, shift: Array) -> gtsam.Pose3:
    """The same pose in a map whose origin is at minus `shift` of the old one."""
    return gtsam.Pose3(T_map_vehicle.rotation(), T_map_vehicle.translation() + shift)


class BodyAndGround(Protocol):
    """What the data say of heave and waves, as `sensor_noise.SensorNoise` has it.

    Figures that the config states are in it as they are stated.
    """

    @property
    def heave_m(self) -> float:
        """1 sigma of the heave."""

    @property
    def floors(self) -> Array:
        """(3,) 1 sigma of the waves of the ground, as in `Problem`."""


def pose_problem(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    noise: BodyAndGround | None = None,
    others: Collection[str] = (),
    kept_ns: Mapping[int, Sequence[int] | IntArray] | None = None,
) -> Problem:
    """Lists LiDARs, poses and clouds that take part: long for the fields of a record.

    Args:
        observations: clouds of each target placement.
        trajectories: one per drive.
        config: LiDARs, noise.
        noise: what the data say of heave and ground; None: figures of the config, or the usual
            ones.
        others: names of LiDARs that take part without having seen a target.
        kept_ns: per drive, stamps of further poses; they have nodes.

    Raises:
        SolveError: there is neither a cloud nor another pose.
    """
    clouds = [(o.placement, c) for o in observations for c in o.clouds]
    further = {(d, int(stamp)) for d, stamps in (kept_ns or {}).items() for stamp in stamps}
    if noise is None:
        heave_m, floors = config.noise.heave_m or HEAVE_SIGMA_M, ground_floors(config.noise)
    else:
        heave_m, floors = noise.heave_m, noise.floors
    seen = {c.lidar for _, c in clouds} | set(others)
    lidars = tuple(n for n in config.lidars if n in seen or config.lidars[n].fixed)
    poses = tuple(sorted({(c.drive, c.stamp_ns) for _, c in clouds} | further))
    if not (poses and lidars):
        raise SolveError("no cloud of a target to calibrate with")
    # If the configured reference saw nothing, another LiDAR carries E.
    reference = config.reference if config.reference in lidars else lidars[0]
    index = {pose: i for i, pose in enumerate(poses)}
    T_map_vehicle: list[gtsam.Pose3] = []
    twists: list[Array] = []
    accelerations: list[Array] = []
    apart_s = np.array([c.apart_s for _, c in clouds])
    for d in sorted({drive for drive, _ in poses}):
        stamps = [stamp for drive, stamp in poses if drive == d]
        T_map_vehicle += unstack(*trajectories[d].poses_at(stamps))
        if config.solve.time_offset or apart_s.any():
            twists.append(twists_at(trajectories[d], stamps))
        if config.solve.time_offset:
            accelerations.append(accelerations_at(trajectories[d], stamps))
    origins = {
        d: np.asarray(T.translation(), np.float64)
        for (d, _), T in reversed(list(zip(poses, T_map_vehicle, strict=True)))
    }
    fixed = frozenset(n for n in lidars if config.lidars[n].fixed)
    smoothed = {
        d: trajectory
        for d, trajectory in enumerate(trajectories)
        if isinstance(trajectory, SmoothedTrajectory) and d in origins
    }
    of_drive = {d: [stamp for drive, stamp in poses if drive == d] for d in smoothed}
    clock, parameters = pose_clock_prior(config), parameter_priors(list(smoothed.values()))
    rates = None if clock is None else _given_rates(trajectories, poses)
    if clock is not None and rates is not None:
        parameters[POSE_TIME_OFFSET] = clock
    terms = {d: motion_term(t, of_drive[d], heave_m) for d, t in smoothed.items()}
    of_pose = dict(zip(poses, T_map_vehicle, strict=True))
    return Problem(
        lidars=lidars,
        reference=reference,
        guesses={n: config.lidars[n].guess() for n in lidars},
        prior_sigmas={n: configured_guess(config, n).sigmas for n in lidars},
        fixed=fixed,
        poses=poses,
        T_map_vehicle=tuple(
            moved_map(T, -origins[d]) for (d, _), T in zip(poses, T_map_vehicle, strict=True)
        ),
        origins_map=origins,
        cloud_lidar=np.array([lidars.index(c.lidar) for _, c in clouds], np.int64),
        cloud_pose=np.array([index[c.drive, c.stamp_ns] for _, c in clouds], np.int64),
        cloud_placement=np.array([m for m, _ in clouds], np.int64),
        placements=len(observations),
        motion={
            d: poses_with_heave(trajectory.joint_information(of_drive[d])[0], heave_m)
            for d, trajectory in smoothed.items()
        },
        motion_terms={d: term for d, term in terms.items() if term is not None},
        parameters=parameters,
        given_rates=rates,
        offsets=config.free_offsets() & set(lidars),
        twists=np.concatenate(twists) if twists else None,
        accelerations=np.concatenate(accelerations) if accelerations else None,
        stated_cov=_stated_covariances(trajectories, poses, config),
        slow_stated=slow_stated(trajectories),
        views=np.concatenate([np.ones(0), *(_views(o, of_pose, config) for o in observations)]),
        heave_m=heave_m,
        floors=floors,
        rate_rows=rate_rows_of_drives(trajectories, of_pose),
        cloud_apart_s=apart_s,
        cloud_turn_rad=_turns(clouds, smoothed) if apart_s.any() else None,
    )


def _given_rates(
    trajectories: Sequence[VehicleTrajectory], poses: Sequence[tuple[int, int]]
) -> Array | None:
    """`Problem.given_rates`; None: no poses were given, but by an odometry."""
    out, any_given = np.zeros((len(poses), 6)), False
    for d in sorted({drive for drive, _ in poses}):
        trajectory = trajectories[d]
        if not isinstance(trajectory, GivenTrajectory) or trajectory.odometry is not None:
            continue
        own = [i for i, (drive, _) in enumerate(poses) if drive == d]
        stamps = [poses[i][1] for i in own]
        R, _ = trajectory.poses_at(stamps)
        out[own], any_given = rates_of_errors(R, twists_at(trajectory, stamps)), True
    return out if any_given else None


def _turns(
    clouds: Sequence[tuple[int, TargetCloud]], smoothed: Mapping[int, SmoothedTrajectory]
) -> Array:
    """`Problem.cloud_turn_rad`: a gyroscope's angle walks, rates without one err."""
    by_drive = {drive: turn_variances(trajectory) for drive, trajectory in smoothed.items()}
    nothing = np.zeros(3), np.zeros(3)
    variance = []
    for _, c in clouds:
        walk, constant = by_drive.get(c.drive, nothing)
        variance.append(abs(c.apart_s) * walk + c.apart_s**2 * constant)
    return np.sqrt(np.array(variance).reshape(-1, 3))


def _views(
    observation: TargetObservation,
    T_map_vehicle: Mapping[tuple[int, int], gtsam.Pose3],
    config: Config,
) -> Array:
    """How many clouds have the view of each, at the guesses: a part of their errors is shared."""
    out = np.ones(len(observation.clouds))
    names = np.array([c.lidar for c in observation.clouds])
    for name in dict.fromkeys(names.tolist()):
        own = np.flatnonzero(names == name)
        guess = config.lidars[name].guess()
        places = []
        for i in own.tolist():
            cloud = observation.clouds[i]
            T = T_map_vehicle[cloud.drive, cloud.stamp_ns].compose(guess)
            places.append(T.transformTo(observation.centre_map))
        out[own] = views(np.array(places))
    return out


def slow_stated(
    trajectories: Sequence[VehicleTrajectory],
) -> tuple[float | None, float | None]:
    """1 sigma of slow errors of rotation (rad) and position (m) that given poses state.

    The root mean square over the drives that state one; None: none does.
    """
    told = [t.slow_stated for t in trajectories if isinstance(t, GivenTrajectory)]
    turns = [turn for turn, _ in told if turn is not None]
    places = [place for _, place in told if place is not None]
    return (
        float(np.sqrt(np.mean(np.square(turns)))) if turns else None,
        float(np.sqrt(np.mean(np.square(places)))) if places else None,
    )


def _stated_covariances(
    trajectories: Sequence[VehicleTrajectory],
    poses: Sequence[tuple[int, int]],
    config: Config,
) -> Array | None:
    """(n, 6, 6) covariances that the messages of given poses state; see `Problem.stated_cov`."""
    out = np.full((len(poses), 6, 6), np.nan)
    drives = np.array([drive for drive, _ in poses])
    for d, trajectory in enumerate(trajectories):
        if isinstance(trajectory, GivenTrajectory) and (drives == d).any():
            stamps = [stamp for drive, stamp in poses if drive == d]
            cov = given_pose_covariances(trajectory.error_covariances(stamps), config)
            if cov is not None:
                out[drives == d] = cov
    return out if np.isfinite(out).any() else None
