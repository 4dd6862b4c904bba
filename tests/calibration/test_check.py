"""What remains of the findings once the first suspect is named."""

from __future__ import annotations

import pytest

from caliv_graph.calibration.check import unexplained
from caliv_graph.products import Suspect
from caliv_graph.uncertainty.consistency import Heading

TURNED = Heading("drive", 0.04, 0.002, told_apart=True)


@pytest.mark.parametrize(
    ("first", "left"),
    [
        ("gnss.drift", ()),
        ("imu.yaw_bias", ()),
        ("lidars.front.initial", (TURNED,)),
        ("ground.vehicle_height", (TURNED,)),
    ],
)
def test_a_heading_is_no_finding_of_its_own_where_the_motion_is_wrong(
    first: str, left: tuple[Heading, ...]
) -> None:
    suspect = Suspect(first, (1.0,), (0.1,), (1.0,), ("m",), 0.9, 65.0, 65.0)
    assert unexplained([TURNED], [suspect]) == left
