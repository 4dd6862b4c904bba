"""`plan` at the command line: JSON, words, exit codes, the file it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app, run
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.simulate import write_drive as write_simulated
from tests.workflows.test_survey import scenario_of

SCENARIOS = Path(__file__).resolve().parents[2] / "configs" / "scenarios"
ARC = SCENARIOS / "paper_arc.yaml"
EIGHT = SCENARIOS / "figure_eight.yaml"


def plan(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["plan", *map(str, arguments)])


def document(*arguments: object) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(plan(*arguments, "--json").stdout)
    return found


def slow(tmp_path: Path, scenario: Path, rate_hz: float = 4.0) -> Path:
    """The same with fewer clouds: what is determined and what is said does not depend on them."""
    raw = yaml.safe_load(scenario.read_text())
    raw["lidars"] = {name: lidar | {"rate_hz": rate_hz} for name, lidar in raw["lidars"].items()}
    path = tmp_path / f"slow_{scenario.name}"
    path.write_text(yaml.safe_dump(raw))
    return path


def changed(tmp_path: Path, name: str = "scenario.yaml", **changes: object) -> Path:
    raw = yaml.safe_load(ARC.read_text())
    raw.update(changes)
    path = tmp_path / name
    path.write_text(yaml.safe_dump(raw))
    return path


def test_an_arc_as_json() -> None:
    found = document(ARC)

    front = found["lidars"]["front"]
    assert front["determined"] == {
        "roll": True,
        "pitch": True,
        "yaw": False,
        "x": False,
        "y": True,
        "z": True,
    }
    # Of z: 5 mm of the vehicle's height, and 2 mm of the biases of its ranges on the ground.
    assert front["sigma_vehicle_axes"]["xyz"] == pytest.approx([0.040, 0.0092, 0.0054], rel=0.05)
    lost = found["observability"]["undetermined"]
    assert [d["text"] for d in lost] == [
        "rotation of all LiDARs about the turn centre: x and yaw together, 9.16 m per rad"
    ]
    assert "figure-eight" in lost[0]["remedy"]
    assert found["sensor_to_sensor"][0]["determined"]["yaw"] is True
    seen = {s["lidar"]: s for s in found["sightings"]}
    # The front LiDAR sees the chair first, the rear one in the end, neither all the time.
    assert seen["front"]["seconds"][0][0] == 0.0
    assert seen["front"]["seconds"][-1][1] < seen["rear"]["seconds"][0][0]
    assert seen["rear"]["seconds"][-1][1] == pytest.approx(17.0)
    assert found["met"] is False
    assert found["suggestion"]["met"] is True
    assert found["suggestion"]["drive"]["kind"] == "s_curve"
    assert found["status"] == "partial"


@pytest.fixture(scope="module")
def suggested(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """What `plan` says of the arc at 4 Hz, in half the time, and the suggestion that it writes."""
    folder = tmp_path_factory.mktemp("plan")
    out = folder / "suggested.yaml"
    return plan(slow(folder, ARC), "--out", out), out


def test_an_arc_in_words(suggested: tuple[Result, Path]) -> None:
    result, _ = suggested

    assert result.exit_code == 0
    assert "Remedy: change the curvature while the target is in view" in result.stdout
    row = next(line for line in result.stdout.splitlines() if line.startswith("front  ("))
    # What the guess decides is in brackets.
    assert row.split()[1] == "(40)"
    assert row.split()[-1] == "(4.3)"
    assert result.stderr == ""


def test_limits_that_no_drive_keeps_end_after_every_candidate(tmp_path: Path) -> None:
    sigma = ("--sigma", "s2v_yaw_deg=0.0001")

    result = plan(slow(tmp_path, SCENARIOS / "tri_lidar.yaml"), "--no-structure", *sigma)

    assert result.exit_code == 3
    assert "The drive does not keep the limits: s2v_yaw_deg 0.0001." in result.stdout
    assert "None of the manoeuvres tried keeps all limits. The nearest:" in result.stdout


def test_sigmas_asked_for_and_not_kept_are_exit_3() -> None:
    limits = ("--sigma", "s2v_yaw_deg=0.05", "--sigma", "s2s_x_m=0.01")
    result = plan(ARC, "--no-structure", *limits)

    assert result.exit_code == 3
    assert "The drive does not keep the limits: s2v_yaw_deg 0.05, s2s_x_m 0.01." in result.stdout
    assert "Smallest drive that keeps all limits" in result.stdout
    kept = plan(EIGHT, "--no-structure", "--sigma", "s2v_yaw_deg=0.05")
    assert kept.exit_code == 0
    assert "The drive keeps the limits" in kept.stdout


def test_what_is_made_of_the_ground(tmp_path: Path) -> None:
    eight = slow(tmp_path, EIGHT)
    texts = {
        ground: [
            d["text"]
            for d in document(eight, "--no-structure", "--ground", ground)["observability"][
                "undetermined"
            ]
        ]
        for ground in ("plane", "height")
    }

    assert texts == {
        "plane": ["height of all LiDARs together"],
        "height": [],
    }


def test_two_drives_together(tmp_path: Path) -> None:
    drive = yaml.safe_load(ARC.read_text())["drive"] | {"turn": "left"}
    world = yaml.safe_load(ARC.read_text())["world"]
    world["objects"]["chair"]["xy_m"] = [15.16, 9.16]
    left = changed(tmp_path, name="left.yaml", drive=drive, world=world)

    found = document(ARC, left, "--no-structure")

    assert found["observability"]["undetermined"] == []
    assert len(found["drives"]) == 2


def test_time_offsets_on_request(tmp_path: Path) -> None:
    found = document(slow(tmp_path, EIGHT), "--no-structure", "--time-offset")

    assert found["lidars"]["front"]["time_offset"]["sigma"] < 0.001
    assert "time_offset" not in document(ARC, "--no-structure")["lidars"]["front"]


def test_a_standing_vehicle() -> None:
    result = plan(SCENARIOS / "static.yaml", "--ground", "none")

    assert result.exit_code == 0
    # Six directions, one sentence.
    assert result.stdout.count("all S2V axes: the vehicle did not move") == 1
    assert "figure-eight" in result.stdout


def test_the_suggestion_as_a_scenario(suggested: tuple[Result, Path]) -> None:
    first, out = suggested
    assert first.exit_code == 0
    assert load_scenario(out).drive.kind == "s_curve"
    again = document(out)
    assert again["observability"]["undetermined"] == []
    before = out.read_text()
    assert run(["plan", str(ARC), "--out", str(out)]) == 2
    assert out.read_text() == before
    assert plan(slow(out.parent, ARC), "--no-structure", "--out", out, "--force").exit_code == 0


def test_a_lidar_that_sees_nothing_is_exit_3(tmp_path: Path) -> None:
    lidars = yaml.safe_load(slow(tmp_path, ARC).read_text())["lidars"]
    lidars["blind"] = dict(lidars["front"], max_range_m=3.0)
    path = changed(tmp_path, lidars=lidars)

    result = plan(path, "--no-structure", "--json")

    assert result.exit_code == 3
    assert "lidar 'blind' never sees a target" in result.stderr
    assert json.loads(result.stdout)["lidars"]["blind"]["sees_target"] is False


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated arc as a bag, with a config that is ready to run."""
    folder = tmp_path_factory.mktemp("drives") / "arc"
    write_simulated(scenario_of("arc"), folder, 1, output="bag", threads=1)
    return folder / "config.yaml"


