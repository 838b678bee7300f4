"""Studies of kind `layer_study`: deflection profiles of ratio models under one line load, and the paper's three findings checked.

Dandekar et al. (2003), Fig. 8: a stiffer layer 1 widens the profile; layer 2 is mixed, narrower near the load and wider beyond, and
matters least; stiffer layers 3 and 4 narrow it; the deeper the layer, the farther from the load its influence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .._results import RESULTS
from ..forward import Assembled, assemble
from ..layers import SOFT_LAYERS
from ..measurements import Measurement
from ..report import figures
from ..report.records import Context, Figure, Row, StudyResult, Table, mesh_record
from ..study import LayerStudy, Study
from ..study_keys import ratio_decades, ratio_moduli
from .fitting import complaint

NEAR = 1.25  # mm from the load: where the paper's Fig. 8 sees layer 2 change sides


def layer_models(study: Study, context: Context) -> StudyResult:
    """Profiles of every model, and what a change of each layer does to them."""
    options = study.options
    assert isinstance(options, LayerStudy)
    assembled = assemble(
        dataclasses.replace(study, measurements=(profile(options),)), tell=lambda share, what: context.tell(0.1 * share, what)
    )
    notes = [study.notes, *assembled.solid.notes]
    begun = StudyResult(study.name, study.notes.split(". ")[0] or "Layer study", "", RESULTS.not_converged, notes=notes)
    begun = dataclasses.replace(begun, meshes={assembled.solid.name: mesh_record(assembled.finger)})
    profiles: dict[str, np.ndarray] = {}
    for number, model in enumerate(options.models):
        context.tell(0.3 + 0.65 * number / len(options.models), model)
        prediction = assembled.predict(_moduli(assembled, model))
        why = complaint(prediction)
        if why is not RESULTS.successful:
            return dataclasses.replace(begun, verdict=f"Not converged at {model}: {why.value}", warnings=[why.value])
        profiles[model] = np.asarray(prediction.readings[0])
    return _result(begun, options, assembled.study.measurements[0].table["distance"], profiles)


def profile(options: LayerStudy) -> Measurement:
    count = round(options.span / options.spacing)
    distance = options.spacing * np.arange(-count, count + 1)
    columns = {"depth": np.full(len(distance), options.depth), "distance": distance, "deflection": np.zeros(len(distance))}
    indenters = {"": options.indenter}
    return Measurement("profile", "deflection_profile", columns, "deflection", None, indenters, "displacement", "z", None, None)


def _moduli(assembled: Assembled, model: str) -> dict[str, float]:
    start = ratio_moduli(model, assembled.model.wired.fixed["epidermis.modulus"])
    return {f"{layer}.modulus": start[layer] for layer in SOFT_LAYERS}


def _result(begun: StudyResult, options: LayerStudy, distance: np.ndarray, profiles: dict[str, np.ndarray]) -> StudyResult:
    reference = options.models[0]
    changes = [change for model in options.models[1:] if (change := _change(reference, model)) is not None]
    influence = [_influence(layer, up, distance, profiles[model] - profiles[reference], options.depth) for model, layer, up in changes]
    findings = check_findings(influence)
    kept = sum(row["holds"] == "yes" for row in findings)
    tidy = _rows(reference, changes, distance, profiles, options.depth)
    return dataclasses.replace(
        begun,
        result=RESULTS.successful,
        verdict=f"{kept} of the paper's {len(findings)} findings about layers hold on this finger.",
        tables=[
            Table("findings", "The paper's findings, checked", findings),
            Table("influence", "What a layer of ten times, or a tenth of, its modulus does; shares of the depth", influence),
        ],
        figures=[_figure(tidy, reference, options)],
    )


def _change(reference: str, model: str) -> tuple[str, int, bool] | None:
    """(model, layer, stiffer) where one soft layer alone differs."""
    a, b = ratio_decades(reference), ratio_decades(model)
    differing = [layer for layer in SOFT_LAYERS if a[layer] != b[layer]]
    if len(differing) != 1:
        return None
    return model, SOFT_LAYERS.index(differing[0]), b[differing[0]] > a[differing[0]]


def _influence(layer: int, stiffer: bool, distance: np.ndarray, change: np.ndarray, depth: float) -> Row:
    """Mean change of the deflection near the load and beyond, and how far out the change lies on average; per depth."""
    size, far = np.abs(distance), np.abs(distance) > NEAR
    weight = np.abs(change)
    return {
        "layer": layer + 1,
        "tissue": SOFT_LAYERS[layer],
        "change": "stiffer" if stiffer else "softer",
        "near": float(change[~far].mean() / depth),
        "beyond": float(change[far].mean() / depth),
        "rms": float(np.sqrt(np.mean(change**2)) / depth),
        "centre_mm": float(np.sum(weight * size) / np.sum(weight)),
    }


def check_findings(influence: list[Row]) -> list[Row]:
    """Each finding of Fig. 8 with yes, no, or not tried, and the numbers behind it."""
    stiff = {row["layer"]: row for row in influence if row["change"] == "stiffer"}
    mean = {layer: np.mean([row["rms"] for row in influence if row["layer"] == layer]) for layer in {row["layer"] for row in influence}}
    centre = {layer: np.mean([row["centre_mm"] for row in influence if row["layer"] == layer]) for layer in mean}
    deeper_is_farther = lambda: bool(np.all(np.diff([centre[k] for k in sorted(centre)]) > 0))  # noqa: E731
    return [
        _finding("a stiffer layer 1 widens the profile", [1], stiff, lambda: min(stiff[1]["beyond"], stiff[1]["near"]) > 0),
        _finding(
            "a stiffer layer 2 narrows it near the load and widens it beyond",
            [2],
            stiff,
            lambda: stiff[2]["near"] < 0 < stiff[2]["beyond"],
        ),
        _finding("layer 2 matters least", [1, 2, 3, 4], mean, lambda: min(mean, key=lambda layer: mean[layer]) == 2),
        _finding("stiffer layers 3 and 4 narrow the profile", [3, 4], stiff, lambda: max(stiff[3]["beyond"], stiff[4]["beyond"]) < 0),
        _finding("the deeper the layer, the farther its influence", [1, 2, 3, 4], centre, deeper_is_farther),
    ]


def _finding(text: str, needed: list[int], there: dict[int, Any], holds: Callable[[], bool]) -> Row:
    if not set(needed) <= set(there):
        return {"finding": text, "holds": "not tried", "numbers": ""}
    numbers = "; ".join(f"layer {layer}: {_told(there[layer])}" for layer in needed)
    return {"finding": text, "holds": "yes" if holds() else "no", "numbers": numbers}


def _told(value: Row | float) -> str:
    if isinstance(value, dict):
        return f"near {value['near']:+.3f}, beyond {value['beyond']:+.3f}"
    return f"{value:.3g}"


def _rows(reference: str, changes: list, distance: np.ndarray, profiles: dict[str, np.ndarray], depth: float) -> list[Row]:
    panels = [("", reference), *((f"layer {layer + 1}, {SOFT_LAYERS[layer]}", model) for model, layer, _ in changes)]
    return [
        {"panel": panel, "model": model, "distance_mm": float(x), "deflection": float(y / depth)}
        for panel, model in panels
        for x, y in zip(distance, profiles[model], strict=True)
    ]


def _figure(tidy: list[Row], reference: str, options: LayerStudy) -> Figure:
    return figures.layer_study(tidy, caption=f"Skin under a wedge {options.depth:g} mm deep; grey: {reference}. After Fig. 8 of the paper.")
