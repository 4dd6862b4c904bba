"""The data that pass from stage to stage: frozen dataclasses, in the order in which they arise.

A new reader starts here: LidarScan -> Trajectory -> TargetObservation -> Registration ->
Solution -> Uncertainty -> Calibration. Frames and tangent order are in `conventions`.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, Protocol

import gtsam
import numpy as np
import numpy.typing as npt
import scipy.sparse

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

Side = Literal["left", "right", "top", "bottom"]
"""A side of what a LiDAR sees, in its frame: azimuth grows to the left, elevation to the top."""


@dataclass(frozen=True)
class LidarScan:
    """One cloud of one LiDAR.

    Attributes:
        lidar: the user's name of the LiDAR.
        stamp_ns: stamp of the cloud in nanoseconds.
        points_lidar: (N, 3) float64, metres, lidar frame; every value finite.
        source: what to call it in messages: a file, or a topic and stamp.
        point_times_s: (N,) seconds after the stamp at which each point was taken (negative where
            stamps mark the end of the sweep), or None if the format has no times: then all points
            are as of the stamp.
    """

    lidar: str
    stamp_ns: int
    points_lidar: Array
    source: str
    point_times_s: Array | None = None


@dataclass(frozen=True)
class PoseFrame:
    """The frame that given poses are of, where their messages name it.

    Attributes:
        name: of it.
        vehicle: the vehicle frame of `/tf_static`; empty: it has none.
        T_vehicle_frame: by `/tf_static`; None: the two are not connected there.
    """

    name: str
    vehicle: str = ""
    T_vehicle_frame: gtsam.Pose3 | None = None


@dataclass(frozen=True)
class GivenPoses:
    """Vehicle poses that came with the recording.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        T_map_vehicle: n poses.
        cov: (n, 6, 6) as the messages state it, right perturbations, rotation then translation;
            NaN where unknown. None: nothing is stated.
        frame: that they are of, and are taken for the vehicle's; None: nothing names it.
    """

    stamps_ns: IntArray
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    cov: Array | None = None
    frame: PoseFrame | None = None


@dataclass(frozen=True)
class ImuSamples:
    """Measurements of the IMU, in its own frame.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        angular_velocity: (n, 3) rad/s, imu frame.
        specific_force: (n, 3) m/s^2, imu frame: +g along the upward axis at rest.
        orientation_xyzw: (n, 4) unit quaternions of R_map_imu (ENU), rows of NaN where a message
            has none; None if no message has one.
        orientation_cov: (n, 3, 3) rad^2 as the messages state it, NaN where unknown, or None.
        angular_velocity_cov: (3, 3) (rad/s)^2 per sample, or None if unknown.
        specific_force_cov: (3, 3) (m/s^2)^2 per sample, or None if unknown.
    """

    stamps_ns: IntArray
    angular_velocity: Array
    specific_force: Array
    orientation_xyzw: Array | None = None
    orientation_cov: Array | None = None
    angular_velocity_cov: Array | None = None
    specific_force_cov: Array | None = None


@dataclass(frozen=True)
class GnssFixes:
    """Positions of the GNSS antenna; messages without a fix are left out.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        latitude_deg: (n,) WGS84.
        longitude_deg: (n,) WGS84.
        altitude_m: (n,) above the WGS84 ellipsoid.
        cov_enu: (n, 3, 3) m^2 as the messages state it, NaN where unknown, or None.
    """

    stamps_ns: IntArray
    latitude_deg: Array
    longitude_deg: Array
    altitude_m: Array
    cov_enu: Array | None = None


@dataclass(frozen=True)
class TwistSamples:
    """Velocities of the vehicle frame's origin, in vehicle axes.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        velocity: (n, 3) m/s, vehicle frame.
        velocity_cov: (n, 3, 3) (m/s)^2 as the messages state it, NaN where unknown, or None.
        yaw_rate: (n,) rad/s about the vehicle's z, NaN where a message has none; None: no message
            has one.
        yaw_rate_var: (n,) (rad/s)^2 as the messages state it, NaN where unknown, or None.
    """

    stamps_ns: IntArray
    velocity: Array
    velocity_cov: Array | None = None
    yaw_rate: Array | None = None
    yaw_rate_var: Array | None = None


@dataclass(frozen=True)
class HeadingSamples:
    """Angles of a baseline of two antennas over ground, as the messages have them.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        yaw_rad: (n,) about the vertical; the config says from where it counts.
        var: (n,) rad^2 as the messages state it, NaN where unknown, or None.
    """

    stamps_ns: IntArray
    yaw_rad: Array
    var: Array | None = None


@dataclass(frozen=True)
class MotionData:
    """All measurements of the vehicle's motion in a recording; None: it is not there.

    Attributes:
        name: of the recording, for messages.
        poses: vehicle poses, instead of or beside raw sensors.
        imu: inertial measurements.
        gnss: positions.
        twist: velocities.
        heading: by two antennas: angles, or the fixes of the second one.
    """

    name: str
    poses: GivenPoses | None = None
    imu: ImuSamples | None = None
    gnss: GnssFixes | None = None
    twist: TwistSamples | None = None
    heading: HeadingSamples | GnssFixes | None = None


class Recording(Protocol):
    """A drive that can be read, one cloud at a time. Readers implement this."""

    @property
    def name(self) -> str:
        """What to call it in messages: the path."""

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs of the config, in the config's order."""

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending, without reading a cloud."""

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; never more than a few in memory.

        Args:
            lidar: its name.
            wanted: stamps of the clouds that are asked for, None: all. The others need not be
                decoded.
        """

    def motion(self) -> MotionData:
        """The recording's measurements of the vehicle's motion, read in one pass."""

    def warnings(self) -> Sequence[str]:
        """What was left out so far, and why, a line each."""


