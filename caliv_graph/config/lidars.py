"""The LiDARs of a configuration: topic, initial guess and how far off it may be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, field_validator, model_validator

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.sections import Name, NonNegative, Positive, PositiveTriple, Section
from caliv_graph.errors import ConfigError

if TYPE_CHECKING:
    import gtsam

    from caliv_graph.products import Array

StampSetting = Literal["start", "end", "auto"]

Lidar = TypeVar("Lidar")

_LEAST_SIGMA = 1e-6
"""Of a guess, metres or degrees: GTSAM treats much smaller ones as constraints."""

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

    deskewed: bool | Literal["auto"] = Field(
        "auto",
        description="true: the driver has moved the points of a sweep to the stamp; auto: by the "
        "data",
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
            raise ValueError(
                "fixed: true trusts the initial guess, and initial is not given: enter it, or "
                "remove fixed"
            )
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
