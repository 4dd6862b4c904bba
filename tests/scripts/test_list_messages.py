"""The list of messages: cause and remedy are parted, and a wrong call for a target is an error."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.list_messages import Message, asks_for_a_target_wrongly, main, parted, unique

ROOT = Path(__file__).resolve().parents[2]


def test_the_remedy_begins_with_an_imperative() -> None:
    cause, remedy = parted("lidar 'rear': stamps are 0.1 s late: 7 sigma. Check its clock, or wait")
    assert cause == "lidar 'rear': stamps are 0.1 s late: 7 sigma"
    assert remedy == "Check its clock, or wait"
    assert (
        parted("off: pitch: imu.T_vehicle_imu rpy_deg about (0, 2, 0) would fit")[0] == "off: pitch"
    )
    assert parted("'duration_s' (9 s) must be below 5 s")[1] == "must be below 5 s"
    assert parted("a.yaml: is a pipe") == ("a.yaml: is a pipe", "")


def test_messages_that_differ_in_numbers_and_names_are_one() -> None:
    def message(cause: str) -> Message:
        return Message(2, "TargetError", cause, "Check it", "test")

    some = [message("lidar 'a' in 3 of 8 scans of d/x.yaml"), message("lidar 'b' in 1 of 9 scans")]
    assert len(unique([*some, message("lidar 'c' in 5 of 7 scans of e/y.yaml")])) == 2


@pytest.mark.parametrize(
    ("cause", "wrong"),
    [
        ("drive: target: none found in 60 of 'front' scans: Seen: 3 under 0.3 m wide", False),
        ("drive: target: none found in 60 of 'front' scans: no ground in any scan", True),
        ("lidar 'front': stamps are late", True),
    ],
)
def test_a_target_is_asked_for_only_where_it_is_missing(cause: str, wrong: bool) -> None:
    remedy = "Add target: {min: [x, y, z]} to the config"
    assert asks_for_a_target_wrongly(Message(2, "TargetError", cause, remedy, "test")) is wrong


def test_it_lists_what_tests_provoke(capsys: pytest.CaptureFixture[str]) -> None:
    some = ("wording/test_contradictions.py", "common/test_yaml_text.py")
    assert main([f"{ROOT}/tests/{name}" for name in some]) == 0
    out = capsys.readouterr().out
    assert "exit 2 ConfigError (tests/common/" in out
    assert out.splitlines()[-1].endswith("although it is not the cause")
