"""Names of frames, housings and the sensor kit from a recording and its /tf_static."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from caliv_graph.errors import ExportError
from caliv_graph.readers.bag import Bag, DamagedMessageError
from caliv_graph.readers.frames import FrameTransform, clean_frame, message_transforms


@dataclass(frozen=True)
class RecordedFrames:
    """The frames of a recording.

    Attributes:
        clouds: per LiDAR the frame of its clouds.
    """

    clouds: Mapping[str, str]
    links: tuple[FrameTransform, ...]
    start_ns: int

    def housing(self, lidar: str) -> FrameTransform | None:
        """`T_housing_lidar`, if the parent of the LiDAR's frame is a `<sensor>_base_link`."""
        frame = self.clouds.get(lidar)
        for link in reversed(self.links):
            if link.child == frame:
                is_housing = link.parent.endswith("_base_link")
                return link if is_housing else None
        return None


def read_frames(path: Path, topics: Mapping[str, str]) -> RecordedFrames:
    """Reads the frames of the bag at `path`; `topics` has per LiDAR the topic of its clouds.

    Raises:
        RecordingError: the path is not a bag, or the bag is damaged.
        ExportError: the bag has neither /tf_static nor clouds of the LiDARs.
    """
    bag = Bag(path)
    links: list[FrameTransform] = []
    static = [name for name in bag.topics if name.rpartition("/")[2] == "tf_static"]
    for topic, _, raw in bag.messages(static):
        try:
            links += [link for _, link in message_transforms(bag.decode(topic, raw))]
        except DamagedMessageError:
            continue
    clouds = {}
    for lidar, topic in topics.items():
        raw_cloud = bag.first_message(topic) if topic in bag.topics else None
        try:
            frame = "" if raw_cloud is None else clean_frame(bag.header(raw_cloud).frame_id)
        except DamagedMessageError:
            frame = ""
        if frame:
            clouds[lidar] = frame
    if not links and not clouds:
        raise ExportError(
            f"{path}: has neither /tf_static nor one of the LiDARs' topics. Give the drive as "
            "--bag, or leave it out"
        )
    return RecordedFrames(clouds, tuple(links), bag.span_ns[0])
