"""Which effect explains a subject's point against its plate: what each would have to be, subject by subject.

With one modulus for a subject a linear finger fixes the ratio of the two forces, whatever that modulus is. Each effect moves this ratio;
where its curve meets the measured one is what the subject would need.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from benchmarks._record import Figure
from fingerjax.effects import catalogue, chosen
from fingerjax.forward import assemble
from fingerjax.loop.findings import Findings
from fingerjax.measurements import Measurement
from fingerjax.report.records import Row, Table
from fingerjax.runners.subject import FingerSubject
from fingerjax.study import Study

SIZES = (-1.0, -0.5, -0.25, 0.25, 0.5, 1.0)
"""Shares of an effect's plausible range at which its curve is taken."""
RATIOS = (0.02, 0.05, 0.2, 0.5, 1.0)
"""Moduli of all layers under the epidermis over the epidermis's."""


def more(study: Study, findings: Findings) -> Iterator[Figure | Table]:
    """The measured ratios, the noise that would excuse them, and what every effect would have to be."""
    wanted = ratios(study)
    spread = float(np.std(np.log(list(wanted.values())), ddof=1))
    yield Figure(f"{study.name}: plate over point, spread over subjects", spread, "1", note="standard deviation of the logarithm")
    yield Figure(f"{study.name}: noise of each force that would excuse it", spread / math.sqrt(2), "1", note="as a share")
    curves = dict(_curves(study))
    here = curves.pop("")[0][1]
    yield Figure(f"{study.name}: plate over point, model", here, "1")
    rows: list[Row] = [_row(name, curve, here, wanted) for name, curve in curves.items()]
    rows.sort(key=lambda row: (-row["subjects_explained"], row["effect"]))
    note = (
        f"The model's plate needs {here:.3g} times its point's force. Lowest and highest: of that ratio over the plausible range of the "
        "effect. Under each subject: its measured ratio, and what the effect would have to be there; empty where it is out of reach. Layer "
        "ratio: the modulus of all layers under the epidermis over the epidermis's."
    )
    yield Table("needed", "What each effect would have to be for each subject", rows, note)


def ratios(study: Study) -> dict[str, float]:
    """Subject -> plate over point, measured."""
    point, plate = (_by_subject(study.measurement(name)) for name in ("point", "plate"))
    return {subject: plate[subject] / point[subject] for subject in point}


def _by_subject(one: Measurement) -> dict[str, float]:
    return dict(zip(one.table["subject"].astype(str).tolist(), one.measured.tolist(), strict=True))


def _curves(study: Study) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Effect and number -> (amount, plate over point); under the empty name the model as it is."""
    single = _of_one(study)
    asked = "all" if study.diagnose is None else study.diagnose.effects
    effects = tuple(effect for effect in chosen(asked, catalogue()) if effect.absent(single.measurements) is None)
    subject = FingerSubject(assemble(single), effects)
    raw = np.array([parameter.raw() for parameter in subject.parameters])

    def ratio(phi: Mapping[str, float]) -> float:
        value = subject.evaluate(raw, phi, ()).prediction
        return float(value[1] / value[0])

    here = ratio({})
    yield "", [(0.0, here)]
    for family in subject.families:
        for way in family.columns:
            ends = {share: way.null + share * (way.upper - way.null if share > 0 else way.null - way.lower) for share in SIZES}
            amounts = sorted({amount for amount in ends.values() if abs(amount - way.null) > 1e-12})
            curve = sorted([(way.null, here), *((amount, ratio({way.key: amount})) for amount in amounts)])
            yield f"{family.name}: {way.name}", [pair for pair in curve if math.isfinite(pair[1])]
    yield "layer ratio", [(share, _layered(single, share)) for share in RATIOS]


def _of_one(study: Study) -> Study:
    """The study of its first subject alone."""
    kept = []
    for one in study.measurements:
        first = one.table["subject"] == one.table["subject"][0]
        table = {name: column[first] for name, column in one.table.items()}
        kept.append(dataclasses.replace(one, table=table, sigma=None if one.sigma is None else one.sigma[first], rows=one.rows[first]))
    return dataclasses.replace(study, measurements=tuple(kept), diagnose=None)


def _layered(study: Study, share: float) -> float:
    """Plate over point with all layers under the epidermis at a share of its modulus."""
    epidermis = study.model.moduli()["epidermis"]
    inner = {f"{layer}.modulus": share * epidermis for layer in ("dermis", "adipose", "fibrous")}
    point, plate = assemble(study).predict(inner).readings
    return float(plate[0] / point[0])


def _row(name: str, curve: list[tuple[float, float]], here: float, wanted: Mapping[str, float]) -> Row:
    values = [value for _, value in curve]
    needed = {subject: crossing(curve, ratio) for subject, ratio in wanted.items()}
    return {
        "effect": name.replace("_", " "),
        "lowest": min(values, default=math.nan),
        "highest": max(values, default=math.nan),
        "subjects_explained": sum(amount is not None for amount in needed.values()),
        **{f"subject {subject} ({wanted[subject]:.3g})": amount for subject, amount in needed.items()},
    }


def crossing(curve: list[tuple[float, float]], level: float) -> float | None:
    """Where a curve first meets a level, by straight lines between its points; None where it does not."""
    for (x0, y0), (x1, y1) in itertools.pairwise(curve):
        if min(y0, y1) <= level <= max(y0, y1) and y0 != y1:
            return x0 + (level - y0) / (y1 - y0) * (x1 - x0)
    return None
