"""`structure` of calibration.yaml: what was used of walls and other structure."""

from __future__ import annotations

from pydantic import Field

from caliv_graph.products import StructureSummary
from caliv_graph.results.fields import Count, Finite, Part, Text


class _SharedPart(Part):
    """Surfaces that two LiDARs see."""

    from_: Text = Field(alias="from")
    to: Text
    surfaces: Count


class StructurePart(Part):
    """What was used of walls and other structure."""

    strips: Count
    surfaces: Count
    offset_m: Finite
    sightings: dict[Text, Count] = Field({})
    shared_surfaces: tuple[_SharedPart, ...] = ()

    def summary(self) -> StructureSummary:
        """The same as a product."""
        return StructureSummary(
            strips=self.strips,
            surfaces=self.surfaces,
            sightings=self.sightings,
            shared={(part.from_, part.to): part.surfaces for part in self.shared_surfaces},
            offset_m=self.offset_m,
        )
