"""A simulated drive past a target, described: vehicle, sensors, world, noise.

Frozen models with units in the `Field` descriptions; `configs/scenarios/` holds commented ones.
Nothing here draws random numbers or casts rays: the room `simulation` does.

The noise of IMU, GNSS, velocity and orientation is that of table I of CaLiV, read as follows. All
figures are 1 sigma of white noise per sample and axis, at 100 Hz for IMU and orientation and 10 Hz
for GNSS and velocity. The GPS's 1.5e-7 degrees of latitude and longitude are an angle at
the centre of the earth: 1.5e-7 pi / 180 x 6378 km = 16.7 mm, taken for north and east alike, as on
the equator. The orientation's 0.005 rad is a rotation about each axis of the IMU.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, model_validator

from caliv_graph.config.load import read_yaml, validated
from caliv_graph.config.model import PoseConfig
from caliv_graph.config.sections import Finite, NonNegative, Positive, PositiveTriple, Section

Pair = tuple[Finite, Finite]
Turn = Literal["left", "right"]
PerAxis = NonNegative | tuple[NonNegative, NonNegative, NonNegative]
TimeField = Literal["t", "time", "timestamp", "time_stamp"]


class _DriveSection(Section):
    """What all drives have. The vehicle frame is on the ground at the rear axle."""

    start_xy_m: Pair = Field((0.0, 0.0), description="metres, start in the map")
    start_yaw_deg: Finite = Field(0.0, description="degrees, heading at the start, from map +x")


class _MovingSection(_DriveSection):
    speed_m_s: Positive = Field(
        2.0, description="metres per second, of the rear axle, once rolling"
    )
    standstill_s: NonNegative = Field(1.0, description="seconds before the vehicle starts to roll")
    ramp_s: Positive = Field(
        1.5, description="seconds from standstill to speed_m_s, and back at the end"
    )
    wheelbase_m: Positive = Field(2.8, description="metres between the axles")


class _TimedSection(_MovingSection):
    duration_s: Positive = Field(description="seconds, from the first scan to standing again")

    @model_validator(mode="after")
    def _time_to_start_and_stop(self) -> _TimedSection:
        least = self.standstill_s + 2.0 * self.ramp_s
        if self.duration_s < least:
            raise ValueError(
                f"duration_s ({self.duration_s} s) leaves no time to start and stop: "
                f"standstill_s + 2 ramp_s is {least} s"
            )
        return self


class _TransitionSection(Section):
    transition_m: Positive = Field(
        3.0, description="metres of path over which one curvature goes over into the other"
    )


class ArcDrive(_TimedSection):
    """One arc with the steering set before the vehicle starts: the paper's drive."""

    kind: Literal["arc"] = "arc"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns")


class SCurveDrive(_TimedSection, _TransitionSection):
    """An arc, and from half of the way on the opposite one."""

    kind: Literal["s_curve"] = "s_curve"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns first")


class FigureEightDrive(_MovingSection, _TransitionSection):
    """A full circle, then a full circle to the other side. The radius sets the duration."""

    kind: Literal["figure_eight"] = "figure_eight"
    radius_m: Positive = Field(9.16, description="metres, turning radius of the rear axle")
    turn: Turn = Field("right", description="side to which the vehicle turns first")


class StraightDrive(_TimedSection):
    """Straight ahead."""

    kind: Literal["straight"] = "straight"


class StandstillDrive(_DriveSection):
    """The vehicle does not move."""

    kind: Literal["standstill"] = "standstill"
    duration_s: Positive = Field(description="seconds")


DriveModel = Annotated[
    ArcDrive | SCurveDrive | FigureEightDrive | StraightDrive | StandstillDrive,
    Field(discriminator="kind"),
]


