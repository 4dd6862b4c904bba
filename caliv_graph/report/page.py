"""What pages of a report are made of: templates, and figures as data for their scripts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jinja2
from markupsafe import Markup

if TYPE_CHECKING:
    from caliv_graph.report.figures.drawing import Figure


def environment() -> jinja2.Environment:
    """Of the report's templates: a name that is missing in one is an error, no empty text."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("caliv_graph.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def script_data(figure: Figure) -> Markup:
    """A figure's data for a script element: no text in it can end the element."""
    from caliv_graph.report.figures.drawing import figure_json

    text = figure_json(figure)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
