"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
