"""The readers that fuzz.py tries, what they may answer, and how their inputs are changed."""

from __future__ import annotations

import contextlib
import math
import random
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from caliv_graph.batch.manifest import load_manifest
from caliv_graph.cli import streams
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import dump_config, load_config, parse_config
from caliv_graph.config.model import TopicsConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.export.consumers import export
from caliv_graph.export.edit import read_base
from caliv_graph.export.request import ImuExtrinsic, Request
from caliv_graph.products import LidarScan, MotionData, Recording
from caliv_graph.readers.bag import Bag, DamagedMessageError
from caliv_graph.readers.caliv_folder import CalivFolder
from caliv_graph.readers.discover import choose_lidar_topics, choose_motion_topics
from caliv_graph.readers.frames import FrameTree, read_urdf
from caliv_graph.readers.imu import ImuCollector, check_imu
from caliv_graph.readers.motion import GnssCollector, TwistCollector
from caliv_graph.readers.pcd import read_pcd
from caliv_graph.readers.pointcloud2 import (
    DecodedCloud,
    UnusableCloudsError,
    decode_livox,
    decode_pointcloud2,
)
from caliv_graph.readers.poses import PoseCollector, TfCollector
from caliv_graph.readers.rosbag import RosbagRecording
from caliv_graph.results.calibration_file import calibration_document, read_calibration_file
from caliv_graph.results.truth_file import read_truth
from caliv_graph.scenario.model import dump_scenario, load_scenario, parse_scenario
from scripts import _fuzz_seeds as seeds

MIN_RANGE_M, MAX_RANGE_M = 0.5, 100.0

one_line = streams.one_line
"""How the command line shows a message."""

Mutate = Callable[[bytes, int], bytes]
"""libFuzzer's own mutation: data, most bytes."""


@dataclass(frozen=True)
class Target:
    """A reader and its inputs.

    Attributes:
        make: given a folder of its own, returns what tries one input. That raises one of `refusals`
            if the reader refuses the input, AssertionError if the reader accepts what it must not,
            and anything else where the reader breaks.
        seeds: inputs to start from.
        kind: how inputs are changed: bytes, or yaml: also by value.
        refusals: how the reader may say no.
        most_bytes: of an input.
    """

    make: Callable[[Path], Callable[[bytes], None]]
    seeds: Callable[[Path], list[bytes]]
    kind: str = "bytes"
    refusals: tuple[type[Exception], ...] = (CalivError,)
    most_bytes: int = 4096


# ------------------------------------------------------------------ what is tried


def _config(folder: Path) -> Callable[[bytes], None]:
    path = folder / "config.yaml"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        config = load_config(path)
        _check_numbers(config.model_dump())
        text = dump_config(config)
        assert text.encode("utf-8")
        assert parse_config(yaml.safe_load(text), "dumped", folder) == config

    return attempt


def _manifest(folder: Path) -> Callable[[bytes], None]:
    path = folder / "manifest.yaml"
    here = folder.absolute()

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        jobs = load_manifest(path)
        # Every job has a folder of its own, in the batch's and nowhere else.
        folders = {(here / job.name).resolve() for job in jobs}
        assert len(folders) == len(jobs)
        assert all(found.parent == here.resolve() for found in folders)

    return attempt


def _scenario(folder: Path) -> Callable[[bytes], None]:
    path = folder / "scenario.yaml"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        scenario = load_scenario(path)
        _check_numbers(scenario.model_dump())
        text = dump_scenario(scenario)
        assert text.encode("utf-8")
        assert parse_scenario(yaml.safe_load(text), "dumped") == scenario

    return attempt


def _calibration(folder: Path) -> Callable[[bytes], None]:
    path = folder / "calibration.yaml"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        read = read_calibration_file(path)
        calibration = read.calibration
        for lidar in calibration.lidars.values():
            assert np.isfinite(lidar.T_vehicle_lidar.matrix()).all()
            assert lidar.scans_used >= 0
            assert lidar.time_offset is None or all(map(math.isfinite, lidar.time_offset))
        for cov in read.cov_pairs.values():
            assert np.isfinite(cov).all()
            assert cov.shape == (6, 6)
        # Raises if a number is not finite, or comes out so.
        calibration_document(calibration)

    return attempt


