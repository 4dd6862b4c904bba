"""URDF: a new file, or an existing URDF or xacro with new origins of its joints."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import gtsam
import numpy as np

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import Edit, line_end, spliced
from caliv_graph.export.frames import match_frame
from caliv_graph.export.request import (
    DEFAULT_VEHICLE_FRAME,
    FRAME_OPTIONS,
    Base,
    Consumer,
    Export,
    Request,
    Transform,
    check_names,
)
from caliv_graph.export.text import notice, numbers, rpy, with_xml, without_notice
from caliv_graph.readers.frames import VEHICLE_FRAMES, FrameTransform, FrameTree


def export(request: Request) -> Export:
    """A URDF with a fixed joint per LiDAR: from the vehicle frame, or as in `--base`.

    Raises:
        ExportError: `--base` is not a URDF, or has no joint of a LiDAR that can be changed.
    """
    if request.base is None:
        return _new(request)
    return _Robot(request.base).with_extrinsics(request)


def _new(request: Request) -> Export:
    transforms = request.vehicle_transforms("URDF joint.")
    check_names("urdf", transforms)
    names = (request.parent, *(transform.child for transform in transforms))
    lines = [f"  <link name={quoteattr(name)}/>" for name in names]
    for transform in transforms:
        lines += [
            f'  <joint name={quoteattr(f"{transform.child}_joint")} type="fixed">',
            f"    <parent link={quoteattr(transform.parent)}/>",
            f"    <child link={quoteattr(transform.child)}/>",
            f'    <origin xyz="{_xyz(transform)}" rpy="{_rpy(transform)}"/>',
            "  </joint>",
        ]
    text = (
        '<?xml version="1.0"?>\n'
        f"{with_xml(notice(request, transforms))}"
        '<robot name="vehicle">\n' + "\n".join(lines) + "\n</robot>\n"
    )
    return Export(text.encode(), transforms)


def _xyz(transform: Transform) -> str:
    return numbers(transform.T_parent_child.translation())


def _rpy(transform: Transform) -> str:
    return numbers(rpy(transform.T_parent_child))


@dataclass
class _Joint:
    """A joint of the file, with the positions of its tags in the text."""

    name: str
    kind: str
    line: int
    tag: int
    parent: str = ""
    child: str = ""
    origin: int | None = None
    xyz: str = "0 0 0"
    rpy: str = "0 0 0"
    from_block: bool = False

    def pose(self) -> gtsam.Pose3 | None:
        """`T_parent_child`; None if the origin has expressions of xacro instead of numbers."""
        try:
            x, y, z = (float(value) for value in self.xyz.split())
            roll, pitch, yaw = (float(value) for value in self.rpy.split())
        except ValueError:
            return None
        if not all(map(math.isfinite, (x, y, z, roll, pitch, yaw))):
            return None
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([x, y, z]))


class _Robot:
    """The joints of a URDF or xacro, with their positions in the text."""

    def __init__(self, base: Base) -> None:
        self._path, self._text = base.path, without_notice(base.text)
        self._bytes = self._text.encode()
        self._is_ascii = self._text.isascii()
        self._joints: list[_Joint] = []
        self._links: list[str] = []
        self._stack: list[_Joint | None] = []
        self._root: tuple[str, int] | None = None
        # The file was read as UTF-8, whatever encoding it declares.
        self._parser = expat.ParserCreate("utf-8")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype
        try:
            self._parser.Parse(self._bytes, True)
        except (expat.ExpatError, ValueError) as e:
            raise ExportError(
                f"{self._path}: is not valid XML: {e}. Correct it there, or give another --base"
            ) from None
        if self._root is None or self._root[0] != "robot":
            found = self._root[0] if self._root else ""
            raise ExportError(
                f"{self._path}: its root is <{found}>, expected <robot>: give the URDF as --base"
            )
        # Transmissions and ros2_control have joint elements, too, without parent and child.
        self._joints = [joint for joint in self._joints if joint.parent and joint.child]

    def _doctype(self, *_: object) -> None:
        # Entities can expand to gigabytes, and a URDF has none.
        raise ExportError(f"{self._path}: has a DOCTYPE, which a URDF does not need. Remove it")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        at = self._index()
        if self._root is None:
            self._root = (name, at)
        joint = self._stack[-1] if self._stack else None
        self._stack.append(self._joint(name, attributes, at))
        if name == "link" and joint is None:
            self._links.append(attributes.get("name", ""))
        elif joint is not None:
            if name == "parent":
                joint.parent = attributes.get("link", "")
            elif name == "child":
                joint.child = attributes.get("link", "")
            elif name == "origin":
                joint.origin = at
                joint.xyz = attributes.get("xyz", joint.xyz)
                joint.rpy = attributes.get("rpy", joint.rpy)
            elif name.startswith("xacro:"):
                joint.from_block = True

    def _index(self) -> int:
        """Index of the current character; the parser counts bytes."""
        at = self._parser.CurrentByteIndex
        return at if self._is_ascii else len(self._bytes[:at].decode())

    def _joint(self, name: str, attributes: dict[str, str], at: int) -> _Joint | None:
        """The joint that begins here: a joint element, or the call of a sensor's macro; else None.

        Macros of sensors take a parent, a name and the origin of the housing `<name>_base_link`.
        """
        joint = None
        line = self._parser.CurrentLineNumber
        if name == "joint":
            joint = _Joint(attributes.get("name", ""), attributes.get("type", ""), line, at)
        elif name.startswith("xacro:") and "parent" in attributes and "name" in attributes:
            child = f"{attributes['name']}_base_link"
            joint = _Joint(name, "fixed", line, at, attributes["parent"], child)
        if joint is not None:
            self._joints.append(joint)
        return joint

    def _end(self, _: str) -> None:
        self._stack.pop()

    def with_extrinsics(self, request: Request) -> Export:
        """The file with the new extrinsics in the joints of the LiDARs."""
        vehicle, warnings = self._vehicle_frame(request)
        joints = {name: self._joint_of(name, request) for name in request.lidars}
        shared = [name for name in joints if list(joints.values()).count(joints[name]) > 1]
        if shared:
            child = joints[shared[0]].child
            raise ExportError(
                f"{self._path}: link '{child}' belongs to LiDARs {', '.join(shared)}. Give --frame "
                "NAME=LINK for each"
            )
        tree = {joint.child: self._link(joint) for joint in self._joints if joint.pose()}
        transforms, edits = [], []
        # A joint below that of another LiDAR comes later, since its parent moves.
        for name in sorted(joints, key=lambda name: self._depth(joints[name])):
            joint = joints[name]
            T_vehicle_parent = self._parent_pose(joint, vehicle, tree, request)
            transform = Transform(
                name,
                joint.parent,
                joint.child,
                T_vehicle_parent.between(request.T_vehicle_child(name)),
                f"URDF joint '{joint.name}'.",
            )
            tree[joint.child] = FrameTransform(joint.parent, joint.child, transform.T_parent_child)
            transforms.append(transform)
            edits.append(self._edit(joint, transform))
        assert self._root is not None
        comment = with_xml(notice(request, transforms)).replace("\n", line_end(self._text))
        edits.append(Edit(self._root[1], self._root[1], comment))
        return Export(spliced(self._text, edits).encode(), tuple(transforms), warnings)

    def _vehicle_frame(self, request: Request) -> tuple[str, tuple[str, ...]]:
        frames = [*self._links, *(joint.parent for joint in self._joints)]
        if request.vehicle_frame:
            if request.vehicle_frame not in frames:
                raise ExportError(
                    f"{self._path}: has no link '{request.vehicle_frame}'. Give --vehicle-frame "
                    f"one of {_listed(frames)}"
                )
            return request.vehicle_frame, ()
        known = [frame for frame in VEHICLE_FRAMES if frame in frames]
        if known:
            return known[0], ()
        children = {joint.child for joint in self._joints}
        roots = list(dict.fromkeys(frame for frame in frames if frame not in children))
        if len(roots) != 1:
            raise ExportError(
                f"{self._path}: the vehicle frame is unknown: no link is named "
                f"'{DEFAULT_VEHICLE_FRAME}'. Give --vehicle-frame one of {_listed(frames)}"
            )
        return roots[0], (
            f"{self._path}: has no link '{DEFAULT_VEHICLE_FRAME}': its root '{roots[0]}' is used "
            "as the vehicle frame. Give --vehicle-frame LINK if it is another",
        )

    def _joint_of(self, lidar: str, request: Request) -> _Joint:
        children = [joint.child for joint in self._joints]
        frame = request.frame_among(lidar, children)
        if frame is None:
            frame = match_frame(lidar, children, housing=lidar in request.housings)
        found = [joint for joint in self._joints if joint.child == frame]
        if not found:
            missing = f"link '{frame}'" if frame else "link with a similar name"
            if frame is None and lidar not in request.housings:
                housing = match_frame(lidar, children, housing=True)
                if housing:
                    raise ExportError(
                        f"{self._path}: LiDAR '{lidar}': '{housing}' is the frame of a housing. "
                        f"Give --housing {lidar}=x,y,z,roll,pitch,yaw, the LiDAR's frame in the "
                        "housing"
                    )
            raise ExportError(
                f"{self._path}: LiDAR '{lidar}': no joint leads to a {missing}. Joints lead to "
                f"{_listed(children)}. Give --frame {lidar}=LINK, or --lidar to leave it out"
            )
        joint = found[0]
        where = f"{self._path}: joint '{joint.name}' in line {joint.line}"
        if len(found) > 1:
            raise ExportError(
                f"{where}: another joint, in line {found[1].line}, also leads to link '{frame}'. "
                "Remove one"
            )
        if joint.kind != "fixed":
            raise ExportError(
                f"{where}: is of type '{joint.kind}', but an extrinsic is fixed. Give --frame "
                f"{lidar}=LINK of a fixed joint"
            )
        is_call_without_origin = joint.name.startswith("xacro:") and joint.origin is None
        if joint.from_block or is_call_without_origin:
            raise ExportError(
                f"{where}: its origin comes from a block of the xacro. Write an <origin> there, or "
                "expand the xacro first: 'xacro FILE > vehicle.urdf'"
            )
        return joint

    def _depth(self, joint: _Joint) -> int:
        up = {other.child: other.parent for other in self._joints}
        frame, depth = joint.parent, 0
        while frame in up and depth <= len(up):
            frame, depth = up[frame], depth + 1
        return depth

    def _parent_pose(
        self, joint: _Joint, vehicle: str, tree: dict[str, FrameTransform], request: Request
    ) -> gtsam.Pose3:
        """`T_vehicle_parent` of a joint."""
        if joint.parent == vehicle:
            return gtsam.Pose3()
        if joint.parent in request.parents:
            return request.parents[joint.parent]
        T = FrameTree(tree.values()).transform(vehicle, joint.parent)
        if T is not None:
            return T
        raise ExportError(
            f"{self._path}: joint '{joint.name}' in line {joint.line}: fixed joints with numbers "
            f"do not lead from '{vehicle}' to its parent '{joint.parent}'. Give --parent "
            f"'{joint.parent}=x,y,z,roll,pitch,yaw', its pose in '{vehicle}'"
        )

    def _link(self, joint: _Joint) -> FrameTransform:
        pose = joint.pose()
        # A movable joint does not connect frames.
        if pose is None or joint.kind != "fixed":
            return FrameTransform(joint.child, joint.child, gtsam.Pose3())
        return FrameTransform(joint.parent, joint.child, pose)

    def _edit(self, joint: _Joint, transform: Transform) -> Edit:
        xyz, angles = _xyz(transform), _rpy(transform)
        if joint.origin is None:
            # After the joint's own tag, on a separate line, indented like the next line.
            at = joint.tag + len(_tag(self._text, joint.tag))
            blank = self._text[at : len(self._text) - len(self._text[at:].lstrip())]
            return Edit(at, at, f'{blank}<origin xyz="{xyz}" rpy="{angles}"/>')
        tag = _tag(self._text, joint.origin)
        changed = _with_attribute(_with_attribute(tag, "rpy", angles), "xyz", xyz)
        return Edit(joint.origin, joint.origin + len(tag), changed)


def _tag(text: str, start: int) -> str:
    """A tag from its first to its last bracket; brackets in quotes do not count."""
    found = re.compile(r"""<(?:[^>"']|"[^"]*"|'[^']*')*>""").match(text, start)
    assert found is not None  # The parser has accepted it.
    return found.group()


def _with_attribute(tag: str, name: str, value: str) -> str:
    found = re.search(rf"""(\s{name}\s*=\s*)("[^"]*"|'[^']*')""", tag)
    if found:
        quote = found.group(2)[0]
        return f"{tag[: found.start()]}{found.group(1)}{quote}{value}{quote}{tag[found.end() :]}"
    at = len("<origin")
    return f'{tag[:at]} {name}="{value}"{tag[at:]}'


def _listed(names: Sequence[str]) -> str:
    """At most twelve names, for a message."""
    unique = list(dict.fromkeys(names))
    rest = f" and {len(unique) - 12} more" if len(unique) > 12 else ""
    return ", ".join(f"'{name}'" for name in unique[:12]) + rest if unique else "nothing"


CONSUMER = Consumer(export, FRAME_OPTIONS | {"--base", "--parent"})
