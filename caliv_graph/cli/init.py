"""`caliv-graph init`: a commented config for a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import Force


def init(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="The drive: a bag, a CaLiV folder, or a folder of clouds."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="CONFIG", help="The config to write.")],
    urdf: Annotated[
        Path | None,
        typer.Option(
            "--urdf", metavar="FILE", help="The vehicle's URDF, for the initial guesses (of a bag)."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a commented config for a drive.

    The config names the LiDARs and, for a bag, the topics of the vehicle's motion. Initial guesses
    come from /tf_static or a URDF, by the frames of the messages or by similar names; the height of
    the vehicle frame from base_footprint. For a CaLiV folder, initial guesses and the region of the
    target come from a config of the CaLiV or GMMCalib authors' program (transform_sensor_N,
    min_bound, max_bound) in the same folder or in its folder config. For a folder of clouds, a file
    of poses in it is named. Values to fill in are marked TODO.

    Example: caliv-graph init drive/ --urdf vehicle.urdf --out config.yaml
    """
    from caliv_graph.common.files import atomic_write, check_output_file
    from caliv_graph.workflows.draft import draft_config

    check_output_file(out, force, [data, urdf])
    draft = draft_config(data, out, urdf)
    check_output_file(out, force, [draft.original])
    atomic_write(out, draft.text, force)
    streams.say(f"{out} written. LiDARs: {', '.join(draft.lidars)}")
    if draft.origin:
        streams.say(draft.origin)
    if draft.unknown:
        streams.warn([f"{out}: fill in before you calibrate: {', '.join(draft.unknown)}"])
