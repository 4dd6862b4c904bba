from __future__ import annotations

import argparse
import importlib
import shlex
import sys
import types
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.tf import export
from caliv_graph.products import Array
from tests.export.requests import (
    T_HOUSING_LIDAR,
    T_VEHICLE_LIDAR,
    calibration_of,
    matrix_of_quaternion,
    request,
)


def published(arguments: list[str]) -> tuple[str, str, Array]:
    """What static_transform_publisher makes of its arguments: parent, child, pose (4, 4)."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    for name in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        parser.add_argument(f"--{name}", type=float, default=0.0)
    parser.add_argument("--frame-id", required=True)
    parser.add_argument("--child-frame-id", required=True)
    told = parser.parse_args(arguments)
    xyz = np.array([told.x, told.y, told.z])
    pose = matrix_of_quaternion(xyz, told.qx, told.qy, told.qz, told.qw)
    return told.frame_id, told.child_frame_id, pose


def in_mcap(content: bytes) -> tuple[list[Any], Mapping[str, str]]:
    """Transforms of /tf_static as the mcap packages read them, and its channel's metadata."""
    reader = importlib.import_module("mcap.reader")
    decoder = importlib.import_module("mcap_ros2.decoder")
    opened = reader.make_reader(BytesIO(content), decoder_factories=[decoder.DecoderFactory()])
    ((_, channel, _, message),) = opened.iter_decoded_messages(topics=["/tf_static"])
    return list(message.transforms), dict(channel.metadata)


def test_lines_of_static_transform_publisher() -> None:
    made = export(request(out=Path("tf.sh"), frames={"rear": "rear lidar"}))

    lines = [line for line in made.content.decode().splitlines() if not line.startswith("#")]
    assert len(lines) == 2
    children = {"front": "front", "rear": "rear lidar"}
    for line, (name, T) in zip(lines, T_VEHICLE_LIDAR.items(), strict=True):
        words = shlex.split(line)
        assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
        parent, child, pose = published(words[4:])
        assert (parent, child) == ("base_link", children[name])
        np.testing.assert_allclose(pose, T.matrix(), atol=1e-9)


def test_a_launch_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run as ROS 2 runs it, with stand-ins for its packages."""
    actions: Any = types.ModuleType("launch_ros.actions")
    actions.Node = lambda **settings: settings
    launch: Any = types.ModuleType("launch")
    launch.LaunchDescription = list
    monkeypatch.setitem(sys.modules, "launch", launch)
    monkeypatch.setitem(sys.modules, "launch_ros", types.ModuleType("launch_ros"))
    monkeypatch.setitem(sys.modules, "launch_ros.actions", actions)
    made = export(request(out=Path("tf.launch.py"), frames={"front": 'it\'s "1"'}))
    namespace: dict[str, Any] = {}

    exec(made.content.decode(), namespace)
    nodes = namespace["generate_launch_description"]()

    assert {(node["package"], node["executable"]) for node in nodes} == {
        ("tf2_ros", "static_transform_publisher")
    }
    assert all(name.isidentifier() for name in (node["name"] for node in nodes))
    assert len({node["name"] for node in nodes}) == 2
    for node, T in zip(nodes, T_VEHICLE_LIDAR.values(), strict=True):
        np.testing.assert_allclose(published(node["arguments"])[2], T.matrix(), atol=1e-9)
    assert published(nodes[0]["arguments"])[1] == 'it\'s "1"'


def test_an_mcap_in_another_reader() -> None:
    made = export(request(out=Path("tf.mcap"), vehicle_frame="body", recorded_ns=17_000_000_005))

    transforms, metadata = in_mcap(made.content)

    assert [t.child_frame_id for t in transforms] == ["front", "rear"]
    for transform, T in zip(transforms, T_VEHICLE_LIDAR.values(), strict=True):
        t, q = transform.transform.translation, transform.transform.rotation
        pose = matrix_of_quaternion(np.array([t.x, t.y, t.z]), q.x, q.y, q.z, q.w)
        np.testing.assert_allclose(pose, T.matrix(), atol=1e-9)
        assert transform.header.frame_id == "body"
        stamp = transform.header.stamp
        assert (stamp.sec, stamp.nanosec) == (17, 5)
    # Latched: a node that starts later gets it too. 1 is transient local in rosbag2.
    assert "durability: 1" in metadata["offered_qos_profiles"]


def test_the_comment_of_an_mcap_is_in_its_metadata() -> None:
    made = export(request(out=Path("tf.mcap")))

    reader = importlib.import_module("mcap.reader").make_reader(BytesIO(made.content))
    texts = " ".join(str(record.metadata) for record in reader.iter_metadata())
    assert "p_parent = T p_child" in texts
    assert "yaw, x (vehicle axes) not determined" in texts


def test_housings_are_published_instead() -> None:
    made = export(
        request(
            out=Path("x"),
            frames={"front": "front_base_link"},
            housings={"front": T_HOUSING_LIDAR},
            lidars=("front",),
        )
    )

    (line,) = [line for line in made.content.decode().splitlines() if not line.startswith("#")]
    _, child, pose = published(shlex.split(line)[4:])
    assert child == "front_base_link"
    T_vehicle_lidar = pose @ T_HOUSING_LIDAR.matrix()
    np.testing.assert_allclose(T_vehicle_lidar, T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)


def test_a_name_cannot_break_out_of_the_comment() -> None:
    T = next(iter(T_VEHICLE_LIDAR.values()))
    made = export(request(calibration_of({"a\nrm -rf x": T}), out=Path("tf.sh")))

    comment, _, command = made.content.decode().partition("end of caliv-graph export\n")
    assert all(line.startswith("#") for line in comment.splitlines())
    assert shlex.split(command)[-1] == "a\nrm -rf x"


@pytest.mark.parametrize(("out", "form"), [("tf.xml", ""), ("tf.sh", "bag")])
def test_an_unknown_form(out: str, form: str) -> None:
    with pytest.raises(
        ExportError, match=f"no form for '{form or '.xml'}': the suffix of --out must be"
    ):
        export(request(out=Path(out), form=form))


def test_one_name_for_two_frames() -> None:
    with pytest.raises(ExportError, match="'base_link' would be the name of two frames"):
        export(request(out=Path("tf.sh"), frames={"front": "base_link"}))
