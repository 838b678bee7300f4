"""What a study must hold for an effect to be looked for: each answers why not, in words, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..measurements import Measurement
    from ..study import Study

FLAT, TIPS = ("flat_plate", "flat_cylinder", "point"), ("line", "point")


def force(study: Study) -> str | None:
    return None if _of(study, "force_displacement") else "no force was measured"


def force_read(study: Study) -> str | None:
    return None if any(one.controlled != "force" for one in _of(study, "force_displacement")) else "no force was read"


def timed_force(study: Study) -> str | None:
    timed = [one for one in _of(study, "force_displacement") if "time" in one.table and one.controlled != "force"]
    return None if timed else "no force was read against time"


def unloading(study: Study) -> str | None:
    if (why := timed_force(study)) is not None:
        return why
    back = any(_turns(one) for one in _of(study, "force_displacement") if "time" in one.table)
    return None if back else "the indenter was never withdrawn"


def _turns(one: Measurement) -> bool:
    labels = [one.table[name].astype(str) for name in ("subject", "condition", "trial", "stimulus") if name in one.table]
    trace = np.unique(np.column_stack(labels), axis=0, return_inverse=True)[1].reshape(-1) if labels else np.zeros(len(one), int)
    order = np.lexsort((one.table["time"], trace))
    back = np.diff(one.table["displacement"][order]) < 0
    return bool(np.any(back & (np.diff(trace[order]) == 0)))


def profile(study: Study) -> str | None:
    return None if _of(study, "deflection_profile") else "no profile was measured"


def rates(study: Study) -> str | None:
    return None if _of(study, "spike_rate") else "no spike rate was measured"


def swept_rates(study: Study) -> str | None:
    if (why := rates(study)) is not None:
        return why
    swept = any(len(np.unique(one.table["position"])) > 2 for one in _of(study, "spike_rate"))
    return None if swept else "the stimulus was not moved over the receptor"


def timed_rates(study: Study) -> str | None:
    return None if any("time" in one.table for one in _of(study, "spike_rate")) else "no spike rate was measured against time"


def imposed_travel(study: Study) -> str | None:
    return None if any(one.controlled != "force" for one in study.measurements) else "no travel was imposed"


def pushing(study: Study) -> str | None:
    return None if study.measurements else "nothing was pressed"


def not_swept(study: Study) -> str | None:
    return None if _of(study, "force_displacement") or _of(study, "deflection_profile") else "the indenter was swept over the skin"


def flat_indenter(study: Study) -> str | None:
    return None if _has_shape(study, FLAT) else "no indenter is flat"


def tip(study: Study) -> str | None:
    return None if _has_shape(study, TIPS) else "no indenter has a sharp tip"


def _has_shape(study: Study, shapes: tuple[str, ...]) -> bool:
    return any(spec.shape in shapes for one in study.measurements for spec in one.indenters.values())


def _of(study: Study, kind: str) -> list[Measurement]:
    return [one for one in study.measurements if one.kind == kind]
