"""YAML that was made to do harm, or that a broken disk made."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from caliv_graph.common.yaml_text import YamlProblemError, parse_yaml
from caliv_graph.config.load import read_yaml
from caliv_graph.errors import ConfigError


def problem_of(text: str) -> str:
    with pytest.raises(YamlProblemError) as caught:
        parse_yaml(text)
    return str(caught.value)


def bomb(levels: int) -> str:
    """Each list holds the one before it ten times."""
    lists = ["&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lists += [f"&a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, levels)]
    return f"x: [{', '.join(lists)}]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lidars: " + "[" * 100_000, "over 50 levels of lists"),
        ("lidars:\n" + "- " * 50_000 + "x\n", "over 50 levels of lists"),
        ("a: " + "{a: " * 51 + "}" * 51, "over 50 levels of lists"),
        (bomb(12), "aliases expand to"),
        ("a: &a {b: *a}\n", "'*a' contains itself"),
        ("a: &a [*a]\n", "'*a' contains itself"),
        ("a: " + "9" * 5000, "a number of 5000 digits"),
        ("a: !!int ''", "does not fit its tag"),
        ("a: !!timestamp now", "does not fit its tag"),
        ("a: !!map x", "expected a mapping node"),
        ("a: !!timestamp 2001-99-99", "month must be in 1..12"),
        ("a: !!python/object/apply:os.system [exit]", "could not determine a constructor"),
        ("? [a]\n: 1", "unhashable"),
        ("? &a [*a]\n: 1", "contains itself"),
        ("a: 1\na: 2\n", "'a' is given twice"),
        ("a: 1\n---\nb: 2\n", "another document"),
        ("a: *b", "undefined alias"),
        (f"a: !{'x' * 5000} b", "could not determine a constructor"),
        ('a: "\\ud800"', "invalid Unicode"),
        ("a\x00b", "control characters"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_hostile_text_is_refused_in_one_short_line(text: str, said: str) -> None:
    message = problem_of(text)

    assert said in message
    assert "\n" not in message
    assert len(message) < 300


def test_what_people_and_programs_write_is_read() -> None:
    nested = "a: " + "[" * 40 + "]" * 40
    assert parse_yaml(nested)
    shared = [[f"{k}.pcd", [float(k), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]] for k in range(3000)]
    # The dumper writes the second sensor's poses, the same list, as an alias.
    text = yaml.safe_dump({f"sensor_{n}": shared for n in range(5)})
    assert "*" in text
    assert parse_yaml(text)["sensor_4"] == shared
    assert parse_yaml("base: &b {x: 1}\nmore: {<<: *b, y: 2}\n")["more"] == {"x": 1, "y": 2}
    assert parse_yaml("a: " + "9" * 30)["a"] == 10**30 - 1
    assert parse_yaml("") is None


@pytest.mark.parametrize(
    "name", ["0001", "2024_05_01", "2024-05-01", "2024-05-01 12:30:00", "12:30:00", "0x1F", "0o17"]
)
def test_names_of_folders_stay_text(name: str) -> None:
    assert parse_yaml(f"path: {name}") == {"path": name}


def test_numbers_are_numbers() -> None:
    text = "[0, 7, -12, +3, 2024, 1.5, -0.0, 1e3, 1.0e+3, .inf, 00.5]"

    assert parse_yaml(text) == [0, 7, -12, 3, 2024, 1.5, 0.0, "1e3", 1000.0, float("inf"), 0.5]


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_bytes(b"\xef\xbb\xbflidars: 1\n")

    assert read_yaml(path) == {"lidars": 1}


def test_no_line_is_named_where_none_is_known(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("a: 1\nb: [1, 2\n")
    with pytest.raises(ConfigError, match=r"config\.yaml: not valid YAML in line 3: did not find"):
        read_yaml(path)
    path.write_text("a: !!int ''\n")
    with pytest.raises(ConfigError, match=r"config\.yaml: not valid YAML: a value does not"):
        read_yaml(path)
