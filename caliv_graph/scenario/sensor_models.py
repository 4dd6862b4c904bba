"""The sensors that a scenario can describe, and their noise, as frozen pydantic models.

The default noise of IMU, GNSS, velocity and orientation is that of table I of the CaLiV paper, read
as 1 sigma of white noise per sample and axis, at 100 Hz for IMU and orientation and at 10 Hz for
GNSS and velocity. Its GPS noise of 1.5e-7 degrees is read as an angle at the centre of the earth:
1.5e-7 pi / 180 x 6378 km = 16.7 mm, north and east alike.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, model_validator

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.sections import Finite, NonNegative, Positive, Section
from caliv_graph.scenario.drive_models import Pair

PerAxis = NonNegative | tuple[NonNegative, NonNegative, NonNegative]
TimeField = Literal["t", "time", "timestamp", "time_stamp"]


class SweepModel(Section):
    """A cloud taken column by column while the vehicle moves."""

    duration_s: Positive | None = Field(
        None, description="seconds from the first to after the last column; absent: 1 / rate_hz"
    )
    direction: Literal["counter_clockwise", "clockwise"] = Field(
        "clockwise", description="which way the columns follow one another, seen from above"
    )
    stamp_at: Literal["start", "end"] = Field(
        "start", description="which end of the sweep the stamp of the cloud marks"
    )
    times_from: Literal["stamp", "start"] = Field(
        "stamp",
        description="what the times of points in the bag count from: the stamp, or the start of "
        "the sweep even if the stamp marks its end, as of an Ouster that is stamped on arrival",
    )
    packet_s: Positive | None = Field(
        None,
        description="seconds; the times of points start anew with every packet of this duration, "
        "as of old Velodyne drivers; absent: they run through the sweep",
    )
    time_field: TimeField = Field(
        "t",
        description="per-point time in the bag: t (uint32 ns after the stamp, Ouster), time "
        "(float32 s after it, Velodyne), timestamp (float64 s, absolute, Hesai and Robosense), "
        "time_stamp (uint32 ns after it, Autoware)",
    )

    @model_validator(mode="after")
    def _unsigned_times_count_from_the_start(self) -> SweepModel:
        counts_back = self.stamp_at == "end" and self.times_from == "stamp"
        if counts_back and self.time_field in ("t", "time_stamp"):
            raise ValueError(
                f"time_field '{self.time_field}' is unsigned and cannot count back from the end "
                "of the sweep: take 'time' or 'timestamp', times_from: start or stamp_at: start"
            )
        if self.time_field == "timestamp" and (self.packet_s or self.times_from == "start"):
            raise ValueError(
                "time_field 'timestamp' is absolute: packet_s and times_from: start need a time "
                "that is relative"
            )
        return self


class EdgeModel(Section):
    """Returns of a beam of finite width at an edge, and beams without a return."""

    divergence_mrad: Positive = Field(
        3.0, description="milliradians, full width of a beam (2 sigma to either side)"
    )
    gap_m: Positive = Field(
        0.05,
        description="smallest difference of range between two parts of a beam at an edge, metres",
    )
    mixing_m: NonNegative = Field(
        1.5,
        description="metres, difference of range up to which the two parts merge into one return",
    )
    mixed_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.7, description="fraction of these returns that lie between the two surfaces"
    )
    lost_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.3, description="fraction of the beams at an edge that return nothing"
    )
    dropout_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.0, description="fraction of all beams that return nothing"
    )


class LidarModel(Section):
    """A LiDAR. Without `sweep` it takes the whole cloud at one instant, as in CARLA.

    A beam has an elevation over the LiDAR's xy plane and an azimuth about the LiDAR's z axis.
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
        description="degrees of elevation per channel, ascending, for uneven spacing; replaces "
        "vertical_fov_deg and channels",
    )
    horizontal_resolution_deg: Positive = Field(
        0.18237, description="degrees between two beams of a channel"
    )
    rate_hz: Positive = Field(10.0, description="clouds per second")
    range_sigma_m: NonNegative = Field(
        0.01, description="metres, 1 sigma of white noise along the beam"
    )
    range_bias_m: Finite = Field(
        0.0, description="metres, constant error of all ranges; positive: they are too long"
    )
    range_bias_sigma_m: NonNegative = Field(
        0.0,
        description="metres, 1 sigma of a constant error that is drawn once per drive and added",
    )
    channel_bias_sigma_m: NonNegative = Field(
        0.0,
        description="metres, 1 sigma of an error of the ranges of each channel, drawn once per "
        "drive and added",
    )
    channel_direction_sigma_mrad: NonNegative = Field(
        0.0,
        description="milliradians, 1 sigma of the errors of elevation and azimuth of each "
        "channel, drawn once per drive",
    )
    incidence_bias_m: Finite = Field(
        0.0,
        description="metres, error b (1 / cos(incidence) - 1) of a range: b at 60 degrees, "
        "constant beyond 80 degrees; a long footprint widens the echo",
    )
    min_range_m: NonNegative = Field(1.0, description="metres; nearer returns are not reported")
    max_range_m: Positive = Field(500.0, description="metres; farther returns are not reported")
    time_offset_s: Finite = Field(
        0.0,
        description="seconds, stamp minus true acquisition time (positive: stamps are late)",
    )
    time_jitter_s: NonNegative = Field(
        0.0, description="seconds, 1 sigma of a white error of the stamp, one draw per cloud"
    )
    phase_s: NonNegative = Field(0.0, description="seconds, stamp of the first cloud")
    sweep: SweepModel | None = Field(None, description="absent: a cloud is taken at one instant")
    edges: EdgeModel | None = Field(None, description="absent: infinitely thin beams")

    @property
    def sweep_s(self) -> float:
        """Duration of a cloud in seconds; 0 if it is taken at one instant."""
        return 0.0 if self.sweep is None else self.sweep.duration_s or 1.0 / self.rate_hz

    @property
    def stamps_at_start(self) -> bool:
        """Whether a cloud's stamp marks the start of its sweep, or its only instant."""
        return self.sweep is None or self.sweep.stamp_at == "start"

    @model_validator(mode="after")
    def _sweep_within_the_period(self) -> LidarModel:
        if self.sweep_s > (1.0 + 1e-9) / self.rate_hz:
            raise ValueError(
                f"sweep.duration_s ({self.sweep_s} s) must not exceed the {1.0 / self.rate_hz:g} s "
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
            raise ValueError(f"horizontal_fov_deg spans {high - low} degrees, must not exceed 360")
        if self.horizontal_resolution_deg > high - low:
            raise ValueError(
                f"horizontal_resolution_deg ({self.horizontal_resolution_deg}) must not "
                f"exceed the field of view of {high - low} degrees"
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
    """A sensor that publishes at a rate."""

    enabled: bool = Field(True, description="false: the vehicle has none")
    phase_s: NonNegative = Field(0.0, description="seconds, stamp of the first sample")


class OrientationModel(Section):
    """The orientation that the IMU reports: its own attitude in ENU axes."""

    enabled: bool = Field(True, description="false: messages say that there is none")
    sigma_rad: NonNegative = Field(
        0.005, description="radians, 1 sigma of white noise per sample and axis of the IMU"
    )
    yaw_bias_deg: Finite = Field(
        0.0, description="degrees, constant error of its heading, positive to the left"
    )
    correlated_sigma_rad: NonNegative = Field(
        0.0, description="radians, 1 sigma of a first-order Gauss-Markov error per map axis"
    )
    correlation_s: Positive = Field(30.0, description="seconds, its correlation time")


class ImuModel(_SampledSection):
    """An IMU, sampled at instants. Earth rotation is not modelled."""

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
    gyroscope_scale_sigma: NonNegative = Field(
        0.0,
        description="radians per radian, 1 sigma of the errors of its scale, and of the directions "
        "of its axes, of each axis on a drive",
    )
    stated_over_true: Positive = Field(
        1.0,
        description="sigmas that the messages state for acceleration and rate, over the true ones",
    )
    orientation: OrientationModel = OrientationModel()


class OutageModel(Section):
    """A time without a fix."""

    start_s: NonNegative = Field(description="seconds since the start of the drive")
    duration_s: Positive = Field(description="seconds")


class JumpModel(OutageModel):
    """A time during which all fixes have the same offset, as with a reflected signal."""

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
    stated_over_true: Positive = Field(
        1.0, description="sigma of white noise that the messages state, over the true one"
    )
    correlated_horizontal_sigma_m: NonNegative = Field(
        0.0,
        description="metres, 1 sigma of a first-order Gauss-Markov error, east and north alike; "
        "no message states it",
    )
    correlated_vertical_sigma_m: NonNegative = Field(
        0.0, description="metres, 1 sigma of the same, up"
    )
    correlation_s: Positive = Field(10.0, description="seconds, its correlation time")
    outlier_probability: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        0.0, description="fraction of the fixes that are outliers"
    )
    outlier_sigma_m: NonNegative = Field(
        2.0, description="metres, 1 sigma of an outlier per axis; the stated covariances exclude it"
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
