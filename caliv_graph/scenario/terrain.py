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

WAVE_LENGTHS_M = (10.0, 40.0)
"""Shortest and longest wave. Shorter ones are bumps, longer ones tilt all that a LiDAR sees."""

WAVES = 24
"""Sines. With fewer the height is far from normal."""

WAVES_STEP_M = 0.5
"""Half of the grid step on waves. The mesh of a wave of 10 m is off by a 20th of its height."""


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
class Waves:
    """Waves of a road, a sum of sines in all directions.

    The power spectral density of the height falls with the square of the wave number, as in
    ISO 8608. A road of class A (16e-6 m^3 at 0.1 cycles per metre) has 2.2 mm from 10 to 40 m.

    Attributes:
        wave_vectors: (n, 2) radians per metre, map axes.
        phases_rad: (n,).
        heights_m: (n,) amplitudes.
    """

    wave_vectors: Array
    phases_rad: Array
    heights_m: Array

    @staticmethod
    def drawn(sigma_m: float, seed: int) -> Waves:
        """Waves whose height has 1 sigma of `sigma_m`."""
        rng = np.random.default_rng(seed)
        shortest_m, longest_m = WAVE_LENGTHS_M
        cycles_per_m = rng.uniform(1.0 / longest_m, 1.0 / shortest_m, WAVES)
        direction_rad = rng.uniform(0.0, 2.0 * math.pi, WAVES)
        towards = np.column_stack([np.cos(direction_rad), np.sin(direction_rad)])
        # A density that falls with the square: amplitudes as the inverse of the wave number.
        heights = 1.0 / cycles_per_m
        heights *= sigma_m * math.sqrt(2.0 / float((heights**2).sum()))
        return Waves(
            2.0 * math.pi * cycles_per_m[:, None] * towards,
            rng.uniform(0.0, 2.0 * math.pi, WAVES),
            heights,
        )

    def at(self, xy_map: Array) -> tuple[Array, Array, Array]:
        """As `Terrain.heights`."""
        phase = xy_map @ self.wave_vectors.T + self.phases_rad
        sine, cosine = self.heights_m * np.sin(phase), self.heights_m * np.cos(phase)
        pairs = self.wave_vectors[:, :, None] * self.wave_vectors[:, None, :]
        return sine.sum(axis=1), cosine @ self.wave_vectors, -np.tensordot(sine, pairs, 1)


@dataclass(frozen=True)
class Terrain:
    """Level ground with ramps and waves, whose heights add up."""

    ramps: tuple[RampModel, ...]
    waves: Waves | None = None

    def heights(self, xy_map: Array) -> tuple[Array, Array, Array]:
        """Height (n,) above the level ground at places (n, 2), metres, and its derivatives.

        These are the (n, 2) gradient and (n, 2, 2) second derivatives in 1/m, map axes.
        """
        n = len(xy_map)
        height, gradient, hessian = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2))
        for ramp in self.ramps:
            h, g, b = _ramp_heights(ramp, xy_map)
            height, gradient, hessian = height + h, gradient + g, hessian + b
        if self.waves is not None:
            h, g, b = self.waves.at(xy_map)
            height, gradient, hessian = height + h, gradient + g, hessian + b
        return height, gradient, hessian

    def height_at(self, xy_m: tuple[float, float]) -> float:
        """Height above the level ground at one place, in metres."""
        return float(self.heights(np.array([xy_m]))[0][0])

    def grid_lines(self, half_size_m: float) -> tuple[Array, Array]:
        """Lines in x and in y of a grid over the square ground, fine where a ramp is."""
        # Coarse lines too: triangles as long as the ground would be too thin for float32.
        step_m = COARSE_STEP_M if self.waves is None else WAVES_STEP_M
        coarse = np.linspace(-half_size_m, half_size_m, math.ceil(half_size_m / step_m) + 1)
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
    """The ground of a scenario; None if it is flat, or has bumps, which no vehicle follows."""
    if model.waves_sigma_m == 0.0:
        return Terrain(model.ramps) if model.ramps else None
    return Terrain(model.ramps, Waves.drawn(model.waves_sigma_m, model.waves_seed))
