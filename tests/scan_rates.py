"""Scenarios with fewer scans: what is not asked of each costs all the same."""

from __future__ import annotations

from collections.abc import Callable

from caliv_graph.scenario.model import Scenario


def scanned_at(scenario: Scenario, rate_hz: float) -> Scenario:
    """With so many scans of each LiDAR a second."""
    return _with_rates(scenario, lambda _: rate_hz)


def scanned_every(scenario: Scenario, count: int) -> Scenario:
    """With every so many-th scan alone."""
    return _with_rates(scenario, lambda rate_hz: rate_hz / count)


def _with_rates(scenario: Scenario, rate_of: Callable[[float], float]) -> Scenario:
    lidars = {
        name: lidar.model_copy(update={"rate_hz": rate_of(lidar.rate_hz)})
        for name, lidar in scenario.lidars.items()
    }
    return scenario.model_copy(update={"lidars": lidars})
