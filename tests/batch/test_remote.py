"""Drives and results behind URLs: in memory, and on a disk by file://."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from caliv_graph.batch.digests import DigestCache, job_digest, job_inputs
from caliv_graph.batch.folder import BatchFolder, JobRecord
from caliv_graph.batch.manifest import load_manifest
from caliv_graph.batch.remote import RemoteFolder
from caliv_graph.batch.remote_folder import RemoteBatchFolder
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.errors import BatchError, OutputError, RecordingError

SUMMARY = '{"schema": "caliv-graph/batch/1"}'


@pytest.fixture
def memory() -> Iterator[Any]:
    """The file system of memory://, empty before and after."""
    system = import_module("fsspec").filesystem("memory")
    system.store.clear()
    yield system
    system.store.clear()


@pytest.fixture
def bag(memory: Any) -> str:
    """A folder like a bag, with a hidden file."""
    memory.pipe(
        {"/night/one/metadata.yaml": b"a", "/night/one/deep/0.mcap": b"bcd", "/night/one/.x": b"e"}
    )
    return "memory://night/one"


def config_of(folder: Path) -> Config:
    poses = {"topic": "/points", "initial": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 0]}}
    return parse_config({"data": {"format": "rosbag"}, "lidars": {"front": poses}}, "c", folder)


# ------------------------------------------------------------------ reading


def test_all_files_but_hidden_ones_are_fetched(bag: str, tmp_path: Path) -> None:
    fetched = RemoteFolder(bag + "/").fetch(tmp_path)

    assert sorted(fetched.listed) == ["deep/0.mcap", "metadata.yaml"]
    assert fetched.copy == tmp_path / "one"
    assert (fetched.copy / "deep/0.mcap").read_bytes() == b"bcd"
    assert not (fetched.copy / ".x").exists()


def test_a_single_file_is_fetched_as_such(bag: str, tmp_path: Path) -> None:
    fetched = RemoteFolder(f"{bag}/deep/0.mcap").fetch(tmp_path)

    assert fetched.copy == tmp_path / "0.mcap"
    assert fetched.copy.read_bytes() == b"bcd"


def test_what_is_not_there_is_said(memory: Any, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"memory://no/where: nothing is there. Give the URL"):
        RemoteFolder("memory://no/where").fetch(tmp_path)
    assert RemoteFolder("memory://no/where").read("x") is None


@pytest.mark.parametrize(
    ("url", "said"),
    [("s3://night/one", "Install s3fs to access S3, with pip"), ("foo://x", "not known: foo")],
)
def test_a_protocol_that_is_missing_is_named(url: str, said: str) -> None:
    with pytest.raises(BatchError, match=said):
        RemoteFolder(url).files()


