"""The prior of the clock of GNSS or given poses: synchronised with another one, or late.

A Gaussian is the wrong prior of a clock. Most receivers stamp a fix with the time at which it was
taken; some drivers stamp it when it arrives, tens of milliseconds later. A wide prior costs the
former two thirds of their precision of S2V x, a narrow one makes the latter wrong by centimetres.
The mixture of these is solved as one Gaussian that has the mean and the variance of the mixture's
posterior (`README.md`, section 17).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.graph import motion_graph
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.reduced import Reduced
from caliv_graph.calibration.solve import SolveState, covariance_of_mode
from caliv_graph.calibration.vehicle_parameters import KEYS, POSE_TIME_OFFSET
from caliv_graph.trajectory.parameters import (
    GNSS_TIME_OFFSET,
    IMU_TIME_OFFSET,
    WHEELS_TIME_OFFSET,
)
from caliv_graph.trajectory.uncertain import SYNCHRONISED_S

WITH_LIDARS, WITH_IMU, LATE = 0.5, 0.3, 0.2
"""Prior probabilities: the stamps of the fixes are in the clock of the LiDARs; in that of the IMU,
as of one device for both; late by anything, one rig in five."""


def has_clock(problem: Problem) -> bool:
    """Whether the clock of the GNSS or of given poses is a variable of a problem."""
    return not problem.parameters.keys().isdisjoint((GNSS_TIME_OFFSET.name, POSE_TIME_OFFSET))


def under_clock_prior(state: SolveState, reduced: Reduced, undetermined: int | None) -> SolveState:
    """A solved graph with the mixture as the prior of a clock, to be solved again.

    `reduced` is `state` at its solution, under the wide prior; `undetermined` as in `step_of_mode`.
    """
    problem = state.problem
    cov = covariance_of_mode(state, reduced, undetermined)

    def of(clock: str) -> Moments:
        value = state.values.atVector(KEYS[clock])
        return Moments(float(value[0]), float(reduced.covariance_of(KEYS[clock], cov)[0, 0]))

    exact = Moments(0.0, SYNCHRONISED_S**2)
    alone = [(WITH_LIDARS + WITH_IMU, exact)]
    clocks = {POSE_TIME_OFFSET: alone, GNSS_TIME_OFFSET.name: alone}
    # The other clock, if it is not that of the LiDARs by definition.
    for inertial in (WHEELS_TIME_OFFSET.name, IMU_TIME_OFFSET.name):
        if inertial in problem.parameters:
            other = of(inertial)
            with_it = replace(other, variance=other.variance + SYNCHRONISED_S**2)
            clocks[GNSS_TIME_OFFSET.name] = [(WITH_LIDARS, exact), (WITH_IMU, with_it)]
    priors = dict(problem.parameters)
    for name in clocks.keys() & priors.keys():
        prior = priors[name]
        wide = Moments(float(np.asarray(prior.mean)[0]), float(prior.cov[0, 0]))
        found = gaussian_prior(of(name), wide, clocks[name])
        cov_found = np.array([[found.variance]])
        priors[name] = replace(prior, mean=np.array([found.mean]), cov=cov_found)
    problem = replace(problem, parameters=priors)
    return replace(state, problem=problem, motion=motion_graph(problem))


@dataclass(frozen=True)
class Moments:
    """Mean and variance of a time offset, s and s^2."""

    mean: float
    variance: float


def gaussian_prior(
    solved: Moments, wide: Moments, synchronised: Sequence[tuple[float, Moments]]
) -> Moments:
    """The Gaussian prior under which a solve has mean and variance of the mixture's posterior.

    Args:
        solved: the time offset by a solve under the prior `wide`.
        wide: of a clock that is late.
        synchronised: prior probability and prior of each clock that it may be synchronised with;
            what is left is the probability of `wide`.

    Returns:
        `wide` itself where the posterior of the mixture is as wide as under it: the clock is late.
    """
    told = max(1.0 / solved.variance - 1.0 / wide.variance, 1e-6 / wide.variance)
    # By the data alone, without the prior.
    data = (solved.mean / solved.variance - wide.mean / wide.variance) / told
    probability = np.array([p for p, _ in synchronised])
    probability = np.append(probability, 1.0 - probability.sum())
    centres = np.array([of.mean for _, of in synchronised] + [wide.mean])
    variances = np.array([of.variance for _, of in synchronised] + [wide.variance])
    spread = variances + 1.0 / told
    log = np.log(probability) - 0.5 * np.log(spread) - 0.5 * (data - centres) ** 2 / spread
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    own = 1.0 / (told + 1.0 / variances)
    means = own * (told * data + centres / variances)
    mean = float(weight @ means)
    variance = float(weight @ (own + (means - mean) ** 2))
    information = 1.0 / variance - told
    if information <= 1.0 / wide.variance:
        return wide
    return Moments((mean / variance - told * data) / information, 1.0 / information)
