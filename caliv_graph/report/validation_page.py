"""validation.html: one self-contained page with figures before and after, coloured by LiDAR."""

from __future__ import annotations

from markupsafe import Markup

import caliv_graph
from caliv_graph.report.figures.drawing import without_template
from caliv_graph.report.figures.structure import validation_figures
from caliv_graph.report.page import environment, script_data
from caliv_graph.report.validation import repeatability_sentences, tables, validation_status
from caliv_graph.validation.findings import Validation
from caliv_graph.workflows.repeatability import Repeatability


def render_validation(found: Validation, repeated: Repeatability | None, p_value: float) -> str:
    """The page, an HTML document of a few megabytes, most of them plotly.js.

    `p_value` is the limit of the tests of repeatability; `repeated` None: not tested.
    """
    from plotly.offline import get_plotlyjs

    with without_template():
        figures = validation_figures(found)
    return (
        environment()
        .get_template("validation.html.j2")
        .render(
            found=found,
            status=validation_status(found),
            tables=tables(found),
            repeated=[] if repeated is None else repeatability_sentences(repeated, p_value),
            figures=figures,
            data={figure.name: script_data(figure) for figure in figures},
            plotlyjs=Markup(get_plotlyjs()),
            version=caliv_graph.__version__,
        )
    )
