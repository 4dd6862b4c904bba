from __future__ import annotations

import errno
import os
import signal
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from caliv_graph.common.files import (
    atomic_write,
    check_output_file,
    check_output_folder,
    output_folder,
)
from caliv_graph.errors import OutputError

CONTENT = ("calibration.yaml", "target_[0-9]*.ply", "log.jsonl")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_result(path: Path, text: str = "new", force: bool = False) -> None:
    with output_folder(path, CONTENT, force) as folder:
        (folder / "calibration.yaml").write_text(text)
        (folder / "log.jsonl").write_text(text)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    path = tmp_path / "result"
    write_result(path, "old")
    return path


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


def test_a_file_is_written_with_its_folders(tmp_path: Path) -> None:
    atomic_write(tmp_path / "a/b/file.yaml", "text\n")

    assert (tmp_path / "a/b/file.yaml").read_text() == "text\n"
    assert names(tmp_path / "a/b") == ["file.yaml"]


def test_a_file_is_replaced_only_with_force(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    atomic_write(path, "old")

    with pytest.raises(OutputError) as caught:
        atomic_write(path, "new")

    assert str(caught.value) == f"{path}: exists already. Give --force to replace it"
    assert path.read_text() == "old"
    atomic_write(path, "new", force=True)
    assert path.read_text() == "new"
    assert names(tmp_path) == ["file.yaml"]


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder"):
        atomic_write(tmp_path, "text", force=True)


@pytest.mark.usefixtures("umask")
def test_permissions_are_the_usual_ones(tmp_path: Path) -> None:
    atomic_write(tmp_path / "file", "text")
    write_result(tmp_path / "result")

    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o644
    assert stat.S_IMODE((tmp_path / "result").stat().st_mode) == 0o755
    assert stat.S_IMODE((tmp_path / "result/log.jsonl").stat().st_mode) == 0o644


def test_a_link_is_followed(tmp_path: Path, result: Path) -> None:
    (tmp_path / "link").symlink_to(result)

    write_result(tmp_path / "link", "new", force=True)

    assert (tmp_path / "link").is_symlink()
    assert (result / "log.jsonl").read_text() == "new"


def test_a_folder_appears_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a/result"

    with output_folder(path, CONTENT) as folder:
        (folder / "calibration.yaml").write_text("text")
        assert not path.exists()

    assert names(path) == ["calibration.yaml"]
    assert names(tmp_path / "a") == ["result"]


def test_an_empty_folder_is_filled_without_force(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()

    write_result(tmp_path / "result")

    assert names(tmp_path / "result") == ["calibration.yaml", "log.jsonl"]
    assert names(tmp_path) == ["result"]


@pytest.mark.parametrize("problem", [ValueError, KeyboardInterrupt])
def test_what_fails_leaves_nothing_behind(tmp_path: Path, problem: type[BaseException]) -> None:
    def fail() -> None:
        with output_folder(tmp_path / "a/b/result", CONTENT) as folder:
            (folder / "calibration.yaml").write_text("half")
            raise problem

    with pytest.raises(problem):
        fail()

    assert names(tmp_path) == []


def test_what_fails_leaves_the_old_result(tmp_path: Path, result: Path) -> None:
    def fail() -> None:
        with output_folder(result, CONTENT, force=True) as folder:
            (folder / "calibration.yaml").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()

    assert names(tmp_path) == ["result"]
    assert (result / "calibration.yaml").read_text() == "old"


def test_a_result_is_replaced_only_with_force(tmp_path: Path, result: Path) -> None:
    with pytest.raises(OutputError) as caught:
        write_result(result)

    assert str(caught.value) == (
        f"{result}: exists already. Give --force to replace it, or another --out"
    )
    (result / "target_2.ply").write_text("old")
    write_result(result, force=True)
    assert names(result) == ["calibration.yaml", "log.jsonl"]
    assert (result / "log.jsonl").read_text() == "new"
    assert names(tmp_path) == ["result"]


def test_a_folder_that_is_no_result_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home/log.jsonl").write_text("mine")

    with pytest.raises(
        OutputError, match=r"holds no calibration\.yaml and is not a result of this"
    ):
        write_result(tmp_path / "home", force=True)

    assert (tmp_path / "home/log.jsonl").read_text() == "mine"


def test_what_others_put_into_a_result_is_never_deleted(result: Path) -> None:
    (result / "notes.txt").write_text("mine")

    with pytest.raises(OutputError, match=r"also holds 'notes\.txt'"):
        write_result(result, force=True)

    assert (result / "notes.txt").read_text() == "mine"
    assert (result / "calibration.yaml").read_text() == "old"


def test_a_result_may_have_subfolders(tmp_path: Path) -> None:
    path, content = tmp_path / "drive", ("truth.yaml", "clouds/sensor_*/[0-9]*.pcd")
    for text in ("old", "new"):
        with output_folder(path, content, force=True) as folder:
            (folder / "clouds/sensor_1").mkdir(parents=True)
            (folder / "clouds/sensor_1/7.pcd").write_text(text)
            (folder / "truth.yaml").write_text(text)
            (folder / "clouds/sensor_2").mkdir()

    assert (path / "clouds/sensor_1/7.pcd").read_text() == "new"
    assert names(path) == ["clouds", "truth.yaml"]
    assert names(path / "clouds") == ["sensor_1", "sensor_2"]
    assert names(tmp_path) == ["drive"]


@pytest.mark.parametrize(
    "mine",
    ["clouds/notes.txt", "clouds/sensor_1/map.pcd", "clouds/sensor_1/7.pcd/1.pcd", "sensor_1/"],
)
def test_what_others_put_into_a_subfolder_is_never_deleted(tmp_path: Path, mine: str) -> None:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive/truth.yaml").write_text("old")
    path = tmp_path / "drive" / mine
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir() if mine.endswith("/") else path.write_text("mine")
    content = ("truth.yaml", "clouds/sensor_*/[0-9]*.pcd")

    with (
        pytest.raises(OutputError, match="also holds '"),
        output_folder(tmp_path / "drive", content, force=True),
    ):
        pass

    assert path.exists()


def test_a_link_in_a_result_is_not_followed(tmp_path: Path, result: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    content = (*CONTENT, "clouds/[0-9]*.pcd")
    (result / "clouds").symlink_to(tmp_path / "mine")

    with pytest.raises(OutputError, match="also holds 'clouds'"):
        check_output_folder(result, content, force=True)

    (result / "target_2.ply").symlink_to(tmp_path / "mine")
    (result / "clouds").unlink()
    write_result(result, force=True)
    assert (tmp_path / "mine/notes.txt").read_text() == "mine"


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "result").write_text("mine")

    with pytest.raises(OutputError, match="is a file"):
        write_result(tmp_path / "result", force=True)


def test_the_current_folder_is_not_replaced(result: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(result)

    with pytest.raises(OutputError, match="the current folder"):
        write_result(Path(), force=True)


def test_a_failing_swap_brings_the_old_result_back(
    tmp_path: Path, result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError(errno.EBUSY, "Device or resource busy", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)

    with pytest.raises(OutputError, match="cannot be written: Device or resource busy"):
        write_result(result, force=True)

    assert names(tmp_path) == ["result"]
    assert (result / "calibration.yaml").read_text() == "old"


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)

    for write in (write_result, lambda path: atomic_write(path, "text")):
        with pytest.raises(OutputError) as caught:
            write(tmp_path / "a/result")
        assert str(caught.value) == (
            f"{tmp_path}/a/result: cannot be written: No space left on device. Nothing was "
            "changed; give another --out"
        )
    assert names(tmp_path) == []


def test_a_file_of_a_folder_is_named_where_it_will_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def write(path: Path) -> None:
        with output_folder(path, CONTENT) as folder:
            atomic_write(folder / "calibration.yaml", "text")

    monkeypatch.setattr(os, "fsync", full)

    with pytest.raises(OutputError) as caught:
        write(tmp_path / "result")

    assert str(caught.value) == (
        f"{tmp_path}/result/calibration.yaml: cannot be written: No space left on device. Nothing "
        "was changed; give another --out"
    )


def test_a_place_that_takes_no_files_is_said_before_the_work() -> None:
    # Nobody, not even root, can make a folder there.
    with pytest.raises(OutputError, match=r"^/proc/nowhere/result: cannot be written"):
        write_result(Path("/proc/nowhere/result"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)

    with pytest.raises(OutputError, match="no permission to write in"):
        check_output_folder(tmp_path / "locked/result", CONTENT)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """What runs in the background of a shell without job control has SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_does_not_split_the_swap(
    tmp_path: Path, result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def interrupted(self: Path, target: Path) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)

    write_result(result, force=True)

    assert names(tmp_path) == ["result"]
    assert (result / "calibration.yaml").read_text() == "new"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_links_in_a_circle_and_files_on_the_way(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_text("mine")

    for check in (check_output_file, lambda path: check_output_folder(path, CONTENT)):
        with pytest.raises(OutputError, match="links in a circle"):
            check(tmp_path / "loop" / "result")
        with pytest.raises(OutputError, match="file is not a folder"):
            check(tmp_path / "file" / "a" / "result")
        with pytest.raises(OutputError, match=r"^/proc/result: cannot be written"):
            check(Path("/proc/result"))
        check(tmp_path / "new" / "result")
    assert names(tmp_path) == ["file", "loop"]


def test_force_replaces_no_input(tmp_path: Path) -> None:
    drive, config = tmp_path / "drive", tmp_path / "config.yaml"
    bag = drive / "drive.mcap"
    drive.mkdir()
    for file in (bag, config):
        file.write_text("mine")
    (tmp_path / "link").symlink_to(bag)
    inputs = [drive, None, config]

    for out in (bag, tmp_path / "link"):
        with pytest.raises(OutputError, match=r"it is part of .*drive, which this command reads"):
            check_output_file(out, True, inputs)
    with pytest.raises(OutputError, match=r"it is what this command reads. Give another name"):
        check_output_file(config, True, inputs)
    # What is not there cannot be lost: a config may lie beside the clouds that it is of.
    check_output_file(drive / "config.yaml", False, inputs)


def test_a_result_that_is_read_is_not_replaced(tmp_path: Path, result: Path) -> None:
    earlier = result / "calibration.yaml"
    with pytest.raises(OutputError, match=r"holds .*calibration.yaml, which this command reads"):
        check_output_folder(result, CONTENT, True, [None, earlier])
    check_output_folder(result, CONTENT, True, [tmp_path / "elsewhere.yaml"])
