"""Guesses that the search had to replace: the config with others, and a sentence about each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caliv_graph.config.model import Config, PoseConfig
from caliv_graph.targets.search.find import FoundTarget


def realigned(config: Config, searched: Sequence[FoundTarget]) -> tuple[Config, tuple[str, ...]]:
    """The config with the guesses that the search of the drives found; and a sentence for each.

    Of several drives the first that has something to say of a LiDAR decides.
    """
    lidars, sentences = dict(config.lidars), []
    for found in searched:
        for name, off in found.misplaced.items():
            if lidars[name] is not config.lidars[name]:
                continue
            T = found.aligned[name]
            x, y, z = (float(v) for v in T.translation())
            roll, pitch, yaw = (float(v) for v in np.degrees(T.rotation().rpy()))
            initial = PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
            lidars[name] = lidars[name].model_copy(update={"initial": initial})
            shift = float(np.linalg.norm(off.shift_m))
            sentences.append(
                f"lidar '{name}': the objects that it sees stand still only if its initial guess "
                f"is off by about {math.degrees(off.yaw_rad):+.0f} degrees in yaw and {shift:.1f} "
                f"m ({off.shift_m[0]:+.1f} forward, {off.shift_m[1]:+.1f} left): the target was "
                f"searched, and the graph solved, from there. Check lidars.{name}.initial: signs, "
                "degrees, T_vehicle_lidar and not its inverse, the topic"
            )
    if not sentences:
        return config, ()
    return config.model_copy(update={"lidars": lidars}), tuple(sentences)
