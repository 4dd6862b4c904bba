"""A simulated drive past a target, described: vehicle, LiDARs, world, noise.

Frozen models with units in the `Field` descriptions; `configs/scenarios/` holds commented ones.
Nothing here draws, moves or casts: `drives`, `worlds` and `lidar` turn the models into that.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from caliv_graph.config import (
    Finite,
    Mounting,
    NonNegative,
    Positive,
    PositiveTriple,
    read_yaml,
)
from caliv_graph.errors import ConfigError

Pair = tuple[Finite, Finite]
Turn = Literal["left", "right"]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, raw: Any) -> Any:
        """Names the nearest known key, which pydantic's own message does not."""
        if isinstance(raw, Mapping):
            for key in raw:
                if key not in cls.model_fields:
                    known = list(cls.model_fields)
                    close = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
                    hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"
                    raise ValueError(f"unknown key '{key}': {hint}")
        return raw


class _DriveSection(_Section):
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


class _TransitionSection(_Section):
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


class LidarModel(_Section):
    """A LiDAR that takes its whole cloud at one instant, as CARLA's do in synchronous mode.

    A beam is given by its elevation over the LiDAR's xy plane and its azimuth about the
    LiDAR's z axis.
    """

    mounting: Mounting = Field(description="true T_vehicle_lidar")
    horizontal_fov_deg: Pair = Field((-60.0, 60.0), description="degrees of azimuth, from and to")
    vertical_fov_deg: Pair = Field(
        (-12.5, 12.5), description="degrees of elevation, lowest and highest channel"
    )
    channels: Annotated[int, Field(ge=2)] = Field(152, description="beams above one another")
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
        if self.min_range_m >= self.max_range_m:
            raise ValueError(
                f"min_range_m ({self.min_range_m} m) must be below "
                f"max_range_m ({self.max_range_m} m)"
            )
        return self


class GroundModel(_Section):
    """Flat ground, a square about the map's origin."""

    height_m: Finite = Field(0.0, description="metres, its z in the map")
    half_size_m: Positive = Field(200.0, description="metres from the origin to each edge")


class _ObjectSection(_Section):
    xy_m: Pair = Field(description="metres, its origin in the map; it stands on the ground")
    yaw_deg: Finite = Field(0.0, description="degrees, its +x (a chair's front) from map +x")


class ChairModel(_ObjectSection):
    """The plastic armchair of `worlds.chair`: 0.71 m wide, 0.77 m deep, 1.25 m high."""

    shape: Literal["chair"] = "chair"


class BoxModel(_ObjectSection):
    """A box; flat and long, a wall."""

    shape: Literal["box"] = "box"
    size_m: PositiveTriple = Field(description="metres along its x, y, z")


ObjectModel = Annotated[ChairModel | BoxModel, Field(discriminator="shape")]


class WorldModel(_Section):
    """What stands around the drive."""

    ground: GroundModel = GroundModel()
    objects: dict[str, ObjectModel] = Field(min_length=1, description="by name")
    targets: tuple[str, ...] = Field(
        min_length=1, description="names of the objects that serve as calibration targets"
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
        return self


class CropModel(_Section):
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


class PoseNoiseModel(_Section):
    """Errors of the given vehicle poses. They are those of a filter: partly correlated in time."""

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


class SuspensionModel(_Section):
    """What the vehicle frame's height above the ground, nominally zero, does."""

    height_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, one error for the whole drive"
    )
    heave_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, white from scan to scan"
    )


class InitialGuessModel(_Section):
    """How far the written config's initial guess is off, drawn uniformly per LiDAR and axis."""

    translation_m: NonNegative = Field(0.1, description="metres, largest error per vehicle axis")
    rotation_deg: NonNegative = Field(3.0, description="degrees, largest roll, pitch, yaw error")


class Scenario(_Section):
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


def _one_line(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(str(item) for item in first["loc"]) or "the file"
    more = error.error_count() - 1
    rest = f" (and {more} more)" if more else ""
    if first["type"] == "missing":
        return f"'{where}' is missing{rest}"
    given = first["input"]
    shown = "" if isinstance(given, Mapping) else f" (got {str(given)[:60]!r})"
    return f"'{where}': {first['msg'].removeprefix('Value error, ')}{shown}{rest}"


def parse_scenario(raw: Any, source: str) -> Scenario:
    """Validates a scenario.

    Args:
        raw: what the YAML file held.
        source: what to call it in messages.

    Raises:
        ConfigError: with the first thing wrong, in one line.
    """
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{source}: holds no scenario: expected keys such as 'drive', 'lidars'")
    try:
        return Scenario.model_validate(raw)
    except ValidationError as e:
        raise ConfigError(f"{source}: {_one_line(e)}") from None


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
