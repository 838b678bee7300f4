"""How much of a fingerpad's force is contact growth, and what each effect adds: curve by curve, model by model, condition by condition."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from benchmarks._record import Figure, at_least, at_most
from fingerjax.loop import heldout
from fingerjax.loop.explanations import Explanation
from fingerjax.loop.findings import Findings
from fingerjax.loop.refit import Optimum
from fingerjax.report.records import Row, Table
from fingerjax.study import Study

TIMES, SHARE = 3.0, 0.10
"""What is hoped for: held-out errors so many times smaller after than before, and at most this share of the held-out forces."""


LEAST = "held-out forces, least error of a model that was fitted"
SHARED = "held-out forces, error of curves that subjects share up to a factor"
SHIFTED = "held-out forces, error of curves that subjects share up to a factor and a depth"
STIFF = 1e-2  # N by which each unit of a curve's second difference, in the logarithm, counts; shifts count so in each 0.3 mm


def more(study: Study, findings: Findings) -> Iterator[Figure | Table]:
    """Curves, models, and the forces that were held out."""
    yield Table("curves", "Each force curve by itself", list(_curves(study, findings)), CURVES)
    before, after = (held_out(study, findings, best) for best in (findings.base.best, findings.closest.best))
    yield Figure(f"{study.name}: held-out forces, error before", before, "1")
    yield at_most(f"{study.name}: held-out forces, error after", after, "1", SHARE)
    yield at_least(f"{study.name}: held-out forces, times smaller after", before / after, "1", TIMES)
    yield from _least(study, findings)
    yield Figure(f"{study.name}: {SHARED}", shared_curves(study, findings, told=False), "1", note="any curve of an indenter")
    yield Figure(f"{study.name}: {SHARED}, fitted to these too", shared_curves(study, findings, told=True), "1")
    yield Figure(f"{study.name}: {SHIFTED}", shifted_curves(study, findings, told=False), "1", note="any smooth curve of an indenter")
    yield Figure(f"{study.name}: {SHIFTED}, fitted to these too", shifted_curves(study, findings, told=True), "1")


def _least(study: Study, findings: Findings) -> Iterator[Figure]:
    """Of all models that were fitted the one that is best on what was held out, and why it is not the end: no choice, an account."""
    fitted = {one: held_out(study, findings, one.best) for one in models(findings)}
    if fitted:
        one = min(fitted, key=lambda one: fitted[one])
        yield Figure(f"{study.name}: {LEAST}", fitted[one], "1", note=f"with {one.name.replace('_', ' ')}, which {one.reason or 'holds'}")


def models(findings: Findings) -> list[Explanation]:
    """Every model with effects whose fit settled: by one and by two, and the nearest where that has more."""
    every = [*findings.explanations, *([] if findings.nearest is None else [findings.nearest])]
    return [one for one in dict.fromkeys(every) if one.best.settled]


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


def shared_curves(study: Study, findings: Findings, *, told: bool) -> float:
    """The same error of a model without mechanics: force = factor of the subject x any curve of the indenter, by least squares.

    How well subjects foretell each other at all, whatever fingers are made of. With `told` the held-out forces are fitted too.
    """
    force, subject, curve, kept, _, _ = (np.concatenate(each) for each in zip(*_forces(study, findings), strict=True))
    curve, subject = (np.unique(each, return_inverse=True)[1].reshape(-1) for each in (curve, subject))
    use, subjects = np.ones(len(force), bool) if told else ~kept, int(subject.max()) + 1

    def foretold(x: np.ndarray) -> np.ndarray:
        return np.exp(np.append(0.0, x[: subjects - 1])[subject] + x[subjects - 1 :][curve])

    start = np.append(np.zeros(subjects - 1), [np.log(np.mean(force[curve == one])) for one in range(int(curve.max()) + 1)])
    found = least_squares(lambda x: (foretold(x) - force)[use], start, x_scale="jac", xtol=1e-12, ftol=1e-12)
    return _left(force[kept], foretold(found.x)[kept])


def shifted_curves(study: Study, findings: Findings, *, told: bool) -> float:
    """The same where each subject's curves may also begin at a depth of their own: force = factor x curve(depth + shift).

    Curves are monotone cubics through the logarithm of force at some depths; what bends them or shifts them counts a little.
    """
    force, subject, _, kept, depth, indenter = (np.concatenate(each) for each in zip(*_forces(study, findings), strict=True))
    subject, indenter = (np.unique(each, return_inverse=True)[1].reshape(-1) for each in (subject, indenter))
    use, others, curves = np.ones(len(force), bool) if told else ~kept, int(subject.max()), int(indenter.max()) + 1
    knots = np.log(np.concatenate([[0.5 * depth.min()], np.unique(np.round(depth, 1)), [depth.max() + 0.5]]))

    def foretold(x: np.ndarray) -> np.ndarray:
        factor, shift, shapes = (np.append(0.0, x[:others])[subject], np.append(0.0, x[others : 2 * others])[subject], _shapes(x))
        at = np.log(np.maximum(depth + shift, 0.1 * depth.min()))
        along = np.zeros(len(force))
        for number, shape in enumerate(shapes):
            here = indenter == number
            along[here] = PchipInterpolator(knots, shape, extrapolate=True)(at[here])
        return np.exp(factor + along)

    def _shapes(x: np.ndarray) -> np.ndarray:
        return x[2 * others :].reshape(curves, len(knots))

    def residual(x: np.ndarray) -> np.ndarray:
        bends = np.diff(_shapes(x), 2, axis=1).ravel()
        return np.concatenate([(foretold(x) - force)[use], STIFF * x[others : 2 * others] / 0.3, 0.1 * STIFF * bends])

    level = [np.log(force[indenter == number].max()) + 2 * (knots - np.log(depth.max())) for number in range(curves)]
    found = least_squares(residual, np.concatenate([np.zeros(2 * others), *level]))
    return _left(force[kept], foretold(found.x)[kept])


def _forces(study: Study, findings: Findings) -> Iterator[tuple[np.ndarray, ...]]:
    """Of each measurement of force: forces, subjects, indenter with depth, whether they were held out, depths in mm, and indenter."""
    rows = findings.subject.rows
    held = heldout.in_role(rows, dict(findings.roles), "report")
    for one in study.measurements:
        if one.kind == "force_displacement":
            where = np.arange(len(rows))[rows.blocks[one.name]]
            curve = np.array([f"{one.name} {depth:.3f}" for depth in one.table["displacement"]])
            depth, name = np.asarray(one.table["displacement"], float), np.full(len(one), one.name)
            yield rows.measured[where], one.table["subject"].astype(str), curve, held[where], depth, name
