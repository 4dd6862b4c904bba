"""The input of the smoother, where the clock of the fixes is far off.

A smoother that begins at a wrong clock bends the trajectory until fixes and IMU meet somewhere, in
hundreds of steps that lead nowhere. The raw sensors tell such an offset before (`README.md`,
section 14); the smoother begins at it and estimates the rest.
"""

from __future__ import annotations

from dataclasses import replace

from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import MotionData
from caliv_graph.trajectory.inputs import SmootherInput, check_input
from caliv_graph.trajectory.physics import motion_physics


def smoother_input(motion: MotionData, config: Config) -> tuple[SmootherInput, list[str]]:
    """`inputs.check_input` of a drive, its fixes at the times that the raw sensors tell.

    Raises:
        TrajectoryError: as `check_input`.
    """
    late = fixes_late_s(motion, config)
    if late is None:
        return check_input(motion, config)
    data, warnings = check_input(_with_earlier_fixes(motion, late[0]), config)
    return replace(data, motion=motion, found_late_s=late), warnings


def fixes_late_s(motion: MotionData, config: Config) -> tuple[float, float] | None:
    """`Axes.certain_delay_s` of a drive; None: its fixes are not late, or it does not say it."""
    try:
        found = motion_physics(motion, config)
    except TrajectoryError:
        return None  # unusable samples, as `check_input` says
    return None if found is None or found.axes is None else found.axes.certain_delay_s


def _with_earlier_fixes(motion: MotionData, by_s: float) -> MotionData:
    """The drive, all that has the clock of the receiver earlier."""
    by_ns = round(by_s * NANOSECONDS_PER_SECOND)
    gnss, heading = motion.gnss, motion.heading
    if gnss is not None:
        gnss = replace(gnss, stamps_ns=gnss.stamps_ns - by_ns)
    if heading is not None:
        heading = replace(heading, stamps_ns=heading.stamps_ns - by_ns)
    return replace(motion, gnss=gnss, heading=heading)
