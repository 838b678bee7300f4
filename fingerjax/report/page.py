"""One self-contained page for a run: nothing in it is fetched from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fingerjax.report.loop_page import filled
from fingerjax.report.loop_words import advice
from fingerjax.report.records import StudyResult, Table, now, versions
from fingerjax.report.tables import as_html
from fingerjax.report.words import mesh_sentence


def page(results: Sequence[StudyResult], title: str = "fingerjax") -> str:
    """The report of a run as one HTML text: an index, then one section for each study.

    In each section the verdict comes first, then warnings, tables, figures, the mesh and where it all came
    from.
    """
    environment = Environment(
        loader=PackageLoader("fingerjax.report", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"drawn": _drawn, "as_html": _table, "diagnosed": lambda result: _diagnosed(environment, result)}
    environment.globals |= {"mesh_sentence": mesh_sentence}
    template = environment.get_template("page.html.j2")
    return template.render(title=title, results=results, versions=versions(), created=now())


def _diagnosed(environment: Environment, result: StudyResult) -> Markup:
    """The chapters of a diagnosis, from its record and the tables and figures that are marked with them."""
    template = environment.get_template("loop.html.j2")
    return Markup(template.render(one=result, advice=advice(result.loop or {}), chapters=filled(result)))


def _table(table: Table) -> Markup:
    return Markup(as_html(table))


def _drawn(svg: str) -> str:
    """An SVG as the address of an image, so that figures cannot get into each other's names."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
