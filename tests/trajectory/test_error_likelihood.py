"""What motion data say of errors that are correlated over time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.conventions import key_bias, key_imu, key_velocity
from caliv_graph.products import IntArray
from caliv_graph.trajectory.build import build_graph
from caliv_graph.trajectory.correlated import CorrelatedError, unit_information
from caliv_graph.trajectory.error_likelihood import (
    ErrorLikelihood,
    eliminated,
    error_likelihood,
    likelihood_end_ns,
    white_sigmas,
)
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.variances import NoiseLikelihood
from tests.trajectory.test_variances import base, recorded, shifted, smoothed

NODES = 30


def test_it_is_the_likelihood_of_the_longer_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Elimination of all but the errors changes nothing, whatever their sizes and times are."""
    # Each node a step of its own, as the chain has it.
    monkeypatch.setattr("caliv_graph.trajectory.effects.STEP_NS", 1_000_000)
    trajectory = base()
    none: IntArray = np.zeros(0, dtype=np.int64)
    graph = build_graph(
        trajectory.data, trajectory.nodes_ns, trajectory.states, none, "none"
    ).factors
    keys = {key(i) for i in range(NODES) for key in (key_imu, key_velocity, key_bias)}
    inside = [i for i in range(graph.size()) if set(graph.at(i).keys()) <= keys]
    part = type(graph)()
    for i in inside:
        part.push_back(graph.at(i))
    values, kinds = trajectory.estimate().values, [trajectory.factor_kinds[i] for i in inside]
    linear = part.linearize(values)
    nodes, R = trajectory.nodes_ns[:NODES], trajectory.states.R_map_imu[:NODES]
    columns = np.random.default_rng(0).standard_normal((sum(_rows(linear)), 1))
    found = eliminated(
        linear, kinds, [], nodes, R, ["gnss", "orientation"], columns, np.array([3.0**-2])
    )

    def longer(*errors: CorrelatedError) -> float:
        chain = NoiseLikelihood(linear, kinds, [], nodes, R, errors, [], columns)
        value = chain.at(np.zeros(0))[0]
        for error in errors:
            of_unit = unit_information(nodes, error.time_s)[2]
            value -= sum(of_unit - 2.0 * NODES * np.log(sigma) for sigma in error.sigmas)
        return 0.5 * value

    fixes = CorrelatedError("gnss", (0.03, 0.02, 0.01), 1.5)
    turns = CorrelatedError("orientation", (4e-3, 2e-3, 3e-3), 8.0)
    alone = longer()
    assert found.gains(fixes, np.array([1.0]))[0] == pytest.approx(alone - longer(fixes), abs=2e-3)
    assert found.gains(turns, np.ones(2))[1] == pytest.approx(alone - longer(turns), abs=2e-3)
    twice = CorrelatedError("gnss", (0.06, 0.04, 0.02), 1.5)
    beside = found.given([turns]).gains(fixes, np.array([2.0, 0.0]))
    assert beside[0] == pytest.approx(longer(turns) - longer(twice, turns), abs=2e-3)
    assert beside[1] == 0.0


def _rows(linear: gtsam.GaussianFactorGraph) -> list[int]:
    factors: list[Any] = [linear.at(i) for i in range(linear.size())]
    return [factor.rows() for factor in factors]


def test_a_slow_error_of_the_fixes_shows_in_the_motion_data() -> None:
    motion = recorded()
    assert motion.gnss is not None
    seconds = 1e-9 * (motion.gnss.stamps_ns - motion.gnss.stamps_ns[0])
    wave = shifted(motion, 0.05 * np.sin(2.0 * seconds))
    hypothesis = CorrelatedError("gnss", (0.05, 0.05, 1e-4), 2.0)

    def gain(trajectory: SmoothedTrajectory) -> float:
        return float(error_likelihood(trajectory, ["gnss"]).gains(hypothesis, np.ones(1))[0])

    sound, wavy = gain(base()), gain(smoothed(wave))
    assert sound < -3.0
    assert wavy > sound + 10.0


def test_of_a_long_drive_the_first_steps_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes that lie apart cover more time: the size of the likelihood does not grow with it."""
    trajectory = base()
    whole = error_likelihood(trajectory, ["gnss"])
    monkeypatch.setattr("caliv_graph.trajectory.error_likelihood.STEPS", 4)

    short = error_likelihood(trajectory, ["gnss"])

    assert len(whole.stamps_ns) > 4
    np.testing.assert_array_equal(short.stamps_ns, whole.stamps_ns[:4])
    end_s = 1e-9 * (likelihood_end_ns(trajectory) - trajectory.nodes_ns[0])
    assert 1.5 <= end_s < 2.0
    # Later data can only add to what is known of the first steps.
    m = len(whole.stamps_ns)
    first = (m * np.arange(3)[:, None] + np.arange(4)).ravel()
    more = whole.information[np.ix_(first, first)] - short.information
    assert np.linalg.eigvalsh(more).min() > -1e-6 * np.diag(whole.information).max()


def test_white_sigmas_are_those_in_use() -> None:
    trajectory = base()

    assert white_sigmas(trajectory.data, "gnss") == pytest.approx([0.0167, 0.0167, 0.02])
    doubled = replace(trajectory.data, scales={"orientation": 2.0})
    one = white_sigmas(trajectory.data, "orientation")
    assert white_sigmas(doubled, "orientation") == pytest.approx(2.0 * one)


def test_white_sigmas_are_about_the_axes_of_the_map() -> None:
    """An IMU that lies on its side, x as in the map: its z is the map's -y, its y the map's z."""
    data = base().data
    imu = data.motion.imu
    assert imu is not None
    n = len(imu.stamps_ns)
    half = np.sqrt(0.5)
    on_its_side = replace(
        imu,
        orientation_xyzw=np.tile([half, 0.0, 0.0, half], (n, 1)),
        orientation_cov=np.tile(np.diag([1e-6, 4e-6, 9e-6]), (n, 1, 1)),
    )
    turned = replace(data, motion=replace(data.motion, imu=on_its_side))

    assert white_sigmas(turned, "orientation") == pytest.approx([1e-3, 3e-3, 2e-3])


def test_kinds_that_a_drive_has_not_say_nothing() -> None:
    none = ErrorLikelihood((), np.arange(3), np.zeros((0, 0)), np.zeros(0))

    error = CorrelatedError("gnss", (1.0, 1.0, 1.0), 5.0)
    assert none.given([error]).gains(error, np.ones(2)).tolist() == [0.0, 0.0]
