"""The report and the log of real runs: numbers against the truth, the page in a real browser."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress, StageRecord
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config, RegistrationConfig, RobustConfig, SolveConfig
from caliv_graph.conventions import AXES
from caliv_graph.pipeline import calibrate
from caliv_graph.products import LidarScan
from caliv_graph.readers import open_recording
from caliv_graph.readers.sampled import POINTS, SCANS, SampledRecording, thinned
from caliv_graph.report.folder import write_result
from caliv_graph.report.html import render_report
from caliv_graph.report.log import log_documents
from caliv_graph.report.residuals import (
    all_residuals,
    cloud_residuals,
    down_weighted,
    gnss_residuals,
    solution_residuals,
    trajectory_residuals,
)
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.simulate import write_drive
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.drives_with_chair import QUICK, paper_scenario, simulated, without_structure
from tests.scan_rates import scanned_at

ROOT = Path(__file__).resolve().parents[2]

EVIL = '<script>alert("x")</script> & <b>up</b></script><img src=x onerror=alert(1)>'
"""What somebody may call a LiDAR."""

EVIL_FOLDER = "<_script><img src=x onerror=alert(1)>"
"""What somebody may call a drive."""

MOST_BYTES = 10_000_000

REGISTRATION = RegistrationConfig(components=400, max_points=320)
"""Fine enough for a figure in which the legs of a chair stand on the ground."""


@dataclass(frozen=True, repr=False)
class Ran:
    run: CalibrationRun
    config: Config
    stages: list[StageRecord]

    def page(self, **changes: Any) -> str:
        run = self.run
        calibration = replace(run.calibration, **changes)
        assert run.record is not None
        return render_report(
            calibration,
            run.solution,
            self.config,
            self.stages,
            run.calibration.warnings,
            run.record,
        )

    def log(self) -> list[dict[str, Any]]:
        run = self.run
        return list(
            log_documents(
                run.calibration,
                run.solution,
                self.config.robust,
                self.stages,
                run.calibration.warnings,
                run.record,
            )
        )


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """An arc from raw sensors, and a LiDAR with a bad name that never sees the target."""
    folder = tmp_path_factory.mktemp("bag") / EVIL_FOLDER
    scenario = scanned_at(load_scenario(ROOT / "configs/scenarios/demo_arc.yaml"), 1.25)
    assert scenario.crop is not None
    crop = scenario.crop.model_copy(update={"elsewhere_stride": 12})
    few = scenario.model_copy(update={"crop": crop})
    write_drive(few, folder, 1, threads=1)
    config = without_structure(load_config(folder / "config.yaml"))
    blind = config.lidars["front"].model_copy(update={"min_range": 400.0, "max_range": 450.0})
    lidars = {**config.lidars, EVIL: blind}
    return ran(config.model_copy(update={"lidars": lidars, "registration": REGISTRATION}))


@pytest.fixture(scope="module")
def html(bag: Ran) -> str:
    """Its page."""
    return bag.page()


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """Given poses, no ground, and the paper's two stages."""
    scenario = paper_scenario(rate_hz=1.25, position_sigma_m=0.005, rotation_sigma_rad=1e-3)
    drive = simulated(scenario, 1, tmp_path_factory.mktemp("caliv") / "arc")
    config = drive.config.model_copy(
        update={"solve": SolveConfig(mode="staged"), "registration": QUICK}
    )
    progress = SilentProgress()
    return Ran(calibrate([drive.recording], config, progress), config, progress.stages)


def ran(config: Config) -> Ran:
    progress = SilentProgress()
    run = calibrate([open_recording(config)], config, progress)
    return Ran(run, config, progress.stages)


def smoothed(bag: Ran) -> SmoothedTrajectory:
    assert bag.run.record is not None
    trajectory = bag.run.record.trajectories[0]
    assert isinstance(trajectory, SmoothedTrajectory)
    return trajectory