def test_a_recorded_drive_and_the_next_one(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "next.yaml"

    found = document(recorded, "--out", out)

    assert found["drives"] == ["drive as recorded"]
    assert found["lidars"]["front"]["determined"]["yaw"] is False
    assert found["lidars"]["front"]["determined"]["z"] is True
    lost = found["observability"]["undetermined"]
    assert [d["text"].rpartition(",")[0] for d in lost] == [
        "rotation of all LiDARs about the turn centre: x and yaw together"
    ]
    assert found["recorded_lidars"]["rear"]["rate_hz"] == 2.0
    # To the right and to the left: two arcs suffice together.
    assert found["suggestion"]["drive"]["kind"] == "arc"
    assert found["suggestion"]["drive"]["turn"] == "left"
    assert any("is planned as a chair" in line for line in found["warnings"])
    assert any("the recorded drive shows no walls" in line for line in found["warnings"])
    both = plan(recorded, out, "--no-structure", "--sigma", "s2v_yaw_deg=0.05")
    assert both.exit_code == 0
    assert "drive as recorded, suggestion" in both.stdout
    assert "LiDARs by their clouds" in both.stdout
    assert "The drive keeps the limits" in both.stdout


def test_limits_and_ground_are_those_of_the_config(recorded: Path, tmp_path: Path) -> None:
    raw = yaml.safe_load(recorded.read_text())
    raw |= {"limits": {"s2v_yaw_deg": 0.05}, "ground": {"use": False}}
    raw["structure"] = {"use": False}
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(raw))

    result = plan(config, "--data", recorded.parent / "drive")

    assert result.exit_code == 3
    assert "The drive does not keep the limits: s2v_yaw_deg 0.05." in result.stdout
    assert "height of all LiDARs together" in result.stdout


def test_what_does_not_go_with_a_recorded_drive(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, said in (
        ([recorded, recorded.parent / "config.yaml"], "is a second config of a recorded drive"),
        ([recorded, "--poses"], "--poses: the recording of"),
        ([ARC, "--data", recorded.parent], "needs a config"),
    ):
        assert run(["plan", *map(str, arguments)]) == 2
        shown = capsys.readouterr()
        assert shown.out == ""
        assert len(shown.err.splitlines()) == 1
        assert said in shown.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.yaml"], "missing.yaml: no such file"),
        ([SCENARIOS / "field.yaml"], "world.targets names no target"),
        ([ARC, "--sigma", "yaw=1"], "--sigma yaw=1: expected KEY=VALUE"),
        ([ARC, "--ground", "swamp"], "--ground"),
        ([], "SCENARIO"),
    ],
    ids=["no file", "no target", "no limit", "no such ground", "nothing"],
)
def test_bad_input_is_one_line_and_exit_2(
    arguments: list[object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run(["plan", *map(str, arguments)])

    shown = capsys.readouterr()
    assert code == 2
    assert shown.out == ""
    assert len(shown.err.splitlines()) == 1
    assert said in shown.err


def test_a_target_nobody_sees_is_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = yaml.safe_load(ARC.read_text())["world"]
    world["objects"]["chair"]["xy_m"] = [150.0, 0.0]

    lidars = yaml.safe_load(slow(tmp_path, ARC).read_text())["lidars"]
    code = run(["plan", str(changed(tmp_path, world=world, lidars=lidars))])

    shown = capsys.readouterr()
    assert code == 2
    assert "no LiDAR sees a target" in shown.err
    assert len(shown.err.splitlines()) == 1
