"""A page of many parts of which a run renews some: the others stand as an earlier run left them."""

from __future__ import annotations

import re

HEADING = "## "


def sections(page: str) -> dict[str, str]:
    """The parts of a page below headings of the second level, by heading; each with its heading, without blank lines around it."""
    pieces = re.split(r"(?m)^(?=## )", page)[1:]
    return {piece.splitlines()[0].removeprefix(HEADING): piece.strip() for piece in pieces}


def rows(page: str) -> dict[str, str]:
    """Lines of the page's first table that begin with a link to a section, by that section's heading."""
    found = re.findall(r"(?m)^\| \[[^\]]+\]\(#([^)]+)\) \|.*$", page)
    lines = [line for line in page.splitlines() if re.match(r"\| \[[^\]]+\]\(#", line)]
    return dict(zip(found, lines, strict=True))


def last_number(row: str) -> float:
    """What stands in the last cell of a table's line."""
    return float(row.strip().strip("|").split("|")[-1])
