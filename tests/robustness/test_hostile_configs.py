"""Configs made at random: what is accepted comes back the same, all else is one line."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from caliv_graph.config.lidars import name_problem
from caliv_graph.config.load import dump_config, load_config, parse_config
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from tests.robustness.hostile_drives import command

QUIET = settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

metres = st.floats(-100.0, 100.0)
heights = st.floats(-30.0, 30.0)
positive = st.floats(1e-6, 1e6)
triples = st.tuples(metres, metres, metres)
names = st.text(min_size=1, max_size=20).filter(lambda name: not name_problem(name))


@st.composite
def configs(draw: st.DrawFn) -> dict[str, Any]:
    """Raw configs that are valid."""
    chosen = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    topics = draw(st.lists(st.text(max_size=20), min_size=4, max_size=4, unique=True))
    lidars = {}
    for name, topic in zip(chosen, topics, strict=False):
        sigma = draw(st.one_of(positive, st.tuples(positive, positive, positive)))
        low = draw(st.floats(0.0, 10.0))
        lidars[name] = {
            "topic": topic,
            "initial": {"xyz": draw(triples), "rpy_deg": draw(triples)},
            "sigma": {"xyz": sigma, "rpy_deg": draw(positive)},
            "fixed": draw(st.booleans()),
            "min_range": low,
            "max_range": low + draw(st.floats(0.1, 1e3)),
        }
    low_corner = draw(triples)
    high_corner = tuple(a + draw(st.floats(0.1, 10.0)) for a in low_corner)
    return {
        "lidars": lidars,
        "reference": draw(st.sampled_from([*chosen, ""])),
        "target": draw(st.sampled_from([None, {"min": low_corner, "max": high_corner}])),
        "ground": {"vehicle_height": draw(st.none() | heights), "sigma": draw(positive)},
        "noise": {
            "lidar_range_m": min(draw(positive), 1.0),
            "velocity_m_s": draw(st.none() | positive),
        },
        "require": draw(st.lists(st.sampled_from(["s2s", "s2v", "s2v_rotation"]), unique=True)),
        "limits": draw(st.dictionaries(st.sampled_from(["s2v_yaw_deg", "s2s_x_m"]), positive)),
        "data": {"format": draw(st.sampled_from(["rosbag", "caliv"])), "path": "drive"},
    }


@QUIET
@given(configs())
def test_a_config_comes_back_the_same(tmp_path: Path, raw: dict[str, Any]) -> None:
    config = parse_config(raw, "config.yaml", Path("/base"))

    (tmp_path / "config.yaml").write_text(dump_config(config), encoding="utf-8")

    assert load_config(tmp_path / "config.yaml") == config


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.dates()
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner),
    max_leaves=12,
)


@QUIET
@given(st.dictionaries(st.sampled_from([*Config.model_fields, "lidar", "x"]), anything), anything)
def test_anything_is_a_config_or_one_line(raw: dict[str, Any], lidar: Any) -> None:
    for document in (raw, {"lidars": {"front": lidar}}, {**raw, "lidars": lidar}, lidar):
        said, config = "", None
        try:
            config = parse_config(document, "config.yaml", Path("/base"))
        except ConfigError as e:
            said = str(e)
        if config is None:
            assert said.startswith("config.yaml: ")
            assert len(said) < 2000
        else:
            assert all(map(math.isfinite, config.lidars[config.reference].given.xyz))


@QUIET
@given(st.binary(max_size=200))
def test_any_bytes_are_a_config_or_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "config.yaml"
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        load_config(path)


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n"
    for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)

FILES: dict[str, bytes] = {
    "aliases": f"lidars: {{front: &z [{', '.join(['*j'] * 9)}]}}\n{LAUGHS}".encode(),
    "aliases first": (LAUGHS + "lidars: {front: {topic: *j}}\n").encode(),
    "a tag": b"lidars: !!python/object/apply:os.system ['touch owned']\n",
    "nested": b"lidars: " + b"[" * 200_000,
    "nested eleven levels": b"lidars: " + b"{a: " * 11 + b"1" + b"}" * 11,
    "huge integer": b"lidars: {front: {topic: t, initial: {xyz: [" + b"9" * 5000 + b", 0, 0]}}}",
    "keys twice": b"lidars: {front: {topic: t}, front: {topic: u}}\n",
    "NaN": b"lidars: {front: {topic: t, initial: {xyz: [.nan, 0, 0]}}}\n",
    "infinity": b"lidars: {front: {topic: t, initial: {xyz: [-.inf, 0, 0]}}}\n",
    "not UTF-8": b"lidars: {front: {topic: \xff\xfe}}\n",
    "UTF-16": "lidars: {}".encode("utf-16"),
    "a mark and nothing": b"\xef\xbb\xbf",
    "empty": b"",
    "zeros": b"\x00" * 1000,
    "control characters in a key": b'"\\e[31mlidars\\n": 1\n',
    "a name of two lines": b'lidars: {"a\\nb": {topic: t, initial: {xyz: [0, 0, 0]}}}\n',
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "program", ["calibrate", "simulate", "plan", "inspect", "observability", "evaluate", "merge"]
)
def test_hostile_files_at_every_door(name: str, program: str, tmp_path: Path) -> None:
    path = tmp_path / "hostile.yaml"
    path.write_bytes(FILES[name])
    arguments: dict[str, list[object]] = {
        "calibrate": [path, "--out", tmp_path / "out"],
        "simulate": [path, "--out", tmp_path / "out"],
        "plan": [path],
        "inspect": [tmp_path, "--config", path],
        "observability": [path],
        "evaluate": [path, path],
        "merge": [path, path, "--out", tmp_path / "out"],
    }

    done = command(program, *arguments[program])

    assert done.code == 2
    assert done.err.startswith("error: ")
    assert len(done.err.splitlines()) == 1
    assert done.err[:-1].isprintable()
    assert len(done.err) < 1000
    assert os.listdir(tmp_path) == [path.name]
