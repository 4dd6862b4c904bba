from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from rich.console import Console

from caliv_graph.batch.page import render_index, summary_table
from caliv_graph.batch.summary import Row, Summary, summary_csv, summary_document
from caliv_graph.conventions import AXES
from caliv_graph.products import Calibration
from tests.fusion.drives import arc_information, draw, drive, information
from tests.samples import make_calibration, unseen

NAMES = ("front", "rear")


def done(job: str, calibration: Calibration, code: int = 0, vehicle: str | None = None) -> Row:
    return Row(job, vehicle, "done", code, seconds=12.34, digest="d", calibration=calibration)


def summary(*rows: Row) -> Summary:
    return Summary(rows, "fleet.yaml", "2026-11-21T08:00:00+00:00")


def drives(count: int, shift: float = 0.0, arc: bool = False) -> list[Row]:
    """Drives of one vehicle with noise that their information describes; the last one shifted."""
    rng = np.random.default_rng(7)
    rows = []
    for i in range(count):
        D = arc_information(NAMES) if arc else information(NAMES, i + 1)
        e = draw(D, rng)
        if i == count - 1:
            e[AXES.index("pitch")] += shift
        rows.append(done(f"day{i}", drive(D, source=f"s{i}", error=e), vehicle="van"))
    return rows


@pytest.mark.parametrize(
    ("rows", "code"),
    [
        ([done("a", make_calibration())], 0),
        ([done("a", make_calibration()), done("b", make_calibration(), 3)], 3),
        ([done("a", make_calibration(), 3), done("b", make_calibration(), 4)], 4),
        ([done("a", make_calibration()), Row("b", state="failed", exit=2)], 3),
        ([done("a", make_calibration()), Row("b", state="failed", exit=1)], 3),
        ([done("a", make_calibration()), Row("b", state="failed")], 3),
        ([done("a", make_calibration(), 4), Row("b", state="failed", exit=2)], 4),
        ([done("a", make_calibration()), Row("b")], 3),
    ],
)
def test_the_exit_code_is_that_of_the_worst_job(rows: list[Row], code: int) -> None:
    assert summary(*rows).exit == code


def test_csv_has_a_line_per_lidar_and_no_number_that_was_not_determined() -> None:
    calibration = unseen(make_calibration("front", "rear", "left"), "left")
    text = summary_csv(summary(done("a", calibration, 3, "van"), Row("b", state="failed", exit=2)))

    lines = list(csv.DictReader(io.StringIO(text)))

    assert [(line["job"], line["lidar"]) for line in lines] == [
        ("a", "front"),
        ("a", "rear"),
        ("a", "left"),
        ("b", ""),
    ]
    front, _, left, failed = lines
    assert (front["y_m"], front["pitch_deg"], front["vehicle"]) == ("0.000000", "10.000000", "van")
    assert float(front["sigma_y_m"]) > 0.0
    assert front["x_m"] == front["sigma_x_m"] == front["yaw_deg"] == ""
    assert [left[f"{axis}_m"] for axis in "xyz"] == ["", "", ""]
    assert (failed["status"], failed["exit"], failed["folder"]) == ("failed", "2", "")


def test_csv_text_is_no_formula() -> None:
    row = Row("a", state="failed", exit=2, message="=cmd|' /C calc'!A0")

    (line,) = csv.DictReader(io.StringIO(summary_csv(summary(row))))

    assert line["message"] == "'=cmd|' /C calc'!A0"


def test_json_has_null_for_what_was_not_determined() -> None:
    document = summary_document(summary(done("a", make_calibration()), Row("b")))

    json.dumps(document, allow_nan=False)
    first, second = document["jobs"]
    front = first["lidars"]["front"]
    assert front["translation_m"] == [None, 0.0, 2.0]
    assert front["rpy_rad"][2] is None
    assert front["sigma_rotation_rad"][1] > 0.0
    assert front["sigma_rotation_rad"][2] is None
    assert (first["status"], first["report"]) == ("partial", "a/report.html")
    assert (second["status"], second["exit"], second["folder"]) == ("waiting", None, None)
    assert document["counts"] == {
        "jobs": 2,
        "done": 1,
        "failed": 0,
        "waiting": 1,
        "not_good_enough": 0,
        "inconsistent": 0,
    }


