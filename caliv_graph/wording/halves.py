"""Sentences on a calibration against others of the same drive: of its halves, of its structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from caliv_graph.conventions import AXES


@dataclass(frozen=True)
class Difference:
    """Where a calibration and another one have LiDARs.

    Attributes:
        lidars: one: against the vehicle. Two: the first against the second.
        axis: index in `AXES` of the one that is off by most sigmas; -1: no single one is off.
        off: calibration less the other, vehicle axes, rad or m.
        sigma: 1 sigma of it.
    """

    lidars: Sequence[str]
    axis: int
    off: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """How many sigmas the axis is off; 0 without one."""
        return abs(self.off) / self.sigma if self.axis >= 0 else 0.0

    @property
    def who(self) -> str:
        """What is compared."""
        if len(self.lidars) == 1:
            return f"S2V of '{self.lidars[0]}'"
        return f"S2S of '{self.lidars[0]}' to '{self.lidars[1]}'"

    @property
    def most(self) -> str:
        """The axis with its numbers, after a comma."""
        if self.axis < 0:
            return ""
        unit = "mrad" if self.axis < 3 else "mm"
        off, sigma = 1e3 * self.off, 1e3 * self.sigma
        return f", {AXES[self.axis]} {off:+.1f} {unit} at a sigma of {sigma:.1f}"


def alike_sentence(tests: Sequence[tuple[str, float]]) -> str:
    """The calibration agrees with each half: its name, and the smallest corrected p-value."""
    halves = " and ".join(f"{name} (p {p:.2g})" for name, p in tests)
    return f"The calibration agrees with that of this drive by {halves}."


def elsewhere_sentence(half: str, found: Difference) -> str:
    """The calibration has LiDARs elsewhere than one half of the drive, `half` in words."""
    return (
        f"A calibration of this drive by {half} contradicts it: {found.who} is "
        f"elsewhere{found.most}. A mount has moved, or an input of one of the two is wrong."
    )


def solved_anew_sentence(found: Difference, tested: str, alike: bool) -> str:
    """S2S of the calibration against that by structure alone; `tested`: numbers of the test."""
    words = "agrees with" if alike else "contradicts"
    return (
        f"Structure alone, solved anew without held-out strips, {words} {found.who} ({tested})"
        f"{found.most}."
    )
