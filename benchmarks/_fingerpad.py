"""How much of a fingerpad's force is contact growth, and what each effect adds: curve by curve, model by model, condition by condition."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks._record import Figure, at_least, at_most
from fingerjax.loop import heldout
from fingerjax.loop.findings import Findings
from fingerjax.loop.refit import Optimum
from fingerjax.report.records import Row, Table
from fingerjax.study import Study

TIMES, SHARE = 3.0, 0.10
"""What is hoped for: held-out errors so many times smaller after than before, and at most this share of the held-out forces."""


def more(study: Study, findings: Findings) -> Iterator[Figure | Table]:
    """Curves, models, and the forces that were held out."""
    yield Table("curves", "Each force curve by itself", list(_curves(study, findings)), CURVES)
    before, after = (held_out(study, findings, best) for best in (findings.base.best, findings.closest.best))
    yield Figure(f"{study.name}: held-out forces, error before", before, "1")
    yield at_most(f"{study.name}: held-out forces, error after", after, "1", SHARE)
    yield at_least(f"{study.name}: held-out forces, times smaller after", before / after, "1", TIMES)


CURVES = (
    "Error over the root mean square of each curve: of the best straight line through zero; of the linear finger's own curve with the best "
    "stiffness for this curve alone, which knows how contact grows; of the base model, one stiffness for a subject; and of the model in "
    "the end, the nearest of the catalogue where none is named. Stiffness: the best for this curve alone, over the subject's."
)


def _curves(study: Study, findings: Findings) -> Iterator[Row]:
    rows, sample = findings.subject.rows, findings.base.best.sample
    before, after = (each.at.prediction + each.sample.offset for each in (findings.base.best, findings.closest.best))
    for one in study.measurements:
        if one.kind != "force_displacement":
            continue
        where = np.arange(len(rows))[rows.blocks[one.name]]
        for subject in dict.fromkeys(one.table["subject"].tolist()):
            own = where[one.table["subject"] == subject]
            y, depth, linear = sample.measured[own], one.table["displacement"][one.table["subject"] == subject], before[own]
            yield {
                "indenter": one.name,
                "subject": str(subject),
                "used": findings.roles[rows.condition[own[0]]],
                "straight_line": _left(y, _best(y, depth) * depth),
                "own_stiffness": _left(y, _best(y, linear) * linear),
                "before": _left(y, linear),
                "after": _left(y, after[own]),
                "stiffness": _best(y, linear),
            }


def _best(y: np.ndarray, f: np.ndarray) -> float:
    return float(f @ y / (f @ f))


def _left(y: np.ndarray, f: np.ndarray) -> float:
    return float(np.linalg.norm(y - f) / np.linalg.norm(y))


def held_out(study: Study, findings: Findings, best: Optimum) -> float:
    """Error of the forces that were held out, over their root mean square."""
    rows = findings.subject.rows
    forces = np.isin(rows.block, [one.name for one in study.measurements if one.kind == "force_displacement"])
    kept = forces & heldout.in_role(rows, dict(findings.roles), "report")
    return _left(rows.measured[kept], (best.at.prediction + best.sample.offset)[kept])
