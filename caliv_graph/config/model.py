"""The configuration: frozen, validated on load, dumped beside every result.

Units are in the `Field` descriptions. An unknown key is an error that names the nearest known one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, field_validator, model_validator

from caliv_graph.config.heading import HeadingConfig
from caliv_graph.config.mounting import GnssConfig, ImuConfig
from caliv_graph.config.mounting import PoseConfig as PoseConfig
from caliv_graph.config.sections import (
    FilePath,
    Finite,
    Name,
    NonNegative,
    Positive,
    PositiveTriple,
    Section,
    Triple,
)
from caliv_graph.config.wheels import WheelsConfig
from caliv_graph.errors import ConfigError

_LEAST_SIGMA = 1e-6
"""Of a guess, metres or degrees: GTSAM treats much smaller ones as constraints."""

if TYPE_CHECKING:
    import gtsam

    from caliv_graph.products import Array

SolveMode = Literal["auto", "staged", "joint"]
RobustKernel = Literal["huber", "tls", "trimmed", "none"]
Requirement = Literal["s2s", "s2v_rotation", "s2v"]
StampSetting = Literal["start", "end", "auto"]
PoseAxes = Literal["flu", "frd", "ned"]

Lidar = TypeVar("Lidar")

LIMIT_KEY = re.compile(r"^(s2s|s2v)_(?:(roll|pitch|yaw)_deg|(x|y|z)_m)$")


_MOST_CHARACTERS = 100
"""Of a LiDAR's name, a column of tables."""


def name_problem(name: str) -> str:
    """The problem of a name for a LiDAR; empty: none.

    Names go to tables, terminals and files of other programs, where line ends and escape sequences
    do damage.
    """
    if name.strip() == name != "" and name.isprintable() and len(name) <= _MOST_CHARACTERS:
        return ""
    return (
        f"{name[:40]!r} cannot be the name of a LiDAR: give it 1 to {_MOST_CHARACTERS} printable "
        "characters, without blanks around them"
    )


def checked_names(lidars: dict[str, Lidar]) -> dict[str, Lidar]:
    """The LiDARs of a file by name; raises ValueError with the first `name_problem`."""
    for problem in filter(None, map(name_problem, lidars)):
        raise ValueError(problem)
    return lidars


class PoseSigmaConfig(Section):
    """How far off the initial guess may be, 1 sigma, per vehicle axis."""

    xyz: Positive | PositiveTriple = Field(0.058, description="metres; 0.058 is a uniform +-0.1 m")
    rpy_deg: Positive | PositiveTriple = Field(
        1.73, description="degrees; 1.73 is a uniform +-3 degrees"
    )

    @field_validator("xyz", "rpy_deg")
    @classmethod
    def _not_a_certainty(cls, sigma: Any) -> Any:
        if min(sigma if isinstance(sigma, tuple) else (sigma,)) < _LEAST_SIGMA:
            raise ValueError(
                f"must be at least {_LEAST_SIGMA:g}. To trust the guess, set 'fixed: true'"
            )
        return sigma

    def xyz_m(self) -> tuple[float, float, float]:
        """Sigma of x, y, z in metres."""
        return self.xyz if isinstance(self.xyz, tuple) else (self.xyz,) * 3

    def rpy_rad(self) -> tuple[float, float, float]:
        """Sigma of the rotation about the vehicle's x, y, z axes in radians."""
        deg = self.rpy_deg if isinstance(self.rpy_deg, tuple) else (self.rpy_deg,) * 3
        return (math.radians(deg[0]), math.radians(deg[1]), math.radians(deg[2]))

    def sigmas(self) -> Array:
        """(6,) rotation before translation, rad and m, vehicle axes."""
        import numpy as np

        return np.array([*self.rpy_rad(), *self.xyz_m()])


def _bin_field(text: str) -> str:
    name, _, kind = text.partition(" ")
    if not name or kind not in BIN_TYPES:
        raise ValueError(
            f"'{text[:40]}' is not a name and one of {', '.join(BIN_TYPES)}, such as 'x f4'"
        )
    return text


BIN_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8")
"""Types of a field in .bin files: letter and bytes, as numpy names them, little-endian."""

