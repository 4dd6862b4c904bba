"""Headings as drivers write them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from caliv_graph.readers.heading import HeadingCollector
from tests.readers.bags import START, as_object, header, imu


def turned(stamp_ns: int, yaw: float, length: float = 1.0) -> Any:
    q = {"z": length * math.sin(0.5 * yaw), "w": length * math.cos(0.5 * yaw)}
    message = {"_type": "geometry_msgs/msg/QuaternionStamped", "header": header(stamp_ns)}
    return as_object({**message, "quaternion": {"x": 0.0, "y": 0.0, **q}})


def test_the_yaw_of_quaternions() -> None:
    collector = HeadingCollector()
    for k, yaw in enumerate([0.3, -2.5, 3.1]):
        collector.add(START + k, turned(START + k, yaw))
    collector.add(START + 9, turned(START + 9, 1.0, length=0.0))
    found = collector.finish()
    assert found is not None
    np.testing.assert_allclose(found.yaw_rad, [0.3, -2.5, 3.1], atol=1e-12)
    assert found.var is None
    assert collector.notes() == [
        "of 4 messages not used: 1 whose orientation is not a unit quaternion"
    ]


def test_of_an_imu_the_yaw_and_its_variance() -> None:
    def message(stamp_ns: int, yaw: float, first: float, variance: float) -> Any:
        cov = np.zeros(9)
        cov[0], cov[8] = first, variance
        q = {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}
        return as_object({**imu(stamp_ns), "orientation": q, "orientation_covariance": cov})

    collector = HeadingCollector()
    collector.add(START, message(START, 0.5, 1e3, 0.01))
    collector.add(START + 1, message(START + 1, 0.6, 1e3, 0.0))
    collector.add(START + 2, message(START + 2, 0.7, -1.0, 0.0))
    found = collector.finish()
    assert found is not None
    np.testing.assert_allclose(found.yaw_rad, [0.5, 0.6], atol=1e-12)
    np.testing.assert_array_equal(found.var, [0.01, math.nan])


def test_a_heading_that_never_changes_is_none() -> None:
    collector = HeadingCollector()
    collector.add(START, turned(START, 0.0))
    collector.add(START + 1, turned(START + 1, 0.0))
    assert collector.finish() is None
    assert collector.notes() == ["the heading is the same in all messages, and is not used"]
