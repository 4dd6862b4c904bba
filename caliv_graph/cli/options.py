"""Arguments and options of several commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ConfigArgument = Annotated[
    Path, typer.Argument(metavar="CONFIG.yaml", help="The config; 'init' writes a draft.")
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
        "of one vehicle, which are solved together.",
    ),
]

PValue = Annotated[
    float,
    typer.Option(
        "--p-value",
        min=1e-12,
        max=0.5,
        help="Probability of a false alarm over all tests, if no mount moved.",
    ),
]
P_VALUE = 0.01

Force = Annotated[bool, typer.Option("--force", help="Replace older output.")]

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]

ResultAsJson = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON document with the content of calibration.yaml."),
]
