from __future__ import annotations

import json
from pathlib import Path

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import load_config, parse_config
from caliv_graph.report.folder import write_result
from tests.samples import make_calibration, make_solution


def test_the_folder_of_a_result(tmp_path: Path) -> None:
    config = parse_config(
        {"lidars": {"front": {"topic": "sensor_1", "initial": {"xyz": [2, 0, 2]}}}},
        "config.yaml",
        tmp_path,
    )
    progress = SilentProgress()
    with progress.stage("reading", 3) as advance:
        advance(3, "sensor_1")

    write_result(
        tmp_path, make_calibration(), make_solution(2), config, progress.stages, ["a warning"]
    )

    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "calibration.yaml",
        "config.yaml",
        "graph.gtsam",
        "graph.values.gtsam",
        "log.jsonl",
        "target.ply",
        "target_2.ply",
    ]
    assert load_config(tmp_path / "config.yaml") == config
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert log[0]["stage"] == "reading"
    assert (log[0]["done"], log[0]["total"], log[0]["note"]) == (3, 3, "sensor_1")
    assert log[0]["seconds"] >= 0.0
    assert [line["registration"] for line in log if "registration" in line] == [
        "target 1",
        "target 2",
    ]
    assert {"warning": "a warning"} in log
