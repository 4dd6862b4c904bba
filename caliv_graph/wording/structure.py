"""Sentences about structure: walls and other flat surfaces that stand still."""

from __future__ import annotations


def no_target_sentence(what: str) -> str:
    """The warning of a run without a target; `what` says why there is none."""
    return f"calibrated without a target, by walls and other structure alone: {what}"


def nothing_sentence(what: str, structure: str) -> str:
    """The error where neither target nor structure tells anything; why, of each."""
    return f"{what}. Structure does not replace it: {structure}"