BinField = Annotated[str, AfterValidator(_bin_field)]


class LidarConfig(Section):
    """One LiDAR, by the user's name for it."""

    topic: Name = Field(
        description="topic of its clouds; in a CaLiV folder sensor_1, sensor_2, ..."
    )
    bin_fields: Annotated[tuple[BinField, ...], Field(min_length=3)] | None = Field(
        None,
        description="fields of a point in .bin files, each a name and a type, such as x f4; "
        "absent: x, y, z, intensity and perhaps a ring, all f4",
    )
    initial: PoseConfig | None = Field(
        None,
        description="initial guess of T_vehicle_lidar; absent or null: found from the drive",
    )
    sigma: PoseSigmaConfig = PoseSigmaConfig()
    fixed: bool = Field(False, description="trust the initial guess: it is not estimated")
    min_range: NonNegative = Field(
        1.0, description="metres; nearer returns are dropped (the vehicle's own body)"
    )
    max_range: Positive = Field(200.0, description="metres; farther returns are dropped")
    stamp: StampSetting = Field(
        "auto",
        description="what the header's stamp marks, start or end of the sweep; auto: by the data",
    )

    @model_validator(mode="after")
    def _ranges_in_order(self) -> LidarConfig:
        if self.min_range >= self.max_range:
            raise ValueError(
                f"min_range ({self.min_range} m) must be below max_range ({self.max_range} m)"
            )
        return self

    @model_validator(mode="after")
    def _trusts_something(self) -> LidarConfig:
        if self.fixed and self.initial is None:
            raise ValueError("fixed: true trusts the initial guess, and initial is not given")
        return self

    @property
    def given(self) -> PoseConfig:
        """The initial guess as it was entered.

        Raises:
            ConfigError: there is none.
        """
        if self.initial is None:
            raise ConfigError(
                f"the LiDAR with topic {self.topic} has no initial guess. Enter its 'initial', or "
                "what 'caliv-graph calibrate' finds"
            )
        return self.initial

    def guess(self) -> gtsam.Pose3:
        """`T_vehicle_lidar`, the initial guess.

        Raises:
            ConfigError: there is none.
        """
        return self.given.pose()


class FoundLidarConfig(LidarConfig):
    """A LiDAR whose `initial` was not given and has been found in the drive.

    `sigma` is then how far off it may be, and `initial` no evidence beside the drive.
    """


class DataConfig(Section):
    """Where the recording is."""

    format: Literal["rosbag", "caliv", "clouds"] = "rosbag"
    path: FilePath | None = Field(None, description="folder or file, relative to the config")
    poses: FilePath | None = Field(
        None, description="file with the vehicle's poses, instead of topics.pose, relative likewise"
    )
    pose_axes: PoseAxes = Field(
        "flu",
        description="axes of given poses: flu: vehicle x forward, y left, z up; frd: x forward, y "
        "right, z down, in a map with z up; ned: the same in a map of north, east, down",
    )

    @model_validator(mode="after")
    def _poses_of_its_own(self) -> DataConfig:
        if self.format == "caliv" and (self.poses is not None or self.pose_axes != "flu"):
            raise ValueError(
                "poses, pose_axes: a CaLiV folder has its own, in input/ego_poses.yaml, with z up"
            )
        return self


class TopicsConfig(Section):
    """Topics of what moves the vehicle: either `pose`, or IMU, GNSS, velocities and heading."""

    imu: str | None = None
    gnss: str | None = None
    twist: str | None = None
    heading: str | None = None
    pose: str | None = None


class TargetRegion(Section):
    """An axis-aligned box in which the target stands. Every object that stands in it is one."""

    min: Triple = Field(description="metres, lower corner")
    max: Triple = Field(description="metres, upper corner")
    frame: Literal["map", "start"] = Field(
        "map", description="map, or start: the vehicle's first pose"
    )

    @model_validator(mode="after")
    def _corners_in_order(self) -> TargetRegion:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                raise ValueError(f"min {axis} ({low} m) must be below max {axis} ({high} m)")
        return self


