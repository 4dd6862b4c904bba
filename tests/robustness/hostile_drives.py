"""A small simulated drive that calibrates in two seconds, and ways to spoil its bag."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from caliv_graph.conventions import AXES
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_determined, sigmas_s2s
from tests.cli.commands import called

FRONT, REAR = "/lidar/front/points", "/lidar/rear/points"
IMU, GNSS, TWIST = "/imu/data", "/gnss/fix", "/vehicle/twist"
LIDARS = (FRONT, REAR)

SIGMAS = 5.0
"""How far off a result may be that nobody was warned of."""

_LIDAR = {"rate_hz": 2.0, "horizontal_resolution_deg": 0.4, "channels": 76}

SCENARIO: Mapping[str, Any] = {
    "name": "small",
    "drive": {"kind": "arc", "duration_s": 14.0, "radius_m": 9.16, "turn": "right"},
    "lidars": {
        "front": {"mounting": {"xyz": [2, 0, 2], "rpy_deg": [0, 10, 0]}, **_LIDAR},
        "rear": {"mounting": {"xyz": [-0.4, 0, 2], "rpy_deg": [0, 10, 180]}, **_LIDAR},
    },
    "reference": "rear",
    "world": {
        "objects": {"chair": {"shape": "chair", "xy_m": [15.16, -9.16], "yaw_deg": 90.0}},
        "targets": ["chair"],
    },
    "crop": {"margin_m": 1.0, "elsewhere_stride": 16},
    "imu": {"rate_hz": 50.0},
    "velocity": {"rate_hz": 5.0},
}

QUICK: Mapping[str, Any] = {
    "registration": {"components": 150, "max_points": 150, "max_iterations": 40},
    "extraction": {"max_scans": 12, "min_points": 20, "min_scans": 4},
}
"""Sections of a config for a quick solve."""

_STORE = get_typestore(Stores.ROS2_HUMBLE)

Change = Callable[[str, int, Any], Iterable[tuple[int, Any]]]
"""Of a topic, a record time in ns and a message: what stands in its place."""


@dataclass(frozen=True)
class Outcome:
    """What a command left.

    Attributes:
        code: its exit code.
        out: what it printed.
        err: what it complained of.
    """

    code: int
    out: str
    err: str


def command(*arguments: object) -> Outcome:
    """Runs the program, in this process."""
    done = called(*arguments)
    return Outcome(done.returncode, done.stdout, done.stderr)


def simulate(folder: Path, output: str = "both") -> Path:
    """Simulates the small drive; returns its folder: config.yaml, drive, caliv, truth.yaml."""
    scenario = folder.with_name(f"{folder.name}.yaml")
    scenario.write_text(yaml.safe_dump(dict(SCENARIO)))
    done = command("simulate", scenario, "--out", folder, "--seed", 1, "--format", output)
    assert done.code == 0, done.err
    write_config(folder, folder / "config.yaml")
    return folder


def write_config(drive: Path, path: Path, **sections: Any) -> Path:
    """Writes the drive's config, made quick, with other sections; keys `a.b` go down."""
    document = yaml.safe_load((drive / "config.yaml").read_text())
    document.update(QUICK)
    document["data"]["path"] = str(drive / "drive")
    for key, value in sections.items():
        *above, last = key.split("__")
        place = document
        for name in above:
            place = place[name]
        place[last] = value
    path.write_text(yaml.safe_dump(document))
    return path


@cache
def recorded(bag: Path) -> tuple[tuple[Connection, int, bytes], ...]:
    """The messages of a bag: connection, record time in ns and content."""
    with Reader(bag) as reader:
        return tuple((c, record_ns, bytes(raw)) for c, record_ns, raw in reader.messages())


def rewritten(drive: Path, folder: Path, change: Change) -> Path:
    """Writes the drive's bag anew with other messages; returns its folder."""
    messages = recorded(drive / "drive")
    types = {c.topic: c.msgtype for c, _, _ in messages}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        to = {
            topic: writer.add_connection(topic, name, typestore=_STORE)
            for topic, name in types.items()
        }
        for connection, record_ns, raw in messages:
            name = connection.msgtype
            message = _STORE.deserialize_cdr(raw, name)
            for new_ns, new in change(connection.topic, record_ns, message):
                writer.write(to[connection.topic], new_ns, _STORE.serialize_cdr(new, name))
    return folder


def on(*topics: str) -> Callable[[Callable[[Any], object]], Change]:
    """Makes a change of the messages of some topics, in place."""

    def of(edit: Callable[[Any], object]) -> Change:
        def change(topic: str, record_ns: int, message: Any) -> Iterable[tuple[int, Any]]:
            if topic in topics:
                edit(message)
            return [(record_ns, message)]

        return change

    return of


def points_of(message: Any) -> Any:
    """The points of a cloud of the small drive, (N, 3) float32; they may be changed."""
    message.data = message.data.copy()
    return message.data.view("<f4").reshape(-1, message.point_step // 4)[:, :3]


def set_points(message: Any, points: Any) -> None:
    """Gives a cloud of the small drive other points, (N, 3)."""
    table = np.zeros((len(points), message.point_step // 4), "<f4")
    table[:, :3] = points
    message.width, message.height = len(points), 1
    message.row_step = message.width * message.point_step
    message.data = table.view(np.uint8).ravel()


def check_sound(done: Outcome, result: Path, truth: Path) -> None:
    """The rule: one line and no output, or a warning exit code, or a result that is right."""
    assert "Traceback" not in done.err
    if done.code == 2:
        assert len(done.err.splitlines()) == 1, done.err
        assert done.err.startswith("error: ")
        assert done.err[:-1].isprintable()
        assert not result.exists()
        return
    assert done.code in (0, 3, 4), done.err
    calibration = read_calibration(result / "calibration.yaml")
    if done.code == 4:
        assert calibration.status == "inconsistent"
        assert calibration.contradictions
        return
    for what, errors, sigmas in _errors(calibration, truth):
        assert np.all(errors <= SIGMAS * sigmas), (
            f"{what}: off by {np.array2string(errors / sigmas, precision=1)} sigma, exit "
            f"{done.code}, unmet {calibration.unmet}: {done.err}"
        )


def _errors(calibration: Any, truth: Path) -> Iterable[tuple[str, Any, Any]]:
    """Of each mounting and pair, errors and sigmas along the axes that count as determined."""
    found = evaluate(calibration, read_truth(truth))
    for name, lidar in calibration.lidars.items():
        axes = np.array([lidar.determined[axis] for axis in AXES])
        error = found["lidars"][name]["s2v"]
        errors = np.abs(np.array([*error["rotation_rad"], *error["translation_m"]]))
        R = lidar.T_vehicle_lidar.rotation().matrix()
        turn = np.kron(np.eye(2), R)
        sigmas = np.sqrt(np.diag(turn @ lidar.cov @ turn.T))
        yield f"S2V {name}", errors[axes], sigmas[axes]
    for pair in found["pairs"]:
        names = (pair["from"], pair["to"])
        known = pair_determined(calibration, *names)
        axes = np.array([known[axis] for axis in AXES])
        errors = np.abs(np.array([*pair["rotation_rad"], *pair["translation_m"]]))
        sigmas = np.asarray(sigmas_s2s(calibration, *names))
        yield f"S2S {names}", errors[axes], sigmas[axes]
