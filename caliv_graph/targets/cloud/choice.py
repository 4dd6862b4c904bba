"""Which of the objects that the search proposes is the target: what a choice is between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from caliv_graph.config.model import Config
from caliv_graph.products import TargetObservation
from caliv_graph.targets.search import FoundTarget
from caliv_graph.trajectory.select import VehicleTrajectory


@dataclass(frozen=True)
class TriedCandidate:
    """An object that the search proposes as the target of a drive, and its clouds.

    Attributes:
        found: what the search knows of it.
        observations: its placements.
    """

    found: FoundTarget
    observations: tuple[TargetObservation, ...]

    @property
    def lidars(self) -> frozenset[str]:
        """Names of the LiDARs that see it often enough."""
        return frozenset(cloud.lidar for o in self.observations for cloud in o.clouds)


@dataclass(frozen=True)
class Choice:
    """Which candidate is the target.

    Attributes:
        index: of the candidate.
        reasons: about it and the others, a line each.
    """

    index: int
    reasons: tuple[str, ...] = ()


Choose = Callable[[Sequence[TriedCandidate], VehicleTrajectory, Config], Choice]


def first_candidate(
    candidates: Sequence[TriedCandidate], trajectory: VehicleTrajectory, config: Config
) -> Choice:
    """The one that is seen best, whether or not its clouds agree."""
    return Choice(0)
