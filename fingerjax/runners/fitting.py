"""Studies of kind `fit` and `predict`: find the free parameters, say how sure they are, and show every reading beside its data."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np

from .._results import RESULTS
from ..forward import Assembled, Prediction, assemble
from ..forward.model import noise_of
from ..forward.problem import Problem
from ..identify import Fit, Multistart, Uncertainty, fit, multistart, sensitivity, uncertainty, with_own_noise
from ..identify.workers import room
from ..layers import SOFT_LAYERS
from ..report import figures, words
from ..report.records import Context, Figure, Row, StudyResult, Table, fit_record, mesh_record, misfit
from ..report.tables import correlation_table, parameter_table, residual_table
from ..study import Study
from ._rows import drawn, rows
from .certainty import how_sure, seen_tables
from .finer import Finer, brought_to_finer_meshes

PAPER_RATIO = 0.1  # dermis and deeper layers to epidermis: m43338, Dandekar et al. (2003), section 4.2


def fit_study(study: Study, context: Context) -> StudyResult:
    """Fit a study's free parameters to its measurements. A fit that is not settled leaves its reason and no value."""
    assembled = assemble(study, tell=lambda share, what: context.tell(0.3 * share, what))
    context.tell(0.3, "first reading")
    problem = assembled.problem()
    found, many = _fitted(study, problem, context.within(0.35, 0.6 if _more(study) else 0.97))
    found, sizes = with_own_noise(found) if study.fit.own_noise and found.settled else (found, {})
    finer = brought_to_finer_meshes(study, assembled, found, sizes, context.within(0.55, 0.6))
    found = finer.fit
    known = uncertainty(found, spread=finer.spread)
    begun = StudyResult(
        name=study.name,
        title=study.notes.split(". ")[0] or f"Fit of {', '.join(one.name for one in study.measurements)}",
        verdict=words.verdict(found, known),
        result=found.result,
        warnings=[*words.warnings(found, known), *finer.warnings],
        notes=[*([study.notes] if study.notes else []), *assembled.solid.notes],
        meshes={assembled.solid.name: mesh_record(assembled.finger)},
    )
    if not found.settled:
        return dataclasses.replace(begun, fit=fit_record(found, known))
    settled = _settled(study, assembled, known, sizes, finer, begun)
    return how_sure(study, assembled, found, known, many, settled, context.within(0.6, 0.98)) if _more(study) else settled


def _more(study: Study) -> bool:
    """Whether the study asks for more than one fit."""
    return bool(study.fit.profile or study.fit.bootstrap or study.fit.sample or study.fit.finer or study.fit.starts > 1)


def _fitted(study: Study, problem: Problem, context: Context) -> tuple[Fit, Multistart | None]:
    """The fit, or the best of those from several starts."""
    if study.fit.starts > 1:
        workers = study.fit.workers or room()
        many = multistart(problem, study.fit.starts, remake=partial(_problem, study), workers=workers, tell=context.tell)
        return many.best, many
    return fit(problem, progress=lambda step: context.tell(min(0.08 * step.step, 1.0), f"step {step.step}, chi2 {step.chi2:.4g}")), None


def _problem(study: Study) -> Problem:
    """A study's problem from nothing but the study, as another process makes it; its mesh is in the cache by then."""
    return assemble(study).problem()


def _settled(
    study: Study, assembled: Assembled, known: Uncertainty, sizes: dict[str, float], finer: Finer, begun: StudyResult
) -> StudyResult:
    found = finer.fit
    sigma = {one.name: sizes.get(one.name, 1.0) * noise_of(one)[0] for one in study.measurements}
    record = fit_record(found, known, misfit(found, sigma, {one.name: one.unit for one in study.measurements}))
    seen = sensitivity(found, sigma)
    predicted = {one.name: one.measured + found.rows(one.name) * sigma[one.name] for one in study.measurements}
    tables = [parameter_table(known, seen), residual_table(record), correlation_table(known)]
    tables += _ratios(assembled, found, known)
    tables += [*seen_tables(study, found, known), *finer.tables, *_noise(study, sigma, sizes)]
    pictures = [picture for one in study.measurements if (picture := drawn(one, rows(one, predicted[one.name], sigma[one.name])))]
    drawn_too = [*_about(found, record), figures.sensitivities(seen.table())]
    return dataclasses.replace(begun, fit=record, tables=[table for table in tables if table.rows], figures=[*pictures, *drawn_too])


