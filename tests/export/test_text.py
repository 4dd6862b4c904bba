from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import yaml
from hypothesis import given
from hypothesis import strategies as st

from caliv_graph.export.request import Transform
from caliv_graph.export.text import (
    caveats,
    notice,
    number,
    rpy,
    with_c,
    with_hash,
    with_xml,
    without_notice,
)
from caliv_graph.products import Guess
from tests.export.requests import T_VEHICLE_LIDAR, calibration_of, matrix_of, request
from tests.samples import unseen

HALF_PI = np.pi / 2.0


@given(st.floats(-1e6, 1e6))
def test_a_number_is_a_double_to_every_parser(value: float) -> None:
    text = number(value)

    assert isinstance(yaml.safe_load(text), float)
    assert abs(float(text) - value) <= 1e-12 + 1e-15 * abs(value)
    assert text != "-0.0"


@given(
    st.floats(-3.1, 3.1),
    st.sampled_from([HALF_PI, -HALF_PI, 0.3]),
    st.sampled_from([0.0, 1e-15, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3]),
    st.floats(-3.1, 3.1),
)
def test_written_angles_are_the_rotation(roll: float, pitch: float, off: float, yaw: float) -> None:
    R = gtsam.Rot3.RzRyRx(roll, pitch - off, yaw)

    angles = [float(number(angle)) for angle in rpy(gtsam.Pose3(R, np.zeros(3)))]

    np.testing.assert_allclose(matrix_of(np.zeros(3), *angles)[:3, :3], R.matrix(), atol=1e-11)


def test_caveats() -> None:
    calibration = calibration_of()
    lines = caveats(request(calibration), calibration.lidars)
    assert lines == [
        f"LiDAR '{name}': yaw, x (vehicle axes) not determined by the drive: values of the "
        "initial guesses"
        for name in calibration.lidars
    ]
    never = unseen(calibration, "rear")
    assert caveats(request(never), ["rear"]) == [
        "LiDAR 'rear' saw neither target nor structure: it keeps the initial guess"
    ]
    found = Guess(T_VEHICLE_LIDAR["rear"], np.full(6, 0.2), found=True)
    nobody = replace(never.lidars["rear"], guess=found)
    never = replace(never, lidars={**never.lidars, "rear": nobody})
    assert caveats(request(never), ["rear"]) == [
        "LiDAR 'rear' saw neither target nor structure: no initial guess was given, so that its "
        "values mean nothing"
    ]
    wrong = replace(calibration, status="inconsistent")
    assert "status inconsistent" in caveats(request(wrong), [])[0]


def test_comments_come_off_as_they_were_put_on() -> None:
    transform = Transform("a--b */ #", "base_link", "x-->y", T_VEHICLE_LIDAR["front"])
    calibration = calibration_of({"a--b */ #": T_VEHICLE_LIDAR["front"]})
    text = notice(request(calibration), [transform])
    body = "# caliv-graph export of something else\n<a/> /* b */\n"

    for mark in (with_hash, with_xml, with_c):
        assert without_notice(mark(text) + body) == body
        assert without_notice(mark(text).replace("\n", "\r\n") + body) == body
    assert "--" not in with_xml(text)[4:-4]
    assert with_c(text).count("*/") == 1


def test_sigmas_are_in_vehicle_axes_and_guesses_are_marked() -> None:
    calibration = calibration_of()
    transform = Transform("front", "base_link", "front", T_VEHICLE_LIDAR["front"])

    text = notice(request(calibration), [transform])

    R = T_VEHICLE_LIDAR["front"].rotation().matrix()
    cov = calibration.lidars["front"].cov
    sigma_y_mm = 1e3 * np.sqrt((R @ cov[3:, 3:] @ R.T)[1, 1])
    assert f"y {sigma_y_mm:.3g} mm, z" in text
    assert text.count("(guess)") == 2
    assert "stamps" not in text
    late = calibration_of(front={"time_offset": (0.0123, 0.0004)})
    assert "front: its stamps are late by 0.012300 s, 1 sigma 0.0004 s." in notice(
        request(late), [transform]
    )
