"""Reading PCD clouds: ascii, binary and binary_compressed.

The header is held against the file's size here, as no library does: Open3D 0.20 makes up points for
a cut-off ascii file and returns zeros for float64 coordinates; pypcd4 1.5 wants columns one space
apart and a COUNT line. The bodies are left to numpy and liblzf. The format:
https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lzf  # type: ignore[import-not-found]
import numpy as np
import numpy.typing as npt

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.errors import RecordingError
from caliv_graph.products import Array

_ENCODINGS = ("ascii", "binary", "binary_compressed")
_HEADER_KEYS = (
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT"),
    *("WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"),
)

_SCALAR_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
"""Bytes that a number of each TYPE may have."""

_COMPRESSED_SIZES = struct.Struct("<II")
"""Before a compressed body: its size and its size when unpacked, in bytes."""

_ADVICE_EMPTY = "Record the cloud again, or remove the file"

_PADDING = b"\0\t\n\r "
"""Bytes allowed after the last point: writers end with a newline or fill up a page."""


class _Unreadable(Exception):
    """A problem of a cloud, without its name, and the way out."""

    def __init__(self, what: str, advice: str = "Copy or export the cloud again") -> None:
        super().__init__(f"{what}. {advice}")


@dataclass(frozen=True)
class _Field:
    """One field of a point, of `count` numbers of `size` bytes; `kind` is F, I or U.

    The fields before it take `offset` bytes of a point and `column` numbers.
    """

    name: str
    kind: str
    size: int
    count: int
    offset: int
    column: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of a number. PCD has no mark for byte order: that of the machine, so little."""
        return np.dtype(f"<{self.kind.lower()}{self.size}")


@dataclass(frozen=True)
class _Header:
    """The expected content of the body: bytes and numbers of one point; and the header's size.

    Of the fields only those that are wanted; x, y and z come first.
    """

    fields: tuple[_Field, ...]
    points: int
    point_size: int
    columns: int
    encoding: str
    size: int


def read_pcd(path: Path) -> Array:
    """The x, y, z of `read_pcd_table`: (N, 3) float64, metres."""
    table = read_pcd_table(path)
    return np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64, order="C")


def read_pcd_table(path: Path, also: Sequence[str] = ()) -> npt.NDArray[np.void]:
    """Reads all points of a PCD file, NaN and zero returns included: (N,) with named fields.

    Float x, y, z (metres) may stand among its fields in any order. VIEWPOINT is not applied: as in
    PCL and Open3D, it is the place of the sensor, and the points are the sensor's. Of the fields
    that `also` names those that the file has are read, too, each of one number.

    Raises:
        RecordingError: the file is missing, empty, cut off or damaged, or has no x, y, z.
    """
    try:
        data = read_input(path)
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None
    try:
        header = _read_header(data, also)
        if header.encoding == "ascii":
            return _read_ascii(data, header)
        if header.encoding == "binary":
            return _read_binary(data, header)
        return _read_compressed(data, header)
    except _Unreadable as e:
        raise RecordingError(f"{path}: {e}") from None


def _read_header(data: bytes, also: Sequence[str]) -> _Header:
    if not data:
        raise _Unreadable("is empty (0 bytes)", _ADVICE_EMPTY)
    entries, size = _header_entries(data)
    encoding = " ".join(entries["DATA"])
    if encoding not in _ENCODINGS:
        raise _Unreadable(f"DATA is {encoding[:40]!r}, expected one of {', '.join(_ENCODINGS)}")
    fields = _fields(entries)
    width = _whole_number(entries, "WIDTH")
    height = _whole_number(entries, "HEIGHT") if "HEIGHT" in entries else 1
    points = _whole_number(entries, "POINTS") if "POINTS" in entries else width * height
    # Some writers leave WIDTH and HEIGHT at 0. The size of the body is held against POINTS below.
    if points != width * height and (width or height):
        raise _Unreadable(
            f"the header is damaged: POINTS is {points}, but WIDTH {width} x HEIGHT {height} is "
            f"{width * height}"
        )
    xyz = _coordinates(fields)
    names = [field.name for field in fields]
    others = [f for f in fields if f.name in also and f.count == names.count(f.name) == 1]
    if points == 0:
        raise _Unreadable("holds no points (POINTS 0)", _ADVICE_EMPTY)
    last = fields[-1]
    return _Header(
        fields=(*xyz, *others),
        points=points,
        point_size=last.offset + last.size * last.count,
        columns=last.column + last.count,
        encoding=encoding,
        size=size,
    )


