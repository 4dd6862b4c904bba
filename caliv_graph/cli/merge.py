"""`caliv-graph merge`: several calibrations of one vehicle into one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import P_VALUE, Force, PValue, ResultAsJson
from caliv_graph.common.exits import INCONSISTENT


def merge(
    calibrations: Annotated[
        list[Path],
        typer.Argument(metavar="A.yaml B.yaml ...", help="Results of 'calibrate', of one vehicle."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The merged calibration.")],
    p_value: PValue = P_VALUE,
    force: Force = False,
    as_json: ResultAsJson = False,
) -> None:
    """Merge several calibrations of one vehicle into one.

    The information of the drives' data is summed, and the common initial guess counts once. The
    result equals that of all drives solved together, without a new solve. Do not merge calibrations
    of the same drive. The files may have different LiDARs and references; the order is that of the
    first file.

    Exit code 4: the result is written, but the calibrations contradict each other.

    Example: caliv-graph merge monday/calibration.yaml friday/calibration.yaml --out vehicle.yaml
    """
    from caliv_graph.common.files import check_output_file, each_once
    from caliv_graph.common.json_text import without_infinities
    from caliv_graph.errors import ConfigError
    from caliv_graph.fusion.merge import merge as merge_calibrations
    from caliv_graph.report.comparison import agreement_document, merger_table
    from caliv_graph.results.calibration_file import (
        calibration_document,
        read_calibration,
        write_calibration,
    )

    if len(calibrations) < 2:
        raise ConfigError(f"{calibrations[0]}: is one calibration. Give two or more")
    each_once(calibrations, "", "a calibration")
    check_output_file(out, force, calibrations)
    merger = merge_calibrations({str(p): read_calibration(p) for p in calibrations}, p_value)
    write_calibration(merger.calibration, out, force)
    if as_json:
        extra = {"out": str(out), "agreement": agreement_document(merger, p_value)}
        document = calibration_document(merger.calibration)
        streams.show_json(without_infinities({**document, **extra}))
    else:
        streams.show(merger_table(merger, p_value))
        streams.say(f"Written to {out}")
    streams.warn(merger.warnings)
    if merger.calibration.status == "inconsistent":
        raise typer.Exit(INCONSISTENT)
