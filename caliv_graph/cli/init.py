"""`caliv-graph init`: a commented config for a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams


def init(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="The drive: a CaLiV folder.")],
    out: Annotated[Path, typer.Option("--out", metavar="CONFIG", help="The config to write.")],
    force: Annotated[
        bool, typer.Option("--force", help="Replace the config if it exists.")
    ] = False,
) -> None:
    """Write a commented config for a drive.

    It names the LiDARs found. Initial guesses and the target's region are taken from a config of
    the CaLiV authors' program (transform_sensor_N, min_bound, max_bound) if one lies beside the
    data; what is left for you to fill in is marked TODO.

    Example: caliv-graph init drive/ --out config.yaml
    """
    from caliv_graph.config_draft import draft_config
    from caliv_graph.files import atomic_write, check_output_file

    check_output_file(out, force)
    draft = draft_config(data, out)
    atomic_write(out, draft.text, force)
    streams.say(f"{out} written. LiDARs: {', '.join(draft.lidars)}")
    if draft.source:
        streams.say(f"Initial guesses and target taken from {draft.source}")
    if draft.unknown:
        streams.warn([f"{out}: fill in before you calibrate: {', '.join(draft.unknown)}"])
