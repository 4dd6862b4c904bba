"""The text of a drafted config: templates, comments, numbers as YAML has them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

import yaml


def align(template: str) -> str:
    """Puts the comments, which follow a tab, below one another."""
    lines = [line.split("\t") for line in template.splitlines()]
    return "".join(f"{line[0]:<30}  {line[1]}\n" if line[1:] else f"{line[0]}\n" for line in lines)


def scalar(text: str) -> str:
    """A string as YAML reads it back, in quotes only if it needs them."""
    plain = re.fullmatch(r"[\w./][\w./ -]*(?<! )", text) and yaml.safe_load(text) == text
    return text if plain else json.dumps(text, ensure_ascii=False)


def yaml_list(values: Sequence[float]) -> str:
    """Numbers on one line."""
    shown: list[Any] = [round(float(v), 9) for v in values]
    return yaml.safe_dump(shown, default_flow_style=True, width=1000).strip()


TODO_POSE = "TODO: these zeros are no guess; measure it, or take it from a drawing"


def from_source(source: str) -> str:
    """Where a value is from, for its comment."""
    return f"taken from {source}"


def comment(text: str) -> str:
    """Text of the data, such as a frame's name, without characters that would end a comment."""
    return re.sub(r"[^\S ]|[^ -~\u00a1-\uffff]", "?", text)


def lidar_text(
    name: str,
    topic: str,
    topic_note: str,
    guess: tuple[Sequence[float], Sequence[float]] | None,
    origin: str,
) -> str:
    """The section of one LiDAR; `origin`: where its guess is from, or why there is none."""
    if guess is None:
        initial = NO_INITIAL_TEMPLATE.format(origin=comment(origin))
    else:
        xyz, rpy_deg = map(yaml_list, guess)
        initial = INITIAL_TEMPLATE.format(origin=comment(origin), xyz=xyz, rpy_deg=rpy_deg)
    return LIDAR_TEMPLATE.format(
        name=scalar(name), topic=scalar(topic), topic_note=comment(topic_note), initial=initial
    )


def target_text(target: tuple[Sequence[float], Sequence[float]] | None, source: str) -> str:
    """The section of the target, or a comment in its place."""
    if target is None:
        return SEARCHED_TARGET_TEMPLATE
    return TARGET_TEMPLATE.format(source=source, min=yaml_list(target[0]), max=yaml_list(target[1]))


TEMPLATE = """\
# Drafted by 'caliv-graph init'. Metres and degrees; paths are relative to this file.
# T_vehicle_lidar maps points of a LiDAR's cloud into the vehicle frame: x forward, y left, z up.

data:
  format: {format}
  path: {path}

{motion}lidars:\t# rename them as you like: front, rear, ...
{lidars}

reference: {reference}\t# the LiDAR that the others are calibrated to

{target}

{ground}

solve:
  mode: auto\t# auto (the guess decides only what the drive leaves open), staged, joint

robust:
  kernel: huber\t# treatment of outlier scans: huber, tls, trimmed, none

require: [s2s]\t# exit code 0 means that these are determined: s2s, s2v_rotation, s2v
"""

LIDAR_TEMPLATE = """\
  {name}:
    topic: {topic}\t# {topic_note}
{initial}
    min_range: 1.0\t# metres; nearer returns (the vehicle's own body) are dropped
    max_range: 200.0\t# metres; farther returns are dropped
    stamp: auto\t# what a cloud's stamp marks: start or end of its sweep; auto: by the data"""

INITIAL_TEMPLATE = """\
    initial:\t# T_vehicle_lidar, {origin}
      xyz: {xyz}\t# metres forward, left, up
      rpy_deg: {rpy_deg}\t# degrees; pitch > 0 is nose down, yaw > 0 left
    sigma:\t# how far off it may be, 1 sigma: a number, or one per vehicle axis
      xyz: 0.058\t# metres; 0.058 is anything up to +-0.1 m
      rpy_deg: 1.73\t# degrees; 1.73 is anything up to +-3 degrees"""

NO_INITIAL_TEMPLATE = """\
    initial: null\t# T_vehicle_lidar, found from the drive: {origin}
    # A guess decides what the drive leaves open. If you have one, put it here, with its sigma:
    # initial: {{xyz: [2.0, 0.0, 1.8], rpy_deg: [0.0, 10.0, 0.0]}}\t# metres and degrees
    # sigma: {{xyz: 0.058, rpy_deg: 1.73}}\t# 1 sigma"""

TARGET_TEMPLATE = """\
target:\t# a box around the target, with nothing else above the ground in it
  min: {min}\t# metres, taken from {source}
  max: {max}\t# metres
  frame: map\t# map (the frame of the poses) or start (the vehicle's first pose)"""

SEARCHED_TARGET_TEMPLATE = """\
# The target is searched for. If that fails, or other objects are near it, give a box around it,
# with nothing else above the ground in it: metres, in the map, or from the vehicle's first pose.
# If there is none, 'target: false': walls and other structure calibrate alone.
# target:
#   min: [10.0, -14.0, -1.0]
#   max: [20.0, -4.0, 3.0]
#   frame: start"""

IMU_TEMPLATE = """\
imu:
  T_vehicle_imu:\t# {origin}
    xyz: {xyz}\t# metres forward, left, up
    rpy_deg: {rpy_deg}\t# degrees; null: unknown, estimated from gravity and the drive

"""

HEADING_TEMPLATE = """\
heading:\t# of two antennas
  yaw_deg: 0.0\t# TODO: degrees, from the vehicle's x to where it points: 0 ahead, 90 left
  sigma_deg: 1.0\t# degrees, how far off that may be, 1 sigma
  axes: enu\t# enu: counted from east to the left; ned: from north to the right (nmea_navsat_driver)

"""

WHEELS_TEMPLATE = """\
wheels:\t# there is no IMU: the wheels tell the motion between the fixes
  T_vehicle_wheels:\t# middle of the axle that does not steer, x where the vehicle goes straight
    xyz: [0.0, 0.0, 0.0]\t# metres; zeros: the vehicle frame is there
    rpy_deg: [0.0, 0.0, 0.0]\t# degrees
  speed_scale_sigma: 0.02\t# 1 sigma of the scale of the speeds, which is estimated

"""

GROUND_TEMPLATE = """\
ground:\t# the ground under the wheels: roll, pitch and z of the LiDARs
  vehicle_height: {height}\t# metres, {origin}
  sigma: 0.005\t# metres, how far off that may be, 1 sigma"""

UNKNOWN_GROUND_TEMPLATE = """\
ground:\t# the ground under the wheels: roll, pitch and z of the LiDARs
  use: true\t# false: it is not used
  # vehicle_height: 0.0\t# TODO: metres, of the vehicle frame above it; without it z stays open
  # sigma: 0.005\t# metres, how far off that may be, 1 sigma"""

GNSS_TEMPLATE = """\
gnss:\t# the antenna in the vehicle frame, {origin}
  lever_arm: {arm}\t# metres forward, left, up; null: unknown, estimated from the drive

"""


def ground_text(known: tuple[float, str] | None) -> str:
    """The section of the ground; `known`: the vehicle's height above it, metres, and its source."""
    if known is None:
        return UNKNOWN_GROUND_TEMPLATE
    return GROUND_TEMPLATE.format(height=yaml_list(known[:1])[1:-1], origin=comment(known[1]))
