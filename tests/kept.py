"""Simulated drives whose rays are cast once: every stage of a calibration reads its clouds anew."""

from __future__ import annotations

from collections.abc import Container, Iterator

from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedScan


class KeptDrive(SimulatedRecording):
    """A simulated drive with its clouds in memory once it has been asked for one."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        super().__init__(scenario, seed)
        self._kept: dict[str, list[SimulatedScan]] = {}

    def scans_with_truth(
        self, lidar: str, wanted: Container[int] | None = None
    ) -> Iterator[SimulatedScan]:
        if lidar not in self._kept:
            self._kept[lidar] = list(super().scans_with_truth(lidar))
        return (s for s in self._kept[lidar] if wanted is None or s.scan.stamp_ns in wanted)
