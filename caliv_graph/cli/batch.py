"""`caliv-graph batch`: many drives and vehicles, resumable."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.common.exits import DONE


def batch(
    manifest: Annotated[
        Path,
        typer.Argument(
            metavar="MANIFEST.yaml",
            help="The jobs; configs/batch.yaml is an example with every key.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for all results.")],
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="A Dask scheduler that runs already, such as tcp://host:8786, instead of workers "
            "on this machine. Its workers need caliv-graph, and the same disk.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=1024,
            metavar="N",
            help="Worker processes, one job each at a time; default: one per processor. With "
            "--scheduler: jobs at a time, at most; default: as many as it has workers.",
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Do all jobs again, also those that are done, and replace results of 'calibrate' "
            "in their folders.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document, summary.json's content.")
    ] = False,
) -> None:
    r"""Calibrate many drives and vehicles, on all processors or on a Dask cluster.

    DIR gets a folder per job with what 'calibrate' writes, and index.html (every job, its
    extrinsics and, per vehicle, how much its drives differ), summary.csv and summary.json, which
    are rewritten as jobs finish.

    The same command again resumes: a result that was made from the same bytes of data and prior,
    the same config and version is left as it is, also after a kill; all else is done again. One
    failure does not stop the others; a job whose worker dies is tried once more. Needs the extra:
    pip install 'caliv-graph\[batch]'

    Exit code: that of the worst job. 4: the data of one contradict each other; 3: one failed (a bad
    config or drive too), or did not reach what its config requires; 0: all are done and good. 2:
    nothing was run: a bad manifest, a folder that is not a batch's, or no scheduler.

    Example: caliv-graph batch fleet.yaml --out fleet/
    """
    from caliv_graph.batch.manifest import load_manifest

    jobs = load_manifest(manifest)

    from caliv_graph.batch.page import summary_table
    from caliv_graph.batch.run import run_batch
    from caliv_graph.batch.summary import summary_document

    with streams.progress_on_stdout(as_json) as progress:
        summary = run_batch(
            jobs,
            out,
            progress,
            scheduler=scheduler,
            workers=workers,
            force=force,
            manifest=str(manifest),
        )
    if as_json:
        streams.show_json({**summary_document(summary), "out": str(out)})
    else:
        streams.show(summary_table(summary))
        streams.say(f"Written to {out}: see {out / 'index.html'}")
    streams.warn(f"{row.job}: {row.note}" for row in summary.rows if row.note)
    if summary.exit != DONE:
        raise typer.Exit(summary.exit)
