"""ROS 1 and ROS 2 bags through `rosbags`: topics, raw messages, and one kind of error.

The readers of `rosbags` for one file read here. Its `AnyReader` refuses a bag for one damaged
message definition, also of a topic that nobody reads (rslidar_sdk of RoboSense records such, issue
38), needs the metadata.yaml of a folder, yields no message of a topic whose QoS differs between
metadata.yaml and the file, and opens a small bag in 130 ms instead of 45 ms.
"""

from __future__ import annotations

import struct
import weakref
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from caliv_graph.common.inputs import unreadable
from caliv_graph.config.load import read_yaml
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.readers.definitions import DEFINITIONS

_Reader = Reader1 | Reader2

BAG_SUFFIXES = (".bag", ".mcap", ".db3")

_METADATA = "metadata.yaml"

_LATEST_NS = 2**62
"""Of a record time: the year 2116. The difference of two such times fits 64 bits."""

_RECOVERY = {
    ".mcap": "Recover it with 'mcap recover', or record the drive again",
    ".bag": "Recover it with 'rosbag reindex', or record the drive again",
    ".db3": "Recover it with 'sqlite3 FILE .recover', or record the drive again",
}

_BEGINNINGS = {
    ".mcap": ("an MCAP file", b"\x89MCAP0\r\n"),
    ".bag": ("a bag of ROS 1", b"#ROS"),
    ".db3": ("an SQLite database", b"SQLite format 3\x00"),
}
"""What a file of each suffix is, and what it begins with."""


@dataclass(frozen=True)
class Topic:
    """One topic of a bag; `type` in ROS 2 spelling, such as sensor_msgs/msg/Imu."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class Header:
    """The `std_msgs/Header` that a message begins with; a stamp that was not set is 0."""

    stamp_ns: int
    frame_id: str


class DamagedMessageError(Exception):
    """A message does not decode as its type. The caller decides what follows."""


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file by its name, a folder by what it holds."""
    if path.is_dir():
        return (path / _METADATA).is_file() or any(
            entry.suffix in BAG_SUFFIXES for entry in path.iterdir()
        )
    return path.suffix in BAG_SUFFIXES