class Page(HTMLParser):
    """Text without scripts and styles, and everything that an element asks to be loaded."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.inside: list[str] = []
        self.words: list[str] = []
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.attributes: set[str] = set()
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {key for key, _ in attrs}
        self.loads += [value or "" for key, value in attrs if key in ("src", "href", "srcset")]
        if tag in ("script", "style"):
            self.inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self.inside and self.inside[-1] == tag:
            self.inside.pop()

    def handle_data(self, data: str) -> None:
        if not self.inside:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


# ------------------------------------------------------------------ residuals


def test_residual_of_a_cloud_is_what_the_graph_predicts_against_what_was_registered(
    bag: Ran,
) -> None:
    solution = bag.run.solution
    (registration,) = solution.registrations
    found = cloud_residuals(solution, 0)

    for j, cloud in enumerate(registration.observation.clouds):
        predicted = (
            solution.T_target_map[0]
            * solution.T_map_vehicle[cloud.drive, cloud.stamp_ns]
            * solution.T_vehicle_lidar[cloud.lidar]
        )
        r = gtsam.Pose3.Logmap(predicted * registration.T_target_lidar[j].inverse())
        assert found[j] == pytest.approx(r, abs=1e-7)


def test_every_factor_of_a_trajectory_has_its_kind(bag: Ran) -> None:
    trajectory = smoothed(bag)
    kinds, graph = trajectory.factor_kinds, trajectory.estimate().graph.factors

    assert len(kinds) == graph.size()
    assert kinds.count("imu") == len(trajectory.nodes_ns) - 1
    for kind, factor in zip(kinds, map(graph.at, range(len(kinds))), strict=True):
        letters = "".join(chr(gtsam.symbolChr(key)) for key in factor.keys())  # noqa: SIM118
        allowed = {
            "imu": {"ivivbb"},
            "gnss": {"i", "iv"},
            "orientation": {"i", "iy"},
            "velocity": {"iv"},
            "prior": {"b", "y"},
        }
        assert letters in allowed[kind]
    # 17 s and both ends at 10 Hz, no fix being an outlier.
    assert kinds.count("gnss") == 171


def test_whitened_residuals_are_normal_where_the_noise_is_as_stated(bag: Ran) -> None:
    by_kind = {r.kind: r for r in trajectory_residuals(smoothed(bag))}

    assert set(by_kind) == {
        "GNSS fixes",
        "orientation",
        "velocity",
        "IMU, preintegrated between nodes",
    }
    for kind in ("GNSS fixes", "orientation", "velocity"):
        assert by_kind[kind].rms == pytest.approx(1.0, abs=0.12)
        assert by_kind[kind].beyond_three < 0.012
    # The paper's noise, per sample: 16.7 mm level and 20 mm up; 0.1 m/s.
    unit, error = by_kind["GNSS fixes"].physical["position"]
    assert unit == "mm"
    assert np.std(error) == pytest.approx(18.0, rel=0.15)
    unit, error = by_kind["velocity"].physical["velocity"]
    assert unit == "mm/s"
    assert np.std(error) == pytest.approx(100.0, rel=0.15)


def test_gnss_residuals_have_the_stamps_of_their_fixes(bag: Ran) -> None:
    trajectory = smoothed(bag)

    stamps, residuals = gnss_residuals(trajectory)

    assert residuals.shape == (len(stamps), 3)
    begin, end = trajectory.span_ns
    assert np.diff(stamps).min() >= 0
    assert np.abs(np.diff(stamps) * 1e-9 - 0.1).max() < 0.1
    assert (stamps[0] - begin) * 1e-9 < 0.1
    assert (end - stamps[-1]) * 1e-9 < 0.2


def test_kinds_of_the_solved_graph(bag: Ran, staged: Ran) -> None:
    raw = {r.kind: r for r in solution_residuals(bag.run.solution)}
    given = {r.kind: r for r in solution_residuals(staged.run.solution)}

    assert list(raw) == [
        "target clouds, pose of each",
        "ground, as the LiDARs see it",
        "ground, height of the vehicle above it",
    ]
    assert list(given) == [
        "target clouds, pose of each",
        "given poses, white error",
        "given poses, change of the Gauss-Markov error",
    ]
    # White errors of 5 mm and 1 mrad were drawn, of which the fit follows a part.
    unit, error = given["given poses, white error"].physical["position"]
    assert unit == "mm"
    assert 1.0 < np.std(error) < 6.0
    # Gauss-Markov errors are a linear factor, whose residual is computed by hand here.
    solution, noise = staged.run.solution, staged.run.solution.pose_noise
    assert noise is not None
    poses = sorted(solution.T_map_vehicle)
    first, second = (solution.values.atVector(gtsam.symbol("d", i)) for i in (0, 1))
    decay = np.exp(-(poses[1][1] - poses[0][1]) * 1e-9 / noise.drift_time_s)
    stationary = np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3)
    whitened = (second - decay * first) / (stationary * np.sqrt(1.0 - decay**2))
    found = given["given poses, change of the Gauss-Markov error"]
    assert found.whitened[0] == pytest.approx(whitened, abs=1e-6)
    assert found.physical["position"][1][:3] == pytest.approx(
        1e3 * (second - decay * first)[3:], abs=1e-6
    )


def test_why_a_cloud_is_believed_less(bag: Ran) -> None:
    solution = bag.run.solution
    (registration,) = solution.registrations
    weights = np.ones(len(registration.T_target_lidar))
    inliers = np.full(len(weights), 0.9)
    weights[3], weights[5] = 0.5, 0.25
    inliers[5] = 0.54  # 0.6 of a typical cloud's: half its weight (EXPLAINED)
    changed = replace(
        solution,
        cloud_weights=(weights,),
        registrations=(replace(registration, inlier_ratio=inliers),),
    )

    second, first = down_weighted(changed, RobustConfig())
    (trimmed,) = down_weighted(
        replace(changed, cloud_weights=(np.where(weights == 0.5, 1e-6, 1.0),)),
        RobustConfig(kernel="trimmed"),
    )

    # Huber bends at 1.5 sqrt(6) = 3.67 sigma: half the weight at twice that.
    assert "its pose residual is 7.3 sigma" in first.reason
    assert "points" not in first.reason
    assert second.weight == 0.25
    assert "only 54% of its points lie on the target (median of all clouds: 90%)" in second.reason
    assert "its pose residual is 7.3 sigma" in second.reason
    assert "among the largest 10 percent" in trimmed.reason
    cloud = registration.observation.clouds[3]
    assert (first.lidar, first.stamp_ns) == (cloud.lidar, cloud.stamp_ns)


# ------------------------------------------------------------------ page


def test_verdict_first_and_nothing_undetermined_looks_like_a_value(html: str) -> None:
    page = Page(html)

    start = page.text[: page.text.index("Sensor to vehicle")]
    assert "partial Calibrated in part" in start
    assert "front to the vehicle y, z, roll, pitch x, yaw" in start
    assert "front to rear all six axes" in start
    assert "rotation of all LiDARs about the turn centre" in start
    assert "S-curve" in start
    assert f"lidar '{EVIL}' never saw the target" in start
    values = page.text[page.text.index("scans used") : page.text.index("Sensor to sensor")]
    front = values[values.index("front") : values.index("rear")]
    assert re.search(r"front \([-\d.]+\) not determined -?[\d.]+ ± [\d.]+ ", front)
    assert front.count("not determined") == 2
    assert values.count("not determined") == 4 + len(AXES)


def test_names_do_not_run(html: str) -> None:
    page = Page(html)
    assert EVIL in page.text
    assert EVIL_FOLDER in page.text
    assert "img" not in page.tags
    assert "onerror" not in page.attributes
    assert "alert(" not in "".join(re.findall(r"<script>(.*?)</script>", html, re.DOTALL)[-1:])
    assert '<script>alert("x")' not in html
    assert "<b>up" not in html
    for element in re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', html):
        assert "<" not in element
        # Plotly has tags of its own, which a name shall not bring.
        assert "<script>" not in json.dumps(json.loads(element))


def test_long_names_are_short_in_figures_only_while_they_differ() -> None:
    from caliv_graph.report.figures.drawing import labels

    long = "velodyne_front_left_upper"

    assert labels([long, "rear"]) == {long: "velodyne_f…eft_upper", "rear": "rear"}
    # Short, these two would be one.
    alike = "velodyne_fr0nt_left_upper"
    assert list(labels([long, alike]).values()) == [long, alike]
    assert labels(["<b>&"]) == {"<b>&": "&lt;b&gt;&amp;"}


def test_it_asks_for_nothing_and_is_small(html: str) -> None:
    assert set(Page(html).loads) <= {"data:,"}
    assert "default-src 'none'" in html
    assert len(html.encode()) < MOST_BYTES


def test_a_contradiction_comes_before_all_else(bag: Ran) -> None:
    what = "front & rear: 0.2 m apart along x, 14 sigma"
    page = Page(bag.page(status="inconsistent", contradictions=(what,)))
    silent = Page(bag.page(status="inconsistent"))

    assert "Do not use this result" in page.text
    assert page.text.index(what) < page.text.index("determined by this drive")
    # A result without contradictions of its own: the warnings are shown.
    assert silent.text.index("never saw the target") < silent.text.index("determined by this drive")


def test_staged_on_given_poses(staged: Ran) -> None:
    page = Page(staged.page())

    assert "Mode staged" in page.text
    assert "IMU biases" not in page.text
    assert "given poses, Gauss-Markov error" in page.text
    # The translation is the guess's: held by the mode.
    assert "front to the vehicle roll, pitch x, y, z, yaw" in page.text


def test_several_recordings_and_targets_are_told_apart(bag: Ran) -> None:
    run = bag.run
    assert run.record is not None
    solution, record = run.solution, run.record
    twice = replace(
        solution,
        registrations=solution.registrations * 3,
        cloud_weights=solution.cloud_weights * 3,
        residuals=solution.residuals * 3,
        T_target_map=solution.T_target_map * 3,
    )
    more = replace(record, drives=("first", "second"), trajectories=record.trajectories * 2)

    html = render_report(run.calibration, twice, bag.config, bag.stages, (), more)

    names = re.findall(r'id="figure-(\w+)"', html)
    assert len(names) == len(set(names))
    assert {"path_0", "path_1", "motion_1", "target_flat_2"} <= set(names)
    # A browser draws about a dozen 3-D views at once.
    assert "target_2" not in names
    assert "GNSS fixes (recording &#39;second&#39;)" in html
    assert len(html.encode()) < MOST_BYTES


def test_a_target_is_shown_upright_where_it_stands(bag: Ran) -> None:
    from caliv_graph.report.figures.alignment import target_figures

    solution, calibration = bag.run.solution, bag.run.calibration
    solid, flat = target_figures(0, solution, calibration)

    chair = [np.array([trace[axis] for axis in "xyz"]).T for trace in solid.figure.data]
    before, after = np.concatenate(chair[:2]), np.concatenate(chair[2:])
    # 0.7 m wide and a chair's height; the guesses of 3 degrees at 12 m tear it apart.
    extent = np.percentile(after, 99, axis=0) - np.percentile(after, 1, axis=0)
    assert extent[:2].max() < 1.0
    assert extent[2] == pytest.approx(1.2, abs=0.15)
    torn = np.percentile(before, 99, axis=0) - np.percentile(before, 1, axis=0)
    assert torn[2] > 1.5
    # The four legs stand on level ground: what is lowest is about as low at all of them.
    feet = [
        np.percentile(after[(np.sign(after[:, :2]) == (x, y)).all(axis=1), 2], 1)
        for x in (-1.0, 1.0)
        for y in (-1.0, 1.0)
    ]
    assert max(feet) - min(feet) < 0.06
    assert len(flat.figure.data) == 8


# ------------------------------------------------------------------ log and files


def test_a_line_per_stage_and_finding(bag: Ran) -> None:
    lines = bag.log()
    about = [next(iter(line)) for line in lines]

    json.dumps(lines, allow_nan=False)
    assert about.count("stage") == len(bag.stages)
    (trajectory,) = (line for line in lines if "trajectory" in line)
    assert trajectory["kind"] == "smoothed"
    assert trajectory["factors"]["gnss"] == 171
    clouds = {line["lidar"]: line for line in lines if "clouds" in line and "lidar" in line}
    assert set(clouds) == {"front", "rear"}
    observed = bag.run.solution.registrations[0].observation.clouds
    assert clouds["front"]["points"] == sum(
        len(c.points_lidar) for c in observed if c.lidar == "front"
    )
    assert len(clouds["rear"]["weights"]) == clouds["rear"]["scans"]
    iterations = [line for line in lines if "iteration" in line]
    (solution,) = (line for line in lines if "solution" in line)
    assert len(iterations) == solution["iterations"] == bag.run.solution.iterations
    assert iterations[-1]["undetermined"] == 1
    # It converged: the last step is small by one of the two measures of the joint loop.
    assert iterations[-1]["step_sigmas"] < 0.1 or iterations[-1]["step_m"] < 3e-4
    (result,) = (line for line in lines if "result" in line)
    assert result["not_determined"]["front"] == ["yaw", "x"]
    assert result["not_determined"][EVIL] == list(AXES)
    assert about.count("warning") == len(bag.run.calibration.warnings) > 0
    kinds = [line["residuals"] for line in lines if "residuals" in line]
    assert bag.run.record is not None
    assert kinds == [r.kind for r in all_residuals(bag.run.solution, bag.run.record)]


def test_both_are_among_the_files_of_a_result(staged: Ran, tmp_path: Path) -> None:
    run = staged.run
    write_result(
        tmp_path,
        run.calibration,
        run.solution,
        staged.config,
        staged.stages,
        run.calibration.warnings,
        run.record,
    )

    names = {path.name for path in tmp_path.iterdir()}
    assert {"report.html", "log.jsonl", "calibration.yaml"} <= names
    assert (tmp_path / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    lines = (tmp_path / "log.jsonl").read_text(encoding="utf-8").splitlines()
    assert all(isinstance(json.loads(line), dict) for line in lines)


def test_plotly_waits_until_there_is_something_to_write() -> None:
    code = (
        "import sys, caliv_graph.pipeline, caliv_graph.report.tables\n"
        "import caliv_graph.results.calibration_file\n"
        "print([m for m in ('plotly', 'jinja2') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )

    assert done.stdout.strip() == "[]"


# ------------------------------------------------------------------ what is kept of the clouds


def test_a_little_of_every_lidar_is_kept_and_nothing_changed(bag: Ran) -> None:
    recording = open_recording(bag.config)
    sampled = SampledRecording(open_recording(bag.config))

    seen = {name: list(sampled.scans(name)) for name in ("front", "rear")}

    for name, scans in seen.items():
        for ours, theirs in zip(scans, recording.scans(name), strict=True):
            assert ours.stamp_ns == theirs.stamp_ns
            assert np.array_equal(ours.points_lidar, theirs.points_lidar)
    kept = sampled.kept()
    assert [scan.lidar for scan in kept] == ["front"] * SCANS + ["rear"] * SCANS
    assert max(len(scan.points_lidar) for scan in kept) <= POINTS
    front = [scan.stamp_ns for scan in kept if scan.lidar == "front"]
    # Over the whole drive of 17 s.
    assert front == sorted(front)
    assert (front[-1] - front[0]) * 1e-9 > 14.0


def test_points_keep_their_times_when_thinned() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-60.0, 60.0, (20_000, 3))
    scan = LidarScan("front", 7, points, "front at 7", points[:, 0] * 1e-3)

    small = thinned(scan)

    assert len(small.points_lidar) == POINTS
    assert small.point_times_s == pytest.approx(small.points_lidar[:, 0] * 1e-3)
    assert np.linalg.norm(small.points_lidar, axis=1).max() <= 40.0
    assert np.array_equal(small.points_lidar, thinned(scan).points_lidar)
    empty = replace(scan, points_lidar=np.zeros((0, 3)), point_times_s=np.zeros(0))
    assert thinned(empty).points_lidar.shape == (0, 3)


# ------------------------------------------------------------------ browser

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--virtual-time-budget=60000",
    "--enable-logging=stderr",
)

HARMLESS = ("GL Driver Message", "willReadFrequently")
"""Advice on speed: of the software renderer, and on plotly's own measuring of text."""


