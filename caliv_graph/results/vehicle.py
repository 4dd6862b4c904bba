"""`vehicle` of calibration.yaml: what was measured by hand, as it was estimated."""

from __future__ import annotations

import numpy as np
from pydantic import StrictBool

from caliv_graph.products import VehicleParameter
from caliv_graph.results.fields import Finite, Part, Sigma, Text


class _MeasuredPart(Part):
    determined: tuple[StrictBool, StrictBool, StrictBool]
    limits: tuple[Text, ...] = ()


class _ArmPart(_MeasuredPart):
    value: tuple[Finite, Finite, Finite]
    sigma: tuple[Sigma, Sigma, Sigma]


class _TurnPart(_MeasuredPart):
    value_deg: tuple[Finite, Finite, Finite]
    sigma_deg: tuple[Sigma, Sigma, Sigma]


class VehiclePart(Part):
    """What was measured by hand on the vehicle, as it was estimated."""

    lever_arm: _ArmPart | None = None
    imu_rotation: _TurnPart | None = None

    def parameters(self) -> dict[str, VehicleParameter]:
        """In metres and radians."""
        out = {}
        if self.lever_arm is not None:
            arm = self.lever_arm
            value, sigma = np.array(arm.value), np.array(arm.sigma)
            out["lever_arm"] = VehicleParameter(value, sigma, arm.determined, arm.limits)
        if self.imu_rotation is not None:
            turn = self.imu_rotation
            value, sigma = np.radians(turn.value_deg), np.radians(turn.sigma_deg)
            out["imu_rotation"] = VehicleParameter(value, sigma, turn.determined, turn.limits)
        return out
