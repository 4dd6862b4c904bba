"""The ground as a function: height, gradient and second derivatives, for drives and for meshes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array
from caliv_graph.scenario.world_models import GroundModel, RampModel

MESH_STEP_M = 0.1
"""Grid step of a ramp's mesh. The mesh error is 0.3 mm at a second derivative of 0.1 per metre."""

COARSE_STEP_M = 4.0
"""Half of the grid step of the level ground around it."""


def _rise(u: Array) -> tuple[Array, Array, Array]:
    """0 below 0, 1 above 1, between them 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7; two derivatives.

    A kink in the second derivative of the height, the pitch rate, would give the pitch of an IMU at
    100 Hz an error of 10 microradians, which is decimetres after a minute.
    """
    v = np.clip(u, 0.0, 1.0)
    w = v * (1.0 - v)
    height = v**4 * (35.0 + v * (-84.0 + v * (70.0 - 20.0 * v)))
    return height, 140.0 * w**3, 420.0 * w**2 * (1.0 - 2.0 * v)


def _profile(way_m: Array, top_m: float, flank_m: float) -> tuple[Array, Array, Array]:
    """A profile along `way_m` (n,): 0, flank up to 1, flank down to 0; two derivatives."""
    up = _rise((way_m + 0.5 * top_m) / flank_m + 1.0)
    down = _rise((way_m - 0.5 * top_m) / flank_m)
    return up[0] - down[0], (up[1] - down[1]) / flank_m, (up[2] - down[2]) / flank_m**2


def _ramp_heights(ramp: RampModel, xy_map: Array) -> tuple[Array, Array, Array]:
    yaw = math.radians(ramp.yaw_deg)
    # Columns: along the ramp and across it.
    R_map_ramp = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    along_m, across_m = ((xy_map - np.array(ramp.xy_m)) @ R_map_ramp).T
    a, a_rate, a_bend = _profile(along_m, ramp.top_m, ramp.flank_m)
    b, b_rate, b_bend = _profile(across_m, ramp.width_m, ramp.flank_m)
    mixed = a_rate * b_rate
    gradient = ramp.height_m * np.stack([a_rate * b, a * b_rate], axis=-1)
    hessian = ramp.height_m * np.stack(
        [np.stack([a_bend * b, mixed], axis=-1), np.stack([mixed, a * b_bend], axis=-1)], axis=-2
    )
    return ramp.height_m * a * b, gradient @ R_map_ramp.T, R_map_ramp @ hessian @ R_map_ramp.T


@dataclass(frozen=True)
class Terrain:
    """Level ground with ramps. Where ramps overlap, their heights add up."""

    ramps: tuple[RampModel, ...]

    def heights(self, xy_map: Array) -> tuple[Array, Array, Array]:
        """Height (n,) above the level ground at places (n, 2), metres, and its derivatives.

        These are the (n, 2) gradient and (n, 2, 2) second derivatives in 1/m, map axes.
        """
        n = len(xy_map)
        height, gradient, hessian = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2))
        for ramp in self.ramps:
            h, g, b = _ramp_heights(ramp, xy_map)
            height, gradient, hessian = height + h, gradient + g, hessian + b
        return height, gradient, hessian

    def height_at(self, xy_m: tuple[float, float]) -> float:
        """Height above the level ground at one place, in metres."""
        return float(self.heights(np.array([xy_m]))[0][0])

    def grid_lines(self, half_size_m: float) -> tuple[Array, Array]:
        """Lines in x and in y of a grid over the square ground, fine where a ramp is."""
        # Coarse lines too: triangles as long as the ground would be too thin for float32.
        coarse = np.linspace(-half_size_m, half_size_m, math.ceil(half_size_m / COARSE_STEP_M) + 1)
        lines = [set(coarse.tolist()) for _ in range(2)]
        for ramp in self.ramps:
            yaw = math.radians(ramp.yaw_deg)
            along = 0.5 * ramp.top_m + ramp.flank_m
            across = 0.5 * ramp.width_m + ramp.flank_m
            c, s = abs(math.cos(yaw)), abs(math.sin(yaw))
            for axis, reach in enumerate((along * c + across * s, along * s + across * c)):
                low = max(ramp.xy_m[axis] - reach, -half_size_m)
                high = min(ramp.xy_m[axis] + reach, half_size_m)
                if low < high:
                    steps = math.ceil((high - low) / MESH_STEP_M)
                    lines[axis].update(np.linspace(low, high, steps + 1).tolist())
        x, y = (np.array(sorted(axis)) for axis in lines)
        return x, y


def make_terrain(model: GroundModel) -> Terrain | None:
    """The ground of a scenario; None if it is flat."""
    return Terrain(model.ramps) if model.ramps else None
