"""Names of the files in the folder of a result."""

CALIBRATION_FILE = "calibration.yaml"

GRAPH_FILE = "graph.gtsam"

REPORT_FILE = "report.html"

RESULT_FILES = (
    CALIBRATION_FILE,
    "config.yaml",
    "target.ply",
    "target_[0-9]*.ply",
    "log.jsonl",
    REPORT_FILE,
    GRAPH_FILE,
    "graph.values.gtsam",
)
"""Patterns for `common.files.output_folder`, the main file first."""

SUSPECT_FOLDER = "suspect"
"""Of the run with the first suspect freed (`calibrate --try-suspects`), beside the first run."""

FILES_OF_BOTH_RUNS = (*RESULT_FILES, *(f"{SUSPECT_FOLDER}/{name}" for name in RESULT_FILES))
"""The same with that run."""