@dataclass(frozen=True)
class PoseNoise:
    """Error model of given poses: a white error on each, and a Gauss-Markov error over time.

    The errors of filtered poses are correlated in time, so white noise alone is the wrong model:
    a first-order Gauss-Markov process (exponential correlation) stands for the drift. Position
    errors are in map axes, rotation errors in vehicle axes; all axes alike. The covariance that a
    pose's message states replaces the white part.

    Attributes:
        white_rotation_rad: 1 sigma of the white part, per axis.
        white_position_m: 1 sigma of the white part, per axis.
        drift_rotation_rad: stationary 1 sigma of the Gauss-Markov part, per axis.
        drift_position_m: stationary 1 sigma of the Gauss-Markov part, per axis.
        drift_time_s: correlation time of the Gauss-Markov part.
    """

    white_rotation_rad: float
    white_position_m: float
    drift_rotation_rad: float
    drift_position_m: float
    drift_time_s: float


@dataclass(frozen=True)
class Trajectory:
    """The vehicle's poses at the stamps of the clouds of one drive.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        T_map_vehicle: n poses.
        cov: (n, 6, 6) marginal covariance of each pose, right perturbation (vehicle frame),
            rotation then translation, rad and m; of given poses as the messages state it, NaN where
            unknown. None: not known.
    """

    stamps_ns: IntArray
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    cov: Array | None = None


@dataclass(frozen=True)
class TargetCloud:
    """The points of one target in one scan.

    Attributes:
        lidar: name of the LiDAR.
        drive: index of the drive.
        stamp_ns: stamp of the scan.
        points_lidar: (N, 3) float64, metres, lidar frame.
        source: what to call the scan in messages.
        cut: the sides, as the LiDAR sees it, on which the edge of its field of view may cut the
            target off: there the cloud ends before the target does. Empty: it is whole.
        swept: the points as they were measured, each at its own time, if the LiDAR gives times:
            for a new motion compensation once the extrinsic is known better.
        origins_lidar: (N, 3) metres, where the LiDAR was at the time of each point, lidar frame;
            None: at the origin.
    """

    lidar: str
    drive: int
    stamp_ns: int
    points_lidar: Array
    source: str
    cut: frozenset[Side] = frozenset()
    swept: LidarScan | None = None
    origins_lidar: Array | None = None

    @property
    def beams_lidar(self) -> Array:
        """(N, 3) unit vectors from where the LiDAR was to the points, lidar frame."""
        points = self.points_lidar
        beams = points if self.origins_lidar is None else points - self.origins_lidar
        return np.asarray(beams / np.maximum(np.linalg.norm(beams, axis=1), 1e-9)[:, None])

    @property
    def seen_from_lidar(self) -> Array:
        """(3,) metres, mean of `origins_lidar`."""
        origins = self.origins_lidar
        return np.zeros(3) if origins is None else np.asarray(origins.mean(axis=0))

    @property
    def apart_s(self) -> float:
        """Mean time of the points after the stamp, seconds; 0 if the LiDAR gives none."""
        times_s = None if self.swept is None else self.swept.point_times_s
        return 0.0 if times_s is None or not len(times_s) else float(times_s.mean())


