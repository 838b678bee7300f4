"""The rows of a study's measurements, and the conditions under which they were made."""

from __future__ import annotations

import numpy as np

from ..loop.subject import Rows
from ..measurements import Measurement
from ..study import Study

LABELS = ("subject", "condition", "stimulus")
IMPOSED = {"deflection_profile": ("depth",), "force_displacement": (), "spike_rate": ("depth", "force")}
ALONG = {
    "deflection_profile": ("distance", "depth"),
    "force_displacement": ("displacement", "force", "time"),
    "spike_rate": ("position", "time", "depth", "force"),
}


def rows_of(study: Study) -> Rows:
    """A condition is one load case as a whole: a profile at one depth, a trace of force, a sweep of positions."""
    measurements = study.measurements
    ends = np.cumsum([0, *(len(one) for one in measurements)])
    blocks = {one.name: slice(int(a), int(b)) for one, a, b in zip(measurements, ends[:-1], ends[1:], strict=True)}
    condition = np.concatenate([_conditions(one) for one in measurements])
    roles: dict[str, str] = {}
    for held in study.diagnose.hold_out if study.diagnose is not None else ():
        one = study.measurement(held.measurement)
        chosen = _chosen(one, held.where)
        names = condition[blocks[one.name]]
        parted = set(names[chosen]) & set(names[~chosen])
        names[chosen] = [f"{name}, held out" if name in parted else name for name in names[chosen]]
        condition = condition.astype(object)
        condition[blocks[one.name]] = names
        roles |= dict.fromkeys(names[chosen].tolist(), "report")
    return Rows(
        blocks=blocks,
        condition=condition.astype(str),
        measured=np.concatenate([one.measured for one in measurements]),
        coordinates={one.name: _coordinates(one) for one in measurements},
        units={one.name: one.unit for one in measurements},
        trial=np.concatenate([one.table.get("trial", np.full(len(one), "1")).astype(str) for one in measurements]),
        kinds={one.name: one.kind for one in measurements},
        sigma=np.concatenate([np.full(len(one), np.nan) if one.sigma is None else one.sigma for one in measurements]),
        stated_repeats={one.name: one.replicates for one in measurements if one.sigma is not None},
        roles=roles,
    )


def _conditions(one: Measurement) -> np.ndarray:
    """(rows,) text: measurement, labels, and what was imposed where that makes a case of its own."""
    parts = [np.full(len(one), one.name, dtype=object)]
    for label in LABELS:
        if label in one.table and len(set(one.table[label].tolist())) > 1:
            parts.append(one.table[label].astype(str).astype(object))
    for imposed in IMPOSED[one.kind]:
        if imposed in one.table and imposed != one.value:
            unit = "N" if imposed == "force" else "mm"
            parts.append(np.array([f"{value:g} {unit}" for value in one.table[imposed]], dtype=object))
    return np.array([", ".join(map(str, each)) for each in zip(*parts, strict=True)], dtype=object)


def _coordinates(one: Measurement) -> dict[str, np.ndarray]:
    return {name: np.asarray(one.table[name], float) for name in ALONG[one.kind] if name in one.table and name != one.value}


def _chosen(one: Measurement, where: dict[str, tuple[float | str, ...]]) -> np.ndarray:
    chosen = np.ones(len(one), bool)
    for name, values in where.items():
        column = one.table[name]
        if np.issubdtype(column.dtype, np.number):
            chosen &= np.any(np.isclose(column[:, None], np.asarray(values, float)[None, :], rtol=1e-9, atol=1e-9), axis=1)
        else:
            chosen &= np.isin(column.astype(str), [str(value) for value in values])
    return chosen