def _header_entries(data: bytes) -> tuple[dict[str, list[str]], int]:
    """The values of each header line, and where the body starts."""
    entries: dict[str, list[str]] = {}
    end = 0
    number = 0
    while "DATA" not in entries:
        start, end = end, data.find(b"\n", end) + 1
        number += 1
        if end == 0:
            raise _Unreadable(
                f"the header has no complete DATA line in {len(data)} bytes: "
                "the file is cut off, or no PCD file"
            )
        line = data[start:end].decode("ascii", errors="replace").strip()
        if not line or line.startswith("#"):
            continue
        key, *values = line.split()
        if key not in _HEADER_KEYS or key in entries:
            what = "repeats an entry" if key in entries else "is no entry of a PCD header"
            raise _Unreadable(f"line {number} {what}: {line[:40]!r}")
        entries[key] = values
    return entries, end


def _fields(entries: dict[str, list[str]]) -> list[_Field]:
    names = _values(entries, "FIELDS")
    kinds = _values(entries, "TYPE")
    sizes = _values(entries, "SIZE")
    # Old writers leave COUNT out where every field is one number.
    counts = _values(entries, "COUNT") if "COUNT" in entries else ["1"] * len(names)
    for key, values in (("TYPE", kinds), ("SIZE", sizes), ("COUNT", counts)):
        if len(values) != len(names):
            raise _Unreadable(
                f"the header is damaged: {key} has {len(values)} values for {len(names)} FIELDS"
            )
    fields: list[_Field] = []
    offset = column = 0
    for name, kind, size_text, count_text in zip(names, kinds, sizes, counts, strict=True):
        size = _parse_whole_number(size_text, "SIZE")
        count = _parse_whole_number(count_text, "COUNT")
        if size not in _SCALAR_SIZES.get(kind, ()) or count < 1:
            raise _Unreadable(
                f"the header is damaged: field {name[:40]!r} has TYPE {kind[:40]!r}, SIZE {size}, "
                f"COUNT {count}"
            )
        fields.append(_Field(name, kind, size, count, offset, column))
        offset += size * count
        column += count
    return fields


def _coordinates(fields: list[_Field]) -> tuple[_Field, _Field, _Field]:
    names = [field.name for field in fields]
    for axis in "xyz":
        if names.count(axis) != 1:
            what = "has no field" if axis not in names else "has more than one field"
            raise _Unreadable(
                f"{what} '{axis}': its FIELDS are {' '.join(names)[:200]!r}",
                "Export the cloud with x, y and z in metres",
            )
        field = fields[names.index(axis)]
        if field.kind != "F" or field.count != 1:
            raise _Unreadable(
                f"field '{axis}' has TYPE {field.kind}, SIZE {field.size}, COUNT {field.count}",
                "Export x, y and z as one float (TYPE F) each, in metres",
            )
    x, y, z = (fields[names.index(axis)] for axis in "xyz")
    return x, y, z


def _values(entries: dict[str, list[str]], key: str) -> list[str]:
    values = entries.get(key)
    if not values:
        raise _Unreadable(f"the header is damaged: {key} is missing")
    return values


def _whole_number(entries: dict[str, list[str]], key: str) -> int:
    return _parse_whole_number(" ".join(_values(entries, key)), key)


