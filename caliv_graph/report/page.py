"""Shared by all HTML pages: the templates, and figures as data for draw.js."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jinja2
from markupsafe import Markup

if TYPE_CHECKING:
    from caliv_graph.report.figures.drawing import Figure


def environment() -> jinja2.Environment:
    """The template environment; a name that is missing in a template raises an error."""
    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("caliv_graph.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.globals["first_picture"] = _first_picture
    return pages


def _first_picture(figure: Figure) -> Markup:
    # Imported here: a page without figures needs no drawing.
    from caliv_graph.report.figures.still import still

    return still(figure)


def script_data(figure: Figure) -> Markup:
    """The JSON of a figure for a script element."""
    return escaped(figure.figure.json())


def escaped(text: str) -> Markup:
    """JSON for a script element, escaped so that no text can end the element."""
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