@pytest.mark.parametrize("count", [2, 4])
def test_drives_that_agree(count: int) -> None:
    (spread,) = summary(*drives(count)).spreads()

    assert spread.moved == ()
    assert spread.reason == ""
    assert set(spread.deviations) == {("front",), ("rear",), ("front", "rear")}
    sigmas = [d.sigmas for axes in spread.deviations.values() for d in axes.values() if d]
    assert len(sigmas) == 18
    # The largest of a few draws of a standard normal each.
    assert 0.3 < np.median(sigmas) < 2.5
    assert max(sigmas) < 4.5


def test_a_drive_that_differs_is_named_with_its_sigmas() -> None:
    (spread,) = summary(*drives(4, shift=0.02)).spreads()

    assert "day3" in spread.moved
    worst = spread.deviations["front",]["pitch"]
    assert worst is not None
    assert worst.job == "day3"
    assert worst.sigmas > 5.0
    page = render_index(summary(*drives(4, shift=0.02)))
    assert "disagree with the other drives of the vehicle" in page
    assert "number  far" in page


def test_what_two_drives_do_not_tell_is_not_compared() -> None:
    (spread,) = summary(*drives(2, arc=True)).spreads()

    front = spread.deviations["front",]
    assert front["x"] is None
    assert front["yaw"] is None
    assert front["pitch"] is not None


def test_results_that_cannot_be_compared_are_left_out_with_the_reason() -> None:
    first, second = drives(2)
    assert first.calibration is not None
    bad = replace(first.calibration, status="inconsistent")

    failed = replace(second, state="failed", calibration=None)
    (spread,) = summary(first, failed).spreads()
    assert spread.reason == "two drives with a result are needed"
    assert spread.left_out == {"day1": "failed"}
    (spread,) = summary(replace(first, calibration=bad), second).spreads()
    assert spread.left_out == {"day0": "inconsistent"}
    (spread,) = summary(first, replace(first, job="again")).spreads()
    assert "stems from the same drive as day0" in spread.reason
    assert summary(replace(first, vehicle=None), replace(second, vehicle=None)).spreads() == []


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for key, value in attrs if key in ("href", "src")]


def test_the_page_links_to_each_report_and_to_nothing_outside() -> None:
    page = render_index(
        summary(
            done("mon", make_calibration(), vehicle="van"),
            done("Süd", make_calibration(unmet=("yaw of 'front' not determined",)), 3),
            Row("tue", state="failed", exit=2, message="<script>alert(1)</script> & more"),
            Row("wed"),
        )
    )

    parsed = Links()
    parsed.feed(page)
    assert {"mon/report.html", "S%C3%BCd/report.html", "summary.csv"} <= set(parsed.links)
    assert not any(link.startswith(("tue", "wed", "http", "//")) for link in parsed.links)
    assert "script" not in parsed.tags
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in page
    assert "default-src &#39;none&#39;" in page or "default-src 'none'" in page
    assert "2 of 4 jobs have a result, 1 failed, 1 not done yet" in page
    assert "yaw of &#39;front&#39; not determined" in page


def test_the_page_shows_no_number_that_was_not_determined() -> None:
    calibration = make_calibration("front")
    held = replace(
        calibration.lidars["front"],
        T_vehicle_lidar=calibration.lidars["front"].T_vehicle_lidar,
        determined=dict.fromkeys(AXES, False),
    )
    page = render_index(summary(done("a", replace(calibration, lidars={"front": held}))))

    body = page.split("<body>")[1]
    assert body.count("not determined</td>") == 6
    assert "2.0" not in body.split("<section")[1].split("</table>")[0]


def test_the_table_says_what_is_wrong() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    rows = [*drives(2), Row("bad", "van", "failed", 2, "no such file")]

    console.print(summary_table(summary(*rows)))

    text = console.export_text()
    assert "2 of 3 jobs have a result, 1 failed." in text
    assert "bad: no such file" in text
    assert "van: 2 drives agree; largest difference" in text
