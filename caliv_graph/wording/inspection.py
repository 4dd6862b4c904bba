"""Sentences on what `inspect` cannot read or show of a drive."""

from __future__ import annotations

from collections.abc import Sequence


def no_trajectory_sentence(reason: str) -> str:
    """Why no clouds along the drive are shown."""
    return f"Clouds along the drive are not shown, for there is no trajectory: {reason}"


def unseen_lidar_sentence(name: str, reason: str) -> str:
    """Why the clouds of a LiDAR are not shown."""
    return f"The clouds of lidar '{name}' are not shown: {reason}"


def no_scene_sentence(reason: str) -> str:
    """Why no clouds are shown at all."""
    return f"No clouds are shown: {reason}"


def unreadable_sentence(name: str, first: str, count: int) -> str:
    """How many clouds of a LiDAR cannot be read, and why the first of them."""
    in_all = f". In all {count} clouds of lidar '{name}' cannot be read" if count > 1 else ""
    return f"{first}{in_all}"


def untested_guesses_sentence(lidars: Sequence[str]) -> str:
    """What `inspect` cannot say of guesses where no target is in view."""
    names = " and ".join(f"'{name}'" for name in lidars)
    return (
        f"Yaw, x and y of the initial guesses of lidars {names} are not tested here, for no target "
        "is seen: 'caliv-graph calibrate' tests them by walls"
    )


def heading_left_sentence(name: str, sigma_deg: float) -> str:
    """What the motion data of a drive leave to walls."""
    return (
        f"{name}: the motion data leave the heading to {sigma_deg:.1f} degrees (1 sigma): "
        "'caliv-graph calibrate' refuses the drive unless walls in view of the LiDARs tell it"
    )
