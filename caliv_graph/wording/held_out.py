"""Sentences about a validation: what it does not see, and the structure that it holds out."""

from __future__ import annotations

from collections.abc import Sequence

UNSEEN = (
    "Errors that all LiDARs share with the trajectory are not seen here: S2V, by a wrong "
    "imu.T_vehicle_imu, gnss.lever_arm or ground.vehicle_height"
)
"""What no validation by structure sees: trajectory and S2V are off by opposite motions, and every
cloud lies where it should."""


def held_out_sentence(strips: int, before_mm: float, after_mm: float, before: str) -> str:
    """How far LiDARs are apart on held-out strips, before (`before_words`) and after."""
    return (
        f"On {strips} held-out strips of structure the LiDARs are {after_mm:.1f} mm apart with the "
        f"calibration, {before_mm:.1f} mm with {before} (root mean square)."
    )


def level_sentence() -> str:
    """What strips of level ground alone test."""
    return (
        "All of them are level: they test z, roll and pitch, but not x, y and yaw, which walls or "
        "the halves of the drive would test."
    )


def thick_sentence(kinds: str, lidars: Sequence[str]) -> str:
    """LiDARs that see surfaces of some kinds far thicker than they should."""
    names = " and ".join(f"'{name}'" for name in lidars)
    return (
        f"By {names} alone {kinds} are more than twice as thick as expected: rotation, clock or "
        "trajectory may be off."
    )


def stage_sentence(
    file: bool, distance_mm: float, expected_mm: float, words: str, tested: str
) -> str:
    """What known errors say of it, for the calibration of the file or for that without the strips.

    `words` are "explain", "explain poorly" or "do not explain"; `tested` are the numbers of the
    test.
    """
    whose = "of the calibration" if file else "of a calibration of this drive without these strips"
    return (
        f"Noise, trajectory and sigmas {whose} give an expected distance of {expected_mm:.1f} mm "
        f"there; the measured one is {distance_mm:.1f} mm. They {words} it ({tested})."
    )


def nothing_shared_sentence() -> str:
    """Of held-out strips that test nothing."""
    return "No two LiDARs see the same held-out strip of structure: it tests nothing."


def no_held_out_sentence(why: str) -> str:
    """Why a validation has no held-out structure."""
    return f"No third of the structure is held out and measured: {why}."
