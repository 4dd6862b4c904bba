"""`vehicle` of calibration.yaml: what was measured by hand, as it was estimated."""

from __future__ import annotations

from collections.abc import Sized

import numpy as np
from pydantic import Field, StrictBool, model_validator

from caliv_graph.products import TIME_OFFSETS, TURNS, VehicleParameter
from caliv_graph.results.fields import Finite, Part, Sigma, Text


class _MeasuredPart(Part):
    determined: tuple[StrictBool, StrictBool, StrictBool]
    limits: tuple[Text, ...] = ()


class _ArmPart(_MeasuredPart):
    value: tuple[Finite, Finite, Finite]
    sigma: tuple[Sigma, Sigma, Sigma]


class _PerDrivePart(Part):
    determined: tuple[StrictBool, ...] = Field(min_length=1)
    limits: tuple[Text, ...] = ()


class _ScalesPart(_PerDrivePart):
    value: tuple[Finite, ...]
    sigma: tuple[Sigma, ...]

    @model_validator(mode="after")
    def _one_per_drive(self) -> _ScalesPart:
        check_lengths(self.determined, self.value, self.sigma)
        return self


class _AnglesPart(_PerDrivePart):
    value_deg: tuple[Finite, ...]
    sigma_deg: tuple[Sigma, ...]

    @model_validator(mode="after")
    def _one_per_drive(self) -> _AnglesPart:
        check_lengths(self.determined, self.value_deg, self.sigma_deg)
        return self


def check_lengths(determined: Sized, value: Sized, sigma: Sized) -> None:
    """Raises ValueError unless there is one of each per drive."""
    if not len(determined) == len(value) == len(sigma):
        raise ValueError("value, sigma and determined must have one entry per drive")


class _TurnPart(_MeasuredPart):
    value_deg: tuple[Finite, Finite, Finite]
    sigma_deg: tuple[Sigma, Sigma, Sigma]


class _ClockPart(Part):
    value: tuple[Finite]
    sigma: tuple[Sigma]
    determined: tuple[StrictBool]
    limits: tuple[Text, ...] = ()


class VehiclePart(Part):
    """What was measured by hand on the vehicle, and clocks of its sensors, as estimated."""

    lever_arm: _ArmPart | None = None
    imu_place: _ArmPart | None = None
    imu_rotation: _TurnPart | None = None
    wheels_rotation: _TurnPart | None = None
    speed_scale: _ScalesPart | None = None
    heading_yaw: _AnglesPart | None = None
    gnss_time_offset: _ClockPart | None = None
    imu_time_offset: _ClockPart | None = None
    twist_time_offset: _ClockPart | None = None
    pose_time_offset: _ClockPart | None = None

    def parameters(self) -> dict[str, VehicleParameter]:
        """In metres, seconds and radians."""
        out = {}
        for name in TURNS:
            turn: _TurnPart | _AnglesPart | None = getattr(self, name)
            if turn is not None:
                value, sigma = np.radians(turn.value_deg), np.radians(turn.sigma_deg)
                out[name] = VehicleParameter(value, sigma, turn.determined, turn.limits)
        for name in ("lever_arm", "imu_place", "speed_scale", *TIME_OFFSETS):
            found: _ArmPart | _ScalesPart | _ClockPart | None = getattr(self, name)
            if found is not None:
                value, sigma = np.array(found.value), np.array(found.sigma)
                out[name] = VehicleParameter(value, sigma, found.determined, found.limits)
        return {name: out[name] for name in type(self).model_fields if name in out}