@cache
def chromium() -> str:
    """The browser; installed where it is missing and that is allowed."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None and os.geteuid() == 0 and shutil.which("apt-get"):
        for command in (["apt-get", "update"], ["apt-get", "install", "-y", "chromium"]):
            subprocess.run(command, capture_output=True, timeout=600, check=False)
        found = shutil.which("chromium")
    if found is None:
        pytest.skip("chromium is not installed, and could not be: apt-get install chromium")
    return found


@dataclass(frozen=True)
class Shown:
    """What a browser made of a page."""

    dom: str
    console: list[str]
    requests: list[str]


def shown(html: str, folder: Path) -> Shown:
    page, profile, net = folder / "page.html", folder / "profile", folder / "net.json"
    page.write_text(html, encoding="utf-8")
    done = subprocess.run(
        [
            chromium(),
            *FLAGS,
            f"--user-data-dir={profile}",
            f"--log-net-log={net}",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    console = [
        line
        for line in done.stderr.splitlines()
        if ":CONSOLE:" in line and not any(word in line for word in HARMLESS)
    ]
    return Shown(done.stdout, console, list(_requests(net)))


def _requests(net: Path) -> Iterator[str]:
    """What the page, not the browser itself, asked the network for."""
    for event in json.loads(net.read_text(encoding="utf-8"))["events"]:
        parameters = event.get("params", {})
        url, initiator = parameters.get("url", ""), parameters.get("initiator")
        if initiator not in (None, "not an origin") and not url.startswith(("file:", "data:")):
            yield url


def test_the_browser_would_tell(tmp_path: Path) -> None:
    """The next test can fail: a page that errs and loads is found out."""
    html = "<script>console.error('boom')</script><img src='http://127.0.0.1:9/a.png'>"

    told = shown(html, tmp_path)

    assert any("boom" in line for line in told.console)
    assert "http://127.0.0.1:9/a.png" in told.requests


def test_every_figure_is_drawn_without_network_or_complaint(html: str, tmp_path: Path) -> None:
    figures = set(re.findall(r'id="figure-(\w+)"', html))

    told = shown(html, tmp_path)

    assert told.console == []
    assert told.requests == []
    assert {
        "sigmas",
        "spectrum",
        "correlation",
        "target_0",
        "scene_0",
        "residuals_1",
        "weights",
        "path_0",
        "motion_0",
        "correction_0",
        "convergence",
    } <= figures
    drawn = re.findall(r'<div class="([^"]*)" data-figure="(\w+)" data-drawn="yes"', told.dom)
    assert {name for _, name in drawn} == figures
    assert 'data-drawn="all"' in told.dom
    assert not re.search(r'class="plot[^"]*broken', told.dom)
    # 3-D views draw on a canvas, and leave a picture for print behind.
    for name in ("target_0", "scene_0"):
        part = told.dom[told.dom.index(f'id="figure-{name}"') :]
        part = part[: part.index("</figure>")]
        assert part.count("<canvas") >= 2
        assert "WebGL is not supported" not in part
        still = re.search(r'<img class="still"[^>]*src="data:image/png;base64,([^"]+)"', part)
        still = still or re.search(r'src="data:image/png;base64,([^"]+)"', part)
        assert still is not None
        # A picture with something in it, not an empty sheet.
        assert len(still.group(1)) > 50_000