class GroundConfig(Section):
    """The ground as a source of roll, pitch and height."""

    use: bool = True
    vehicle_height: Finite | None = Field(
        None, description="metres, height of the vehicle frame above ground; absent: unknown"
    )
    sigma: Positive = Field(0.005, description="metres, sigma of vehicle_height over the drive")
    parallel_sigma_deg: Positive | None = Field(
        None, description="degrees; given: the vehicle stands parallel to the ground to this sigma"
    )


class StructureConfig(Section):
    """Walls, fronts, containers and other flat structure that stands still."""

    use: bool = Field(True, description="used where it is")


class NoiseConfig(Section):
    """Noise of each sensor, 1 sigma. Absent: message covariances, else the paper's table."""

    lidar_range_m: Positive = Field(0.01, description="metres, along the beam")
    lidar_range_bias_m: Positive | None = Field(
        None,
        description="metres, how much all ranges of a LiDAR on one target are off, 1 sigma; "
        "absent: integrated over, with the few millimetres of data sheets as the prior",
    )
    pose_position_m: Positive | None = Field(
        None,
        description="metres, white error of each given pose; absent: its message, or fitted",
    )
    pose_rotation_deg: Positive | None = Field(
        None,
        description="degrees, white error of each given pose; absent: its message, or fitted",
    )
    pose_drift_position_m: Positive | None = Field(
        None, description="metres, slowly varying error of the given poses over the drive"
    )
    pose_drift_rotation_deg: Positive | None = Field(
        None, description="degrees, slowly varying error of the given poses over the drive"
    )
    pose_drift_time_s: Positive = Field(
        4.0, description="seconds, correlation time of the slowly varying error of given poses"
    )
    accelerometer_density_m_s2_sqrthz: Positive | None = None
    gyroscope_density_rad_s_sqrthz: Positive | None = None
    accelerometer_bias_walk_m_s3_sqrthz: Positive | None = None
    gyroscope_bias_walk_rad_s2_sqrthz: Positive | None = None
    accelerometer_bias_m_s2: Positive = Field(
        0.1, description="m/s^2, constant bias of the accelerometer, per axis"
    )
    gyroscope_bias_rad_s: Positive = Field(
        0.01, description="rad/s, constant bias of the gyroscope, per axis"
    )
    gnss_horizontal_m: Positive | None = None
    gnss_vertical_m: Positive | None = None
    gnss_correlated_horizontal_m: NonNegative | None = Field(
        None,
        description="metres, first-order Gauss-Markov error of the fixes, east and north alike; "
        "absent: estimated; 0: none",
    )
    gnss_correlated_vertical_m: NonNegative | None = Field(
        None, description="metres, the same, up; absent while the other is given: none"
    )
    gnss_correlation_s: Positive | None = Field(
        None, description="seconds, its correlation time; absent: estimated"
    )
    orientation_correlated_deg: NonNegative | None = Field(
        None,
        description="degrees, first-order Gauss-Markov error of the IMU's orientation, per map "
        "axis; absent: estimated; 0: none",
    )
    orientation_correlation_s: Positive | None = Field(
        None, description="seconds, its correlation time; absent: estimated"
    )
    heave_m: Positive | None = Field(
        None,
        description="metres, lift of the body on its springs at each stamp; absent: estimated",
    )
    sway_deg: Positive = Field(
        0.057,
        description="degrees, tilt of the body at each stamp from its mean over the drive, per "
        "axis; used with ground.parallel_sigma_deg",
    )
    ground_normal_deg: Positive | None = Field(
        None,
        description="degrees, tilt of the ground around a LiDAR from the plane of the drive, from "
        "scan to scan; absent: estimated",
    )
    ground_distance_m: Positive | None = Field(
        None,
        description="metres, height of the ground below a LiDAR over that plane, from scan to "
        "scan; absent: estimated",
    )
    velocity_m_s: Positive | None = None
    yaw_rate_rad_s: Positive | None = Field(
        None, description="rad/s, yaw rate of the odometry, used where there is no IMU"
    )
    heading_deg: Positive | None = Field(
        None, description="degrees, each heading of topics.heading; absent: its message, or 0.3"
    )
    orientation_deg: Positive | None = None


