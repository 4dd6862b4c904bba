"""What the clouds alone say of their poses, for pose factors; when the joint loop ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.refine import (
    MOST_ROUNDS,
    WAY,
    _in_rounds,
    _Loop,
    creeps,
    poses_by_clouds_alone,
)
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import Array, Iteration
from caliv_graph.registration.quadratic import ShapeQuadratic
from caliv_graph.registration.register import JointRegistration, left_step
from tests.registration.scenes import chair_scene, config_of, matrices

CLOUDS = 8


@cache
def shaped() -> tuple[JointRegistration, Array, Array]:
    """A chair reconstructed at the true poses of eight clouds, and poses beside the true ones."""
    scene = chair_scene([45.0 * j for j in range(CLOUDS)], [6.0] * CLOUDS, 0.01, 1)
    state = JointRegistration(scene.observation, config_of(components=150, max_points=200))
    R, t = matrices(scene.T_target_lidar)
    state.held_along = 0.0
    state.seed(R, t, 0.02)
    while not state.finest:
        state.expect(R, t)
        state.maximise(R, t)
    beside = np.random.default_rng(2).normal(size=(CLOUDS, 6)) * 2e-3
    return state, *left_step(R, t, beside)


def quadratic_of(weights: Array) -> tuple[ShapeQuadratic, Array, Array]:
    state, R, t = shaped()
    state.weights = weights
    return state.expect(R, t), R, t


def test_as_pose_factors_they_have_the_gradient_of_the_quadratic() -> None:
    quadratic, R, t = quadratic_of(np.ones(CLOUDS))
    R_alone, t_alone, blocks, H = poses_by_clouds_alone(quadratic, np.ones(CLOUDS), R, t)
    np.testing.assert_array_equal(blocks, quadratic.blocks)
    np.testing.assert_array_equal(H, quadratic.joint())
    found, before = unstack(R_alone, t_alone), unstack(R, t)
    d = np.array(
        [
            gtsam.Pose3.Logmap(new.compose(old.inverse()))
            for new, old in zip(found, before, strict=True)
        ]
    )
    assert 1e-4 < np.abs(d).max() < 0.02
    left = H @ d.ravel() + quadratic.gradient.ravel()
    assert np.abs(left).max() < 1e-3 * np.abs(quadratic.gradient).max()


def test_robust_weights_are_taken_out_of_a_clouds_own_information() -> None:
    weights = np.ones(CLOUDS)
    weights[3] = 1e-3
    full = quadratic_of(np.ones(CLOUDS))[0].blocks
    quadratic, R, t = quadratic_of(weights)
    blocks = poses_by_clouds_alone(quadratic, weights, R, t)[2]
    # The noise of the ranges is estimated in each E-step, and differs without the cloud: for all.
    others = np.arange(CLOUDS) != 3
    noise = np.median(np.trace(blocks[others].T) / np.trace(full[others].T))
    assert 0.5 < noise < 1.5
    atol = 0.03 * np.abs(full[3]).max()
    np.testing.assert_allclose(blocks[3] / noise, full[3], rtol=0.1, atol=atol)


class Rounds:
    """A loop whose steps (sigmas) are given, and that has converged at a step of 0.05."""

    def __init__(self, sigmas: Sequence[float]) -> None:
        self.sigmas, self.begun, self.iterated = sigmas, 0, 0

    def begin_round(self) -> None:
        self.begun += 1

    def iterate(self, number: int) -> Iteration:
        assert number == self.iterated % 20 + 1  # of its round
        self.iterated += 1
        return Iteration(1e-4, 1e-3, self.sigmas[min(self.iterated, len(self.sigmas)) - 1], 0.0)

    def has_converged(self, last: Iteration) -> bool:
        return last.sigmas <= 0.05


@dataclass
class Moving:
    """A loop whose LiDAR moves along x."""

    step_m: float = 0.001
    x_m: float = 0.0
    ends: list[list[gtsam.Pose3]] = field(default_factory=list)

    def extrinsics(self) -> list[gtsam.Pose3]:
        self.x_m += self.step_m
        return [gtsam.Pose3(gtsam.Rot3(), np.array([self.x_m, 0.0, 0.0]))]


@pytest.mark.parametrize(
    ("sigmas", "rounds", "iterations", "converged"),
    [
        ([3.0, 1.0, 0.05], 1, 3, True),
        ([2.0] * 10 + [0.4], 1, 20, False),
        ([2.0] * 45 + [0.05], 3, 46, True),
        ([2.0] * 18 + [0.4] * 100, 2, 40, False),
        ([2.0] * 17 + [0.4] * 100, 1, 20, False),
        ([1.0], MOST_ROUNDS, 20 * MOST_ROUNDS, False),
    ],
    ids=[
        "converges",
        "wanders a little",
        "creeps and converges",
        "creeps less",
        "slows down",
        "creeps on",
    ],
)
def test_a_loop_that_creeps_begins_its_shapes_anew(
    sigmas: Sequence[float], rounds: int, iterations: int, converged: bool
) -> None:
    loop, course = Rounds(sigmas), list[Iteration]()
    told = list[tuple[int, str]]()

    def advance(n: int = 1, note: str = "") -> None:
        told.append((n, note))

    found = _in_rounds(cast("_Loop", loop), course, 20, advance)
    assert (found, loop.begun, len(course)) == (converged, rounds, iterations)
    assert told[:20] == [(1, "")] * min(iterations, 20)
    assert told[20:] == [(0, f"round {2 + k // 20}") for k in range(iterations - 20)]
    assert (not found and creeps(course)) == (sigmas[-1] > 0.5)


def test_what_does_not_move_does_not_creep() -> None:
    """A hundredth of a millimetre is nothing, even where it is a sigma."""
    assert not creeps([])
    assert not creeps([Iteration(1e-5, 1e-4, 1.0, 0.5)] * 30)
    assert creeps([Iteration(1e-5, 1e-3, 1.0, 0.5)] * 30)


@pytest.mark.parametrize(("way_sigmas", "on_its_way"), [(2.4, False), (4.5, True)])
def test_small_steps_that_lead_far_creep(way_sigmas: float, on_its_way: bool) -> None:
    steps = [Iteration(3e-4, 2e-3, 0.45, 0.1, way_sigmas=way_sigmas)] * 30
    assert creeps(steps) == on_its_way
    assert not creeps([*steps, replace(steps[0], sigmas=0.09)])
    assert not creeps([replace(step, turn_rad=1e-5, shift_m=1e-4) for step in steps])


def test_the_way_of_a_loop_is_that_of_its_last_iterations() -> None:
    """x goes by 1 mm in each, with a sigma of 2 mm: 5 sigmas in ten; to and fro it is none."""
    loop = Moving()
    way = partial(_Loop._way_sigmas, cast("_Loop", loop), np.eye(6) / 0.002**2)
    ways = [way() for _ in range(WAY + 4)]
    assert ways[:WAY] == [0.0] * WAY
    assert ways[WAY:] == pytest.approx([5.0] * 4)
    loop.step_m = -0.001
    assert [way() for _ in range(5)] == pytest.approx([4.0, 3.0, 2.0, 1.0, 0.0])
