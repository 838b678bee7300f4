"""The rows of a study's measurements, and the conditions under which they were made."""

from __future__ import annotations

import numpy as np

from ..loop.subject import Rows
from ..measurements import Measurement
from ..study import Study
from ..study_records import MEASUREMENT, Diagnose

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
        calibration=_placement(study, blocks, condition),
        form=_form(study, condition),
        setup=np.concatenate([_joined(_setup(one)) for one in measurements]).astype(str),
    )


def labels_of(study: Study, column: str) -> np.ndarray:
    """(rows,) text of a column of labels that every measurement has, or the measurement's name."""
    named = [np.full(len(one), one.name) if column == MEASUREMENT else one.table[column] for one in study.measurements]
    return np.concatenate([each.astype(str) for each in named])


def _form(study: Study, condition: np.ndarray) -> np.ndarray:
    """(rows,): what any model may be wrong by: a share of a force, and of the greatest deflection of a profile or rate of a sweep."""
    shares = (study.diagnose or Diagnose()).form
    kind = np.concatenate([np.full(len(one), one.kind) for one in study.measurements])
    size = np.abs(np.concatenate([one.measured for one in study.measurements]))
    _, group = np.unique(condition.astype(str), return_inverse=True)
    greatest = np.zeros(group.max(initial=0) + 1)
    np.maximum.at(greatest, group, size)
    greatest = greatest[group]
    by_kind = {"deflection_profile": greatest, "force_displacement": size, "spike_rate": greatest}
    return sum((shares[name] * np.where(kind == name, of, 0.0) for name, of in by_kind.items()), np.zeros(len(size)))


def _placement(study: Study, blocks: dict[str, slice], condition: np.ndarray) -> dict[str, np.ndarray]:
    """Name -> (rows,): what rates would change by were the afferent beside its place, from the slopes of the sweeps themselves."""
    known, found = (study.diagnose or Diagnose()).placement, {}
    for one in study.measurements:
        if one.kind != "spike_rate" or known == 0:
            continue
        slope = np.zeros(len(one))
        for name in np.unique(condition[blocks[one.name]].astype(str)):
            inside = np.flatnonzero(condition[blocks[one.name]].astype(str) == name)
            place, group = np.unique(np.asarray(one.table["position"], float)[inside], return_inverse=True)
            if len(place) > 2:
                mean = np.bincount(group, one.measured[inside]) / np.bincount(group)
                slope[inside] = np.gradient(mean, place)[group]
        if slope.any():
            whole = np.zeros(sum(map(len, study.measurements)))
            whole[blocks[one.name]] = known * slope
            found[f"place of the afferent of {one.name}"] = whole
    return found


def _setup(one: Measurement) -> list[np.ndarray]:
    """(rows,) each: measurement, and the labels that differ within it."""
    labels = [one.table[label] for label in LABELS if label in one.table and len(set(one.table[label].tolist())) > 1]
    return [np.full(len(one), one.name, dtype=object), *labels]


def _conditions(one: Measurement) -> np.ndarray:
    """(rows,) text: the set-up, and what was imposed where that makes a case of its own."""
    parts = _setup(one)
    for imposed in IMPOSED[one.kind]:
        if imposed in one.table and imposed != one.value:
            unit = "N" if imposed == "force" else "mm"
            parts.append(np.array([f"{value:g} {unit}" for value in one.table[imposed]], dtype=object))
    return _joined(parts)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
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
