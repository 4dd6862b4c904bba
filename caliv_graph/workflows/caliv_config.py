"""Configs of the CaLiV and GMMCalib authors' programs: initial guesses and the target's region.

CaLiV writes roll, pitch and yaw in degrees, GMMCalib in radians, under the same keys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, RootModel

from caliv_graph.config.load import read_yaml, validated
from caliv_graph.config.sections import Finite, Triple
from caliv_graph.errors import ConfigError

_ROUNDING_RAD = 0.01
"""Beyond pi, of an angle that somebody rounded."""


def _inner_list(raw: Any) -> Any:
    """The numbers of a list, which the CaLiV authors' program writes inside another list."""
    return raw[0] if isinstance(raw, list) and len(raw) == 1 else raw


_Numbers6 = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


class _Transforms(RootModel[dict[str, Annotated[_Numbers6, BeforeValidator(_inner_list)]]]):
    """`transform_sensor_N`: roll, pitch, yaw, then metres, of T_vehicle_lidar."""


class _Bounds(BaseModel):
    """The target's region in the map, metres."""

    min_bound: Annotated[Triple, BeforeValidator(_inner_list)]
    max_bound: Annotated[Triple, BeforeValidator(_inner_list)]


@dataclass(frozen=True)
class Original:
    """The values of such a config, in the units of our config.

    Attributes:
        path: the file.
        extrinsics: by sensor, metres and roll, pitch, yaw in degrees of T_vehicle_lidar.
        target: lower and upper corner of the region, metres; None: it has none.
        radians: whether the file has its angles in radians.
    """

    path: Path
    extrinsics: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    target: tuple[Sequence[float], Sequence[float]] | None
    radians: bool

    @property
    def source(self) -> str:
        """The file, for a comment."""
        how = ", angles in radians there by their size: check them" if self.radians else ""
        return f"{self.path.name}{how}"


def find_original(folder: Path) -> Original | None:
    """Looks for such a config beside the poses, and beside the folder `input` that holds them.

    In each place also in the folder `config`, where the authors keep it.

    Raises:
        ConfigError: it is damaged.
    """
    folders = [folder, folder.parent] if folder.name == "input" else [folder]
    for candidate in (path for around in folders for path in (around, around / "config")):
        if not candidate.is_dir():
            continue
        for path in sorted(candidate.iterdir()):
            if path.suffix in (".yaml", ".yml") and path.is_file():
                original = _read_original(path)
                if original:
                    return original
    return None


def _read_original(path: Path) -> Original | None:
    try:
        raw = read_yaml(path)
    except ConfigError:
        return None
    if not isinstance(raw, dict) or "transform_sensor_1" not in raw:
        return None
    expected = "CaLiV config"
    values = {key: value for key, value in raw.items() if str(key).startswith("transform_")}
    transforms = validated(_Transforms, values, str(path), expected).root
    radians = are_radians([numbers[:3] for numbers in transforms.values()])
    unit = math.degrees(1.0) if radians else 1.0
    extrinsics = {
        name.removeprefix("transform_"): (numbers[3:], [unit * angle for angle in numbers[:3]])
        for name, numbers in transforms.items()
    }
    if "min_bound" not in raw or "max_bound" not in raw:
        return Original(path, extrinsics, None, radians)
    bounds = validated(_Bounds, raw, str(path), expected)
    return Original(path, extrinsics, (bounds.min_bound, bounds.max_bound), radians)


def are_radians(angles: Sequence[Sequence[float]]) -> bool:
    """Whether roll, pitch, yaw of all sensors of a file are radians, by their size.

    Radians of a pose stay within pi, and pitch within half of it. Degrees that all do so would be
    LiDARs that all look ahead and stand level to 3 degrees.
    """
    most = (math.pi, math.pi / 2.0, math.pi)
    fits = all(
        abs(angle) <= limit + _ROUNDING_RAD
        for rpy in angles
        for angle, limit in zip(rpy, most, strict=True)
    )
    return fits and any(angle != 0.0 for rpy in angles for angle in rpy)