@dataclass(frozen=True)
class TargetObservation:
    """All clouds of one target placement (one target in one drive).

    Attributes:
        placement: index of the placement; one latent target frame belongs to each.
        name: what to call it in messages.
        centre_map: (3,) metres, rough centre in the map of its drive.
        clouds: in order of LiDAR, then stamp; of many scans that see it, evenly chosen ones.
        warnings: what was left out, and why, a line each.
        seen_ns: LiDAR -> stamps of all scans that were found to see it, ascending.
        range_noise_m: LiDAR -> noise along the beam at the target's distance, 1 sigma, as surfaces
            around tell it; none: as it is configured.
    """

    placement: int
    name: str
    centre_map: Array
    clouds: tuple[TargetCloud, ...]
    warnings: tuple[str, ...] = ()
    seen_ns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    range_noise_m: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class NoiseLevel:
    """A noise level that no message states.

    Attributes:
        name: 'heave', 'ground_normal', 'gnss_correlated_horizontal', ...
        sigma: 1 sigma, in `unit`.
        unit: 'm' or 'rad'.
        source: where the figure is from.
        time_s: correlation time; None: white from scan to scan.
    """

    name: str
    sigma: float
    unit: str
    source: str
    time_s: float | None = None


@dataclass(frozen=True)
class GroundObservation:
    """The ground in one scan: points p of the lidar frame with `normal . p + distance = 0`.

    Attributes:
        lidar: name of the LiDAR.
        drive: index of the drive.
        stamp_ns: stamp of the pose that the scan is assigned to.
        normal_lidar: (3,) unit normal, upwards, lidar frame.
        distance_m: of the LiDAR's origin above the plane, along the normal.
        axes_lidar: (2, 3) unit vectors u and v, at right angles to the normal and to each other.
        cov: (3, 3) of (a, b, distance), the normal being along `normal + a u + b v`; rad, rad, m.
        centre_lidar: (3,) metres, centre of the points on the plane.
        points: how many there are.
        R_vehicle_lidar: (3, 3) of the extrinsic, a guess, that the motion was compensated with;
            None: no compensation was needed.
        by_extrinsic: (3, 3) derivative of (a, b, distance) by the extrinsic's rotation w,
            `R_vehicle_lidar Exp(w)`; None likewise. At 2 m/s, a pitch that is 3 degrees off lets
            the ground rise by a centimetre during a sweep.
        beyond: (3,) change of (a, b, distance) if the ground goes on to the LiDAR's foot with the
            curvature of the patch, compensated with `R_vehicle_lidar`.
        beyond_variances: (3,) of `beyond`, by the noise of the points.
        beyond_by_extrinsic: (3, 3) derivative of `beyond` by w; None: no compensation was needed.
        by_bend: (3, 3) the part of `cov` that is what a bend of the ground may do.
        apart_ns: time of the scan after `stamp_ns`. The trajectory carries the observation there;
            it does not contain the heave of the body on its springs.
        by_range_bias: (3, 3) change of (a, b, distance) if all ranges are too long by a metre, and
            by the two of `config.range_errors.growth`; None: none is assumed.
        by_rates: (3, 6) change of (a, b, distance) if the angular (rad/s) and linear velocity (m/s)
            that moved the points to `stamp_ns` were larger, vehicle axes; None: none were moved.
        taken_s: first and last time of the points after `stamp_ns`, seconds.
        twist_map: (6,) rad/s and m/s that moved them, map axes; None likewise.
        R_map_vehicle: (3, 3) of the pose at `stamp_ns` by which it was turned; None likewise.
        repeated: (3, 3) of (a, b, distance), beside `cov`, with which it counts for the part of
            waves and bends that it shares with other scans; None: it shares nothing.
        bent: part of the scans of its drive in which the ground is bent, of the LiDAR that finds it
            so most often.
        roughness_m: scatter of the ground within a square metre, 1 sigma; nan: not known.
    """

    lidar: str
    drive: int
    stamp_ns: int
    normal_lidar: Array
    distance_m: float
    axes_lidar: Array
    cov: Array
    centre_lidar: Array
    points: int
    R_vehicle_lidar: Array | None = None
    by_extrinsic: Array | None = None
    beyond: Array = field(default_factory=partial(np.zeros, 3))
    beyond_variances: Array = field(default_factory=partial(np.zeros, 3))
    beyond_by_extrinsic: Array | None = None
    by_bend: Array = field(default_factory=partial(np.zeros, (3, 3)))
    apart_ns: int = 0
    by_range_bias: Array | None = None
    by_rates: Array | None = None
    taken_s: tuple[float, float] = (0.0, 0.0)
    twist_map: Array | None = None
    R_map_vehicle: Array | None = None
    repeated: Array | None = None
    bent: float = 0.0
    roughness_m: float = math.nan


