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
            help="The jobs; configs/batch.yaml shows every key.",
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder for all results, or a URL such as s3://bucket/fleet.",
        ),
    ],
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="A running Dask scheduler, such as tcp://host:8786, instead of workers on this "
            "machine. Its workers need caliv-graph and the same disk.",
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
            "--scheduler: largest number of jobs at a time; default: its number of workers.",
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Run all jobs again, including finished ones, and replace results of 'calibrate' "
            "in their folders.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the content of summary.json.")
    ] = False,
) -> None:
    r"""Calibrate many drives and vehicles, on all processors or on a Dask cluster.

    DIR contains one folder per job with the files of 'calibrate', and index.html (all jobs, their
    extrinsics and, per vehicle, the differences between its drives), summary.csv and summary.json,
    which are rewritten when a job finishes.

    The same command resumes a batch, also after a kill: results from the same bytes of data and
    prior, the same config and the same version are kept; all other jobs run again. A failed job
    does not stop the others; a job whose worker dies is tried once more. Needs the extra:
    pip install 'caliv-graph\[batch]'

    Exit code: that of the worst job. 4: the data of a job contradict each other; 3: a job failed
    (for a bad config or drive too), or did not reach what its config requires; 0: all jobs are
    done. 2: no job was run: a bad manifest, a folder with other content, or no scheduler.

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
        streams.show_json({**summary_document(summary), "out": out})
    else:
        streams.show(summary_table(summary))
        streams.say(f"Written to {out}: see {out.rstrip('/')}/index.html")
    streams.warn(f"{row.job}: {row.note}" for row in summary.rows if row.note)
    if summary.exit != DONE:
        raise typer.Exit(summary.exit)
