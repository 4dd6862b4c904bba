"""validation.html: one self-contained page with pictures before and after, coloured by LiDAR.

Interactive figures rather than image files: one zooms in on the two millimetres that matter, and
nothing but what the report needs anyway has to be installed.
"""

from __future__ import annotations

from markupsafe import Markup

import caliv_graph
from caliv_graph.report.figures.drawing import without_template
from caliv_graph.report.figures.structure import validation_figures
from caliv_graph.report.page import environment, script_data
from caliv_graph.report.validation import repeatability_sentences, tables
from caliv_graph.validation.validate import Validation
from caliv_graph.workflows.repeatability import Repeatability


def render_validation(found: Validation, repeated: Repeatability | None, p_value: float) -> str:
    """The page.

    Args:
        found: the validation.
        repeated: split-half repeatability, if it was asked for.
        p_value: limit of the tests in it.

    Returns:
        A whole HTML document of a few megabytes, most of them plotly.js.
    """
    from plotly.offline import get_plotlyjs

    with without_template():
        figures = validation_figures(found)
    return (
        environment()
        .get_template("validation.html.j2")
        .render(
            found=found,
            status=_status(found),
            tables=tables(found),
            repeated=[] if repeated is None else repeatability_sentences(repeated, p_value),
            figures=figures,
            data={figure.name: script_data(figure) for figure in figures},
            plotlyjs=Markup(get_plotlyjs()),
            version=caliv_graph.__version__,
        )
    )


def _status(found: Validation) -> str:
    """A class of the page's style."""
    if not found.has_structure:
        return "partial"
    bad = found.verdict.contradicts or (found.verdict.better or 1.0) < 1.0
    return "inconsistent" if bad else "ok"
