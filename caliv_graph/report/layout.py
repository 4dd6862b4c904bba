"""Building blocks of the tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterable

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from caliv_graph.report.numbers import SHOWN_AXES

_TEXT_COLUMNS = ("frames", "seconds", "type", "times of points")
"""Last columns that hold text of any length."""

UNKNOWN = "-"
"""Cell of a number that cannot be computed."""


def sentences(heading: str, texts: Iterable[str]) -> list[RenderableType]:
    """A heading and a line per text; nothing without texts."""
    lines: list[RenderableType] = [Text(f"  - {text}") for text in texts]
    return ["", Text(heading, style="bold"), *lines] if lines else []


def titled(title: str, table: Table) -> list[RenderableType]:
    """A table below its title. A title of rich itself is no wider than its table."""
    return ["", Text(title, style="bold"), table]


def new_table(*columns: str) -> Table:
    """An empty table: the first column is aligned to the left, numbers to the right."""
    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        show_edge=False,
    )
    for number, column in enumerate(columns):
        last_of_text = column in _TEXT_COLUMNS and number == len(columns) - 1
        left = number == 0 or last_of_text
        table.add_column(
            column, justify="left" if left else "right", no_wrap=not last_of_text, overflow="fold"
        )
    return table


def axis_headings(length: str, angle: str) -> list[str]:
    """Headings of the axes, with the units of lengths and angles."""
    return [f"{axis}\n{length if axis in 'xyz' else angle}" for axis in SHOWN_AXES]


def millimetres(value_m: float | None) -> str:
    """A length in millimetres."""
    return UNKNOWN if value_m is None else f"{1e3 * value_m:.1f}"