@dataclass(frozen=True)
class Strip:
    """A strip of surface, flat over at most 2 m.

    Attributes:
        drive: index of the drive.
        surface: number of the surface (a wall) that it is a part of, within the drive.
        centre_map: (3,) metres.
        normal_map: (3,) unit, towards the side it was seen from.
        scans: LiDAR -> number of scans that see it.
        residuals_m: LiDAR -> weighted mean distance of its points from the strip.
        scatter_m: its thickness: root mean square distance of what single scans see of it from one
            plane, at the estimate; NaN without weight.
        before_m: the same at the initial guesses, fitted anew.
        weight: robust weight of the strip, 1 full and 0 dropped.
    """

    drive: int
    surface: int
    centre_map: Array
    normal_map: Array
    scans: Mapping[str, int]
    residuals_m: Mapping[str, float]
    scatter_m: float
    before_m: float
    weight: float


@dataclass(frozen=True)
class Stance:
    """How the vehicle stands on the ground that the LiDARs of a drive see.

    With the coordinates d of a `StructureTerm`, errors of what is assumed of it are `value +
    rows d` with covariance `cov`: of the height above the ground (m) where the config has one, and,
    unless the term has a tilt, x and y of the ground's mean normal in the vehicle frame (rad).
    Nothing that is assumed is in them.

    Attributes:
        value: (s,) s is 1 to 3.
        rows: (s, n).
        cov: (s, s).
        height_sigma_m: of the assumed height, which is in the term; None: unknown.
        tilt_in_term: whether an assumed tilt is in the term.
    """

    value: Array
    rows: Array
    cov: Array
    height_sigma_m: float | None
    tilt_in_term: bool


@dataclass(frozen=True)
class StandingErrors:
    """How a `StructureTerm` depends on errors of what the config says of the vehicle's stand.

    They are eliminated in the term, by their priors. Other evidence of the same errors must not do
    so once more: it takes them as variables, with what is here.

    Attributes:
        height: whether the first is that of the height above the ground (m).
        tilt: whether the last two are those of the ground's normal in the vehicle frame (x and y).
        value: (s,) at the linearisation of the term.
        coupling: (n, s) information between the term's coordinates and them.
        information: (s, s) of them, without their priors.
        gradient: (s,) without their priors.
        prior: (s,) 1 / sigma^2 of each.
    """

    height: bool
    tilt: bool
    value: Array
    coupling: Array
    information: Array
    gradient: Array
    prior: Array

    def kept_in(self, information: Array, gradient: Array) -> tuple[Array, Array]:
        """The quadratic of a term, (n, n) and (n,), with them as its last s coordinates."""
        total = self.information + np.diag(self.prior)
        pull = self.gradient - self.prior * self.value
        by_them = np.linalg.solve(total, np.column_stack([self.coupling.T, pull]))
        taken = self.coupling @ by_them
        both = np.block(
            [[information + taken[:, :-1], self.coupling], [self.coupling.T, self.information]]
        )
        return both, np.concatenate([gradient + taken[:, -1], self.gradient])


@dataclass(frozen=True)
class MountSlip:
    """A mount that slips once during a drive: what the surfaces around would rather have.

    Attributes:
        lidars: of one LiDAR; several: all of them move alike.
        others: LiDARs whose slip would explain as much as that of the first.
        since_s: seconds from the first scan to the slip.
        lasts_s: seconds from the first scan to the last.
        change: (6,) by which the LiDAR is turned (rad) and shifted (m) by it, vehicle axes, about
            its own origin; several, about that of the vehicle.
        sigmas: how significant it is, an allowance included, of a normal variable.
        alone: no other LiDAR sees enough to tell it from what turns the motion data.
    """

    lidars: tuple[str, ...]
    others: tuple[str, ...]
    since_s: float
    lasts_s: float
    change: Array
    sigmas: float
    alone: bool = False


