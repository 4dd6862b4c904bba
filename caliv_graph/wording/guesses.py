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


def in_brackets_sentence(undetermined: Sequence[str], found: Sequence[str]) -> str:
    """What sigmas in brackets are: of LiDARs with undetermined axes, `found` without a guess."""
    if not found:
        what = "the sigma of the initial guess"
    elif set(undetermined) <= set(found):
        what = "no initial guess was given"
    else:
        what = f"the sigma of the initial guess; of {', '.join(found)} none was given"
    return f"In brackets: not determined by the drive; {what}."