def _parse_whole_number(text: str, key: str) -> int:
    # Nineteen digits hold any size a file can have; int() of thousands of digits raises.
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise _Unreadable(
            f"the header is damaged: {key} is {text[:40]!r}, expected a whole number, 0 or more"
        )
    return int(text)


def _check_end(data: bytes, end: int, declared: str) -> None:
    """Refuses a file whose body is not `end - header` bytes: its points would be made up."""
    if len(data) < end:
        raise _Unreadable(f"is cut off: {end} bytes expected ({declared}), {len(data)} found")
    if data[end:].strip(_PADDING):
        raise _Unreadable(
            f"has {len(data) - end} bytes too many: {end} bytes expected ({declared}), "
            f"{len(data)} found; the header does not belong to these data"
        )


def _read_binary(data: bytes, header: _Header) -> npt.NDArray[np.void]:
    _check_end(
        data,
        header.size + header.points * header.point_size,
        f"{header.points} points of {header.point_size} bytes",
    )
    record = np.dtype(
        {
            "names": [field.name for field in header.fields],
            "formats": [field.dtype for field in header.fields],
            "offsets": [field.offset for field in header.fields],
            "itemsize": header.point_size,
        }
    )
    return np.frombuffer(data, record, count=header.points, offset=header.size)


def _read_compressed(data: bytes, header: _Header) -> npt.NDArray[np.void]:
    """Reads fields that were stored one after another, all points of each, and LZF-compressed."""
    body = header.size + _COMPRESSED_SIZES.size
    _check_end(data[:body], body, "header and the sizes of the compressed data")
    packed_size, size = _COMPRESSED_SIZES.unpack_from(data, header.size)
    _check_end(data, body + packed_size, f"{packed_size} of them compressed")
    if size != header.points * header.point_size:
        raise _Unreadable(
            f"the header is damaged: {header.points} points of {header.point_size} bytes are "
            f"{header.points * header.point_size} bytes, but the data unpack to {size}"
        )
    try:
        unpacked: bytes | None = lzf.decompress(data[body : body + packed_size], size)
    except (ValueError, MemoryError):
        unpacked = None
    if unpacked is None or len(unpacked) != size:
        raise _Unreadable(
            f"the compressed data are damaged: {packed_size} bytes do not unpack to {size}"
        )
    return _table(
        {
            field.name: np.frombuffer(
                unpacked, field.dtype, header.points, header.points * field.offset
            )
            for field in header.fields
        }
    )


def _read_ascii(data: bytes, header: _Header) -> npt.NDArray[np.void]:
    try:
        text = data[header.size :].decode("ascii")
        # An empty body is a warning to loadtxt, and an error here.
        rows = np.loadtxt(io.StringIO(text), comments=None, ndmin=2) if text.strip() else None
    except ValueError as e:
        # Without numpy's advice on its own arguments.
        what = str(e).split("; use")[0].rstrip(".")
        raise _Unreadable(f"the points are damaged: {what}") from None
    found = 0 if rows is None else len(rows)
    if rows is None or found != header.points:
        raise _Unreadable(
            f"{header.points} points expected (POINTS), {found} found in {len(data)} bytes"
        )
    if rows.shape[1] != header.columns:
        raise _Unreadable(
            f"{header.columns} numbers expected per point (FIELDS, COUNT), {rows.shape[1]} found; "
            "the header does not belong to these data"
        )
    return _table({field.name: _of_type(rows[:, field.column], field) for field in header.fields})


def _of_type(numbers: Array, field: _Field) -> npt.NDArray[Any]:
    """Numbers of an ascii file in the type of their field; coordinates with all of their digits."""
    if field.name in ("x", "y", "z"):
        return numbers
    with np.errstate(invalid="ignore", over="ignore"):
        cast = numbers.astype(field.dtype)
    # A whole number that is none, or too large, stays as it is written.
    return cast if field.kind == "F" or np.array_equal(cast, numbers) else numbers


def _table(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.void]:
    count = len(next(iter(columns.values())))
    table = np.empty(count, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table
