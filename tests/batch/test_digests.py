from __future__ import annotations

import os
from pathlib import Path

import pytest

import caliv_graph
from caliv_graph.batch import digests
from caliv_graph.batch.digests import DigestCache, job_digest, job_inputs
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from tests.cli.commands import write_config, write_drive

OLD_S = 1_000_000_000


@pytest.fixture
def config(tmp_path: Path) -> Config:
    write_drive(tmp_path / "drive")
    return load_config(write_config(tmp_path / "config.yaml"))


@pytest.fixture(autouse=True)
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' files are new, and their digests shall be kept nevertheless."""
    monkeypatch.setattr(digests, "_SETTLED_NS", -1)


def digest(config: Config, cache: DigestCache | None = None, **more: Path) -> str:
    data = tuple(more[key] for key in ("data",) if key in more)
    inputs = job_inputs(config, data, more.get("prior"), more.get("out"))
    assert inputs is not None
    return job_digest(config, inputs, DigestCache() if cache is None else cache)


def test_it_depends_on_bytes_config_version_and_prior(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = digest(config)
    cloud = tmp_path / "drive/input/sensor_1/0.pcd"
    prior = tmp_path / "prior.yaml"
    prior.write_text("a")

    staged = config.model_copy(update={"solve": config.solve.model_copy(update={"mode": "staged"})})
    found = {before, digest(staged), digest(config, prior=prior)}
    prior.write_text("b")
    found.add(digest(config, prior=prior))
    cloud.write_bytes(cloud.read_bytes()[:-1] + b"\x01")
    found.add(digest(config))
    cloud.rename(cloud.with_name("7.pcd"))
    found.add(digest(config))
    monkeypatch.setattr(caliv_graph, "__version__", "0.1.1")
    found.add(digest(config))

    assert len(found) == 7


def test_it_does_not_depend_on_where_the_drive_lies_or_what_else_is_there(
    config: Config, tmp_path: Path
) -> None:
    before = digest(config)
    (tmp_path / "drive").rename(tmp_path / "moved")
    moved = tmp_path / "moved"
    (moved / "notes.txt").write_text("of somebody")
    (moved / "input/sensor_1/.0.pcd.swp").write_text("of an editor")
    (moved / "input/sensor_9").mkdir()
    (moved / "input/sensor_9/0.pcd").write_text("a LiDAR that the config does not have")

    assert digest(config, data=moved) == before


def test_a_bag_is_all_its_files_but_not_our_results(tmp_path: Path) -> None:
    config = load_config(write_config(tmp_path / "config.yaml", data={"path": "bag"}))
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("m")
    (bag / "part_0.mcap").write_text("0")
    before = digest(config, out=bag / "results")
    (bag / "results").mkdir()
    (bag / "results/summary.json").write_text("{}")
    (bag / ".Trash").mkdir()
    (bag / ".Trash/part_9.mcap").write_text("9")

    assert digest(config, out=bag / "results") == before
    (bag / "part_1.mcap").write_text("1")
    assert digest(config, out=bag / "results") != before


def test_the_order_of_drives_counts(config: Config, tmp_path: Path) -> None:
    second = write_drive(tmp_path / "second", frames=4)
    drives = (tmp_path / "drive", second)

    one, other = (job_inputs(config, d, None) for d in (drives, drives[::-1]))

    assert one is not None
    assert other is not None
    assert job_digest(config, one, DigestCache()) != job_digest(config, other, DigestCache())


@pytest.mark.parametrize("remove", ["drive", "drive/input/ego_poses.yaml"])
def test_a_drive_that_is_not_there_has_no_files(
    config: Config, tmp_path: Path, remove: str
) -> None:
    (tmp_path / remove).rename(tmp_path / "gone")

    assert job_inputs(config, (), None) is None


def test_files_are_read_once(config: Config, tmp_path: Path) -> None:
    cache = DigestCache()
    before = digest(config, cache)
    kept = DigestCache.parse(cache.dump())
    assert kept == cache
    inputs = job_inputs(config, (), None)
    assert inputs is not None
    assert inputs.known(kept)
    files = [file for file in inputs.files if isinstance(file, Path)]
    assert len(files) == len(inputs.files)
    for file in files:
        file.chmod(0)  # root may read them all the same, but the time of the change is another

    assert not inputs.known(kept)
    for file in files:
        file.chmod(0o644)
    assert digest(config, kept) == before


def test_a_change_that_hides_its_time_and_size_is_seen(config: Config, tmp_path: Path) -> None:
    cloud = tmp_path / "drive/input/sensor_1/0.pcd"
    os.utime(cloud, (OLD_S, OLD_S))
    cache = DigestCache()
    before = digest(config, cache)

    cloud.write_bytes(cloud.read_bytes()[:-1] + b"\x01")
    os.utime(cloud, (OLD_S, OLD_S))

    assert cache.known(cloud) is None
    assert digest(config, cache) != before


def test_what_was_just_written_is_not_kept(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(digests, "_SETTLED_NS", 3_000_000_000)
    cache = DigestCache()

    digest(config, cache)

    assert cache.entries == {}


@pytest.mark.parametrize("damage", ["", "{}", "[]", "null", "{" * 5000, "cut", "forged"])
def test_a_damaged_cache_is_none(config: Config, damage: str) -> None:
    cache = DigestCache()
    digest(config, cache)
    text = cache.dump()
    known = next(iter(cache.entries.values()))[1]
    damaged = {"cut": text[:-40], "forged": text.replace(known, "0" * 64)}.get(damage, damage)

    assert DigestCache.parse(damaged) == DigestCache()
