"""Reading, validating and dumping a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import (
    ValidationError,
)

from caliv_graph.common.inputs import read_input
from caliv_graph.common.yaml_text import YamlProblemError, parse_yaml
from caliv_graph.config.model import Config
from caliv_graph.config.sections import _one_line
from caliv_graph.errors import ConfigError

_MOST_BYTES = 200_000_000
"""Of a YAML file. The poses of a drive of hours take a tenth of it, and a recording that is given
by mistake is not read to its end."""


def read_yaml(path: Path, error: type[Exception] = ConfigError) -> Any:
    """Reads a YAML file with the safe loader.

    Raises:
        error: the file is missing, unreadable, too large, or not YAML; names the line.
    """
    try:
        text = read_input(path, _MOST_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except IsADirectoryError:
        raise error(f"{path}: is a folder, expected a YAML file") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not text in UTF-8") from None
    except OSError as e:
        raise error(f"{path}: {e.strerror}") from None
    try:
        return parse_yaml(text)
    except YamlProblemError as e:
        where = " " if str(e).startswith("in line ") else ": "
        raise error(f"{path}: not valid YAML{where}{e}") from None


def parse_config(raw: Any, source: str, base: Path) -> Config:
    """Validates a configuration.

    Args:
        raw: what the YAML file held.
        source: what to call it in messages.
        base: folder that its paths are relative to.

    Raises:
        ConfigError: with the first thing wrong, in one line.
    """
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{source}: holds no configuration: expected keys such as 'lidars'")
    try:
        config = Config.model_validate(raw)
    except ValidationError as e:
        raise ConfigError(f"{source}: {_one_line(e, Config)}") from None
    if config.data.path is None:
        return config
    data = config.data.model_copy(update={"path": (base / config.data.path).absolute()})
    return config.model_copy(update={"data": data})


def load_config(path: Path) -> Config:
    """Reads and validates a configuration file.

    Raises:
        ConfigError: the file is missing, not YAML, or not valid.
    """
    return parse_config(read_yaml(path), str(path), path.parent)


def dump_config(config: Config) -> str:
    """The effective configuration as YAML that `load_config` reads back to the same values."""
    data = config.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