def _noise(study: Study, sigma: dict[str, np.ndarray], sizes: dict[str, float]) -> list[Table]:
    """Where the noise of every measurement comes from, and how large it is; where some was estimated."""
    tidy: list[Row] = [
        {
            "measurement": one.name,
            "noise": float(np.median(sigma[one.name])),
            "unit": one.unit,
            "from": "its own residuals" if one.name in sizes else noise_of(one)[1],
        }
        for one in study.measurements
    ]
    return [Table("noise", "Noise of each measurement", tidy)] if sizes else []


def _about(found: Fit, record: dict[str, Any]) -> list[Figure]:
    several = [figures.correlations(record["correlations"])] if len(found.problem.parameters) > 1 else []
    path = [{"step": s.step, "chi2": s.chi2, "gradient": s.gradient, "accepted": s.accepted} for s in found.history]
    return [*several, figures.fit_path(path)]


def _ratios(assembled: Assembled, found: Fit, known: Uncertainty) -> list[Table]:
    """Moduli of the soft layers over the epidermis's, with 95 % intervals, beside the paper's ten to one."""
    wired, names = assembled.model.wired, [parameter.name for parameter in found.problem.parameters]
    if wired.per or not {wired.owner[f"{layer}.modulus"] for layer in SOFT_LAYERS} & set(names):
        return []
    values = {one.name: one.value for one in known.estimates}
    log = np.array([[_log_slope(wired.owner[f"{layer}.modulus"], name) for name in names] for layer in SOFT_LAYERS])
    modulus = np.array([values.get(wired.owner[f"{layer}.modulus"], wired.fixed[wired.owner[f"{layer}.modulus"]]) for layer in SOFT_LAYERS])
    weights = log - log[0]
    spread = known.t * np.sqrt(np.maximum(np.einsum("lp,pq,lq->l", weights, known.covariance, weights), 0.0))
    tidy = [
        {
            "layer": layer,
            "ratio_to_epidermis": float(modulus[i] / modulus[0]),
            "lower": float(modulus[i] / modulus[0] * np.exp(-spread[i])),
            "upper": float(modulus[i] / modulus[0] * np.exp(spread[i])),
            "paper": 1.0 if i == 0 else PAPER_RATIO,
        }
        for i, layer in enumerate(SOFT_LAYERS)
    ]
    return [Table("layer_ratios", "Layer moduli over the epidermis's, beside the paper's m43338", tidy)]


def _log_slope(owner: str, name: str) -> float:
    return 1.0 if owner == name else 0.0


def predict_study(study: Study, context: Context) -> StudyResult:
    """Read every instrument at the study's own values, beside what was measured."""
    assembled = assemble(study, tell=lambda share, what: context.tell(0.4 * share, what))
    context.tell(0.4, "reading")
    prediction = assembled.predict()
    why = complaint(prediction)
    begun = StudyResult(study.name, "Prediction", f"Not converged: {why.value}", RESULTS.not_converged, warnings=[why.value])
    notes, meshes = list(assembled.solid.notes), {assembled.solid.name: mesh_record(assembled.finger)}
    begun = dataclasses.replace(begun, notes=notes, meshes=meshes)
    if why is not RESULTS.successful:
        return begun
    tidy = [rows(one, np.asarray(prediction.readings[i]), noise_of(one)[0]) for i, one in enumerate(study.measurements)]
    pictures = [drawn(one, each) for one, each in zip(study.measurements, tidy, strict=True)]
    return dataclasses.replace(
        begun,
        verdict="Predicted at the study's own values; nothing was fitted.",
        result=RESULTS.successful,
        warnings=[],
        tables=[Table(one.name, f"{one.name}: measured and predicted", each) for one, each in zip(study.measurements, tidy, strict=True)],
        figures=[picture for picture in pictures if picture],
    )


def complaint(prediction: Prediction) -> RESULTS:
    """What went wrong in a prediction, most basic first; `successful` where nothing did."""
    if not bool(prediction.converged):
        return RESULTS.not_converged
    if not bool(prediction.settled):
        return RESULTS.contact_did_not_settle
    return RESULTS.successful if bool(prediction.inside) else RESULTS.contact_reached_edge
