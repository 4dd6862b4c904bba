"""`vehicle` of calibration.yaml: what was measured by hand, as it was estimated."""

from __future__ import annotations

from collections.abc import Sized

import numpy as np
from pydantic import Field, StrictBool, model_validator

from caliv_graph.products import TURNS, VehicleParameter
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


class VehiclePart(Part):
    """What was measured by hand on the vehicle, as it was estimated."""

    lever_arm: _ArmPart | None = None
    imu_rotation: _TurnPart | None = None
    wheels_rotation: _TurnPart | None = None
    speed_scale: _ScalesPart | None = None
    heading_yaw: _AnglesPart | None = None

    def parameters(self) -> dict[str, VehicleParameter]:
        """In metres and radians."""
        out = {}
        if self.lever_arm is not None:
            arm = self.lever_arm
            value, sigma = np.array(arm.value), np.array(arm.sigma)
            out["lever_arm"] = VehicleParameter(value, sigma, arm.determined, arm.limits)
        for name in TURNS:
            turn: _TurnPart | _AnglesPart | None = getattr(self, name)
            if turn is not None:
                value, sigma = np.radians(turn.value_deg), np.radians(turn.sigma_deg)
                out[name] = VehicleParameter(value, sigma, turn.determined, turn.limits)
        if self.speed_scale is not None:
            scale = self.speed_scale
            value, sigma = np.array(scale.value), np.array(scale.sigma)
            out["speed_scale"] = VehicleParameter(value, sigma, scale.determined, scale.limits)
        return out
