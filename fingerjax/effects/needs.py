"""What the data must hold for an effect to be looked for: each answers why not, in words, or None."""

from __future__ import annotations

import numpy as np

from .effect import Data
from .records import Measured

FLAT, TIPS = ("flat_plate", "flat_cylinder", "point"), ("line", "point")


def force(data: Data) -> str | None:
    return None if _of(data, "force_displacement") else "no force was measured"


def force_read(data: Data) -> str | None:
    return None if any(one.controlled != "force" for one in _of(data, "force_displacement")) else "no force was read"


def timed_force(data: Data) -> str | None:
    timed = [one for one in _of(data, "force_displacement") if "time" in one.table and one.controlled != "force"]
    return None if timed else "no force was read against time"


def unloading(data: Data) -> str | None:
    if (why := timed_force(data)) is not None:
        return why
    back = any(_turns(one) for one in _of(data, "force_displacement") if "time" in one.table)
    return None if back else "the indenter was never withdrawn"


def _turns(one: Measured) -> bool:
    labels = [one.table[name].astype(str) for name in ("subject", "condition", "trial", "stimulus") if name in one.table]
    trace = np.unique(np.column_stack(labels), axis=0, return_inverse=True)[1].reshape(-1) if labels else np.zeros(len(one), np.int64)
    order = np.lexsort((one.table["time"], trace))
    back = np.diff(one.table["displacement"][order]) < 0
    return bool(np.any(back & (np.diff(trace[order]) == 0)))


def profile(data: Data) -> str | None:
    return None if _of(data, "deflection_profile") else "no profile was measured"


def rates(data: Data) -> str | None:
    return None if _of(data, "spike_rate") else "no spike rate was measured"


def swept_rates(data: Data) -> str | None:
    if (why := rates(data)) is not None:
        return why
    swept = any(len(np.unique(one.table["position"])) > 2 for one in _of(data, "spike_rate"))
    return None if swept else "the stimulus was not moved over the receptor"


def timed_rates(data: Data) -> str | None:
    return None if any("time" in one.table for one in _of(data, "spike_rate")) else "no spike rate was measured against time"


def imposed_travel(data: Data) -> str | None:
    return None if any(one.controlled != "force" for one in data) else "no travel was imposed"


def pushing(data: Data) -> str | None:
    return None if data else "nothing was pressed"


def not_swept(data: Data) -> str | None:
    return None if _of(data, "force_displacement") or _of(data, "deflection_profile") else "the indenter was swept over the skin"


def flat_indenter(data: Data) -> str | None:
    return None if has_shape(data, FLAT) else "no indenter is flat"


def tip(data: Data) -> str | None:
    return None if has_shape(data, TIPS) else "no indenter has a sharp tip"


def has_shape(data: Data, shapes: tuple[str, ...]) -> bool:
    return any(spec.shape in shapes for one in data for spec in one.indenters.values())


def _of(data: Data, kind: str) -> list[Measured]:
    return [one for one in data if one.kind == kind]
