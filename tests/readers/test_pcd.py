"""Files are made by hand here, byte by byte: no writer vouches for the reader."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.errors import RecordingError
from caliv_graph.readers.pcd import read_pcd, read_pcd_table

POINTS = np.array([[1.5, -2.25, 0.125], [10.0, 20.0, -30.0], [0.1, 0.2, 0.3], [7.0, 8.0, 9.0]])

HEADER = {
    "VERSION": "0.7",
    "FIELDS": "x y z",
    "SIZE": "4 4 4",
    "TYPE": "F F F",
    "COUNT": "1 1 1",
    "WIDTH": "4",
    "HEIGHT": "1",
    "VIEWPOINT": "0 0 0 1 0 0 0",
    "POINTS": "4",
    "DATA": "binary",
}

# A point with everything that readers trip over: another order, one- and two-byte numbers, a
# field of three, padding, coordinates of both sizes.
MIXED = {
    "FIELDS": "ring z _ x rgb y",
    "SIZE": "2 4 1 8 4 4",
    "TYPE": "U F U F U F",
    "COUNT": "1 1 3 1 1 1",
}
MIXED_COLUMNS = (
    np.array([1, 2, 3, 65535], dtype="<u2"),
    POINTS[:, 2].astype("<f4"),
    np.full((4, 3), 255, dtype="u1"),
    POINTS[:, 0].astype("<f8"),
    np.full(4, 4278190335, dtype="<u4"),
    POINTS[:, 1].astype("<f4"),
)


def header(**changed: str | None) -> bytes:
    """The header with some entries changed or (None) left out; DATA is the last, as it must be."""
    entries = {**HEADER, **changed}
    entries["DATA"] = entries.pop("DATA")
    lines = ["# .PCD v0.7 - Point Cloud Data file format"]
    lines += [f"{key} {value}" for key, value in entries.items() if value is not None]
    return ("\n".join(lines) + "\n").encode()


def binary_body(dtype: str = "<f4") -> bytes:
    return POINTS.astype(dtype).tobytes()


def ascii_body(separator: str = " ", end: str = "\n") -> bytes:
    return "".join(separator.join(map(str, point)) + end for point in POINTS.tolist()).encode()


def compressed_body(unpacked: bytes) -> bytes:
    """LZF's simplest stream: literal runs of up to 32 bytes, each after its length less one."""
    runs = [unpacked[i : i + 32] for i in range(0, len(unpacked), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    return struct.pack("<II", len(packed), len(unpacked)) + packed


def write(folder: Path, *parts: bytes) -> Path:
    path = folder / "17.pcd"
    path.write_bytes(b"".join(parts))
    return path


def error_of(path: Path) -> str:
    """The message: one line that begins with the file and ends with what to do."""
    with pytest.raises(RecordingError) as caught:
        read_pcd(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__ or caught.value.__context__ is None
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_binary_points_are_float64_as_written(tmp_path: Path, dtype: str) -> None:
    size = dtype[-1]
    path = write(tmp_path, header(SIZE=f"{size} {size} {size}"), binary_body(dtype))
    points = read_pcd(path)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, POINTS.astype(dtype))


def test_binary_with_other_order_sizes_and_padding(tmp_path: Path) -> None:
    rows = b"".join(
        b"".join(column[i].tobytes() for column in MIXED_COLUMNS) for i in range(len(POINTS))
    )
    points = read_pcd(write(tmp_path, header(**MIXED), rows))
    np.testing.assert_array_equal(points[:, 0], POINTS[:, 0])
    np.testing.assert_array_equal(points[:, 1:], POINTS[:, 1:].astype("<f4"))


def test_compressed_fields_are_stored_one_after_another(tmp_path: Path) -> None:
    columns = b"".join(column.tobytes() for column in MIXED_COLUMNS)
    path = write(tmp_path, header(**MIXED, DATA="binary_compressed"), compressed_body(columns))
    points = read_pcd(path)
    np.testing.assert_array_equal(points[:, 0], POINTS[:, 0])
    np.testing.assert_array_equal(points[:, 1:], POINTS[:, 1:].astype("<f4"))


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed", "ascii"])
def test_fields_that_are_asked_for_have_their_types(tmp_path: Path, encoding: str) -> None:
    count = len(POINTS)
    whole = np.array([2**40 + k for k in range(count)], "<u8")
    columns = {
        "t": whole,
        **{axis: POINTS[:, i].astype("<f8") for i, axis in enumerate("xyz")},
        "rgb": np.ones(count, "<f4"),
        "time": np.arange(count).astype("<i4"),
    }
    fields = {
        "FIELDS": " ".join(columns),
        "SIZE": "8 8 8 8 4 4",
        "TYPE": "U F F F F I",
        "COUNT": "1 1 1 1 1 1",
        "DATA": encoding,
    }
    rows = list(zip(*columns.values(), strict=True))
    body = {
        "binary": b"".join(b"".join(v.tobytes() for v in row) for row in rows),
        "binary_compressed": compressed_body(b"".join(c.tobytes() for c in columns.values())),
        "ascii": "".join(" ".join(str(v) for v in row) + "\n" for row in rows).encode(),
    }[encoding]

    table = read_pcd_table(write(tmp_path, header(**fields), body), ("time", "t", "timestamp"))

    assert table.dtype.names == ("x", "y", "z", "t", "time")
    assert [table[name].dtype.str for name in ("t", "time")] == ["<u8", "<i4"]
    np.testing.assert_array_equal(table["t"], whole)
    np.testing.assert_array_equal(table["time"], np.arange(count))
    np.testing.assert_array_equal(table["x"], POINTS[:, 0])


def test_compressed_back_reference(tmp_path: Path) -> None:
    """Two points (1, 2, 3): each coordinate is a literal of 4 bytes, then those 4 once more."""
    packed = b"".join(
        b"\x03" + struct.pack("<f", value) + b"\x40\x03"  # (4 - 2) << 5, distance 4 - 1
        for value in (1.0, 2.0, 3.0)
    )
    path = write(
        tmp_path,
        header(WIDTH="2", POINTS="2", DATA="binary_compressed"),
        struct.pack("<II", len(packed), 24),
        packed,
    )
    np.testing.assert_array_equal(read_pcd(path), [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("separator", "end"),
    [(" ", "\n"), ("  ", "\n"), ("\t", "\n"), (" ", " \n"), (" ", "\r\n"), (" ", "\n\n")],
    ids=["space", "aligned", "tab", "trailing space", "windows", "blank lines"],
)
def test_ascii_whitespace(tmp_path: Path, separator: str, end: str) -> None:
    path = write(tmp_path, header(DATA="ascii"), ascii_body(separator, end))
    np.testing.assert_array_equal(read_pcd(path), POINTS)


def test_ascii_with_other_order_and_fields_of_several_numbers(tmp_path: Path) -> None:
    rows = "".join(f"3 {z} 7 8 9 {x} 4278190335 {y}\n" for x, y, z in POINTS.tolist())
    path = write(tmp_path, header(**MIXED, DATA="ascii"), rows.encode())
    np.testing.assert_array_equal(read_pcd(path), POINTS)


def test_ascii_nan_and_a_single_point(tmp_path: Path) -> None:
    path = write(tmp_path, header(WIDTH="1", POINTS="1", DATA="ascii"), b"nan -nan 1e-3\n")
    np.testing.assert_array_equal(read_pcd(path), [[np.nan, np.nan, 0.001]])


def test_organised_cloud_is_a_list_of_points(tmp_path: Path) -> None:
    path = write(tmp_path, header(WIDTH="2", HEIGHT="2"), binary_body())
    np.testing.assert_array_equal(read_pcd(path), POINTS.astype("<f4"))


def test_a_width_and_height_of_zero_leave_the_points_to_points(tmp_path: Path) -> None:
    plain = read_pcd(write(tmp_path, header(), binary_body()))
    path = write(tmp_path, header(WIDTH="0", HEIGHT="0"), binary_body())

    np.testing.assert_array_equal(read_pcd(path), plain)
    error_of(write(tmp_path, header(WIDTH="0", HEIGHT="0", POINTS="5"), binary_body()))
    error_of(write(tmp_path, header(WIDTH="0", HEIGHT="1"), binary_body()))


def test_header_of_an_old_writer(tmp_path: Path) -> None:
    """No VERSION, COUNT, VIEWPOINT, HEIGHT, POINTS; Windows line ends, a comment, a blank line."""
    old = header(VERSION=None, COUNT=None, VIEWPOINT=None, HEIGHT=None, POINTS=None)
    old = old.replace(b"WIDTH", b"\n# made by hand\nWIDTH").replace(b"\n", b"\r\n")
    np.testing.assert_array_equal(
        read_pcd(write(tmp_path, old, binary_body())), POINTS.astype("<f4")
    )


def test_nan_and_zero_returns_are_kept(tmp_path: Path) -> None:
    """Which points are returns is for the reader of the recording to say."""
    raw = np.array([[np.nan, 0, 0], [0, 0, 0], [np.inf, 1, 1], [1, 2, 3]], dtype="<f4")
    np.testing.assert_array_equal(read_pcd(write(tmp_path, header(), raw.tobytes())), raw)


@pytest.mark.parametrize("padding", [b"\n", bytes(4096)], ids=["newline", "page of zeros"])
def test_padding_after_the_points_is_nothing(tmp_path: Path, padding: bytes) -> None:
    path = write(tmp_path, header(), binary_body(), padding)
    np.testing.assert_array_equal(read_pcd(path), POINTS.astype("<f4"))


@pytest.mark.parametrize("missing", [1, 12, 47, 48])
def test_cut_off_binary_names_both_sizes(tmp_path: Path, missing: int) -> None:
    whole = header() + binary_body()
    message = error_of(write(tmp_path, whole[:-missing]))
    assert f"{len(whole)} bytes expected" in message
    assert f"{len(whole) - missing} found" in message
    assert message.endswith("Copy or export the cloud again")


def test_cut_off_at_any_byte_of_a_compressed_file(tmp_path: Path) -> None:
    whole = header(DATA="binary_compressed") + compressed_body(binary_body())
    for size in range(len(whole)):
        error_of(write(tmp_path, whole[:size]))
    body = len(header(DATA="binary_compressed"))
    message = error_of(write(tmp_path, whole[: body + 30]))
    assert f"{len(whole)} bytes expected" in message
    assert f"{body + 30} found" in message


@pytest.mark.filterwarnings("error")
def test_cut_off_ascii_counts_the_points(tmp_path: Path) -> None:
    rows = ascii_body().splitlines(keepends=True)
    message = error_of(write(tmp_path, header(DATA="ascii"), *rows[:3]))
    assert "4 points expected (POINTS), 3 found" in message
    assert "4 points expected (POINTS), 0 found" in error_of(write(tmp_path, header(DATA="ascii")))
    error_of(write(tmp_path, header(DATA="ascii"), *rows[:3], b"7.0 8.0"))


def test_data_that_the_header_does_not_declare(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, header(WIDTH="3", POINTS="3"), binary_body()))
    assert "12 bytes too many" in message
    message = error_of(write(tmp_path, header(DATA="ascii"), ascii_body(), b"1 2 3\n"))
    assert "4 points expected (POINTS), 5 found" in message
    rgb = ascii_body(end=" 7\n")
    message = error_of(write(tmp_path, header(DATA="ascii"), rgb))
    assert "3 numbers expected per point" in message
    assert "4 found" in message


def test_ascii_point_that_is_no_number(tmp_path: Path) -> None:
    body = ascii_body().replace(b"20.0", b"2o.0")
    message = error_of(write(tmp_path, header(DATA="ascii"), body))
    assert "2o.0" in message
    assert "usecols" not in error_of(write(tmp_path, header(DATA="ascii"), ascii_body(), b"1 2\n"))


def test_damaged_compressed_data(tmp_path: Path) -> None:
    good = compressed_body(binary_body())
    # A back reference to before the beginning.
    message = error_of(
        write(tmp_path, header(DATA="binary_compressed"), good[:8], b"\xff\xff\xff", good[11:])
    )
    assert "do not unpack to 48" in message
    other = struct.pack("<II", len(good) - 8, 96) + good[8:]
    message = error_of(write(tmp_path, header(DATA="binary_compressed"), other))
    assert "48 bytes" in message
    assert "unpack to 96" in message
    # One run fewer than declared: it unpacks, but to less.
    short = compressed_body(binary_body()[:32])
    message = error_of(
        write(
            tmp_path,
            header(DATA="binary_compressed"),
            struct.pack("<II", len(short) - 8, 48),
            short[8:],
        )
    )
    assert "do not unpack to 48" in message


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"WIDTH": "four"}, "WIDTH is 'four', expected a whole number"),
        ({"WIDTH": "-4"}, "WIDTH is '-4', expected a whole number"),
        ({"POINTS": "9" * 5000}, "POINTS is '999"),
        ({"WIDTH": None}, "WIDTH is missing"),
        ({"FIELDS": None}, "FIELDS is missing"),
        ({"SIZE": None}, "SIZE is missing"),
        ({"TYPE": None}, "TYPE is missing"),
        ({"POINTS": "5"}, "POINTS is 5, but WIDTH 4 x HEIGHT 1 is 4"),
        ({"SIZE": "4 4"}, "SIZE has 2 values for 3 FIELDS"),
        ({"TYPE": "F F F F"}, "TYPE has 4 values for 3 FIELDS"),
        ({"COUNT": "1 1"}, "COUNT has 2 values for 3 FIELDS"),
        ({"SIZE": "4 4 3"}, "field 'z' has TYPE 'F', SIZE 3"),
        ({"TYPE": "F Q F"}, "field 'y' has TYPE 'Q'"),
        ({"COUNT": "1 1 0"}, "field 'z' has TYPE 'F', SIZE 4, COUNT 0"),
        ({"FIELDS": "x y w"}, "has no field 'z': its FIELDS are 'x y w'"),
        ({"FIELDS": "x y y"}, "more than one field 'y'"),
        ({"TYPE": "I F F"}, "Export x, y and z as one float"),
        ({"COUNT": "1 2 1"}, "field 'y' has TYPE F, SIZE 4, COUNT 2"),
        ({"DATA": "zip"}, "DATA is 'zip', expected one of ascii, binary, binary_compressed"),
        ({"DATA": None}, "no complete DATA line"),
        ({"COLOUR": "red"}, "no entry of a PCD header: 'COLOUR red'"),
        ({"WIDTH": "200000000000", "POINTS": "200000000000"}, "2400000000186 bytes expected"),
    ],
)
def test_damaged_header(tmp_path: Path, changed: dict[str, str | None], said: str) -> None:
    assert said in error_of(write(tmp_path, header(**changed), binary_body()))


