"""Running the program, with a pipeline that a test makes up where one is needed."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import yaml

from caliv_graph.cli import main

ROOT = Path(__file__).resolve().parents[2]

# What is made up is imported when it is asked for: most pipelines end before.
_MADE_UP = """
import types
def make_calibration(*lidars, **changes):
    from tests import samples
    return samples.make_calibration(*lidars, **changes)
def run_of(calibration):
    from tests.samples import make_solution
    return types.SimpleNamespace(
        calibration=calibration, solution=make_solution(), observations=(), record=None,
    )
"""

_WITH_PIPELINE = """
import sys, types
sys.path.insert(0, {root!r})
{pipeline}
module = types.ModuleType("caliv_graph.pipeline")
module.calibrate = calibrate
sys.modules["caliv_graph.pipeline"] = module
from caliv_graph.cli.main import main
main()
"""


def start(*arguments: object, pipeline: str = "", cwd: Path = ROOT) -> subprocess.Popen[str]:
    """Starts the program.

    Args:
        arguments: its arguments.
        pipeline: source of `calibrate(recordings, config, progress, prior)`; empty: the real one.
        cwd: the folder to run it in.
    """
    program = ["-c", program_with(pipeline)] if pipeline else ["-m", "caliv_graph"]
    return subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=cwd,
        # OpenBLAS rounds by the kernel that it is told to use: the same one as in this process.
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
        | {name: value for name, value in os.environ.items() if name.startswith("OPENBLAS_")},
    )


def program_with(pipeline: str) -> str:
    """Source of a program that has a pipeline that is made up; see `start`."""
    return _WITH_PIPELINE.format(root=str(ROOT), pipeline=_MADE_UP + pipeline)


def run(
    *arguments: object, pipeline: str = "", cwd: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    """Runs the program to its end."""
    process = start(*arguments, pipeline=pipeline, cwd=cwd)
    out, err = process.communicate(timeout=60)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def called(*arguments: object, pipeline: str = "") -> subprocess.CompletedProcess[str]:
    """Runs the program in this process, which has imported what takes a second; see `start`."""
    out, err = io.StringIO(), io.StringIO()
    line = [str(argument) for argument in arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _made_up(pipeline):
        code = main.run(line)
    return subprocess.CompletedProcess(line, code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def _made_up(pipeline: str) -> Iterator[None]:
    if not pipeline:
        yield
        return
    module = types.ModuleType("caliv_graph.pipeline")
    exec(_MADE_UP + pipeline, module.__dict__)
    with mock.patch.dict(sys.modules, {module.__name__: module}):
        yield


def write_drive(folder: Path, sensors: int = 2, frames: int = 3) -> Path:
    """A CaLiV folder: frames 0, 1, ... of 4 points each, the vehicle 1 m further in each."""
    points = np.array([[3, 0, 0], [4, 0, 0], [5, 1, 0], [6, 1, 1]], dtype="<f4")
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA binary\n"
    poses = {}
    for number in range(1, sensors + 1):
        sensor = folder / "input" / f"sensor_{number}"
        sensor.mkdir(parents=True)
        for frame in range(frames):
            (sensor / f"{frame}.pcd").write_bytes(header.encode() + points.tobytes())
        poses[sensor.name] = [
            [f"{frame}.pcd", [float(frame), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]
            for frame in range(frames)
        ]
    (folder / "input/ego_poses.yaml").write_text(yaml.safe_dump(poses))
    return folder


def write_config(path: Path, **sections: object) -> Path:
    """A config of the LiDARs `front` and `rear` for a drive beside it."""
    document = {
        "data": {"format": "caliv", "path": "drive"},
        "lidars": {
            "front": {"topic": "sensor_1", "initial": {"xyz": [2, 0, 2], "rpy_deg": [0, 10, 0]}},
            "rear": {"topic": "sensor_2", "initial": {"xyz": [0, 0, 2], "rpy_deg": [0, 10, 180]}},
        },
        **sections,
    }
    path.write_text(yaml.safe_dump(document))
    return path
