"""A drive past a target, described: vehicle, sensors, world, noise.

`configs/scenarios/` holds commented examples. `planning` predicts from these models what a drive
determines, and `simulation` draws measurements.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, model_validator

from caliv_graph.config.load import read_yaml, validated
from caliv_graph.config.sections import NonNegative, Positive, Section
from caliv_graph.errors import ConfigError
from caliv_graph.scenario.drive_models import DriveModel
from caliv_graph.scenario.sensor_models import (
    GnssModel,
    ImuModel,
    LidarModel,
    PoseNoiseModel,
    VelocityModel,
)
from caliv_graph.scenario.world_models import BodyBoxModel, WorldModel


class CropModel(Section):
    """Which beams are cast and written. Cropping makes a scan cheap and small.

    A beam that is kept returns the same as without cropping, noise included.
    """

    margin_m: NonNegative = Field(
        1.0,
        description="metres around a target's bounding sphere; beams that can hit it are kept",
    )
    elsewhere_stride: Annotated[int, Field(ge=0)] = Field(
        8, description="of all other beams every n-th channel and column is kept; 0: none"
    )


class BagModel(Section):
    """Options of the bag."""

    start_time_s: Annotated[int, Field(ge=0)] = Field(
        1_750_000_000, description="seconds since 1970, stamp of the drive's start"
    )
    compression: Literal["none", "zstd"] = Field("none", description="of the MCAP's chunks")
    transport_s: NonNegative = Field(
        0.0, description="seconds from the end of a sweep to the recording of its cloud"
    )
    covariances: Literal["stated", "unknown"] = Field(
        "stated",
        description="covariances in the messages: those of the white noise, or zeros, which "
        "mean unknown",
    )


class SuspensionModel(Section):
    """Error of the vehicle frame's height above the ground, whose nominal value is zero.

    Heave lifts vehicle and LiDARs while a cloud is taken. It is white from scan to scan. A physical
    motion cannot be white, so IMU, GNSS and velocity do not measure it.
    """

    height_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, one error for the whole drive"
    )
    heave_sigma_m: NonNegative = Field(
        0.005, description="metres, 1 sigma, white from scan to scan"
    )


UNIFORM_TO_SIGMA = 1.0 / math.sqrt(3.0)
"""Standard deviation of a uniform draw from -1 to 1."""


class InitialGuessModel(Section):
    """Error of the initial guess in the written config, drawn uniformly per LiDAR and axis."""

    translation_m: NonNegative = Field(0.1, description="metres, largest error per vehicle axis")
    rotation_deg: NonNegative = Field(3.0, description="degrees, largest roll, pitch, yaw error")


class Scenario(Section):
    """A simulated drive past one or more targets."""

    name: str = Field(
        pattern=r"^[\w. -]+$", description="its name: letters, digits, dots, dashes, spaces"
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
        (), description="parts of the vehicle that the LiDARs see; absent: none"
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
                f"reference '{self.reference}' is not one of the lidars: set it to one of "
                f"{', '.join(self.lidars)}"
            )
        if not self.reference:
            object.__setattr__(self, "reference", next(iter(self.lidars)))
        return self


def parse_scenario(raw: Any, source: str) -> Scenario:
    """Validates a scenario from the YAML file `source`.

    Raises:
        ConfigError: with the first problem, in one line.
    """
    expected = "scenario: expected keys such as 'drive', 'lidars'"
    return validated(Scenario, raw, source, expected)


def is_recording_config(path: Path) -> bool:
    """Whether a YAML file is a config of a recorded drive, not a scenario.

    Raises:
        ConfigError: the file is missing or not YAML.
    """
    return _is_recording_config(read_yaml(path))


def _is_recording_config(raw: Any) -> bool:
    return isinstance(raw, Mapping) and "lidars" in raw and not {"drive", "world"} & raw.keys()


def load_scenario(path: Path) -> Scenario:
    """Reads and validates a scenario file.

    Raises:
        ConfigError: the file is missing, not YAML, or not valid.
    """
    raw = read_yaml(path)
    if _is_recording_config(raw):
        raise ConfigError(
            f"{path}: is a config of a recorded drive: it has neither 'drive' nor 'world', which a "
            f"scenario has. Make one with its vehicle by 'caliv-graph plan {path} --out "
            "scenario.yaml', or choose one of configs/scenarios"
        )
    return parse_scenario(raw, str(path))


def dump_scenario(scenario: Scenario) -> str:
    """The effective scenario as YAML. `load_scenario` reads the same values from it."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
