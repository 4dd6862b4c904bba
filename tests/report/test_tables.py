from __future__ import annotations

import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from rich.console import Console, RenderableType

from caliv_graph.common.progress import SilentProgress, StageRecord
from caliv_graph.products import Guess, Suspect
from caliv_graph.report.figures.uncertainty import sigma_figure
from caliv_graph.report.html import move_rows, verdicts
from caliv_graph.report.inspection import (
    DriveSummary,
    Inspection,
    LidarSummary,
    Points,
    Sighting,
    TargetSummary,
)
from caliv_graph.report.inspection_table import inspection_table
from caliv_graph.report.tables import calibration_table, evaluation_table, slow_errors_text
from caliv_graph.uncertainty.evaluation import evaluate
from tests.samples import make_calibration, trusted, unseen


def rendered(table: RenderableType, width: int = 80) -> list[str]:
    console = Console(width=width, color_system=None)
    with console.capture() as captured:
        console.print(table, highlight=False)
    return [line.rstrip() for line in captured.get().splitlines()]


def cells(lines: list[str], name: str, after: str = "") -> list[str]:
    """The row that begins with a name, behind a heading."""
    start = next(i for i, line in enumerate(lines) if line.startswith(after))
    row = next(line for line in lines[start:] if line.startswith(name))
    return row.removeprefix(name).split()


def cells_below(lines: list[str], name: str) -> list[str]:
    index = next(i for i, line in enumerate(lines) if line.startswith(name))
    return lines[index + 1].split()


def with_sigma(sigma_rad: float, sigma_m: float) -> np.ndarray:
    return np.diag([sigma_rad] * 3 + [sigma_m] * 3) ** 2


def test_a_guess_that_nobody_gave_is_not_compared_with() -> None:
    calibration = make_calibration("front", "rear", undetermined=())
    guess = Guess(gtsam.Pose3(), np.full(6, 0.2))
    lidars = {
        name: replace(
            lidar,
            guess=replace(guess, found=name == "rear"),
            determined={**lidar.determined, "z": False},
        )
        for name, lidar in calibration.lidars.items()
    }
    calibration = replace(calibration, lidars=lidars)

    figure = sigma_figure(calibration)

    blind = unseen(unseen(calibration, "front"), "rear")
    said = rendered(calibration_table(blind, [], 1.0))

    assert [row["name"] for row in move_rows(calibration)] == ["front"]
    saw = "saw neither target nor structure"
    assert f"  - LiDAR 'front' {saw}: it keeps the initial guess" in said
    assert any(f"'rear' {saw}: no initial guess was given" in line for line in said)
    assert [unknown for _, _, unknown in verdicts(blind)] == [
        "all six axes: nothing seen, the extrinsic is the guess",
        "all six axes: nothing seen, no guess given",
    ]
    assert figure is not None
    shown = {(t["name"], at) for t in figure.figure.data for at in t["x"]}
    assert ("initial guess", "front x") in shown
    assert ("initial guess", "rear x") not in shown
    assert ("not determined: sigma of the initial guess", "front z") in shown
    assert ("not determined: sigma of the initial guess", "rear z") not in shown


def test_values_are_shown_to_two_digits_of_their_sigma_in_metres_and_degrees() -> None:
    calibration = make_calibration("rear", undetermined=())
    cov = with_sigma(np.radians(0.031), 0.0093)
    result = replace(
        calibration.lidars["rear"],
        T_vehicle_lidar=gtsam.Pose3(
            gtsam.Rot3.RzRyRx(*np.radians([-1.23456, 10.0, 91.0])), np.array([1.23456, 0, -2.5])
        ),
        cov=cov,
        determined=dict.fromkeys(calibration.lidars["rear"].determined, True),
    )
    calibration = replace(calibration, lidars={"rear": result}, cov_joint=cov)

    lines = rendered(calibration_table(calibration, [], 1.0))

    assert cells(lines, "rear") == [
        "1.2346", "0.0000", "-2.5000", "-1.235", "10.000", "91.000", "60"
    ]  # fmt: skip
    assert cells_below(lines, "rear") == ["±0.0093"] * 3 + ["±0.031"] * 3
    assert not any("held" in line or "Not determined" in line for line in lines)


