"""The folder of a result: calibration, graph, targets, effective config, log and report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from caliv_graph.common.json_text import without_infinities
from caliv_graph.common.progress import StageRecord
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config
from caliv_graph.fusion.archive import calibration_graph, write_archive
from caliv_graph.products import Calibration, Solution
from caliv_graph.report.html import render_report
from caliv_graph.report.log import log_documents
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.results.names import CALIBRATION_FILE, GRAPH_FILE, REPORT_FILE
from caliv_graph.results.target_file import write_target

if TYPE_CHECKING:
    from caliv_graph.results.run import RunRecord


def write_result(
    folder: Path,
    calibration: Calibration,
    solution: Solution,
    config: Config,
    stages: Sequence[StageRecord],
    warnings: Sequence[str],
    record: RunRecord | None = None,
) -> None:
    """Writes all files of a result into an empty folder (`common.files.output_folder`).

    The files are calibration.yaml, graph.gtsam and graph.values.gtsam (the extrinsics as priors for
    GTSAM), target.ply, target_2.ply, ... (the reconstructed targets), config.yaml, log.jsonl and,
    with a record, report.html.
    """
    write_calibration(calibration, folder / CALIBRATION_FILE)
    write_archive(*calibration_graph(calibration), folder / GRAPH_FILE)
    (folder / "config.yaml").write_text(dump_config(config), encoding="utf-8")
    for number, registration in enumerate(solution.registrations, start=1):
        file = "target.ply" if number == 1 else f"target_{number}.ply"
        write_target(registration.mixture, folder / file, registration.observation.name)
    documents = log_documents(calibration, solution, config.robust, stages, warnings, record)
    lines = [json.dumps(without_infinities(line)) for line in documents]
    (folder / "log.jsonl").write_text("\n".join([*lines, ""]), encoding="utf-8")
    if record is not None:
        page = render_report(calibration, solution, config, stages, warnings, record)
        (folder / REPORT_FILE).write_text(page, encoding="utf-8")