@dataclass(frozen=True)
class StructureTerm:
    """What the structure of one drive says; its planes and all other poses are eliminated.

    Minus the log-likelihood is `d^T information d / 2 - gradient^T d`. d are, in this order, right
    perturbations of the vehicle's poses (rotation then translation, rad and m), of the parameters
    of the vehicle (metres of the lever arm; right perturbation of R_vehicle_imu; seconds of a
    clock), of the time offsets (s), and right perturbations of T_vehicle_lidar (lidar frame).
    Motion data, guesses and priors are not in it.

    Attributes:
        drive: index of the drive.
        stamps_ns: (m,) of the poses, those of the scans that see a target.
        T_map_vehicle: m poses at which it was linearised, the drive's map.
        parameters: name -> value at which it was linearised (`gnss.lever_arm` (3,), a rotation, a
            time (1,)).
        time_offsets_s: LiDAR -> the same, of the LiDARs whose offset is free.
        T_vehicle_lidar: LiDAR -> the same, of the LiDARs that see structure.
        information: (6 m + p + o + 6 n,) squared.
        gradient: (6 m + p + o + 6 n,).
        strips: the strips, for the report.
        offset_m: 1 sigma of the offset of a strip in a scan, estimated.
        ground: LiDARs whose ground is in it, and the vehicle's stand on it if that is known.
        warnings: for the user, a line each.
        on_ground: false: the level strips below the vehicle are far above the ground by
            `vehicle_height`, which then tells no height.
        odometry_of: the LiDAR by whose odometry the poses are known, and of whose mounting ground
            and direction of travel alone tell the rotation; empty: there are motion data.
        stance: how the vehicle stands on the ground; None: no ground below it was seen.
        standing: errors of what is stated of that, which are eliminated in it; None: there are
            none, or no ground below the vehicle was seen.
        clocks: LiDAR -> how late its stamps are and 1 sigma, seconds, by these surfaces alone, of
            the LiDARs whose offset is held at zero.
        clocks_apart: two of these -> how much later the stamps of the second are, and 1 sigma.
        channels: LiDAR -> 1 sigma of the errors of one of its channels, estimated: range (m),
            elevation and azimuth (rad).
        slip: the slip of a mount that these surfaces would rather have; None: not tested.
    """

    drive: int
    stamps_ns: IntArray
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    parameters: Mapping[str, Array | gtsam.Rot3]
    time_offsets_s: Mapping[str, float]
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    information: Array
    gradient: Array
    strips: tuple[Strip, ...]
    offset_m: float
    ground: frozenset[str] = frozenset()
    warnings: tuple[str, ...] = ()
    on_ground: bool = True
    odometry_of: str = ""
    stance: Stance | None = None
    standing: StandingErrors | None = None
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    clocks_apart: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict)
    channels: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    slip: MountSlip | None = None


@dataclass(frozen=True)
class Finding:
    """A value that the user gave and that the raw data contradict, found without a solved graph.

    Attributes:
        input: its key in the config, such as `imu.T_vehicle_imu`.
        value: what would fit, in the units of the config; empty: unknown.
        sigma: of each of `value`.
        sigmas: how significant the contradiction is.
        severity: `fatal`: nothing can be computed from such data; `contradiction`: beyond 5 sigma;
            `warning`: less.
        sentence: for the user.
    """

    input: str
    value: tuple[float, ...]
    sigma: float
    sigmas: float
    severity: Literal["fatal", "contradiction", "warning"]
    sentence: str


@dataclass(frozen=True)
class Mixture:
    """The reconstructed target: surfels, small pieces of plane, in the target frame.

    Attributes:
        means_target: (K, 3) metres.
        normals_target: (K, 3) unit vectors, towards the side the surface was seen from.
        var_tangent: (K,) m^2, squared width along each tangent.
        weights: (K,) part of the points that are target; they add up to one.
    """

    means_target: Array
    normals_target: Array
    var_tangent: Array
    weights: Array


@dataclass(frozen=True)
class Surface:
    """Whether the clouds of a target show a surface.

    Attributes:
        scatter_m: LiDAR -> scatter of the distances of neighbouring points of a scan from the
            surfels, along the beams, 1 sigma, metres. Those of a cloud that lies wrong are alike.
            Of LiDARs with enough points.
        told_m: LiDAR -> noise of its ranges as it was known before.
    """

    scatter_m: Mapping[str, float]
    told_m: Mapping[str, float]


@dataclass(frozen=True)
class Registration:
    """Every cloud of a placement registered to the latent target frame.

    After GMMCalib; the derivation is in `caliv_graph/registration/README.md`.

    Attributes:
        observation: what was registered.
        T_target_lidar: a pose per cloud.
        information: (J, 6, 6) of each pose given the shape, rotation then translation, rad and m,
            left perturbation (target frame): `Exp(d) T_target_lidar`.
        information_joint: (6 J, 6 J) of all poses together, the shape eliminated: it was estimated
            from the same points.
        mixture: the reconstructed target.
        view_weights: (J,) weight of each cloud in these for what it shares with others of the same
            view.
        inlier_ratio: (J,) part of each cloud's points that the mixture explains.
        iterations: EM iterations done.
        converged: whether the last step was below the tolerance.
        last_step: (rotation rad, translation m) of the last iteration: of the median cloud, or of
            the extrinsics where the graph solve took part.
        surface: whether its clouds show one; None: it was not estimated.
    """

    observation: TargetObservation
    T_target_lidar: tuple[gtsam.Pose3, ...]
    information: Array
    information_joint: Array
    view_weights: Array
    mixture: Mixture
    inlier_ratio: Array
    iterations: int
    converged: bool
    last_step: tuple[float, float]
    surface: Surface | None = None