def _truth(folder: Path) -> Callable[[bytes], None]:
    path = folder / "truth.yaml"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        for T in read_truth(path).values():
            _check_rotation(T.rotation().matrix())
            assert np.isfinite(T.translation()).all()

    return attempt


def _poses(folder: Path) -> Callable[[bytes], None]:
    path = folder / "input" / "ego_poses.yaml"
    path.parent.mkdir()
    for sensor in ("sensor_1", "sensor_2"):
        (path.parent / sensor).mkdir()
        for frame, cloud in enumerate(seeds.pcd_files()[:2]):
            (path.parent / sensor / f"{frame}.pcd").write_bytes(cloud)
    lidars = {name: _lidar(f"sensor_{i}") for i, name in enumerate(("front", "rear"), start=1)}

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        _check_motion(CalivFolder(folder, lidars).motion())

    return attempt


def _pcd(folder: Path) -> Callable[[bytes], None]:
    path = folder / "0.pcd"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        points = read_pcd(path)
        assert points.dtype == np.float64
        assert points.ndim == 2
        assert points.shape[1] == 3
        # A point takes at least three characters or bytes; LZF packs 264 bytes into 3 at best.
        assert 1 <= len(points) <= 100 * len(data)

    return attempt


def _open_small_bag(folder: Path) -> Bag:
    return Bag(seeds.bag(folder, "mcap", seeds.TYPES))


def _pointcloud2(folder: Path) -> Callable[[bytes], None]:
    bag = _open_small_bag(folder)

    def attempt(data: bytes) -> None:
        stamp_ns = bag.header(data).stamp_ns
        message = bag.decode("/points", data)
        _check_cloud(decode_pointcloud2(message, stamp_ns, MIN_RANGE_M, MAX_RANGE_M))

    return attempt


def _livox(folder: Path) -> Callable[[bytes], None]:
    def attempt(data: bytes) -> None:
        raw, is_ros1 = data[1:], data[:1] == b"\1"
        _check_cloud(decode_livox(raw, is_ros1, seeds.START_NS, MIN_RANGE_M, MAX_RANGE_M))

    return attempt


_MOTION_TOPICS: Sequence[tuple[str, type[Any]]] = (
    ("/imu", ImuCollector),
    ("/fix", GnssCollector),
    ("/odom", PoseCollector),
    ("/odom", TwistCollector),
    ("/twist", TwistCollector),
    ("/pose", PoseCollector),
    ("/tf", TfCollector),
)


