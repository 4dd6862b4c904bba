"""Reading, validating and dumping a configuration."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.common.yaml_text import YamlProblemError, parse_yaml
from caliv_graph.config.model import Config
from caliv_graph.config.sections import first_problem
from caliv_graph.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

_MOST_BYTES = 200_000_000
"""Of a YAML file: ten times the poses of a drive of hours. A recording that is given by mistake is
larger, and is not read to its end."""

_OF_A_BAG = "metadata.yaml"
"""YAML that a person never gives: that of a rosbag2 folder."""

_MOST_NAMED = 4
"""Files of a folder that a message names at most."""


def read_yaml(path: Path, error: type[Exception] = ConfigError) -> Any:
    """Reads a YAML file with the safe loader.

    Raises:
        error: the file is missing, unreadable, too large, or not YAML; names the line.
    """
    try:
        text = read_input(path, _MOST_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path}: no such file. Check the path") from None
    except IsADirectoryError:
        raise error(f"{path}: {_instead_of_folder(path)}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not text in UTF-8. Give a YAML file") from None
    except OSError as e:
        raise error(f"{path}: {unreadable(e)}") from None
    try:
        return parse_yaml(text)
    except YamlProblemError as e:
        where = " " if str(e).startswith("in line ") else ": "
        raise error(f"{path}: not valid YAML{where}{e}") from None


def validated(model: type[Model], raw: Any, source: str, expected: str, remedy: str = "") -> Model:
    """Validates what a YAML file held, with the model of the whole file.

    `source` names the file in messages; `expected` is for the message about a file without keys;
    `remedy` ends messages about a file that nobody writes by hand.

    Raises:
        ConfigError: with the first problem, in one line.
    """
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{source}: holds no {expected}")
    try:
        return model.model_validate(raw)
    except ValidationError as e:
        raise ConfigError(f"{source}: {first_problem(e, model, remedy)}") from None


def parse_config(raw: Any, source: str, base: Path) -> Config:
    """Validates the configuration that a YAML file held; its paths are relative to `base`.

    `~` at the beginning of a path is the home folder, as in a shell.

    Raises:
        ConfigError: with the first problem, in one line.
    """
    expected = "configuration: expected keys such as 'lidars'"
    config = validated(Config, raw, source, expected)
    named = {"path": config.data.path, "poses": config.data.poses}
    paths = {
        key: (base / os.path.expanduser(path)).absolute()  # `Path` fails where there is no home
        for key, path in named.items()
        if path is not None
    }
    return config.model_copy(update={"data": config.data.model_copy(update=paths)})


def load_config(path: Path) -> Config:
    """Reads and validates a configuration file.

    Raises:
        ConfigError: the file is missing, not YAML, or not valid.
    """
    try:
        problem = _no_config(path)
    except OSError:  # a name that is too long, a folder that may not be read: reading tells it
        problem = ""
    if problem:
        raise ConfigError(f"{path}: {problem}")
    return parse_config(read_yaml(path), str(path), path.parent)


def _no_config(path: Path) -> str:
    """Why a path is no config file, and what to give or to do instead; empty: it is a file."""
    inside = path / "config.yaml"
    if path.is_dir() and inside.is_file():
        return f"is a folder. Give {inside}"
    if path.is_dir():
        return _instead_of_folder(path)
    if not path.exists():
        return f"no such file. Write it for a drive by 'caliv-graph init DRIVE --out {path}'"
    return ""


def _instead_of_folder(path: Path) -> str:
    """What to give instead of a folder: the YAML files in it, or a config of the drive it is."""
    try:
        inside = sorted(p for p in path.glob("*.yaml") if p.name != _OF_A_BAG)
    except OSError:
        inside = []
    if inside:
        named = ", ".join(map(str, inside[:_MOST_NAMED]))
        more = ", ..." if len(inside) > _MOST_NAMED else ""
        which = "one of its files" if len(inside) > 1 else "its file"
        return f"is a folder. Give {which}: {named}{more}"
    return (
        "is a folder, expected a YAML file. If this is a drive, write one by 'caliv-graph init "
        f"{path} --out config.yaml'"
    )


def dump_config(config: Config) -> str:
    """The effective configuration as YAML that `load_config` reads back to the same values.

    Absent keys stay absent. A null that is not the default stays: `lever_arm: null` is an unknown
    lever arm, and an absent one is exactly zero.
    """
    data = _without_absent(config, config.model_dump(mode="json"))
    for lidar in data["lidars"].values():
        if "initial" not in lidar:
            del lidar["sigma"]  # of a guess that is not there
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _without_absent(value: Any, dumped: Any) -> Any:
    """What a value of a model is dumped as, without the nulls of fields whose default is null."""
    if isinstance(value, BaseModel):
        fields = type(value).model_fields
        return {
            name: _without_absent(getattr(value, name), entry)
            for name, entry in dumped.items()
            if entry is not None or fields[name].default is not None
        }
    if isinstance(value, Mapping):
        return {key: _without_absent(value[key], entry) for key, entry in dumped.items()}
    if isinstance(value, tuple):
        return [_without_absent(*pair) for pair in zip(value, dumped, strict=True)]
    return dumped
