"""A second run with the first suspect freed, or set to the value that it would take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from caliv_graph.calibration.suspect_values import FREE_ARM_M
from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.sections import Section
from caliv_graph.products import Calibration, Suspect
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS

DRIFT_TIME_S = 20.0
"""Correlation time of given poses that drift over a drive of a minute."""


@dataclass(frozen=True)
class Trial:
    """What is tried.

    Attributes:
        suspect: the input.
        config: with it freed or set.
        change: what was changed in the config, for the user.
    """

    suspect: Suspect
    config: Config
    change: str


def trial_of(calibration: Calibration, config: Config) -> Trial | None:
    """The config of a second run; None: nothing is suspect, or no key frees the first suspect."""
    if not calibration.suspects or calibration.suspects[0].sigmas <= CONTRADICTION_SIGMAS:
        return None
    first = calibration.suspects[0]
    if first.input.endswith(".initial"):
        return _guess(first, config)
    changed = _changed(first, config)
    if changed is None:
        return None
    section, values = changed
    part: Section = getattr(config, section)
    said = ", ".join(f"{section}.{key}: {_said(value)}" for key, value in values.items())
    moved = config.model_copy(update={section: part.model_copy(update=dict(values))})
    return Trial(first, moved, said)


def _guess(first: Suspect, config: Config) -> Trial:
    """The initial guess of a LiDAR where the rest of the data have it."""
    name = first.input.removeprefix("lidars.").removesuffix(".initial")
    x, y, z, roll, pitch, yaw = first.value
    sigma = PoseSigmaConfig(xyz=max(first.sigma[:3]), rpy_deg=max(first.sigma[3:]))
    initial = PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
    lidar = config.lidars[name].model_copy(update={"initial": initial, "sigma": sigma})
    moved = config.model_copy(update={"lidars": {**config.lidars, name: lidar}})
    return Trial(first, moved, f"lidars.{name}.initial: as the rest of the data have it")


def _changed(first: Suspect, config: Config) -> tuple[str, Mapping[str, object]] | None:
    """Section of the config and its new values."""
    name = first.input
    if name == "gnss.lever_arm":
        # A coordinate that is not determined has the value that was typed.
        return "gnss", {
            "lever_arm": first.value,
            "lever_arm_sigma": min(max(first.sigma), FREE_ARM_M),
        }
    if name == "imu.T_vehicle_imu":
        T = config.imu.T_vehicle_imu.model_copy(update={"rpy_deg": first.value})
        return "imu", {"T_vehicle_imu": T, "rotation_sigma_deg": max(first.sigma)}
    if name == "ground.vehicle_height":
        return "ground", {"vehicle_height": first.value[0], "sigma": first.sigma[0]}
    if name.startswith("lidars.") and name.endswith(".time_offset"):
        return "solve", {"time_offset": True}
    if name.startswith("poses.drift"):
        size = max(abs(change) for change in first.change[:3])
        return "noise", {"pose_drift_position_m": 0.5 * size, "pose_drift_time_s": DRIFT_TIME_S}
    if name == "imu.yaw_bias":
        return "imu", {"yaw_bias": True}
    return None


def _said(value: object) -> str:
    """A value of the config in a sentence."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, tuple):
        return f"[{', '.join(f'{x:.3g}' for x in value)}]"
    if isinstance(value, PoseConfig):
        return f"rpy_deg [{', '.join(f'{x:.2f}' for x in value.rpy_deg or ())}]"
    return str(value)