class SolveConfig(Section):
    """How the graph is solved."""

    mode: SolveMode = Field(
        "auto",
        description="staged: the paper's two stages; joint: everything free under its prior; "
        "auto: the prior decides only along what the drive does not determine",
    )
    time_offset: bool = Field(False, description="estimate a constant time offset per LiDAR")


class RobustConfig(Section):
    """The robust kernel, in the place of the paper's percentile filter."""

    kernel: RobustKernel = "huber"
    huber_k: Positive = Field(1.5, description="whitened residual per sqrt(dof) where Huber bends")
    tls_p_value: Annotated[float, Field(gt=0.0, lt=0.5)] = Field(
        0.001, description="chi-square tail probability beyond which TLS drops a cloud"
    )
    trim_percent: Annotated[float, Field(ge=0.0, lt=50.0)] = Field(
        10.0, description="percent of the clouds that `trimmed` drops: the worst"
    )


class ExtractionConfig(Section):
    """How target points are cut out of the clouds."""

    ground_distance: Positive = Field(
        0.05, description="metres; points nearer to the ground plane are ground"
    )
    voxel: NonNegative = Field(
        0.0, description="metres; at most one point per voxel of this size is kept; 0: all points"
    )
    outlier_neighbours: Annotated[int, Field(ge=0)] = Field(
        6, description="neighbours of the statistical outlier filter; 0: no filter"
    )
    outlier_ratio: Positive = Field(
        3.0,
        description="standard deviations by which the neighbours of a dropped point are too far",
    )
    min_points: Annotated[int, Field(ge=6)] = Field(
        8, description="a scan with fewer target points does not see the target"
    )
    min_scans: Annotated[int, Field(ge=2)] = Field(
        8, description="a LiDAR with fewer scans of the target does not see it"
    )
    max_scans: Annotated[int, Field(ge=10)] = Field(
        80,
        description="scans of one LiDAR used at most, evenly spread; of three and more LiDARs "
        "fewer of each",
    )


class RegistrationConfig(Section):
    """The mixture that all clouds of a target are registered to."""

    components: Annotated[int, Field(ge=20)] = Field(
        1000, description="surfels of the target at most; one per 10 points if fewer"
    )
    outlier_ratio: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        0.05, description="assumed ratio of outliers to inliers (gamma)"
    )
    max_iterations: Annotated[int, Field(ge=5)] = Field(100, description="EM iterations at most")
    max_points: Annotated[int, Field(ge=20)] = Field(
        1500, description="points of one cloud used at most; a larger cloud is thinned"
    )


def check_limit_keys(keys: Iterable[str]) -> None:
    """Checks the names of limits on sigmas.

    Raises:
        ValueError: one is not a `LIMIT_KEY`; the message describes them.
    """
    for key in keys:
        if not LIMIT_KEY.match(key):
            raise ValueError(
                f"unknown limit '{key}': write s2s_ or s2v_, then roll_deg, pitch_deg, "
                "yaw_deg, x_m, y_m or z_m"
            )