def test_a_drive_that_changes_meanwhile_is_no_drive(
    bag: str, memory: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = type(memory).get_file

    def longer(self: Any, remote: str, local: str, **more: Any) -> None:
        memory.pipe("/night/one/deep/0.mcap", b"bcdef")
        plain(self, remote, local, **more)

    monkeypatch.setattr(type(memory), "get_file", longer)
    with pytest.raises(RecordingError, match=r"changed while it was read \(deep/0.mcap: 5 bytes"):
        RemoteFolder(bag).fetch(tmp_path)


def test_a_failure_of_the_store_is_one_line(
    bag: str, memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise LookupError("no\ncredentials")

    monkeypatch.setattr(type(memory), "find", fails)
    monkeypatch.setattr(type(memory), "put_file", fails)
    with pytest.raises(RecordingError, match="one: cannot be read: LookupError: no credentials"):
        RemoteFolder(bag).files()
    with pytest.raises(OutputError, match=r"cannot be written: .* Give another --out"):
        RemoteFolder(bag).put([Path(__file__)])


# ------------------------------------------------------------------ digests


def test_a_drive_has_the_same_digest_on_a_disk_and_behind_a_url(bag: str, tmp_path: Path) -> None:
    config, cache = config_of(tmp_path), DigestCache()
    fetched = {bag: RemoteFolder(bag).fetch(tmp_path)}
    there = job_inputs(config, [bag], None, fetched=fetched)
    here = job_inputs(config, [tmp_path / "one"], None)
    assert there is not None
    assert here is not None
    assert job_digest(config, there, cache) == job_digest(config, here, DigestCache())


def test_what_was_fetched_once_is_known_until_it_changes(
    bag: str, memory: Any, tmp_path: Path
) -> None:
    config, cache = config_of(tmp_path), DigestCache()
    inputs = job_inputs(config, [bag], None)
    assert inputs is not None
    assert not inputs.known(cache)
    with pytest.raises(OSError, match="was not fetched"):
        job_digest(config, inputs, cache)
    fetched = {bag: RemoteFolder(bag).fetch(tmp_path)}
    fresh = job_inputs(config, [bag], None, fetched=fetched)
    assert fresh is not None
    digest = job_digest(config, fresh, cache)
    cache = DigestCache.parse(cache.dump())

    again = job_inputs(config, [bag], None)
    assert again is not None
    assert again.known(cache)
    assert job_digest(config, again, cache) == digest
    memory.pipe("/night/one/deep/0.mcap", b"xyz")
    changed = job_inputs(config, [bag], None)
    assert changed is not None
    assert not changed.known(cache)
    assert job_inputs(config, ["memory://no/where"], None) is None


def test_a_manifest_may_have_urls_among_its_drives(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(
        "defaults: {config: c.yaml}\n"
        "jobs:\n- {name: a, data: s3://night/one}\n- {name: b, data: [drive, memory://x/y]}\n"
    )
    a, b = load_manifest(tmp_path / "fleet.yaml")

    assert a.data == ("s3://night/one",)
    assert b.data == (tmp_path / "drive", "memory://x/y")


# ------------------------------------------------------------------ results


def put(folder: BatchFolder, digest: str = "d1") -> JobRecord:
    staged = folder.work / f"staged-{digest}"
    staged.mkdir()
    (staged / "calibration.yaml").write_text("schema: x\n")
    (staged / "report.html").write_text(f"<p>{digest}")
    return folder.put(
        "mon",
        staged,
        digest=digest,
        exit_code=0,
        seconds=1.0,
        warnings=(),
        written="2026-11-24T08:00:00+00:00",
    )


@pytest.fixture
def fleet(memory: Any) -> str:
    """The URL of a batch with one result."""
    with RemoteBatchFolder("memory://fleet") as folder:
        put(folder)
        folder.write({"summary.json": SUMMARY})
        folder.keep_cache()
        copy = folder.path
    assert not copy.parent.exists()
    return "memory://fleet"


def test_a_result_behind_a_url_is_known_again(fleet: str, memory: Any) -> None:
    assert sorted(memory.find("/fleet")) == [
        "/fleet/.digests.json",
        "/fleet/mon/calibration.yaml",
        "/fleet/mon/job.json",
        "/fleet/mon/report.html",
        "/fleet/summary.json",
    ]
    with RemoteBatchFolder(fleet) as folder:
        record = folder.record("mon")
        assert record is not None
        assert record.digest == "d1"
        assert (folder.path / "mon/calibration.yaml").read_text() == "schema: x\n"
        assert folder.record("tue") is None


@pytest.mark.parametrize("lost", ["report.html", "job.json", "calibration.yaml"])
def test_a_result_that_is_not_whole_is_none(fleet: str, memory: Any, lost: str) -> None:
    memory.rm_file(f"/fleet/mon/{lost}")
    with RemoteBatchFolder(fleet) as folder:
        assert folder.record("mon") is None
    if lost != "calibration.yaml":
        memory.pipe("/fleet/mon/calibration.yaml", b"schema: y\n")
        with RemoteBatchFolder(fleet) as folder:
            assert folder.record("mon") is None


def test_a_result_is_replaced_and_without_job_json_meanwhile(
    fleet: str, memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(self: Any, local: str, remote: str, **more: Any) -> None:
        raise ConnectionError("lost")

    with RemoteBatchFolder(fleet) as folder:
        folder.check_place("mon", force=False)
        put(folder, "d2")
    assert memory.cat("/fleet/mon/report.html") == b"<p>d2"
    with RemoteBatchFolder(fleet) as folder:
        monkeypatch.setattr(type(memory), "put_file", breaks)
        with pytest.raises(OutputError, match="ConnectionError: lost"):
            put(folder, "d3")
    assert not memory.exists("/fleet/mon/job.json")


def test_what_is_not_of_a_batch_stays(fleet: str, memory: Any) -> None:
    memory.pipe("/other/notes.txt", b"mine")
    other = RemoteBatchFolder("memory://other")
    with pytest.raises(OutputError, match="memory://other: exists already, and is not"), other:
        pass
    memory.pipe("/fleet/mon/notes.txt", b"mine")
    with (
        RemoteBatchFolder(fleet) as folder,
        pytest.raises(OutputError, match=r"memory://fleet/mon: exists already, and holds 'notes"),
    ):
        folder.check_place("mon", force=True)
    assert memory.cat("/other/notes.txt") == b"mine"


def test_a_batch_that_did_nothing_leaves_nothing(memory: Any) -> None:
    def stopped() -> None:
        with RemoteBatchFolder("memory://new") as folder:
            folder.write({"summary.json": SUMMARY})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert memory.find("/new") == []