def test_an_undetermined_axis_is_held_and_says_why() -> None:
    lines = rendered(calibration_table(make_calibration(), [], 1.0))

    row = cells(lines, "front")
    assert row[0] == "(2.000)"
    assert row[5] == "(0.00)"
    assert re.fullmatch(r"0\.0+", row[1])
    below = cells_below(lines, "front")
    assert (below[0], below[5]) == ("held", "held")
    assert below[1].startswith("±")
    assert any(line.startswith("held: this drive does not determine") for line in lines)
    index = lines.index("Not determined by this drive:")
    assert lines[index + 1] == "  - rotation of all LiDARs about the turn centre"


def test_the_turn_of_all_lidars_leaves_their_pair_determined() -> None:
    lines = rendered(calibration_table(make_calibration(), [], 1.0))

    start = next(i for i, line in enumerate(lines) if line.startswith("Sensor to sensor"))
    end = next(i for i, line in enumerate(lines) if line.startswith("held:"))
    assert "held" not in " ".join(lines[start:end])
    assert cells(lines, "front", after="Sensor to sensor")[0].startswith("-2.36")


def test_a_lidar_that_never_saw_the_target_pretends_nothing() -> None:
    calibration = unseen(make_calibration("front", "left", "rear"), "left")

    lines = rendered(calibration_table(calibration, [], 1.0))

    row, below = cells(lines, "left"), cells_below(lines, "left")
    assert all(cell.startswith("(") for cell in row[:6])
    assert row[6:] == ["none"]
    assert below == ["held"] * 6
    said = "  - LiDAR 'left' saw neither target nor structure: it keeps the initial guess"
    assert said in lines
    assert all(cell.startswith("(") for cell in cells(lines, "front", after="Sensor to sensor")[:6])


def test_a_lidar_that_saw_structure_alone_used_no_scans_of_a_target() -> None:
    calibration = make_calibration("front", "left", "rear")
    left = replace(calibration.lidars["left"], saw_target=False, saw_structure=True)
    calibration = replace(calibration, lidars={**calibration.lidars, "left": left})

    lines = rendered(calibration_table(calibration, [], 1.0))

    assert cells(lines, "left")[6:] == ["structure"]
    assert "target" not in " ".join(lines)


def test_the_times_of_the_stages_add_up() -> None:
    inner = StageRecord("reading", None, 1, seconds=1.5)
    stages = [StageRecord("searching", 3, 0, 3, seconds=2.004), inner]
    stages.append(StageRecord("solving", None, 0, seconds=4.25))

    lines = rendered(calibration_table(make_calibration(), stages, 9.0))

    start = next(i for i, line in enumerate(lines) if line.startswith("stage"))
    seconds = {line[:30].strip(): float(line.split()[-1]) for line in lines[start + 5 :]}
    assert lines[start + 2].split() == ["searching", "2.00", "3/3"]
    assert seconds == {"reading the config, writing th": 2.75, "all": 9.0}


def test_what_was_asked_for_and_not_reached_is_said() -> None:
    calibration = make_calibration(unmet=("s2v: yaw of front is not determined",))

    lines = rendered(calibration_table(calibration, [], 1.0))

    index = lines.index("Required by the config, but not reached:")
    assert lines[index + 1] == "  - s2v: yaw of front is not determined"


def test_times_of_the_stages() -> None:
    progress = SilentProgress()
    with progress.stage("reading", 3) as advance:
        advance(3)

    lines = rendered(calibration_table(make_calibration(), progress.stages, 12.5))

    seconds, steps = cells(lines, "reading")
    assert (seconds, steps) == (f"{progress.stages[0].seconds:.2f}", "3/3")
    assert cells(lines, "all") == ["12.50"]


def test_names_are_no_markup() -> None:
    calibration = make_calibration("rear", undetermined=())
    renamed = replace(
        calibration,
        reference="[red]rear",
        lidars={"[red]rear": calibration.lidars["rear"]},
        unmet=("[bold]s2v",),
    )

    text = "\n".join(rendered(calibration_table(renamed, [], 1.0)))

    assert "reference [red]rear" in text
    assert "[bold]s2v" in text


