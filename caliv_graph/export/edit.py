"""Changes of numbers in an existing file; all other bytes stay the same."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.errors import ExportError
from caliv_graph.export.request import Base
from caliv_graph.export.text import number, without_notice

_BOM = "\ufeff"

_MOST_BYTES = 100_000_000
"""Largest size of a file that people edit by hand."""


@dataclass(frozen=True)
class Edit:
    """The replacement of the characters from `start` to before `stop`, equal for an insertion."""

    start: int
    stop: int
    text: str


def read_base(path: Path) -> Base:
    """Reads a file to change.

    Raises:
        ExportError: the file is missing, or is not text in UTF-8.
    """
    try:
        # Not read_text, which would change the line ends.
        return Base(path, read_input(path, _MOST_BYTES).decode("utf-8"))
    except FileNotFoundError:
        raise ExportError(
            f"{path}: no such file. Give --base an existing file, or leave it out"
        ) from None
    except UnicodeDecodeError:
        raise ExportError(f"{path}: is not text in UTF-8. Give another --base") from None
    except OSError as e:
        raise ExportError(f"{path}: {unreadable(e)}") from None


def spliced(text: str, edits: Sequence[Edit]) -> str:
    """A text after all edits, which must not overlap."""
    out, at = [], 0
    for edit in sorted(edits, key=lambda e: e.start):
        out += [text[at : edit.start], edit.text]
        at = edit.stop
    return "".join([*out, text[at:]])


def with_comment(comment: str, text: str) -> str:
    """A text with a comment on top, with the line ends of the text."""
    comment = comment.replace("\n", line_end(text))
    # A byte order mark must stay in front.
    return _BOM + comment + text[1:] if text.startswith(_BOM) else comment + text


def line_end(text: str) -> str:
    """The line end of a text."""
    return "\r\n" if "\r\n" in text else "\n"


@dataclass(frozen=True)
class Entry:
    """A key of a YAML file and its value; `path` has the keys above it and its own."""

    path: tuple[str, ...]
    key: yaml.ScalarNode
    value: yaml.Node


class YamlFile:
    """A YAML file whose numbers can be replaced in place, without the comment of an earlier export.

    Raises ExportError if the file is not YAML, or has no keys.
    """

    def __init__(self, base: Base) -> None:
        self._base = base = Base(base.path, without_notice(base.text))
        try:
            root = yaml.compose(base.text, Loader=yaml.SafeLoader)
        except yaml.MarkedYAMLError as e:
            line = f" in line {e.problem_mark.line + 1}" if e.problem_mark else ""
            raise ExportError(
                f"{base.path}: not valid YAML{line}: {e.problem}. Correct it there, or give "
                "another --base"
            ) from None
        except (yaml.YAMLError, RecursionError) as e:
            first = (str(e).splitlines() or ["nested too deeply"])[0]
            raise ExportError(
                f"{base.path}: not valid YAML: {first}. Give another --base"
            ) from None
        if not isinstance(root, yaml.MappingNode):
            raise ExportError(f"{base.path}: has no keys with values. Give another --base")
        self._root = root
        self._edits: list[Edit] = []

    @property
    def entries(self) -> Iterator[Entry]:
        """All keys at all depths, upper keys before lower ones."""
        yield from _entries(self._root, (), set())

    def entry(self, key: str) -> Entry | None:
        """The only entry with this key at any depth; None if there is none.

        Raises:
            ExportError: several entries have this key.
        """
        found = [entry for entry in self.entries if entry.path[-1] == key]
        if len(found) > 1:
            lines = ", ".join(str(entry.key.start_mark.line + 1) for entry in found)
            raise ExportError(
                f"{self._base.path}: '{key}' is ambiguous: it is in lines {lines}. Leave only one"
            )
        return found[0] if found else None

    def set_numbers(self, entry: Entry, values: Sequence[float]) -> None:
        """Replaces the numbers of a list, each in its place."""
        node = entry.value
        items = node.value if isinstance(node, yaml.SequenceNode) else []
        if len(items) == len(values) and all(isinstance(item, yaml.ScalarNode) for item in items):
            for item, value in zip(items, values, strict=True):
                self._replace(item, number(value))
            return
        if isinstance(node, yaml.SequenceNode) and not node.flow_style:
            raise ExportError(
                f"{self._where(entry)}: expected a list of {len(values)} numbers. Correct --base"
            )
        self._replace(node, f"[{', '.join(map(number, values))}]")

    def set_scalars(self, entry: Entry, values: Mapping[str, float]) -> None:
        """Replaces the numbers at the keys of a mapping.

        Raises:
            ExportError: the entry is not a mapping, or lacks one of the keys.
        """
        for key, value in values.items():
            node = self.below(entry).get(key)
            if not isinstance(node, yaml.ScalarNode):
                raise ExportError(
                    f"{self._where(entry)}: has no number '{key}'. Add '{key}: 0.0' to --base"
                )
            self._replace(node, number(value))

    def set_text(self, node: yaml.Node, text: str) -> None:
        """Replaces a scalar by a quoted one."""
        self._replace(node, f'"{text}"')

    def below(self, entry: Entry) -> dict[str, yaml.Node]:
        """The values of a mapping by their keys."""
        if not isinstance(entry.value, yaml.MappingNode):
            return {}
        return {str(key.value): value for key, value in entry.value.value}

    def scalar(self, node: yaml.Node | None) -> float | None:
        """The value of a node as a finite number; None if it is not one."""
        if not isinstance(node, yaml.ScalarNode):
            return None
        try:
            value = float(node.value)
        except ValueError:
            return None
        return value if math.isfinite(value) else None

    def edited(self) -> str:
        """The file with all replacements."""
        return spliced(self._base.text, self._edits)

    def _replace(self, node: yaml.Node, text: str) -> None:
        # The end mark of a plain scalar may be after the blanks that follow it.
        start, stop = node.start_mark.index, node.end_mark.index
        if start == stop:
            # The mark of a missing value may be anywhere up to the next key.
            raise ExportError(
                f"{self._base.path}: a value is missing in or above line "
                f"{node.start_mark.line + 1}. Write one there, such as 0.0"
            )
        piece = self._base.text[start:stop]
        self._edits.append(Edit(start, start + len(piece.rstrip()), text))

    def _where(self, entry: Entry) -> str:
        return f"{self._base.path}: {'.'.join(entry.path)} in line {entry.key.start_mark.line + 1}"


def _entries(node: yaml.Node, path: tuple[str, ...], seen: set[int]) -> Iterator[Entry]:
    # An alias is the same node as its anchor, and can be changed only once.
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode):
                own = (*path, str(key.value))
                yield Entry(own, key, value)
                yield from _entries(value, own, seen)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            yield from _entries(item, (*path, str(index)), seen)