class SweepModel(Section):
    """A cloud taken column by column while the vehicle moves."""

    duration_s: Positive | None = Field(
        None, description="seconds from the first to after the last column; absent: 1 / rate_hz"
    )
    direction: Literal["counter_clockwise", "clockwise"] = Field(
        "clockwise", description="which way the columns follow one another, seen from above"
    )
    stamp_at: Literal["start", "end"] = Field(
        "start", description="end of the sweep that the stamp of the cloud tells"
    )
    time_field: TimeField = Field(
        "t",
        description="per-point time in the bag: t (uint32 ns after the stamp, Ouster), time "
        "(float32 s after it, Velodyne), timestamp (float64 s, absolute, Hesai and Robosense), "
        "time_stamp (uint32 ns after it, Autoware)",
    )

    @model_validator(mode="after")
    def _unsigned_times_count_from_the_start(self) -> SweepModel:
        if self.stamp_at == "end" and self.time_field in ("t", "time_stamp"):
            raise ValueError(
                f"time_field '{self.time_field}' is unsigned and cannot count back from the end "
                "of the sweep: take 'time' or 'timestamp', or stamp_at: start"
            )
        return self


class EdgeModel(Section):
    """What a beam of finite width returns at an edge, and beams that return nothing."""

    divergence_mrad: Positive = Field(
        3.0, description="milliradians, full width of a beam (2 sigma to either side)"
    )
    gap_m: Positive = Field(
        0.05, description="metres of range between two parts of a beam that make it an edge"
    )
    mixing_m: NonNegative = Field(
        1.5, description="metres of range up to which the two parts melt into one return"
    )
    mixed_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.7, description="part of these that come from between the two surfaces"
    )
    lost_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.3, description="part of all edge beams that return nothing"
    )
    dropout_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.0, description="part of all beams that return nothing"
    )


class LidarModel(Section):
    """A LiDAR. Without `sweep` it takes its whole cloud at one instant, as in CARLA.

    A beam is given by its elevation over the LiDAR's xy plane and its azimuth about the
    LiDAR's z axis.
    """

    mounting: PoseConfig = Field(description="true T_vehicle_lidar")
    horizontal_fov_deg: Pair = Field((-60.0, 60.0), description="degrees of azimuth, from and to")
    vertical_fov_deg: Pair = Field(
        (-12.5, 12.5), description="degrees of elevation, lowest and highest channel"
    )
    channels: Annotated[int, Field(ge=2)] = Field(152, description="beams above one another")
    elevations_deg: tuple[Finite, ...] | None = Field(
        None,
        min_length=2,
        description="degrees of elevation per channel, ascending, where they are uneven; takes "
        "the place of vertical_fov_deg and channels",
    )
    horizontal_resolution_deg: Positive = Field(
        0.18237, description="degrees between two beams of a channel"
    )
    rate_hz: Positive = Field(10.0, description="clouds per second")
    range_sigma_m: NonNegative = Field(
        0.01, description="metres, 1 sigma of white noise along the beam"
    )
    min_range_m: NonNegative = Field(1.0, description="metres; nearer returns are not reported")
    max_range_m: Positive = Field(500.0, description="metres; farther returns are not reported")
    time_offset_s: Finite = Field(
        0.0,
        description="seconds, stamp minus true acquisition time (positive: stamps are late)",
    )
    phase_s: NonNegative = Field(0.0, description="seconds, stamp of the first cloud")
    sweep: SweepModel | None = Field(None, description="absent: a cloud is taken at one instant")
    edges: EdgeModel | None = Field(None, description="absent: infinitely thin beams")

    @property
    def sweep_s(self) -> float:
        """Seconds that a cloud takes; 0 if it is taken at one instant."""
        return 0.0 if self.sweep is None else self.sweep.duration_s or 1.0 / self.rate_hz

    @model_validator(mode="after")
    def _sweep_within_the_period(self) -> LidarModel:
        if self.sweep_s > (1.0 + 1e-9) / self.rate_hz:
            raise ValueError(
                f"sweep.duration_s ({self.sweep_s} s) exceeds the {1.0 / self.rate_hz:g} s "
                f"between two clouds at {self.rate_hz:g} Hz"
            )
        return self

    @model_validator(mode="after")
    def _in_order(self) -> LidarModel:
        for name in ("horizontal_fov_deg", "vertical_fov_deg"):
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name}: {low} degrees must be below {high} degrees")
        low, high = self.horizontal_fov_deg
        if high - low > 360.0:
            raise ValueError(f"horizontal_fov_deg spans {high - low} degrees: 360 at most")
        if self.horizontal_resolution_deg > high - low:
            raise ValueError(
                f"horizontal_resolution_deg ({self.horizontal_resolution_deg}) exceeds "
                f"the field of view of {high - low} degrees"
            )
        if min(self.vertical_fov_deg) < -90.0 or max(self.vertical_fov_deg) > 90.0:
            raise ValueError("vertical_fov_deg must lie within -90 and 90 degrees")
        elevations = self.elevations_deg or ()
        if any(low >= high for low, high in itertools.pairwise(elevations)):
            raise ValueError("elevations_deg must ascend")
        if elevations and (elevations[0] < -90.0 or elevations[-1] > 90.0):
            raise ValueError("elevations_deg must lie within -90 and 90 degrees")
        if self.min_range_m >= self.max_range_m:
            raise ValueError(
                f"min_range_m ({self.min_range_m} m) must be below "
                f"max_range_m ({self.max_range_m} m)"
            )
        return self