def test_header_line_twice(tmp_path: Path) -> None:
    path = write(tmp_path, b"WIDTH 4\n", header(), binary_body())
    assert "repeats an entry: 'WIDTH 4'" in error_of(path)


def test_empty_clouds(tmp_path: Path) -> None:
    assert "is empty (0 bytes)" in error_of(write(tmp_path))
    message = error_of(write(tmp_path, header(WIDTH="0", HEIGHT="0", POINTS="0")))
    assert "holds no points (POINTS 0)" in message


def test_what_is_no_pcd_file(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, b"\x89PNG\r\n\x1a\n", bytes(range(256))))
    assert "line 1 is no entry of a PCD header" in message
    assert "no complete DATA line in 300000 bytes" in error_of(write(tmp_path, b"#" * 300_000))
    missing = tmp_path / "18.pcd"
    assert "No such file" in error_of(missing)
    assert "directory" in error_of(tmp_path)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_any_damage_gives_an_error_or_points(tmp_path: Path, encoding: str) -> None:
    """Never another exception: that would be a defect of ours, reported as one."""
    bodies = {
        "ascii": ascii_body(),
        "binary": binary_body(),
        "binary_compressed": compressed_body(binary_body()),
    }
    whole = header(DATA=encoding) + bodies[encoding]
    rng = np.random.default_rng(17)
    read = 0
    messages = []
    for _ in range(1000):
        damaged = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        try:
            points = read_pcd(write(tmp_path, bytes(damaged)))
        except RecordingError as e:
            messages.append(str(e))
        else:
            assert points.shape[0] >= 1
            assert points.shape[1] == 3
            read += 1
    assert read
    assert messages
    # One line, and nothing of the file that a terminal would obey.
    assert [message for message in messages if not message.isprintable()] == []
