"""Why scans of a LiDAR do not show the target, in counts; and what of it a setting would change."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

from caliv_graph.config.model import ExtractionConfig

OUTSIDE = "outside the region"
NOTHING = "nothing above the ground that is 0.2 to 2 m wide"
MOVED = "something else stood there"
EMPTY = "empty within the range limits"

OTHER_REGION = "Move or widen target.min/max, or leave target out: it is then searched for"
"""Remedy for a region with no target in it."""

FEWEST_POINTS = 6
"""Smallest value of `extraction.min_points`."""


@dataclass
class Tally:
    """Counts of the scans of one LiDAR, and how near its returns came to the region.

    `cut` of the `kept` ones are cut off by the edge of the field of view. `sparse`: the points of
    the largest object of each scan that was rejected because it has too few.
    """

    scans: int = 0
    kept: int = 0
    cut: int = 0
    nearest_m: float = math.inf
    most_points: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    sparse: list[int] = field(default_factory=list)

    def reasons(self) -> str:
        """Why scans were rejected, the three most common reasons; and how many kept ones are cut.

        Empty if there is nothing to say.
        """
        lines = [f"{n} {why}" for why, n in self.rejected.most_common(3)]
        if self.cut:
            lines.append(f"{self.cut} cut off by the edge of the field of view")
        return ", ".join(lines)

    def remedy(self, extraction: ExtractionConfig, is_given: bool) -> str:
        """What would make more scans count.

        Args:
            extraction: its settings.
            is_given: whether the config has the region (`target`), or the search found it.
        """
        missing = extraction.min_scans - self.kept
        enough = sorted((n for n in self.sparse if n >= FEWEST_POINTS), reverse=True)
        if 0 < missing <= len(enough):
            fewest = enough[missing - 1]
            count = sum(n >= fewest for n in enough)
            return (
                f"Set extraction.min_points to {fewest} (now {extraction.min_points}): {count} "
                "more scans show an object with as many points"
            )
        worst = max(self.rejected, key=lambda why: self.rejected[why], default=OUTSIDE)
        if worst == EMPTY:
            return "Check the topic of this LiDAR and its min_range and max_range"
        if worst == MOVED:
            return "Check its initial guess, its stamps, and that the target stood still"
        if worst.startswith("under "):
            return "Pass the target more slowly, or nearer, on the side that this LiDAR sees"
        if is_given:
            return f"{OTHER_REGION}; 'caliv-graph inspect' shows who sees it when"
        return (
            "Check its initial guess, and drive so that it passes the target; 'caliv-graph "
            "inspect' shows who sees it when"
        )