class RampModel(Section):
    """A smooth rise of the ground: up a flank, a level top, down a flank.

    The steepest place of a flank has a slope of 35/16 height_m / flank_m.
    """

    xy_m: Pair = Field(description="metres, middle of its top in the map")
    yaw_deg: Finite = Field(0.0, description="degrees, direction of its flanks, from map +x")
    height_m: Positive = Field(description="metres from the ground to the top")
    flank_m: Positive = Field(description="metres of ground that each flank takes")
    top_m: NonNegative = Field(0.0, description="metres, length of the level top")
    width_m: Positive = Field(
        6.0, description="metres, width of the level top, beside which flanks come down as well"
    )


class GroundModel(Section):
    """Flat ground, a square about the map's origin, with ramps on it."""

    height_m: Finite = Field(0.0, description="metres, its z in the map")
    half_size_m: Positive = Field(200.0, description="metres from the origin to each edge")
    ramps: tuple[RampModel, ...] = Field((), description="absent: flat all over")


class MoveModel(Section):
    """Somebody carries an object to another place. In between nobody is there."""

    begin_s: NonNegative = Field(description="seconds since the start of the drive, picked up")
    end_s: Positive = Field(description="seconds since the start of the drive, put down")
    xy_m: Pair = Field(description="metres, its new origin in the map")
    yaw_deg: Finite = Field(0.0, description="degrees, its +x from map +x at the new place")

    @model_validator(mode="after")
    def _takes_time(self) -> MoveModel:
        if self.begin_s >= self.end_s:
            raise ValueError(f"begin_s ({self.begin_s} s) must be before end_s ({self.end_s} s)")
        return self


class _ObjectSection(Section):
    xy_m: Pair = Field(description="metres, its origin in the map; it stands on the ground")
    yaw_deg: Finite = Field(0.0, description="degrees, its +x (a chair's front) from map +x")
    moves: tuple[MoveModel, ...] = Field(
        (), description="where it is carried, one after the other; absent: it stands all the time"
    )

    @model_validator(mode="after")
    def _one_move_after_the_other(self) -> _ObjectSection:
        for before, after in itertools.pairwise(self.moves):
            if before.end_s > after.begin_s:
                raise ValueError(
                    f"moves: one begins at {after.begin_s} s, before the one at "
                    f"{before.begin_s} s has ended"
                )
        return self


class ChairModel(_ObjectSection):
    """The plastic armchair of `worlds.chair`: 0.71 m wide, 0.77 m deep, 1.25 m high."""

    shape: Literal["chair"] = "chair"


class BoxModel(_ObjectSection):
    """A box; flat and long, a wall."""

    shape: Literal["box"] = "box"
    size_m: PositiveTriple = Field(description="metres along its x, y, z")


