"""Sentences on what a result starts from: initial guesses, or what was found without one."""

from __future__ import annotations

from collections.abc import Sequence


def unseen_sentence(name: str, without_guess: bool) -> str:
    """What a LiDAR has that saw nothing."""
    kept = (
        "no initial guess was given, so that its values mean nothing"
        if without_guess
        else "it keeps the initial guess"
    )
    return f"LiDAR '{name}' saw neither target nor structure: {kept}"


def before_words(lidars: Sequence[str], found: Sequence[str]) -> str:
    """What "before" a calibration is; `found` are the LiDARs for which nobody gave a guess."""
    if not found:
        return "the initial guesses"
    if set(lidars) <= set(found):
        return "the mountings that were found in the drive"
    return f"the initial guesses, and what was found in the drive for {', '.join(found)}"
