"""The manifest of a batch: its drives, and the config of each."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from caliv_graph.batch.remote import is_url
from caliv_graph.config.load import parse_config, read_yaml, validated
from caliv_graph.config.model import (
    Config,
    Requirement,
    SolveMode,
    check_limit_keys,
)
from caliv_graph.config.sections import FilePath, Name, Positive, Section, as_written
from caliv_graph.errors import ConfigError

MOST_CHARACTERS = 80
"""Of a name: a file system allows 255 bytes, and scratch names beside it are longer."""

RESERVED = ("index.html", "summary.csv", "summary.json")
"""Names of the files beside the folders of the jobs."""

_NAME = re.compile(r"\w(?:[\w.-]*[\w-])?")
_VEHICLE = re.compile(r"\w(?:[\w. -]*[\w.-])?")


@dataclass(frozen=True)
class Job:
    """One calibration of a batch. All paths are absolute.

    Attributes:
        name: of the job and of its folder.
        config: the config.
        vehicle: jobs of the same vehicle are compared; None: with no other job.
        prior: an earlier calibration; None: none.
        data: drives, instead of the config's: paths, and URLs as text; empty: the config's.
        mode, require, limits: instead of the config's; None: the config's.
    """

    name: str
    config: Path
    vehicle: str | None = None
    data: tuple[Path | str, ...] = ()
    prior: Path | None = None
    mode: SolveMode | None = None
    require: tuple[Requirement, ...] | None = None
    limits: Mapping[str, float] | None = None


class _Settings(Section):
    """The settings of a job, or the defaults of all jobs."""

    config: FilePath | None = Field(None, description="the config, relative to the manifest")
    vehicle: str | None = Field(None, description="jobs of one vehicle are compared")
    prior: FilePath | None = Field(None, description="earlier calibration.yaml of the vehicle")
    mode: SolveMode | None = Field(None, description="instead of solve.mode of the config")
    require: tuple[Requirement, ...] | None = Field(None, description="instead of the config's")
    limits: dict[str, Positive] | None = Field(None, description="instead of the config's")

    @field_validator("vehicle", mode="before")
    @classmethod
    def _plain_vehicle(cls, raw: Any) -> Any:
        return raw if raw is None else _plain(raw, _VEHICLE, "spaces, ")

    @field_validator("require", mode="before")
    @classmethod
    def _one_or_many(cls, raw: Any) -> Any:
        return [raw] if isinstance(raw, str) else raw

    @field_validator("limits")
    @classmethod
    def _known_limits(cls, limits: dict[str, float] | None) -> dict[str, float] | None:
        check_limit_keys(limits or ())
        return limits


class _JobEntry(_Settings):
    """One job as it is written."""

    name: str = Field(description="of the job, and of its folder")
    data: tuple[Name, ...] = Field((), description="drives or URLs, instead of the config's")

    @field_validator("name", mode="before")
    @classmethod
    def _plain_name(cls, raw: Any) -> Any:
        name = _plain(raw, _NAME, "")
        if name.casefold() in RESERVED:
            raise ValueError(
                f"is the name of a file of the batch, must be none of {', '.join(RESERVED)}"
            )
        return name

    @field_validator("data", mode="before")
    @classmethod
    def _one_or_many_drives(cls, raw: Any) -> Any:
        if raw is None:
            return ()
        return [raw] if isinstance(raw, str | int) else raw


class _Manifest(Section):
    """The file."""

    defaults: _Settings = _Settings()
    jobs: tuple[_JobEntry, ...] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _empty_defaults(cls, raw: Any) -> Any:
        """`defaults:` with nothing below it means none."""
        if isinstance(raw, Mapping) and raw.get("defaults", ...) is None:
            return {key: value for key, value in raw.items() if key != "defaults"}
        return raw


def load_manifest(path: Path) -> tuple[Job, ...]:
    """Reads a manifest, in which paths are relative to its folder.

    Each job checks its config and drives when it runs.

    Raises:
        ConfigError: it is missing, not YAML, not a manifest, or two jobs would share a folder.
    """
    expected = "manifest: expected 'jobs' with a list"
    manifest = validated(_Manifest, read_yaml(path), str(path), expected)
    base = path.parent.absolute()
    jobs = tuple(_job(entry, manifest.defaults, base, path) for entry in manifest.jobs)
    seen: dict[str, str] = {}
    for job in jobs:
        # Some file systems ignore case.
        folder = job.name.casefold()
        if folder in seen:
            first = "twice" if seen[folder] == job.name else f"beside '{seen[folder]}'"
            raise ConfigError(
                f"{path}: job name '{job.name}' is used {first}: each job has its own folder. "
                "Rename one"
            )
        seen[folder] = job.name
    return jobs


def effective_config(job: Job) -> Config:
    """The config of a job, with what the manifest has instead.

    Raises:
        ConfigError: the config is missing, not YAML, or not valid.
    """
    raw = read_yaml(job.config)
    if isinstance(raw, Mapping):
        raw = dict(raw)
        if job.mode is not None and isinstance(raw.get("solve") or {}, Mapping):
            raw["solve"] = {**(raw.get("solve") or {}), "mode": job.mode}
        if job.limits is not None:
            # The config may have its limits in two places.
            raw["limits"] = dict(job.limits)
            raw["require"] = _without_limits(raw.get("require"))
        if job.require is not None:
            raw["require"] = [*job.require, *_limits_inside(raw.get("require"))]
        if raw.get("require") is None:
            raw.pop("require", None)
    return parse_config(raw, str(job.config), job.config.parent)


def _limits_inside(require: Any) -> list[Any]:
    """The limits that the config has inside `require`: they are not what a job has instead."""
    items = require if isinstance(require, list) else [require]
    return [item for item in items if isinstance(item, Mapping)]


def _without_limits(require: Any) -> Any:
    if isinstance(require, Mapping):
        return []
    if isinstance(require, list):
        return [item for item in require if not isinstance(item, Mapping)]
    return require


def _job(entry: _JobEntry, defaults: _Settings, base: Path, manifest: Path) -> Job:
    def setting(key: str) -> Any:
        # `prior: null` in a job switches the default prior off.
        return getattr(entry if key in entry.model_fields_set else defaults, key)

    config, prior = setting("config"), setting("prior")
    if config is None:
        raise ConfigError(
            f"{manifest}: job '{entry.name}' has no config: give it 'config', or all of them "
            "'defaults.config'"
        )
    return Job(
        name=entry.name,
        config=base / config,
        vehicle=setting("vehicle"),
        data=tuple(drive if is_url(drive) else base / drive for drive in entry.data),
        prior=None if prior is None else base / prior,
        mode=setting("mode"),
        require=setting("require"),
        limits=setting("limits"),
    )


def _plain(raw: Any, pattern: re.Pattern[str], also: str) -> str:
    """A name that is safe as a folder, in a table and on a page."""
    raw = as_written(raw)
    if not isinstance(raw, str):
        raise ValueError("is not text in YAML: write it in quotes")
    # One spelling of what looks the same.
    name = unicodedata.normalize("NFC", raw)
    if len(name) > MOST_CHARACTERS or len(name.encode(errors="replace")) > 2 * MOST_CHARACTERS:
        raise ValueError(f"must have at most {MOST_CHARACTERS} characters")
    if not pattern.fullmatch(name):
        raise ValueError(
            f"must be letters, digits, {also}'_', '-' and '.', beginning with a letter or digit"
        )
    return name