class Bag:
    """A recorded bag: a ROS 2 folder (MCAP or sqlite3), a bare .mcap or .db3, ROS 1 .bag file(s).

    Opening a bag reads only its index. Messages come out raw: of most, only the stamp is needed.
    """

    def __init__(self, path: Path) -> None:
        """Opens a file; or the folder of a ROS 2 bag, or of the parts of a split bag.

        Raises:
            RecordingError: it is missing, not a bag, damaged, or in a form that is not supported.
        """
        self._path = path
        self._files = _find_files(path)
        self._is_ros1 = _is_ros1(self._files[0])
        self._stores: dict[str, Typestore] = {}
        # Readers between two passes: opening one may unpack or scan the whole bag.
        self._idle: list[list[_Reader]] = []
        weakref.finalize(self, _close_all, self._idle)
        self._definitions: dict[str, MessageDefinition] = {}
        found: dict[str, Topic] = {}
        with self._readers() as readers:
            filled = [reader for reader in readers if reader.message_count]
            self._span_ns = (
                min((reader.start_time for reader in filled), default=0),
                max((reader.end_time for reader in filled), default=0),
            )
            for connection in (c for reader in readers for c in reader.connections):
                self._definitions.setdefault(connection.msgtype, connection.msgdef)
                before = found.get(connection.topic)
                if before and before.type != connection.msgtype:
                    raise RecordingError(
                        f"{path}: topic '{before.name}' holds messages of two types, "
                        f"{before.type} and {connection.msgtype}. Split the bag by type"
                    )
                count = connection.msgcount + (before.messages if before else 0)
                found[connection.topic] = Topic(connection.topic, connection.msgtype, count)
        self._topics = dict(sorted(found.items()))

    @property
    def name(self) -> str:
        """The path as given."""
        return str(self._path)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name, in alphabetical order."""
        return self._topics

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last record time, nanoseconds; zeros if the bag is empty."""
        return self._span_ns

    @property
    def is_ros1(self) -> bool:
        """Whether messages are serialised as in ROS 1; else CDR."""
        return self._is_ros1

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Raw messages of some topics, in the order of their record times within each file.

        Yields topic, record time in nanoseconds and the serialised message; with `start_ns` only
        those recorded at or after it, with `stop_ns` only those before it.

        Raises:
            RecordingError: the bag is damaged.
        """
        if not topics:
            return
        with self._readers() as readers:
            for reader in readers:
                wanted = [c for c in reader.connections if c.topic in topics]
                if not wanted or (stop_ns is not None and reader.start_time >= stop_ns):
                    continue
                if start_ns is not None and reader.end_time < start_ns:
                    continue
                with self._errors_named(reader.path):
                    source = reader.messages(wanted, start_ns, stop_ns)
                while True:
                    # Not around the yield: an error of the caller is no damage of the bag.
                    with self._errors_named(reader.path):
                        message = next(source, None)
                        if message is None:
                            break
                        _check_time(message[1])
                        if message[0].topic not in topics:
                            raise ValueError(f"{message[0].topic} has the number of another topic")
                        if not isinstance(message[2], bytes | bytearray | memoryview):
                            raise ValueError(f"a message of {message[0].topic} is not bytes")
                    yield message[0].topic, message[1], message[2]

    def first_message(self, topic: str) -> bytes | None:
        """The first message of a topic, serialised; None if it has none.

        Raises:
            RecordingError: the bag is damaged.
        """
        for _, _, raw in self.messages([topic]):
            return raw
        return None

    def decode(self, topic: str, raw: bytes) -> Any:
        """A message as an object with the fields of its type. Arrays are views into `raw`.

        Raises:
            DamagedMessageError: it does not decode as its type.
            RecordingError: its type is not known.
        """
        type_name = self._topics[topic].type
        store = self._stores.get(type_name)
        if store is None:
            store = self._stores[type_name] = self._typestore(type_name)
        try:
            if self._is_ros1:
                return store.deserialize_ros1(raw, type_name)
            return store.deserialize_cdr(raw, type_name)
        except Exception as e:  # the generated decoder may raise any
            raise DamagedMessageError(str(e)) from None

    def header(self, raw: bytes) -> Header:
        """The header of a message whose type begins with one.

        By hand: a decoder of `rosbags` takes a whole message, and most clouds are only looked at.

        Raises:
            DamagedMessageError: the message is cut off.
        """
        try:
            if self._is_ros1:
                _, seconds, nanoseconds, size = struct.unpack_from("<IIII", raw)
                start, end = 16, 16 + size
            else:
                order = "<" if raw[1] else ">"
                # The string's size counts a zero at its end.
                seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", raw, 4)
                start, end = 16, 15 + size
        except (struct.error, IndexError):
            raise DamagedMessageError("is cut off in its header") from None
        if end > len(raw):
            raise DamagedMessageError("is cut off in its header")
        frame_id = bytes(raw[start:end]).decode("utf-8", "replace")
        return Header(seconds * NANOSECONDS_PER_SECOND + nanoseconds, frame_id)

    def _typestore(self, type_name: str) -> Typestore:
        store = _typestore(self._definitions[type_name], type_name, self._is_ros1)
        if store is None:
            what = f"{self._path}: holds no definition of the type {type_name}"
            raise RecordingError(what, "Record it with its package sourced, or as another type")
        return store

    @contextmanager
    def _readers(self) -> Iterator[list[_Reader]]:
        """Open readers for one pass: each has a position in its file, and two passes may run."""
        readers = self._idle.pop() if self._idle else self._open()
        try:
            yield readers
        except RecordingError:
            _close(readers)
            raise
        except BaseException:
            self._idle.append(readers)
            raise
        self._idle.append(readers)

    def _open(self) -> list[_Reader]:
        readers: list[_Reader] = []
        try:
            for file in self._files:
                with self._errors_named(file):
                    reader = Reader1(file) if _is_ros1(file) else Reader2(file)
                    reader.open()
                    readers.append(reader)
                    _check_index(reader)
        except BaseException:
            _close(readers)
            raise
        readers.sort(key=lambda reader: reader.start_time)
        return readers

    @contextmanager
    def _errors_named(self, file: Any) -> Iterator[None]:
        """Turns any error of `rosbags` in a damaged file into one line."""
        try:
            yield
        except RecordingError:
            raise
        except OSError as e:
            raise RecordingError(f"{file}: {unreadable(e)}") from None
        except Exception as e:  # struct.error, KeyError, MemoryError of a size gone wrong, ...
            if other := _of_another_kind(Path(file)):
                raise RecordingError(f"{file}: {other}") from None
            said = " ".join(str(e).split()).rstrip(".") or type(e).__name__
            advice = _RECOVERY.get(Path(file).suffix, "Record the drive again, or recover the bag")
            if "empty" in said:
                advice = "Record the drive again"
            elif "Profile is not ros2" in said:
                advice = "Convert it with 'rosbags-convert', or give the original bag"
            raise RecordingError(
                f"{file}: the bag is cut off, damaged or of an unsupported kind "
                f"({type(e).__name__}: {said}). {advice}"
            ) from None


def _of_another_kind(file: Path) -> str | None:
    """What is wrong with a file that never was what its suffix says; None: it may have been."""
    what, begins_with = _BEGINNINGS.get(file.suffix, ("", b""))
    with suppress(OSError), file.open("rb") as opened:
        begins = opened.read(len(begins_with))
        # A file may be cut off there, or hold zeros where a recorder was stopped.
        if begins.strip(b"\x00") and not begins_with.startswith(begins):
            return f"is not {what}: it begins with {begins!r}. Give the recording's own file"
    return None


def _close(readers: list[_Reader]) -> None:
    while readers:
        with suppress(Exception):
            readers.pop().close()


def _close_all(idle: list[list[_Reader]]) -> None:
    for readers in idle:
        _close(readers)


def _check_index(reader: _Reader) -> None:
    """Raises ValueError for values that `rosbags` reads from a damaged file without a check."""
    for connection in reader.connections:
        names = (connection.topic, connection.msgtype)
        if not all(isinstance(name, str) for name in names):
            raise ValueError(f"a topic is {names[0]!r} of type {names[1]!r}")
    if reader.message_count:
        _check_time(reader.start_time)
        _check_time(reader.end_time)


def _check_time(record_ns: Any) -> None:
    """Raises ValueError if a record time is not a time, or so late that differences overflow."""
    if not isinstance(record_ns, int) or not 0 <= record_ns < _LATEST_NS:
        raise ValueError(f"a message was recorded at {str(record_ns)[:40]} ns")


@lru_cache(maxsize=64)
def _typestore(definition: MessageDefinition, type_name: str, is_ros1: bool) -> Typestore | None:
    """Types of a topic: as the bag defines them, else as the current ROS does.

    Kept: reading the standard types and writing decoders takes as long as opening a bag.
    """
    store = get_typestore(Stores.EMPTY)
    # A standard type does not need its definition: a damaged one is ignored.
    with suppress(Exception):
        if definition.format == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(definition.data, type_name))
        elif definition.format == MessageDefinitionFormat.IDL:
            # One file, or all that it needs: for each a rule, `IDL: its name`, and the file.
            for part in filter(None, definition.data.split(f"{'=' * 80}\n")):
                named = part.startswith("IDL: ")
                store.register(get_types_from_idl(part.partition("\n")[2] if named else part))
    standard = _standard(is_ros1)
    if type_name in store.fielddefs and _has_all_fields(store, standard):
        return store
    if type_name in standard.fielddefs:
        return standard
    if type_name not in DEFINITIONS:
        return None
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


@lru_cache
def _standard(is_ros1: bool) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)


def _has_all_fields(store: Typestore, standard: Typestore) -> bool:
    """Whether types with the name of a standard one have its fields, which the code needs."""
    return all(
        {field for field, _ in standard.fielddefs[name][1]} <= {field for field, _ in fields}
        for name, (_, fields) in store.fielddefs.items()
        if name in standard.fielddefs
    )


def _is_ros1(path: Path) -> bool:
    """Whether one of `_find_files` is a ROS 1 bag; a folder is a ROS 2 bag, by any name."""
    return path.suffix == ".bag" and path.is_file()


def _find_files(path: Path) -> list[Path]:
    """The paths for `rosbags` to open: the files of a bag, or its folder."""
    try:
        if not path.exists():
            raise RecordingError(
                f"{path}: no such file or folder. Set data.path (or --data) to a bag"
            )
        if path.is_dir():
            return _find_files_in(path)
        if not path.is_file():
            raise RecordingError(f"{path}: is a pipe or a device. Give a bag on a disk")
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None
    if path.suffix not in BAG_SUFFIXES:
        packed = path.suffix in (".zst", ".zstd", ".gz", ".lz4", ".active")
        hint = " Unpack it first" if packed else ""
        raise RecordingError(
            f"{path}: is not a bag by its name: expected {', '.join(BAG_SUFFIXES)}, or the "
            f"folder of a ROS 2 bag.{hint}"
        )
    return [path]


def _find_files_in(folder: Path) -> list[Path]:
    metadata = folder / _METADATA
    if metadata.is_file():
        return _listed_files(metadata)
    # Without metadata: of a recorder that crashed, or a split ROS 1 bag.
    files = sorted(
        entry for entry in folder.iterdir() if entry.suffix in BAG_SUFFIXES and entry.is_file()
    )
    if not files:
        caliv = (folder / "input").is_dir() or (folder / "ego_poses.yaml").is_file()
        hint = "For a CaLiV folder set data.format: caliv" if caliv else "Give the folder of a bag"
        raise RecordingError(f"{folder}: holds no bag ({', '.join(BAG_SUFFIXES)}). {hint}")
    if len({file.suffix for file in files}) > 1:
        raise RecordingError(
            f"{folder}: holds bags of several kinds ({files[0].name}, {files[-1].name}). Give one "
            "of them"
        )
    return files


def _listed_files(metadata: Path) -> list[Path]:
    try:
        information = read_yaml(metadata, RecordingError)["rosbag2_bagfile_information"]
        names = [Path(name).name for name in information["relative_file_paths"]]
        packed = information.get("compression_mode", "").lower() in ("file", "message")
    except (RecordingError, LookupError, TypeError, AttributeError):
        raise RecordingError(
            f"{metadata}: is not the description of a ROS 2 bag. Make it anew with "
            "'ros2 bag reindex', or give the .mcap or .db3 itself"
        ) from None
    missing = [name for name in names if not (metadata.parent / name).is_file()]
    if missing or not names:
        raise RecordingError(
            f"{metadata}: names the file '{', '.join(missing) or 'none'}', which is not there. "
            "Copy the bag completely, or make the description anew with 'ros2 bag reindex'"
        )
    if packed:
        return [metadata.parent]  # only as a folder does `rosbags` unpack it
    # File by file: of a folder, `rosbags` yields no message of a topic whose QoS differs between
    # the description and the file.
    return [metadata.parent / name for name in names]