class PoleModel(_ObjectSection):
    """An upright round pole."""

    shape: Literal["pole"] = "pole"
    radius_m: Positive = Field(0.08, description="metres")
    height_m: Positive = Field(4.0, description="metres")


class CylinderModel(_ObjectSection):
    """A drum. It looks the same after any turn about its axis: smooth, unlike a pole's 24 sides."""

    shape: Literal["cylinder"] = "cylinder"
    radius_m: Positive = Field(0.3, description="metres")
    height_m: Positive = Field(0.9, description="metres")


class TableModel(_ObjectSection):
    """A table on four legs: it looks the same after half a turn, and only then."""

    shape: Literal["table"] = "table"
    size_m: PositiveTriple = Field((1.1, 0.7, 0.72), description="metres along its x, y, z")
    top_m: Positive = Field(0.04, description="metres, how thick its top is")
    leg_m: Positive = Field(0.07, description="metres, side of its square legs")

    @model_validator(mode="after")
    def _legs_below_the_top(self) -> TableModel:
        if self.top_m >= self.size_m[2] or 2.0 * self.leg_m > min(self.size_m[:2]):
            raise ValueError(
                f"size_m {self.size_m} leaves no room for a top of {self.top_m} m and legs of "
                f"{self.leg_m} m"
            )
        return self


ObjectModel = Annotated[
    ChairModel | BoxModel | PoleModel | CylinderModel | TableModel, Field(discriminator="shape")
]


class WalkerModel(Section):
    """A person, 1.75 m tall, who walks to and fro along a line."""

    from_xy_m: Pair = Field(description="metres, one end of the line in the map")
    to_xy_m: Pair = Field(description="metres, the other end")
    speed_m_s: Positive = Field(1.3, description="metres per second")

    @model_validator(mode="after")
    def _somewhere_to_go(self) -> WalkerModel:
        if math.dist(self.from_xy_m, self.to_xy_m) < 0.1:
            raise ValueError("from_xy_m and to_xy_m are less than 0.1 m apart: nowhere to walk")
        return self


class WorldModel(Section):
    """What stands around the drive."""

    ground: GroundModel = GroundModel()
    objects: dict[str, ObjectModel] = Field({}, description="what stands, by name")
    walkers: dict[str, WalkerModel] = Field({}, description="who walks, by name")
    targets: tuple[str, ...] = Field(
        (), description="names of the objects that serve as calibration targets"
    )
    region_margin_m: Positive = Field(
        5.0,
        description="metres around each target that the written config calls its region",
    )

    @model_validator(mode="after")
    def _targets_are_objects(self) -> WorldModel:
        for name in self.targets:
            if name not in self.objects:
                raise ValueError(
                    f"target '{name}' is not one of the objects: {', '.join(self.objects)}"
                )
        for name in self.walkers:
            if name in self.objects:
                raise ValueError(f"'{name}' is the name of an object and of a walker")
        for name in (*self.objects, *self.walkers):
            if name in ("ground", "vehicle"):
                raise ValueError(f"'{name}' is the name of something else: give another one")
        return self


class CropModel(Section):
    """Which beams are cast and written, so that a scan is cheap and small.

    A beam that is kept returns what it returns without cropping, noise included.
    """

    margin_m: NonNegative = Field(
        1.0,
        description="metres around a target's bounding sphere; beams that can hit it are kept",
    )
    elsewhere_stride: Annotated[int, Field(ge=0)] = Field(
        8, description="of all other beams every n-th channel and column is kept; 0: none"
    )


class PoseNoiseModel(Section):
    """Errors of the poses in a CaLiV folder: those of a filter, partly correlated in time."""

    position_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma per map axis, white from pose to pose"
    )
    rotation_sigma_rad: NonNegative = Field(
        0.001, description="radians, 1 sigma per vehicle axis, white from pose to pose"
    )
    position_walk_m_sqrts: NonNegative = Field(
        0.0,
        description="metres per sqrt(second), random walk per map axis, zero at the start",
    )
    rotation_walk_rad_sqrts: NonNegative = Field(
        0.0,
        description="radians per sqrt(second), random walk per map axis, zero at the start",
    )


