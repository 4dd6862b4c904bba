"""GLIM: `T_lidar_imu` of `config_sensors.json`, as x y z qx qy qz qw.

GLIM defines it by `p_lidar = T_lidar_imu p_imu` (koide3/glim, docs and config_sensors.json).
"""

from __future__ import annotations

import json
import re

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import Edit, line_end, spliced, with_comment
from caliv_graph.export.request import IMU_OPTIONS, Base, Consumer, Export, Request, Transform
from caliv_graph.export.text import notice, numbers, quaternion_xyzw, with_c, without_notice

_KEY = "T_lidar_imu"
_NOTE = "_caliv_graph"
"""Key of the comment in a file without /* */ or // comments; GLIM ignores unknown keys."""


def export(request: Request) -> Export:
    """A `config_sensors.json` with `T_lidar_imu` alone, or `--base` with a new value.

    Raises:
        ExportError: the pose of the IMU is unknown, or `--base` has not exactly one `T_lidar_imu`.
    """
    lidar, several = request.one_lidar("glim")
    T_lidar_imu, assumed = request.T_lidar_imu(lidar, "glim")
    assert request.imu is not None
    transform = Transform(
        lidar,
        lidar,
        "imu",
        T_lidar_imu,
        f"{_KEY}: x y z qx qy qz qw; p_lidar = T p_imu. "
        f"T_vehicle_imu is from {request.imu.origin}.",
    )
    note = notice(request, [transform])
    value = f"[{numbers((*T_lidar_imu.translation(), *quaternion_xyzw(T_lidar_imu)), ', ')}]"
    if request.base is None:
        text = (
            '{\n  "sensors": {\n'
            f'    "{_NOTE}": {_json_lines(note, "    ")},\n'
            f'    "{_KEY}": {value}\n'
            "  }\n}\n"
        )
    else:
        text = _changed(request.base, value, note)
    return Export(text.encode(), (transform,), (*several, *assumed))


def _changed(base: Base, value: str, note: str) -> str:
    text = without_notice(base.text)
    ends = line_end(text)
    code = _without_comments(text)
    # The comment of an earlier export is removed with its comma and its line.
    own = re.search(rf'"{_NOTE}"\s*:\s*\[[^\]]*\]\s*,\s*', code)
    found = list(re.finditer(rf'"{_KEY}"\s*:\s*(\[[^\]]*\])', code))
    if len(found) != 1:
        raise ExportError(
            f"{base.path}: has '{_KEY}' {len(found)} times, expected one list of 7 numbers. Give "
            "GLIM's config_sensors.json as --base"
        )
    edits = [Edit(*found[0].span(1), value)]
    if own:
        edits.append(Edit(own.start(), own.end(), ""))
    takes_comments = code != text
    if not takes_comments:
        at = found[0].start()
        blank = text[len(text[:at].rstrip()) : at]
        indent = blank.rpartition("\n")[2]
        lines = _json_lines(note, indent).replace("\n", ends)
        edits.append(Edit(at, at, f'"{_NOTE}": {lines},{blank or " "}'))
    edited = spliced(text, edits)
    if takes_comments:
        edited = with_comment(with_c(note), edited)
    try:
        json.loads(_without_comments(edited).removeprefix("\ufeff"))
    except ValueError as e:
        raise ExportError(
            f"{base.path}: is not valid JSON: {e}. Correct it there, or give another --base"
        ) from None
    return edited


def _json_lines(note: str, indent: str) -> str:
    # A bracket would end the list for the search of the next export.
    lines = [json.dumps(line.replace("[", "(").replace("]", ")")) for line in note.splitlines()]
    inner = f",\n{indent}  ".join(lines)
    return f"[\n{indent}  {inner}\n{indent}]"


def _without_comments(text: str) -> str:
    """The text with blanks instead of /* */ and // comments; indices stay valid."""
    pattern = re.compile(r'"(?:\\.|[^"\\])*"|/\*.*?\*/|//[^\r\n]*', re.DOTALL)

    def blank(found: re.Match[str]) -> str:
        piece = found.group()
        return piece if piece.startswith('"') else re.sub(r"[^\r\n]", " ", piece)

    return pattern.sub(blank, text)


CONSUMER = Consumer(export, IMU_OPTIONS)