def _motion(folder: Path) -> Callable[[bytes], None]:
    bag = _open_small_bag(folder)

    def attempt(data: bytes) -> None:
        topic, collector_type = _MOTION_TOPICS[data[0] % len(_MOTION_TOPICS) if data else 0]
        collector = collector_type()
        raw = data[2:]
        count = 1 + (data[1] % 4 if len(data) > 1 else 0)
        size = -(-len(raw) // count)
        for i in range(count):
            part = raw[size * i : size * (i + 1)]
            stamp_ns = bag.header(part).stamp_ns if topic != "/tf" else seeds.START_NS
            collector.add(stamp_ns, bag.decode(topic, part))
        found = collector.finish()
        assert all(isinstance(note, str) for note in collector.notes())
        if found is None:
            raise DamagedMessageError("has no measurements")
        kind = {GnssCollector: "gnss", ImuCollector: "imu", TwistCollector: "twist"}
        _check_motion(MotionData("fuzz", **{kind.get(collector_type, "poses"): found}))

    return attempt


def _urdf(folder: Path) -> Callable[[bytes], None]:
    path = folder / "vehicle.urdf"

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        links = read_urdf(path)
        for link in links:
            _check_rotation(link.T_parent_child.rotation().matrix())
            assert np.isfinite(link.T_parent_child.translation()).all()
        tree = FrameTree(links)
        for frame in tree.frames:
            tree.transform("base_link", frame)

    return attempt


def _base(folder: Path) -> Callable[[bytes], None]:
    consumers = list(seeds.BASES)
    calibration = replace(seeds.small_calibration("front", "rear"), undetermined=())
    imu = ImuExtrinsic(calibration.lidars["rear"].T_vehicle_lidar, "config.yaml")

    def attempt(data: bytes) -> None:
        consumer = consumers[data[0] % len(consumers) if data else 0]
        path = folder / "old"
        path.write_bytes(data[1:])
        request = Request(
            calibration=calibration,
            source="calibration.yaml",
            lidars=("front",),
            out=folder / "new",
            imu=imu,
            base=read_base(path),
            topics={"front": "/points"},
        )
        made = export(consumer, request)
        text = made.content.decode("utf-8")
        # What was one document of its kind has to stay one.
        if consumer in ("autoware", "lio-sam", "fast-lio", "mola"):
            assert isinstance(yaml.compose(text), yaml.MappingNode)
        if consumer == "urdf" and _is_xml(data[1:]):
            ET.fromstring(text)

    return attempt


def _is_xml(data: bytes) -> bool:
    """Whether it is XML with namespaces, of which the export knows nothing."""
    try:
        ET.fromstring(data.decode("utf-8"))
    except (ET.ParseError, ValueError):
        return False
    return True


class _Stores:
    """Makes the decoders of a definition once: to make them is most of what reading a bag takes.

    A definition that was changed is another one, and its decoders are made.
    """

    def __init__(self) -> None:
        self._make = Bag._typestore
        self._made: dict[tuple[bool, str, str], Typestore] = {}

    def __call__(self, bag: Bag, type_name: str) -> Typestore:
        key = (bag.is_ros1, type_name, str(bag._definitions[type_name].data))
        if key not in self._made:
            store = self._make(bag, type_name)
            if len(self._made) > 200:
                self._made.clear()
            self._made[key] = store
        return self._made[key]


def _make_decoders_once() -> None:
    stores = _Stores()

    def made_once(self: Bag, type_name: str) -> Typestore:
        return stores(self, type_name)

    Bag._typestore = made_once  # type: ignore[method-assign]


def _bag(suffix: str) -> Callable[[Path], Callable[[bytes], None]]:
    def make(folder: Path) -> Callable[[bytes], None]:
        path = folder / f"drive.{suffix}"
        _make_decoders_once()

        def attempt(data: bytes) -> None:
            path.write_bytes(data)
            _read_bag(path)

        return attempt

    return make


def _read_bag(path: Path) -> None:
    """All that is ever read of a bag: what it is, its motion, its clouds."""
    bag = Bag(path)
    choose_lidar_topics(bag)
    chosen = choose_motion_topics(bag).chosen
    lidars = {"front": _lidar("/points")}
    recording: Recording = RosbagRecording(path, lidars, TopicsConfig(**chosen))
    _check_motion(recording.motion())
    stamps = recording.scan_stamps_ns("front")
    assert list(stamps) == sorted(set(stamps))
    for scan in recording.scans("front"):
        _check_scan(scan)
    assert all(isinstance(line, str) for line in recording.warnings())


def _metadata(folder: Path) -> Callable[[bytes], None]:
    bag = seeds.bag(folder, "mcap", ["/points", "/imu"])
    path = bag.parent / "metadata.yaml"
    _make_decoders_once()

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        _read_bag(path.parent)

    return attempt


def _metadata_seeds(folder: Path) -> list[bytes]:
    bag = seeds.bag(folder, "mcap", ["/points", "/imu"])
    return [(bag.parent / "metadata.yaml").read_bytes()]


# ------------------------------------------------------------------ what has to hold


def _lidar(topic: str) -> LidarConfig:
    return LidarConfig(
        topic=topic,
        initial=PoseConfig(xyz=(0.0, 0.0, 0.0)),
        min_range=MIN_RANGE_M,
        max_range=MAX_RANGE_M,
    )


def _check_numbers(value: Any) -> None:
    """No NaN and no infinity, however deep."""
    if isinstance(value, Mapping):
        for item in value.values():
            _check_numbers(item)
    elif isinstance(value, list | tuple):
        for item in value:
            _check_numbers(item)
    elif isinstance(value, float):
        assert math.isfinite(value)


def _check_rotation(R: Any) -> None:
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(R) > 0.0


def _check_stamps(stamps_ns: Any) -> None:
    assert stamps_ns.dtype == np.int64
    assert (np.diff(stamps_ns.astype(object)) > 0).all()


def _check_motion(motion: MotionData) -> None:
    """Stamps ascend, and what is measured is finite; covariances may be unknown."""
    if motion.poses is not None:
        _check_stamps(motion.poses.stamps_ns)
        for T in motion.poses.T_map_vehicle:
            _check_rotation(T.rotation().matrix())
            assert np.isfinite(T.translation()).all()
    if motion.imu is not None:
        _check_stamps(motion.imu.stamps_ns)
        assert np.isfinite(motion.imu.specific_force).all()
        assert np.isfinite(motion.imu.angular_velocity).all()
        check_imu(motion.imu)
    if motion.gnss is not None:
        _check_stamps(motion.gnss.stamps_ns)
        assert (np.abs(motion.gnss.latitude_deg) <= 90.0).all()
        assert np.isfinite(motion.gnss.altitude_m).all()
    if motion.twist is not None:
        _check_stamps(motion.twist.stamps_ns)
        assert np.isfinite(motion.twist.velocity).all()


def _check_points(points: Any, times_s: Any) -> None:
    assert points.ndim == 2
    assert points.shape[1] == 3
    assert np.isfinite(points).all()
    ranges = np.linalg.norm(points, axis=1)
    assert ((ranges >= MIN_RANGE_M - 1e-9) & (ranges <= MAX_RANGE_M + 1e-9)).all()
    if times_s is not None:
        assert times_s.shape == (len(points),)
        assert (np.abs(times_s) <= 1.0).all()


def _check_cloud(cloud: DecodedCloud) -> None:
    _check_points(cloud.points_lidar, cloud.times_s)


def _check_scan(scan: LidarScan) -> None:
    _check_points(scan.points_lidar, scan.point_times_s)


# ------------------------------------------------------------------ how inputs change


VALUES: Sequence[bytes] = (
    *(b".nan", b".inf", b"-.inf", b"1e308", b"-1e308", b"1e-320", b"0.0", b"-0.0", b"0", b"-1"),
    *(b"1" + b"0" * 30, b"1" + b"0" * 400, b'""', b"x", b"1e5", b"nan", b'"1e999"', b"1:30:15"),
    *(b"../../etc/passwd", b"/", b'"a\\nb"', b'"\\e[31m"', b'"\\0"', b'"\\x85"', b'"\\u2028"'),
    *(b"<script>alert(1)</script>", b"'{{7*7}}'", b'"' + b"\xc3\xa9" * 300 + b'"', b"=cmd()"),
    *(b"~", b"true", b"[]", b"{}", b"[[]]", b"{? ''}", b"[~, ~]", b"!!binary /wA=", b"[1, 1, 1]"),
)

FACTORS: Sequence[float] = (-1.0, 1e-3, 1e3, 57.3, 1e160, 1e-160, 1.001, 2.0)

SNIPPETS: Sequence[bytes] = (
    *(
        b"&a ",
        b"*a",
        b"<<: *a\n",
        b"<<: {}\n",
        b"!!python/object/apply:os.system [ls]",
        b"? ",
        b"- ",
    ),
    *(b"!!binary ", b"!!set ", b"!!timestamp ", b"!!float ", b"!!int ", b"!!str ", b"!x "),
    *(b"[" * 40, b"{" * 40, b"- " * 40, b"\xef\xbb\xbf", b"\xff\xfe", b"\x00", b"%YAML 9.9\n---\n"),
    *(
        b"---\n",
        b"...\n",
        b"\t",
        b"|\n",
        b">\n",
        b"2001-99-99",
        b"0x",
        b"0b2",
        b"1_0",
        b"'",
        b'"\\ud800"',
    ),
    *(
        b"&a [*a]",
        b"&a {a: *a}",
        b"9" * 5000,
        b"1e",
        b".nan",
        b"-.inf",
        b"#",
        b"\r",
        b"\xe2\x80\xa8",
    ),
)


def change_yaml(
    data: bytes, most_bytes: int, seed: int, mutate: Mutate, valid: Sequence[bytes]
) -> bytes:
    """Changes a YAML file: mostly a value or a line of it, else its bytes.

    Args:
        data: what was found to lead somewhere new.
        most_bytes: of the result.
        seed: of the choice.
        mutate: libFuzzer's own way.
        valid: files that are accepted: every third change is of one of them, for what is refused
            early hides what comes later.
    """
    rng = random.Random(seed)
    if rng.random() < 0.33:
        data = rng.choice(valid)
    choice = rng.random()
    if choice < 0.6:
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            data = _change_token(data, rng)
    elif choice < 0.75:
        data = _change_lines(data, rng)
    elif choice < 0.9:
        at = rng.randrange(len(data) + 1)
        stop = at + rng.choice((0, 0, 1, 8))
        data = data[:at] + rng.choice(SNIPPETS) + data[stop:]
    else:
        return mutate(data, most_bytes)
    return data[:most_bytes]


_TOKEN = re.compile(rb"[^\s\[\]{},:]+")


def _change_token(data: bytes, rng: random.Random) -> bytes:
    """Puts something else in the place of a value or a key."""
    found = _TOKEN.search(data, rng.randrange(len(data) + 1))
    if found is None:
        return data
    new = rng.choice(VALUES)
    if rng.random() < 0.5:
        with contextlib.suppress(ValueError):
            new = repr(float(found[0]) * rng.choice(FACTORS)).encode()
    return data[: found.start()] + new + data[found.end() :]


def _change_lines(data: bytes, rng: random.Random) -> bytes:
    """Leaves a line out, or puts it in once more."""
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    line = rng.choice(lines)
    if rng.random() < 0.5:
        lines.remove(line)
    else:
        lines.insert(rng.randrange(len(lines) + 1), line)
    return b"".join(lines)


# ------------------------------------------------------------------ the list


def _of(*texts: Callable[[], str]) -> Callable[[Path], list[bytes]]:
    return lambda folder: [text().encode() for text in texts]


def _motion_seeds(folder: Path) -> list[bytes]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    made = seeds.messages(store)
    inputs = []
    for index, (topic, _) in enumerate(_MOTION_TOPICS):
        raw = [bytes(store.serialize_cdr(m, seeds.TYPES[topic])) for _, m in made[topic]]
        inputs.append(bytes([index, len(raw) - 1]) + b"".join(raw))
        inputs.append(bytes([index, 0]) + raw[0])
    return inputs


def _bag_seeds(*kinds: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        inputs = []
        for number, topics in enumerate((["/points", "/imu", "/fix"], ["/points", "/twist"])):
            for kind in kinds:
                place = folder / f"{kind}{number}"
                place.mkdir()
                inputs.append(seeds.bag(place, kind, topics).read_bytes())
        return inputs

    return make


def _base_seeds(folder: Path) -> list[bytes]:
    return [bytes([i]) + text.encode() for i, text in enumerate(seeds.BASES.values())]


TARGETS: Mapping[str, Target] = {
    "config": Target(_config, _of(seeds.config_text), "yaml"),
    "manifest": Target(_manifest, _of(seeds.manifest_text), "yaml"),
    "scenario": Target(
        _scenario,
        _of(seeds.scenario_text),
        "yaml",
    ),
    "calibration": Target(
        _calibration,
        _of(
            lambda: seeds.calibration_text("front"),
            lambda: seeds.calibration_text("front", "rear"),
        ),
        "yaml",
        most_bytes=32768,
    ),
    "truth": Target(
        _truth,
        _of(seeds.truth_text),
        "yaml",
    ),
    "poses": Target(
        _poses,
        _of(seeds.poses_text),
        "yaml",
    ),
    "pcd": Target(_pcd, lambda folder: seeds.pcd_files()),
    "pointcloud2": Target(
        _pointcloud2,
        lambda folder: seeds.clouds(get_typestore(Stores.ROS2_HUMBLE)),
        refusals=(DamagedMessageError, UnusableCloudsError),
    ),
    "livox": Target(
        _livox,
        lambda folder: seeds.livox(),
        refusals=(DamagedMessageError,),
    ),
    "motion": Target(_motion, _motion_seeds, refusals=(DamagedMessageError,)),
    "urdf": Target(_urdf, lambda folder: [seeds.URDF.encode()]),
    "base": Target(_base, _base_seeds),
    "mcap": Target(_bag("mcap"), _bag_seeds("mcap", "zstd"), most_bytes=32768),
    "sqlite3": Target(_bag("db3"), _bag_seeds("db3"), most_bytes=65536),
    "ros1": Target(_bag("bag"), _bag_seeds("bag"), most_bytes=32768),
    "metadata": Target(_metadata, _metadata_seeds, "yaml"),
}
