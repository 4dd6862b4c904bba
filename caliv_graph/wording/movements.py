"""Sentences on what moved between two calibrations."""

from __future__ import annotations

from collections.abc import Sequence

Pair = tuple[str, str]


def moved_sentence(tested: bool, lidars: int, moved: Sequence[str], apart: Sequence[Pair]) -> str:
    """The verdict of a comparison.

    Args:
        tested: whether any direction was tested.
        lidars: number of LiDARs compared.
        moved: LiDARs that moved against the vehicle.
        apart: pairs of which the first moved against the second.
    """
    if not tested:
        return "Nothing can be said: no direction is determined by both drives."
    if not moved and not apart:
        return "No mount has moved, as far as these drives can tell."
    if not moved:
        return f"A mount has moved: {_pairs(apart)}. The drives do not determine which of the two."
    if len(moved) == lidars > 1 and not apart:
        return (
            "All LiDARs have moved together against the vehicle frame: their common rack "
            "has moved, or the frame itself (IMU, GNSS antenna)."
        )
    verb = "has" if len(moved) == 1 else "have"
    kind = "LiDAR" if len(moved) == 1 else "LiDARs"
    return f"{kind} {', '.join(repr(name) for name in moved)} {verb} moved."


def shared_sentence(verdict: str, same: bool, moved: Sequence[str], apart: Sequence[Pair]) -> str:
    """The verdict on two calibrations with common data; `same`: they have no other data."""
    if not same:
        return (
            f"{verdict} The two share data of a drive: their errors are partly the same, and a "
            "small movement may be missed."
        )
    if not moved and not apart:
        return (
            "Both are results of one drive, and they agree. Whether a mount has moved needs a "
            "second drive."
        )
    names = ", ".join([*(f"'{name}'" for name in moved), *([_pairs(apart)] if apart else [])])
    return (
        f"Both are results of one drive, and they differ by more than their sigmas: {names}. No "
        "mount has moved between them: the settings differ, or a sigma is too small."
    )


def _pairs(pairs: Sequence[Pair]) -> str:
    return ", ".join(f"'{a}' against '{b}'" for a, b in pairs)