class _SampledSection(Section):
    """What is published at a rate."""

    enabled: bool = Field(True, description="false: the vehicle has none")
    phase_s: NonNegative = Field(0.0, description="seconds, stamp of the first sample")


class OrientationModel(Section):
    """The orientation that the IMU reports: of the IMU in ENU axes."""

    enabled: bool = Field(True, description="false: messages say that there is none")
    sigma_rad: NonNegative = Field(
        0.005, description="radians, 1 sigma of white noise per sample and axis of the IMU"
    )
    yaw_bias_deg: Finite = Field(
        0.0, description="degrees, constant error of its heading, positive to the left"
    )


class ImuModel(_SampledSection):
    """An IMU, sampled at instants; the earth does not turn."""

    mounting: PoseConfig = Field(
        PoseConfig(xyz=(0.0, 0.0, 0.0)), description="true and known T_vehicle_imu"
    )
    rate_hz: Positive = Field(100.0, description="samples per second")
    accelerometer_sigma_m_s2: NonNegative = Field(
        0.05, description="m/s^2, 1 sigma of white noise per sample and axis"
    )
    gyroscope_sigma_rad_s: NonNegative = Field(
        0.005, description="rad/s, 1 sigma of white noise per sample and axis"
    )
    accelerometer_bias_sigma_m_s2: PerAxis = Field(
        0.0, description="m/s^2, 1 sigma of the bias at the start, one number or one per axis"
    )
    gyroscope_bias_sigma_rad_s: PerAxis = Field(
        0.0, description="rad/s, 1 sigma of the bias at the start, one number or one per axis"
    )
    accelerometer_bias_walk_m_s3_sqrthz: NonNegative = Field(
        0.0, description="m/s^2 per sqrt(second), random walk of the bias"
    )
    gyroscope_bias_walk_rad_s2_sqrthz: NonNegative = Field(
        0.0, description="rad/s per sqrt(second), random walk of the bias"
    )
    orientation: OrientationModel = OrientationModel()


class OutageModel(Section):
    """A time without a fix."""

    start_s: NonNegative = Field(description="seconds since the start of the drive")
    duration_s: Positive = Field(description="seconds")


class JumpModel(Section):
    """A time during which all fixes are off by the same, as by a reflected signal."""

    start_s: NonNegative = Field(description="seconds since the start of the drive")
    duration_s: Positive = Field(description="seconds")
    offset_enu_m: tuple[Finite, Finite, Finite] = Field(description="metres east, north, up")


class GnssModel(_SampledSection):
    """A GNSS receiver."""

    lever_arm: tuple[Finite, Finite, Finite] = Field(
        (0.0, 0.0, 0.0), description="metres, antenna in the vehicle frame, true and known"
    )
    rate_hz: Positive = Field(10.0, description="fixes per second")
    horizontal_sigma_m: NonNegative = Field(
        0.0167, description="metres, 1 sigma of white noise, east and north alike"
    )
    vertical_sigma_m: NonNegative = Field(0.02, description="metres, 1 sigma of white noise")
    outlier_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.0, description="part of the fixes that are outliers"
    )
    outlier_sigma_m: NonNegative = Field(
        2.0, description="metres, 1 sigma of an outlier per axis; no covariance tells of it"
    )
    outages: tuple[OutageModel, ...] = Field((), description="absent: always a fix")
    jumps: tuple[JumpModel, ...] = Field((), description="absent: none")
    latitude_deg: Annotated[float, Field(ge=-89.0, le=89.0)] = Field(
        48.2627, description="degrees, WGS84, of the map's origin"
    )
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = Field(
        11.6681, description="degrees, WGS84, of the map's origin"
    )
    altitude_m: Finite = Field(
        520.0, description="metres above the WGS84 ellipsoid, of the map's origin"
    )


