"""What a run leaves behind: tables, figures with the numbers they were drawn from, one page, one record."""

from __future__ import annotations

from fingerjax.report.records import Context, Figure, StudyResult, Table

__all__ = ["Context", "Figure", "StudyResult", "Table"]
