"""What tables for a terminal are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

SHOWN_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Order in tables: as people write a mounting down."""

_MOST_DECIMALS = 6

_TEXT_COLUMNS = ("frames", "seconds", "type", "times of points")
"""Last columns that hold text of any length."""


def sentences(heading: str, texts: Iterable[str]) -> list[RenderableType]:
    """A heading and a line for each text; nothing without any."""
    lines: list[RenderableType] = [Text(f"  - {text}") for text in texts]
    return ["", Text(heading, style="bold"), *lines] if lines else []


def titled(title: str, table: Table) -> list[RenderableType]:
    """A table below its title. Rich's own titles are no wider than their tables."""
    return ["", Text(title, style="bold"), table]


def new_table(*columns: str) -> Table:
    """An empty table: the first column to the left, numbers to the right."""
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


def value_and_sigma(value: float, sigma: float) -> str:
    """A value to two digits of its sigma, and the sigma below it."""
    decimals = decimals_of(sigma, 2)
    return f"{fixed(value, decimals)}\n±{sigma:.{decimals}f}"


def decimals_of(sigma: float, digits: int) -> int:
    """Decimals that show so many digits of a sigma."""
    if not sigma > 0.0:
        return 3
    return min(max(digits - 1 - math.floor(math.log10(sigma)), 0), _MOST_DECIMALS)


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals, and no minus before zeros."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