@dataclass(frozen=True)
class Iteration:
    """One iteration of the joint loop: a new shape, a graph solve, new weights.

    Attributes:
        turn_rad: largest rotation of an extrinsic by the step.
        shift_m: largest shift of one.
        sigmas: the step in joint standard deviations of the extrinsics.
        weight_change: largest change of a cloud's robust weight.
        undetermined: number of undetermined directions; None: mode `joint`.
        way_sigmas: how far the extrinsics have come in the last ten iterations (`refine.WAY`), in
            joint standard deviations; 0: there were fewer since the shapes began.
    """

    turn_rad: float
    shift_m: float
    sigmas: float
    weight_change: float
    undetermined: int | None = None
    way_sigmas: float = 0.0


@dataclass(frozen=True)
class LinearisedGraph:
    """The solved graph at the estimate, linearised; Gauss-Markov pose errors are eliminated.

    M coordinates of all variables, J clouds. `d^T information d / 2 - gradient^T d` is minus the
    log-likelihood of a step d of the variables, without the initial guesses.

    Attributes:
        information: (M, M) of poses, ground, trusted extrinsics and clouds, with the gauge prior
            on the target frames.
        gradient: (M,).
        information_guesses: (M, M) of the initial guesses.
        cloud_jacobian: (6 J, M) derivative of the clouds' poses T_target_lidar (left
            perturbations) with respect to the variables.
        cloud_information: (6 J, 6 J) of these poses, robust weights included.
        cloud_gradient: (6 J,) derivative of minus the clouds' log-likelihood.
        by_vehicle: (J, 6, 6) derivative of each cloud's pose with respect to its vehicle pose.
        by_extrinsic: (J, 6, 6) with respect to its LiDAR's T_vehicle_lidar, right perturbation.
        starts: key of a variable -> its first coordinate.
        pose_information: (M, M) of motion data and given poses alone, no LiDAR. The vehicle's poses
            are the first coordinates, in the order of `Solution.T_map_vehicle`.
        pose_gradient: (M,) of the same.
        sound_pose_information: (M, M) the same, given poses with the noise of sound ones at most.
        sound_pose_gradient: (M,) of that.
        to_vehicle_axes: (6 L, 6 L) from the last 6 L coordinates, the extrinsics, to vehicle axes
            of the LiDARs in the order of `Solution.lidars`.
    """

    information: Array
    gradient: Array
    information_guesses: Array
    cloud_jacobian: scipy.sparse.csr_array
    cloud_information: Array
    cloud_gradient: Array
    by_vehicle: Array
    by_extrinsic: Array
    starts: Mapping[int, int]
    pose_information: Array
    pose_gradient: Array
    sound_pose_information: Array
    sound_pose_gradient: Array
    to_vehicle_axes: Array


TURNS = ("imu_rotation", "wheels_rotation", "heading_yaw")
"""Names of parameters of the vehicle that are rotations: radians here, degrees in files."""

TIME_OFFSETS = ("gnss_time_offset", "imu_time_offset", "twist_time_offset", "pose_time_offset")
"""Names of those that are stamps of a sensor less the true times, in the clock of the LiDARs."""


