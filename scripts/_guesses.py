"""Configs without initial guesses."""

from __future__ import annotations

from typing import Any


def drop_guesses(raw: dict[str, Any]) -> None:
    """Takes guess and sigma of every LiDAR out of a config as `simulate` writes it."""
    for lidar in raw["lidars"].values():
        del lidar["initial"], lidar["sigma"]
