"""The configuration: frozen, validated on load, dumped beside every result.

Units are in the `Field` descriptions. An unknown key is an error that names the nearest known one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from caliv_graph.config.heading import HeadingConfig
from caliv_graph.config.lidars import LidarConfig, checked_names
from caliv_graph.config.mounting import GnssConfig, ImuConfig
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.config.sections import (
    FilePath,
    Fine,
    Finite,
    Name,
    NonNegative,
    Positive,
    Section,
    Triple,
)
from caliv_graph.config.wheels import WheelsConfig

SolveMode = Literal["auto", "staged", "joint"]
RobustKernel = Literal["huber", "tls", "trimmed", "none"]
Requirement = Literal["s2s", "s2v_rotation", "s2v"]
PoseAxes = Literal["flu", "frd", "ned"]

LIMIT_KEY = re.compile(r"^(s2s|s2v)_(?:(roll|pitch|yaw)_deg|(x|y|z)_m)$")


class DataConfig(Section):
    """Where the recording is."""

    format: Literal["rosbag", "caliv", "clouds"] = "rosbag"
    path: FilePath | None = Field(None, description="folder or file, relative to the config")
    poses: FilePath | None = Field(
        None, description="file with the vehicle's poses, instead of topics, relative likewise"
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
                "poses, pose_axes: a CaLiV folder has its own, in input/ego_poses.yaml, with z up: "
                "remove these keys, or set format to clouds"
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


_MOST_HEIGHT_M = 30.0
"""Of a vehicle frame above or below the ground: that of a container crane on wheels."""


def _above_ground(height_m: float) -> float:
    if abs(height_m) > _MOST_HEIGHT_M:
        raise ValueError(
            f"must be within {_MOST_HEIGHT_M:g} m of the ground: in metres, not millimetres"
        )
    return height_m


Height = Annotated[Finite, AfterValidator(_above_ground)]


class GroundConfig(Section):
    """The ground as a source of roll, pitch and height."""

    use: bool = True
    vehicle_height: Height | None = Field(
        None, description="metres, height of the vehicle frame above ground; absent: unknown"
    )
    sigma: Positive = Field(0.005, description="metres, sigma of vehicle_height over the drive")
    parallel_sigma_deg: Positive | None = Field(
        None, description="degrees; given: the vehicle stands parallel to the ground to this sigma"
    )


class StructureConfig(Section):
    """Walls, fronts, containers and other flat structure that stands still."""

    use: bool = Field(True, description="used where it is")


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

    ground_distance: Fine = Field(
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
                "left to calibrate by: remove one of the two"
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
                f"reference '{self.reference}' is not a LiDAR of this config: set it to one of "
                f"{', '.join(self.lidars)}"
            )
        if not self.reference:
            object.__setattr__(self, "reference", next(iter(self.lidars)))
        fixed = [name for name, lidar in self.lidars.items() if lidar.fixed]
        if fixed and self.solve.mode == "staged" and self.reference not in fixed:
            raise ValueError(
                f"'solve.mode: staged' places all LiDARs by the initial guess of the reference "
                f"'{self.reference}', which would move lidars.{fixed[0]}, whose guess is fixed: "
                f"set reference to {fixed[0]}, or mode to auto"
            )
        topics = [lidar.topic for lidar in self.lidars.values()]
        for topic in topics:
            if topics.count(topic) > 1:
                of = " and ".join(f"'{n}'" for n, m in self.lidars.items() if m.topic == topic)
                raise ValueError(f"topic '{topic}' belongs to LiDARs {of}: give each its own")
        return self

    def names_poses(self) -> bool:
        """Whether the config names poses, which are taken instead of all other motion data."""
        return self.topics.pose is not None or self.data.poses is not None

    def names_motion(self) -> bool:
        """Whether the config names anything that measures the vehicle's motion."""
        topics = any(topic is not None for _, topic in self.topics)
        return topics or self.data.poses is not None or self.data.format == "caliv"

    def free_offsets(self) -> frozenset[str]:
        """Names of the LiDARs whose time offset is estimated."""
        return frozenset(self.lidars) if self.solve.time_offset else frozenset()

    def lidar_order(self) -> tuple[str, ...]:
        """LiDAR names in the order of the file."""
        return tuple(self.lidars)