class VelocityModel(_SampledSection):
    """The velocity of the vehicle frame's origin in vehicle axes."""

    rate_hz: Positive = Field(10.0, description="samples per second")
    sigma_m_s: NonNegative = Field(
        0.1, description="m/s, 1 sigma of white noise per sample and axis"
    )


class BodyBoxModel(Section):
    """A box that is part of the vehicle."""

    centre_m: tuple[Finite, Finite, Finite] = Field(description="metres, vehicle frame")
    size_m: PositiveTriple = Field(description="metres along the vehicle's x, y, z")


class BagModel(Section):
    """How the bag is written."""

    start_time_s: Annotated[int, Field(ge=0)] = Field(
        1_750_000_000, description="seconds since 1970, stamp of the drive's start"
    )
    compression: Literal["none", "zstd"] = Field("none", description="of the MCAP's chunks")
    covariances: Literal["stated", "unknown"] = Field(
        "stated",
        description="covariances in the messages: those of the white noise, or zeros, which "
        "mean unknown",
    )


class SuspensionModel(Section):
    """What the vehicle frame's height above the ground, nominally zero, does.

    Heave lifts vehicle and LiDARs while a cloud is taken. It is white from scan to scan and
    therefore no motion that an IMU could feel: IMU, GNSS and velocity know nothing of it.
    """

    height_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, one error for the whole drive"
    )
    heave_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, white from scan to scan"
    )


class InitialGuessModel(Section):
    """How far the written config's initial guess is off, drawn uniformly per LiDAR and axis."""

    translation_m: NonNegative = Field(0.1, description="metres, largest error per vehicle axis")
    rotation_deg: NonNegative = Field(3.0, description="degrees, largest roll, pitch, yaw error")


class Scenario(Section):
    """A simulated drive past one or more targets."""

    name: str = Field(
        pattern=r"^[\w. -]+$", description="what to call it: letters, digits, dots, dashes, spaces"
    )
    drive: DriveModel
    lidars: dict[str, LidarModel] = Field(min_length=1, description="by the user's name")
    reference: str = Field(
        "", description="reference LiDAR of the written config; empty: the first"
    )
    world: WorldModel
    crop: CropModel | None = Field(None, description="absent: full clouds")
    poses: PoseNoiseModel = PoseNoiseModel()
    imu: ImuModel = ImuModel()
    gnss: GnssModel = GnssModel()
    velocity: VelocityModel = VelocityModel()
    gravity_m_s2: Positive = Field(9.80665, description="m/s^2, towards map -z")
    vehicle_body: tuple[BodyBoxModel, ...] = Field(
        (), description="what the LiDARs see of the vehicle; absent: nothing"
    )
    bag: BagModel = BagModel()
    config_target: Literal["region", "search"] = Field(
        "region", description="whether the written config names the target's region"
    )
    suspension: SuspensionModel = SuspensionModel()
    initial_guess: InitialGuessModel = InitialGuessModel()

    @model_validator(mode="after")
    def _reference_is_a_lidar(self) -> Scenario:
        if self.reference and self.reference not in self.lidars:
            raise ValueError(
                f"reference '{self.reference}' is not one of the lidars: {', '.join(self.lidars)}"
            )
        if not self.reference:
            object.__setattr__(self, "reference", next(iter(self.lidars)))
        return self


def parse_scenario(raw: Any, source: str) -> Scenario:
    """Validates a scenario.

    Args:
        raw: what the YAML file held.
        source: the name of the file in messages.

    Raises:
        ConfigError: with the first problem, in one line.
    """
    expected = "scenario: expected keys such as 'drive', 'lidars'"
    return validated(Scenario, raw, source, expected)


def load_scenario(path: Path) -> Scenario:
    """Reads and validates a scenario file.

    Raises:
        ConfigError: the file is missing, not YAML, or not valid.
    """
    return parse_scenario(read_yaml(path), str(path))


def dump_scenario(scenario: Scenario) -> str:
    """The effective scenario as YAML that `load_scenario` reads back to the same values."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
