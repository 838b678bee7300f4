"""What is done for each kind of study: one file, one kind, from a checked `Study` to a `StudyResult`."""

from __future__ import annotations

from collections.abc import Callable

from ..report.records import Context, StudyResult
from ..study import Study
from .fitting import fit_study, predict_study
from .force_table import force_table
from .layer_models import layer_models
from .sweeps import sweep

Runner = Callable[[Study, Context], StudyResult]
RUNNERS: dict[str, Runner] = {
    "fit": fit_study,
    "predict": predict_study,
    "table": force_table,
    "layer_study": layer_models,
    "sweep": sweep,
}

__all__ = ["RUNNERS", "Runner"]
