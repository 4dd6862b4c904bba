"""Config before messages before the paper's table, and zeros are no statement."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import GnssFixes, ImuSamples, TwistSamples
from caliv_graph.trajectory.gnss import normal_gravity, positions_in_map, shared_by_rough
from caliv_graph.trajectory.noise import (
    gnss_covariances,
    imu_noise,
    orientation_covariances,
    stated,
    velocity_covariances,
)
from tests.trajectory.motions import Sensors, config_for

N = 4
AT = np.arange(N, dtype=np.int64) * 5_000_000  # 200 Hz
CONFIG = config_for(Sensors())


def test_what_counts_as_stated() -> None:
    good = np.diag([1.0, 2.0, 3.0])
    singular = np.ones((3, 3))
    nan = np.full((3, 3), np.nan)
    assert stated(np.array([good, np.zeros((3, 3)), nan, singular, -good])).tolist() == [
        True,
        False,
        False,
        False,
        False,
    ]


def test_a_sample_figure_is_over_the_root_of_the_rate() -> None:
    bare = ImuSamples(AT, np.zeros((N, 3)), np.zeros((N, 3)))
    noise = imu_noise(bare, CONFIG)
    assert math.sqrt(noise.gyro_density[0, 0]) == pytest.approx(0.005 / math.sqrt(200))
    assert math.sqrt(noise.force_density[0, 0]) == pytest.approx(0.05 / math.sqrt(200))
    assert noise.sources["gyroscope"] == "the paper's table"
    told = ImuSamples(
        AT,
        np.zeros((N, 3)),
        np.zeros((N, 3)),
        angular_velocity_cov=4e-6 * np.eye(3),
        specific_force_cov=np.zeros((3, 3)),
    )
    noise = imu_noise(told, config_for(Sensors(), noise={"accelerometer_density_m_s2_sqrthz": 0.1}))
    assert noise.gyro_density[1, 1] == pytest.approx(4e-6 / 200)
    assert noise.force_density[2, 2] == pytest.approx(0.01)
    assert noise.sources == {"gyroscope": "messages", "accelerometer": "config"}


def test_a_message_that_states_nothing_is_like_its_fellows() -> None:
    cov = np.tile(np.diag([0.04, 0.04, 0.09]), (N, 1, 1))
    cov[2] = 0.0
    out, source = velocity_covariances(TwistSamples(AT, np.zeros((N, 3)), cov), CONFIG)
    np.testing.assert_allclose(out[2], np.diag([0.04, 0.04, 0.09]))
    assert source == "messages, their median where one states none"
    out, source = velocity_covariances(TwistSamples(AT, np.zeros((N, 3)), 0.0 * cov), CONFIG)
    np.testing.assert_allclose(out[2], 0.01 * np.eye(3))
    assert source == "the paper's table"


def test_the_config_may_name_one_direction_of_the_gnss() -> None:
    gnss = GnssFixes(AT, np.zeros(N), np.zeros(N), np.zeros(N), np.tile(np.eye(3), (N, 1, 1)))
    out, source = gnss_covariances(gnss, config_for(Sensors(), noise={"gnss_vertical_m": 3.0}))
    np.testing.assert_allclose(out[1], np.diag([1.0, 1.0, 9.0]))
    assert source == "config, and messages"


def test_an_orientation_in_degrees() -> None:
    imu = ImuSamples(AT, np.zeros((N, 3)), np.zeros((N, 3)), np.tile([0.0, 0, 0, 1], (N, 1)))
    out, source = orientation_covariances(
        imu, config_for(Sensors(), noise={"orientation_deg": 1.0})
    )
    np.testing.assert_allclose(np.sqrt(out[0].diagonal()), math.pi / 180.0)
    assert source == "config"


def test_the_map_begins_at_the_first_usable_fix() -> None:
    latitude = np.array([np.nan, 48.0, 48.001, 95.0])
    longitude = np.array([11.0, 11.0, 11.001, 11.0])
    gnss = GnssFixes(AT, latitude, longitude, np.array([500.0, 500.0, 503.0, 500.0]))
    positions, warnings = positions_in_map(gnss, CONFIG, "drive/")
    assert warnings == ("drive/: 2 of 4 GNSS fixes are not usable",)
    assert positions.stamps_ns.tolist() == AT[1:3].tolist()
    assert positions.origin_deg_m == (48.0, 11.0, 500.0)
    np.testing.assert_allclose(positions.position_map[0], 0.0, atol=1e-9)
    # A thousandth of a degree at 48 degrees north, WGS84: 74.6 m east, 111.2 m north.
    np.testing.assert_allclose(positions.position_map[1], [74.6, 111.2, 3.0], atol=0.1)


def test_fixes_that_are_none_are_an_error() -> None:
    nan = np.full(N, np.nan)
    with pytest.raises(TrajectoryError, match=r"^drive/: none of 4 GNSS fixes"):
        positions_in_map(GnssFixes(AT, nan, nan, nan), CONFIG, "drive/")


@pytest.mark.parametrize(
    ("latitude_deg", "altitude_m", "expected"),
    [(0.0, 0.0, 9.780325), (90.0, 0.0, 9.832185), (45.0, 0.0, 9.806199), (45.0, 1000.0, 9.803113)],
)
def test_gravity_of_the_ellipsoid(latitude_deg: float, altitude_m: float, expected: float) -> None:
    assert normal_gravity(latitude_deg, altitude_m) == pytest.approx(expected, abs=1e-5)


def test_one_statement_for_all_messages_is_as_good_as_many() -> None:
    good, zero = np.diag([1e-6, 2e-6, 3e-6]), np.zeros((3, 3))
    bare = ImuSamples(AT, np.zeros((N, 3)), np.zeros((N, 3)))
    for one, expected in ((good, "messages"), (zero, "the paper's table")):
        many = np.tile(one, (N, 1, 1))
        same = np.broadcast_to(one, (N, 3, 3))  # what the reader of bags makes of it
        out_many, source_many = orientation_covariances(replace(bare, orientation_cov=many), CONFIG)
        out_same, source_same = orientation_covariances(replace(bare, orientation_cov=same), CONFIG)
        assert source_same == source_many == expected
        np.testing.assert_array_equal(out_same, out_many)


def test_gnss_figures_of_the_config_leave_the_messages_alone() -> None:
    stated_cov = np.broadcast_to(np.diag([0.04, 0.04, 0.09]), (N, 3, 3))
    fixes = GnssFixes(AT, np.zeros(N), np.zeros(N), np.zeros(N), stated_cov)
    out, _ = gnss_covariances(fixes, config_for(Sensors(), noise={"gnss_vertical_m": 3.0}))
    assert out[:, 2, 2].tolist() == [9.0] * N
    assert out[:, 0, 0].tolist() == [0.04] * N
    assert stated_cov[0, 2, 2] == 0.09


@pytest.mark.parametrize(
    ("rate_hz", "rough", "sigmas_m", "factor"),
    [
        # 10 Hz, 3 s of 10 cm: with errors of 10 s 30 fixes are one fix; at 1 Hz 60 are three.
        (10.0, slice(20, 50), (0.1, 0.1, 0.1), 30.0),
        (1.0, slice(20, 80), (0.1, 0.1, 0.1), 20.0),
        (10.0, slice(20, 21), (0.1, 0.1, 0.1), 1.0),  # alone it is as it says
        (10.0, slice(20, 50), (0.045, 0.045, 0.045), 1.0),  # as with fixed ambiguities
        (10.0, slice(20, 50), (0.01, 0.01, 0.1), 1.0),  # poor in height alone
        (0.05, slice(20, 50), (0.1, 0.1, 0.1), 1.0),  # one in 20 s
    ],
)
def test_fixes_that_state_much_more_than_the_better_ones_count_as_few(
    rate_hz: float, rough: slice, sigmas_m: tuple[float, float, float], factor: float
) -> None:
    at = np.round(np.arange(100) / rate_hz * 1e9).astype(np.int64)
    cov = np.tile(np.eye(3) * 0.01**2, (100, 1, 1))
    cov[rough] = np.diag(sigmas_m) ** 2
    expected = np.ones(100)
    expected[rough] = factor

    np.testing.assert_allclose(shared_by_rough(at, cov), expected)
    fixes = GnssFixes(at, np.full(100, 48.0), np.full(100, 11.0), np.full(100, 500.0), cov)
    positions, _ = positions_in_map(fixes, CONFIG, "drive/")
    np.testing.assert_allclose(positions.cov_map, expected[:, None, None] * cov)
