"""Noise figures of the config that the drive contradicts."""

from __future__ import annotations

import math

import pytest

from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.stated_noise import stated_noise_warnings
from tests.trajectory.motions import Course, Sensors, arc_drive, config_for, record, stamps

COURSE = Course(arc_drive(8.0))
WANTED = stamps(7.0, 2.0)[2:]
MOTION = record(COURSE, Sensors(), 2)
# Of the paper's table, at the 100 Hz of this IMU.
FORCE, GYRO = 0.05 / math.sqrt(100.0), 0.005 / math.sqrt(100.0)


def said_of(**noise: float) -> list[str]:
    config = config_for(Sensors(), noise=noise)
    return stated_noise_warnings([smooth_trajectory(MOTION, config, WANTED)], config)


def test_a_figure_that_holds_is_not_mentioned() -> None:
    right = {
        "accelerometer_density_m_s2_sqrthz": FORCE,
        "gyroscope_density_rad_s_sqrthz": GYRO,
        "gnss_horizontal_m": 0.0167,
        "gnss_vertical_m": 0.02,
    }
    assert said_of(**right) == []


def test_a_figure_that_is_too_large_makes_no_sigma_too_small() -> None:
    assert said_of(gnss_horizontal_m=0.167) == []


@pytest.mark.parametrize(
    ("key", "true"),
    [("gnss_horizontal_m", 0.0167), ("gnss_vertical_m", 0.02), ("velocity_m_s", 0.1)],
)
def test_a_figure_ten_times_too_small_is_named_with_about_the_right_one(
    key: str, true: float
) -> None:
    (line,) = said_of(**{key: 0.1 * true})

    assert f"noise.{key} is {0.1 * true:.2g}, the drive rather has" in line
    found = float(line.split("rather has ")[1].split(":")[0])
    assert found == pytest.approx(true, rel=0.4)
