"""Arguments and options that several commands have, and what is checked of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from caliv_graph.config import Config
    from caliv_graph.products import Recording

ConfigArgument = Annotated[
    Path, typer.Argument(metavar="CONFIG.yaml", help="The config; 'init' drafts one.")
]

CalibrationArgument = Annotated[
    Path, typer.Argument(metavar="CALIBRATION.yaml", help="A result of 'calibrate'.")
]

Drives = Annotated[
    list[Path] | None,
    typer.Option(
        "--data",
        metavar="PATH",
        help="The drive, instead of data.path of the config. Repeat the option for several drives "
        "of one vehicle: they are taken together.",
    ),
]

PValue = Annotated[
    float,
    typer.Option(
        "--p-value",
        min=1e-12,
        max=0.5,
        help="Chance of a false alarm if no mount has moved, over all tests together.",
    ),
]
P_VALUE = 0.01

Force = Annotated[bool, typer.Option("--force", help="Replace older output.")]

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]

ResultAsJson = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON document, calibration.yaml's content and more."),
]


def each_once(paths: Sequence[Path], where: str, what: str) -> None:
    """Checks that no path is given twice, under whatever names.

    Args:
        paths: as given.
        where: what the message begins with before the path: an option and a space, or nothing.
        what: the paths are of, "a drive".

    Raises:
        ConfigError: one is.
    """
    from caliv_graph.errors import ConfigError

    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise ConfigError(f"{where}{path}: given twice; {what} counts once")
        seen.add(path.resolve())


def open_drives(config: Config, data: Sequence[Path] | None) -> list[Recording]:
    """The recordings that `--data` names, or else the config.

    Raises:
        ConfigError: a drive is given twice, or none at all.
        RecordingError: one cannot be read.
    """
    from caliv_graph.readers import open_recording

    each_once(data or (), "--data ", "a drive")
    return [open_recording(config, path) for path in data or (None,)]
