"""Which inputs a drive can accuse."""

from caliv_graph.scenario.drives import CurvatureProfile, Drive, SpeedProfile
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.suspects import suspect_parameters
from tests.trajectory.motions import (
    Course,
    Sensors,
    config_for,
    eight_drive,
    record,
    stamps,
)


def names(course: Course) -> set[str]:
    motion = record(course, Sensors(), 1)
    wanted = stamps(course.duration_s, 1.0, 0.05)
    smoothed = smooth_trajectory(motion, config_for(Sensors()), wanted)
    return {suspect.parameter.name for suspect in suspect_parameters(smoothed)}


def test_a_gyroscope_is_accused_only_by_a_drive_that_turns() -> None:
    """What the estimated turns of a vehicle that stands are is noise."""
    still = Drive(SpeedProfile(0.0, 1.0, 1.5, 8.0), CurvatureProfile(0.0), 2.8)
    assert "imu.gyroscope.scale" not in names(Course(still))
    assert "imu.accelerometer.scale" in names(Course(still))
    assert "imu.gyroscope.scale" in names(Course(eight_drive(14.0)))