class Config(Section):
    """The whole configuration; every section but `lidars` has defaults."""

    data: DataConfig = DataConfig()
    topics: TopicsConfig = TopicsConfig()
    lidars: Annotated[dict[Name, LidarConfig], Field(min_length=1), AfterValidator(checked_names)]
    reference: Name = Field("", description="reference LiDAR; empty: the first")
    target: Annotated[tuple[TargetRegion, ...], Field(min_length=1)] | Literal[False] | None = (
        Field(
            None,
            description="one region or a list of them; absent: it is searched for; false: none "
            "is looked for, and structure calibrates alone",
        )
    )
    ground: GroundConfig = GroundConfig()
    structure: StructureConfig = StructureConfig()
    imu: ImuConfig = ImuConfig()
    gnss: GnssConfig = GnssConfig()
    wheels: WheelsConfig = WheelsConfig()
    heading: HeadingConfig = HeadingConfig()
    noise: NoiseConfig = NoiseConfig()
    solve: SolveConfig = SolveConfig()
    robust: RobustConfig = RobustConfig()
    extraction: ExtractionConfig = ExtractionConfig()
    registration: RegistrationConfig = RegistrationConfig()
    require: tuple[Requirement, ...] = Field(
        ("s2s",), description="what exit code 0 promises to have determined"
    )
    limits: dict[str, Positive] = Field(
        {},
        description="largest sigma that exit code 0 allows, vehicle axes: s2v_yaw_deg: 0.1, ...",
    )

    @model_validator(mode="before")
    @classmethod
    def _empty_sections(cls, raw: Any) -> Any:
        """`topics:` with nothing below it means its defaults."""
        if not isinstance(raw, Mapping):
            return raw
        return {key: value for key, value in raw.items() if value is not None or key == "lidars"}

    @model_validator(mode="before")
    @classmethod
    def _limits_inside_require(cls, raw: Any) -> Any:
        """`require` may carry the limits: `{limits: {...}}`, alone or as an item of the list."""
        if not isinstance(raw, Mapping) or "require" not in raw:
            return raw
        items = raw["require"]
        items = [items] if isinstance(items, str | Mapping) else items
        if not isinstance(items, list | tuple):
            return raw
        names = [item for item in items if not isinstance(item, Mapping)]
        found: list[Any] = [raw["limits"]] if "limits" in raw else []
        # A bare {s2v_yaw_deg: 0.1} can only mean a limit as well.
        found += [item.get("limits", item) for item in items if isinstance(item, Mapping)]
        limits: Any = {}
        for given in found:
            if not isinstance(given, Mapping):
                limits = given  # the check of the field reports it
                break
            limits = {**limits, **given}
        return {**raw, "require": names, "limits": limits}

    @field_validator("target", mode="before")
    @classmethod
    def _one_region_or_many(cls, raw: Any) -> Any:
        return [raw] if isinstance(raw, Mapping) else raw

    @model_validator(mode="after")
    def _something_to_calibrate_by(self) -> Config:
        if self.target is False and not self.structure.use:
            raise ValueError(
                "target: false leaves structure alone, and 'structure.use' is false: nothing is "
                "left to calibrate by"
            )
        if self.target is False and self.solve.mode == "staged":
            raise ValueError(
                "target: false leaves structure alone, which 'solve.mode: staged' does not use: "
                "set it to auto or joint"
            )
        return self

    @model_validator(mode="after")
    def _poses_of_one_source(self) -> Config:
        if self.data.poses is not None and self.topics.pose is not None:
            raise ValueError("give data.poses or topics.pose, not both")
        return self

    @model_validator(mode="after")
    def _fields_of_bin_files(self) -> Config:
        for name, lidar in self.lidars.items():
            if lidar.bin_fields is not None and self.data.format != "clouds":
                raise ValueError(
                    f"lidars.{name}.bin_fields are of .bin files, and data.format is "
                    f"{self.data.format}, whose clouds name their fields: remove the key, or set "
                    "data.format to clouds"
                )
        return self

    @model_validator(mode="after")
    def _translations_to_hold(self) -> Config:
        missing = [name for name, lidar in self.lidars.items() if lidar.initial is None]
        if missing and self.solve.mode == "staged":
            raise ValueError(
                f"'solve.mode: staged' holds translations at the initial guesses, and "
                f"lidars.{missing[0]}.initial is not given: enter it, or set mode to auto"
            )
        return self

    @field_validator("limits")
    @classmethod
    def _known_limits(cls, limits: dict[str, float]) -> dict[str, float]:
        check_limit_keys(limits)
        return limits

    @model_validator(mode="after")
    def _reference_is_a_lidar(self) -> Config:
        if self.reference and self.reference not in self.lidars:
            raise ValueError(
                f"reference '{self.reference}' is not a LiDAR of this config: "
                f"{', '.join(self.lidars)}"
            )
        if not self.reference:
            object.__setattr__(self, "reference", next(iter(self.lidars)))
        topics = [lidar.topic for lidar in self.lidars.values()]
        for topic in topics:
            if topics.count(topic) > 1:
                raise ValueError(f"topic '{topic}' belongs to more than one LiDAR")
        return self

    def names_motion(self) -> bool:
        """Whether the config names anything that measures the vehicle's motion."""
        topics = any(topic is not None for _, topic in self.topics)
        return topics or self.data.poses is not None or self.data.format == "caliv"

    def lidar_order(self) -> tuple[str, ...]:
        """LiDAR names in the order of the file."""
        return tuple(self.lidars)