@dataclass(frozen=True)
class VehicleParameter:
    """Something that the user measured on the vehicle, and the solve estimated.

    Attributes:
        value: (3,) lever arm in metres, vehicle frame; or roll, pitch, yaw of T_vehicle_imu or
            T_vehicle_wheels in rad; or (1,) time offset of a sensor in seconds; or (drives,)
            measured over true speeds, or the direction of the baseline of two antennas in rad.
        sigma: (3,), (1,) or (drives,) in the same unit; of a rotation about the vehicle's axes. The
            user's own sigma is part of it.
        determined: per coordinate whether the drive alone determines it.
        limits: axes of S2V of which half the variance or more comes from it.
    """

    value: Array
    sigma: Array
    determined: tuple[bool, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Solution:
    """The solved factor graph.

    Matrices over the extrinsics are in *vehicle axes* (see `conventions`), LiDARs in the order of
    `lidars`, six coordinates each, rotation before translation.

    Attributes:
        mode: staged, joint or auto.
        lidars: LiDARs in the graph: they saw a target or structure, or are fixed.
        reference: name of the reference LiDAR.
        T_vehicle_lidar: estimate per LiDAR.
        T_map_vehicle: estimated vehicle pose per (drive, stamp_ns).
        T_target_map: estimate per placement.
        registrations: the graph's input, a registration per placement.
        cloud_weights: robust weight of each cloud, per placement, 1 full and 0 dropped.
        residuals: whitened pose-factor residuals, (J, 6) per placement.
        pose_noise: error model of the given poses that was used; None: no poses were given.
        registration_scale: factor on the sigmas of the registration, estimated from the data.
        range_bias_m: 1 sigma of a bias of the ranges of each LiDAR on each target is at least this,
            by the data, with a probability of 99 percent; 0: none was looked for.
        information_data: (6n, 6n) of the data alone, no prior on the extrinsics.
        information_prior: (6n, 6n) of the initial guesses.
        cov: (6n, 6n) joint covariance of all extrinsics, priors included as the mode uses them.
        held: names of the axes of the LiDARs that the mode held at the guess (staged: x, y, z).
        vehicle: `lever_arm`, `imu_rotation` and `wheels_rotation`, where they are uncertain.
        information_knowing: of `vehicle`, (6n, 6n) of the data if that were known exactly.
        iterations: iterations of the outer loop.
        converged: whether the outer loop's last step was below its tolerance.
        graph: the factor graph.
        factor_kinds: of each of its factors, in order: `calibration.graph.FactorKind`.
        values: its values.
        linearised: the graph at these values.
        stage_times_s: seconds per stage.
        time_offsets: per LiDAR whose offset was estimated its value and sigma in seconds: header
            stamp minus true acquisition time.
        warnings: for the user, a line each.
        gradient_data: (6n,) of the data's log-likelihood at the estimate; None: not computed.
        course: the iterations of the joint loop; empty without a target.
        creeps: whether they ended far from where they lead.
        sensor_noise: noise levels that no message states, and where their figures are from.
        structure: the structure of each drive that has any.
    """

    mode: str
    lidars: tuple[str, ...]
    reference: str
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    T_map_vehicle: Mapping[tuple[int, int], gtsam.Pose3]
    T_target_map: tuple[gtsam.Pose3, ...]
    registrations: tuple[Registration, ...]
    cloud_weights: tuple[Array, ...]
    residuals: tuple[Array, ...]
    pose_noise: PoseNoise | None
    registration_scale: float
    information_data: Array
    information_prior: Array
    cov: Array
    held: tuple[str, ...]
    iterations: int
    converged: bool
    graph: gtsam.NonlinearFactorGraph
    factor_kinds: tuple[str, ...]
    values: gtsam.Values
    linearised: LinearisedGraph
    stage_times_s: Mapping[str, float] = field(default_factory=dict)
    time_offsets: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    gradient_data: Array | None = None
    range_bias_m: float = 0.0
    vehicle: Mapping[str, VehicleParameter] = field(default_factory=dict)
    information_knowing: Mapping[str, Array] = field(default_factory=dict)
    course: tuple[Iteration, ...] = ()
    creeps: bool = False
    sensor_noise: tuple[NoiseLevel, ...] = ()
    structure: tuple[StructureTerm, ...] = ()


@dataclass(frozen=True)
class Direction:
    """A direction in the space of all extrinsics.

    Attributes:
        vector: per LiDAR (6,), vehicle axes, rotation (rad) then translation (m).
        sigma_data: 1 sigma of the data along it; inf if unobservable. In units of `vector`.
        sigma_prior: 1 sigma of the prior along it, same units.
        text: its name for the user; empty until `wording.directions.named` fills it in.
        together: whether all LiDARs move as one, so that S2S does not change.
        remedy: the manoeuvre or the setting that would determine it; filled in with `text`.
    """

    vector: Mapping[str, Array]
    sigma_data: float
    sigma_prior: float
    text: str
    together: bool
    remedy: str = ""


@dataclass(frozen=True)
class Uncertainty:
    """What the drive determines (`uncertainty/README.md`).

    Attributes:
        undetermined: directions along which the prior alone decides.
        weak: directions that the data determine no better than ten times the prior.
        determined: per LiDAR and axis of `conventions.AXES`.
        spectrum: sigma of the data, scaled so that 1 mrad and 10 mm compare, ascending, in mrad.
    """

    undetermined: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    determined: Mapping[str, Mapping[str, bool]]
    spectrum: Array


@dataclass(frozen=True)
class Guess:
    """The initial guess of an extrinsic: from a drawing or a tape measure.

    Attributes:
        T_vehicle_lidar: the guess.
        sigmas: (6,) in vehicle axes, rad and m.
        fixed: the user trusts it; it is not estimated.
        found: nobody gave one. It was found in the drive: where the drive does not determine the
            extrinsic, its value means nothing.
    """

    T_vehicle_lidar: gtsam.Pose3
    sigmas: Array
    fixed: bool = False
    found: bool = False


@dataclass(frozen=True)
class DataTerm:
    """The likelihood of the extrinsics from the data of some drives alone.

    Minus the log-likelihood of a perturbation e of the extrinsics is
    `e^T information e / 2 - gradient^T e`, in vehicle axes, LiDARs in the order of
    `T_vehicle_lidar`, six coordinates each.

    Attributes:
        sources: digests of the drives, so that none counts twice.
        T_vehicle_lidar: where e is zero.
        information: (6n, 6n).
        gradient: (6n,).
    """

    sources: tuple[str, ...]
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    information: Array
    gradient: Array


@dataclass(frozen=True)
class LidarResult:
    """The reported extrinsic of one LiDAR.

    Attributes:
        T_vehicle_lidar: the estimate, or the initial guess if no data tell of it.
        cov: (6, 6) right perturbation (lidar frame), rotation then translation, rad and m.
        determined: per axis of `conventions.AXES`, vehicle axes.
        scans_used: scans of a target that carried weight.
        saw_target: False if it never saw a target.
        time_offset: (value, sigma) in seconds, header stamp minus true acquisition time; None: not
            estimated.
        guess: the initial guess; None: not known (another program's file).
        saw_structure: whether structure was used that it saw; also of a LiDAR without a target.
    """

    T_vehicle_lidar: gtsam.Pose3
    cov: Array
    determined: Mapping[str, bool]
    scans_used: int
    saw_target: bool
    time_offset: tuple[float, float] | None = None
    guess: Guess | None = None
    saw_structure: bool = False

    @property
    def has_data(self) -> bool:
        """Whether it saw anything that it is calibrated by."""
        return self.saw_target or self.saw_structure

    @property
    def placed(self) -> bool:
        """Whether data or a trusted guess (`fixed: true`) say where it is."""
        return self.has_data or (self.guess is not None and self.guess.fixed)

    @property
    def without_guess(self) -> bool:
        """Whether nobody gave a guess: what the drive does not determine is unknown then."""
        return self.guess is not None and self.guess.found


@dataclass(frozen=True)
class StructureSummary:
    """What a calibration used of walls and other structure, all drives together.

    Attributes:
        strips: number of strips with weight.
        surfaces: number of surfaces that they are parts of.
        sightings: LiDAR -> number of pairs of a strip and a scan that sees it.
        shared: pair of LiDARs, in the order of the result -> number of surfaces that both see.
        offset_m: 1 sigma of the offset of a strip in a scan, root mean square over the drives.
    """

    strips: int
    surfaces: int
    sightings: Mapping[str, int]
    shared: Mapping[tuple[str, str], int]
    offset_m: float


@dataclass(frozen=True)
class Suspect:
    """An input that could be wrong, and what freeing it would explain.

    Attributes:
        input: its name: a key of the config, or a part of the drive (`uncertainty/README.md`).
        value: that it would take, a number per coordinate, in `units`.
        sigma: 1 sigma of each.
        change: `value` less what the input is now.
        units: of each coordinate: m, deg, s, or 1.
        explains: part of all contradictions that freeing it takes away, 0 to 1.
        sigmas: of a normal variable with the same p-value, one sound input in mind.
        sigmas_left: the same once the first of the ranking is freed; of the first, `sigmas`.
        determined: whether the data determine each coordinate: where not, `value` is what the input
            is now. Empty: all.
    """

    input: str
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    change: tuple[float, ...]
    units: tuple[str, ...]
    explains: float
    sigmas: float
    sigmas_left: float
    determined: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """The result, as written to calibration.yaml (`results/README.md`).

    Attributes:
        status: ok, partial or inconsistent.
        reference: name of the reference LiDAR.
        lidars: in the config's order.
        cov_joint: (6n, 6n) over the LiDARs in that order, right perturbations.
        information_data: (6n, 6n) in the same coordinates, without any prior; zero rows and
            columns for a LiDAR that no data tell of.
        undetermined: directions, vehicle axes.
        weak: directions, vehicle axes.
        unmet: requirements and limits that are not met, a sentence each.
        provenance: versions, configuration digest, inputs; plain values only.
        gradient_data: (6n,) of the data's log-likelihood at the extrinsics, same coordinates: the
            maximum of the data alone is `solve(information_data, gradient_data)` away. None: not
            known (another program's file).
        earlier: data terms of earlier drives that served as a prior. They are part of the
            extrinsics and of `cov_joint`, not of `information_data`.
        contradictions: a sentence each; with any the status is inconsistent.
        warnings: what else a person should know of the result, a sentence each.
        suspects: inputs that could be wrong, the one that explains most first; empty: not tested.
        vehicle: `lever_arm`, `imu_rotation`, `wheels_rotation`, `speed_scale` and `heading_yaw`,
            where they were estimated.
        structure: the structure that was used; None: none.
    """

    status: str
    reference: str
    lidars: Mapping[str, LidarResult]
    cov_joint: Array
    information_data: Array
    undetermined: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    unmet: tuple[str, ...]
    provenance: Mapping[str, object]
    gradient_data: Array | None = None
    earlier: tuple[DataTerm, ...] = ()
    contradictions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    suspects: tuple[Suspect, ...] = ()
    vehicle: Mapping[str, VehicleParameter] = field(default_factory=dict)
    structure: StructureSummary | None = None
