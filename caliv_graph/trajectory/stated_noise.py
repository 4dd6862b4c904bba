"""Noise figures of the config that are too small for what a drive shows.

They are kept: who states a figure means it. But sigmas of a result do not hold if they rest on one
that is ten times too small, and the other levels are then fitted to it. So the drive is smoothed
without the figures, and they are held against what it shows there (`README.md`, section 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.trajectory.inputs import SmootherInput, check_input, scaled
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.variances import EVIDENCE, fit, likelihood_of, noise_keys

FAR = 2.0
"""Estimated scale on a figure from which that is called wrong. The accelerometer of a drive of a
minute is known to 30 percent. Figures that are too large make no sigma too small."""


def stated_noise_warnings(trajectories: Sequence[VehicleTrajectory], config: Config) -> list[str]:
    """A line for each noise figure of the config that is too small for a drive."""
    if config.robust.kernel == "none":
        return []  # everything is believed, jumps of the fixes too
    out = []
    for trajectory in trajectories:
        if isinstance(trajectory, SmoothedTrajectory):
            out += _of_drive(trajectory, config)
    return out


def _of_drive(trajectory: SmoothedTrajectory, config: Config) -> list[str]:
    """`stated_noise_warnings` of one drive."""
    noise = config.noise
    stated = {
        name: key
        for name, key in noise_keys(trajectory.data).items()
        # A baseline is as good as the fixes at its ends.
        if key is not None and name != "baseline" and getattr(noise, key) is not None
    }
    if not stated:
        return []
    none = noise.model_copy(update=dict.fromkeys(stated.values()))
    motion, without = trajectory.data.motion, config.model_copy(update={"noise": none})
    try:
        free = smooth_trajectory(motion, without, [])
        others = {n: s for n, s in free.data.scales.items() if n not in stated}
        data = _with_noise_of(free.data, scaled(check_input(motion, config)[0], others))
        likelihood = likelihood_of(
            data, free.nodes_ns, free.states, free.gnss_dropped, free.correlated, list(stated)
        )
        scales, best = fit(likelihood, set(likelihood.names))
        far = [name for name, scale in scales.items() if scale > FAR]
        held = {
            name: fit(likelihood, set(likelihood.names) - {name}, best + EVIDENCE, scales)[1]
            for name in far
        }
    except TrajectoryError:
        return []  # without the figures the drive does not determine the motion
    return [
        _sentence(motion.name, stated[name], getattr(noise, stated[name]), scales[name])
        for name in far
        if held[name] - best > EVIDENCE
    ]


def _with_noise_of(data: SmootherInput, stated: SmootherInput) -> SmootherInput:
    """An input with its parameters as estimated, and the noise levels of another of its drive."""
    positions, headings = data.positions, data.headings
    if positions is not None and stated.positions is not None:
        positions = replace(positions, cov_map=stated.positions.cov_map)
    if headings is not None and stated.headings is not None:
        headings = replace(headings, var=stated.headings.var)
    return replace(
        data,
        config=stated.config,
        noise=stated.noise,
        positions=positions,
        headings=headings,
        scales=stated.scales,
    )


def _sentence(drive: str, key: str, value: float, scale: float) -> str:
    """That a figure is too small, and what to do."""
    return (
        f"{drive}: noise.{key} is {value:.2g}, the drive rather has {scale * value:.2g}: sigmas of "
        "the result that rest on it are too small. Correct it, or leave it out: it is then "
        "estimated from the drive"
    )
