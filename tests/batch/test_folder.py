from __future__ import annotations

import json
from pathlib import Path

import pytest

from caliv_graph.batch.folder import SUMMARY_SCHEMA, BatchFolder, JobRecord
from caliv_graph.errors import OutputError
from caliv_graph.results.calibration_file import write_calibration
from tests.samples import make_calibration

SUMMARY = json.dumps({"schema": SUMMARY_SCHEMA})


def stage(folder: BatchFolder, name: str = "mon") -> Path:
    staged = folder.work / f"{name}.result-1"
    staged.mkdir()
    write_calibration(make_calibration(), staged / "calibration.yaml")
    (staged / "log.jsonl").write_text("{}\n")
    return staged


def put(folder: BatchFolder, name: str = "mon", digest: str = "d1") -> JobRecord:
    return folder.put(
        name,
        stage(folder, name),
        digest=digest,
        exit_code=0,
        seconds=1.5,
        warnings=("careful",),
        written="2026-11-21T08:00:00+00:00",
    )


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A batch with one result."""
    with BatchFolder(tmp_path / "out") as folder:
        put(folder)
        folder.write({"summary.json": SUMMARY})
    return tmp_path / "out"


def test_a_result_is_known_again(out: Path) -> None:
    with BatchFolder(out) as folder:
        record = folder.record("mon")

    assert record is not None
    assert (record.digest, record.exit, record.seconds) == ("d1", 0, 1.5)
    assert record.warnings == ("careful",)
    assert sorted(record.files) == ["calibration.yaml", "log.jsonl"]
    assert sorted(p.name for p in out.iterdir()) == [".lock", "mon", "summary.json"]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("job.json", None),
        ("job.json", "{"),
        ("job.json", "[]"),
        ("job.json", '{"schema": "caliv-graph/batch-job/1"}'),
        ("log.jsonl", None),
        ("log.jsonl", "longer than it was\n"),
        ("calibration.yaml", None),
        ("calibration.yaml", "status: ok\n"),
    ],
)
def test_a_result_that_is_not_whole_is_none(out: Path, file: str, text: str | None) -> None:
    path = out / "mon" / file
    if text is None:
        path.unlink()
    else:
        # As long as it was, where that is possible.
        size = path.stat().st_size if file == "calibration.yaml" else 0
        path.write_text(text.ljust(size, "#"))

    with BatchFolder(out) as folder:
        assert folder.record("mon") is None


def test_two_batches_do_not_share_a_folder(out: Path) -> None:
    with BatchFolder(out), pytest.raises(OutputError) as caught, BatchFolder(out):
        pass

    assert str(caught.value).startswith(f"{out}: another batch is at work there (process ")
    with BatchFolder(out) as folder:
        assert folder.record("mon") is not None, "the one that was refused took nothing away"


def test_what_a_killed_batch_left_is_removed(out: Path) -> None:
    (out / ".work/abc").mkdir(parents=True)
    (out / ".mon.0123456789ab/new").mkdir(parents=True)
    (out / ".summary.json.0123456789ab").write_text("half")
    (out / ".mine.0123456789ab").mkdir()
    (out / ".mine.0123456789ab/thesis.txt").write_text("of somebody")

    with BatchFolder(out) as folder:
        assert [p.name for p in (out / ".work").iterdir()] == [folder.work.name]
        assert folder.record("mon") is not None

    assert sorted(p.name for p in out.iterdir()) == [
        ".lock",
        ".mine.0123456789ab",
        "mon",
        "summary.json",
    ]


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")

    with pytest.raises(OutputError, match="holds no batch"), BatchFolder(tmp_path):
        pass

    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(OutputError, match="is a file"), BatchFolder(tmp_path / "notes.txt"):
        pass


def test_a_batch_that_comes_to_nothing_leaves_nothing(tmp_path: Path) -> None:
    def begin() -> None:
        with BatchFolder(tmp_path / "a/out") as folder:
            folder.write({"summary.json": SUMMARY, "index.html": "", "summary.csv": ""})
            folder.keep_cache()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()

    assert list(tmp_path.iterdir()) == []


def test_a_batch_that_fails_keeps_its_results(tmp_path: Path) -> None:
    def begin() -> None:
        with BatchFolder(tmp_path / "out") as folder:
            put(folder)
            folder.write({"summary.json": SUMMARY})
            stage(folder, "tue")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()

    with BatchFolder(tmp_path / "out") as folder:
        assert folder.record("mon") is not None
        assert folder.record("tue") is None


def test_only_results_of_a_batch_are_replaced(out: Path) -> None:
    (out / "tue").mkdir()
    write_calibration(make_calibration(), out / "tue/calibration.yaml")

    with BatchFolder(out) as folder:
        folder.check_place("mon", force=False)
        folder.check_place("wed", force=False)
        with pytest.raises(OutputError, match="tue: exists already"):
            folder.check_place("tue", force=False)
        folder.check_place("tue", force=True)
        (out / "mon/thesis.txt").write_text("of somebody")
        with pytest.raises(OutputError, match=r"thesis\.txt"):
            folder.check_place("mon", force=True)


def test_a_newer_result_takes_the_place_of_an_older_one(out: Path) -> None:
    with BatchFolder(out) as folder:
        put(folder, digest="d2")
        record = folder.record("mon")

    assert record is not None
    assert record.digest == "d2"
    assert sorted(p.name for p in (out / "mon").iterdir()) == [
        "calibration.yaml",
        "job.json",
        "log.jsonl",
    ]