def test_a_pair_with_a_trusted_lidar_that_saw_nothing_has_a_verdict() -> None:
    calibration = trusted(make_calibration(undetermined=()), "front")
    truth = {name: result.T_vehicle_lidar for name, result in calibration.lidars.items()}

    assert ("front to rear", "all six axes", "") in verdicts(calibration)
    lines = rendered(evaluation_table(evaluate(calibration, truth), calibration))
    assert cells(lines, "S2S front to rear")[:6] == ["0.00"] * 6


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_a_terminal(width: int) -> None:
    calibration = unseen(make_calibration("front", "left", "rear"), "left")
    truth = {name: gtsam.Pose3() for name in calibration.lidars}

    for table in (
        calibration_table(calibration, [], 1.0),
        evaluation_table(evaluate(calibration, truth), calibration),
    ):
        assert not any("…" in line for line in rendered(table, width))


def test_errors_in_millimetres_and_milliradians() -> None:
    calibration = make_calibration()
    truth = {name: result.T_vehicle_lidar for name, result in calibration.lidars.items()}
    evaluation = evaluate(calibration, truth)
    evaluation["lidars"]["front"]["s2v"] |= {
        "translation_m": [0.0123456, -0.001, -1e-9],
        "rotation_rad": [0.001, -0.0005, 0.0043],
        "nees": 5.4321,
    }
    evaluation["pairs"][0]["nees"] = None

    lines = rendered(evaluation_table(evaluation, calibration))

    # x and yaw were not determined.
    assert cells(lines, "S2V front") == [
        "(12.35)", "-1.00", "0.00", "1.00", "-0.50", "(4.30)", "5.43"
    ]  # fmt: skip
    assert cells(lines, "S2S front to rear") == ["0.00"] * 6 + ["-"]
    assert lines[-1].startswith("In brackets: not determined by the drive")


def test_what_a_recording_holds() -> None:
    points = Points(10, 20, 30)
    inspection = Inspection(
        data="drive",
        lidars={
            "front": LidarSummary(5, (3, 15), 2, ((5, 11),), 5.0, points),
            "rear": LidarSummary(1, (7, 7), 1, (), None, points),
        },
        drive=DriveSummary(6, 1.2, 3.456, 0.02, -90.0, 95.0),
        targets=(
            TargetSummary(
                "target 1",
                (15.0, -9.0, 0.5),
                {
                    "front": Sighting(3, ((3, 5), (11, 11)), points, (4.0, 9.5)),
                    "rear": Sighting(0, (), None, None),
                },
            ),
        ),
    )

    lines = rendered(inspection_table(inspection))

    assert " ".join(cells(lines, "front")) == "5 3 to 15 2 5 10 / 20 / 30"
    assert " ".join(cells(lines, "rear")) == "1 7 to 7 1 - 10 / 20 / 30"
    assert "front: clouds are missing between the frames 5 and 11" in lines
    assert "heading changes by -90.0 degrees" in " ".join(lines)
    seen = "target 1 near (15.0, -9.0, 0.5) m in the map"
    assert " ".join(cells(lines, "front", after=seen)) == "3 4.0 to 9.5 10 / 20 / 30 3 to 5, 11"
    assert cells(lines, "rear", after=seen) == ["0", "-", "-", "never"]


def test_slow_errors_are_said_with_their_source() -> None:
    level = {"name": "gnss_correlated_horizontal", "sigma": 0.0525, "unit": "m"}
    known = {"slow_errors": [{**level, "from": "residuals of the LiDARs"}]}
    text = slow_errors_text(known)
    assert text.endswith("of the motion data: GNSS horizontal 52 mm (estimated from the drive).")
    open_ = {"slow_errors": [{**level, "sigma": 0.0124, "from": "expected: LiDARs leave it open"}]}
    assert "GNSS horizontal 12 mm (expected: LiDARs leave it open)" in slow_errors_text(open_)
    assert slow_errors_text({}) == ""


@pytest.mark.parametrize("width", [80, 120])
def test_names_of_suspects_are_whole(width: int) -> None:
    """A place and its angles are six numbers with six sigmas, which take two lines."""
    name = "lidars.front.mount.halves"
    sigma = (0.02, 0.01, 0.01, 0.1, 0.1, 0.2)
    value = (-0.12, 0.35, 0.01, -1.05, 0.62, 17.25)
    suspect = Suspect(name, value, sigma, value, ("m",) * 3 + ("deg",) * 3, 0.93, 23.0, 23.0)
    calibration = make_calibration(contradictions=("a",), suspects=(suspect,))
    lines = rendered(calibration_table(calibration), width)
    assert sum(line.startswith(name) for line in lines) == 1
    assert "0.2) deg)" in " ".join(line.strip() for line in lines)
