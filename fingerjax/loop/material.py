"""Whether an effect is larger than what any model is wrong by.

`Rows.form` says by how much a model may miss a reading, and the tests count those misses as unrelated from one reading to the next. Along a
trace they need not be: geometry and laws are wrong in ways that bend slowly, and an effect that stays within them everywhere may be no more
than their shape. However many readings speak for it, it is not named unless somewhere it is larger:

    times = largest over traces of rms(change of the prediction) / rms(form)  >=  1

This is a bound on size beside the tests of significance, as minimum-effect tests have it (Murphy & Myors 1999, J. Appl. Psychol. 84, 234).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from .subject import Rows

ENOUGH = 1.0


def times_form(rows: Rows, chosen: Bool[np.ndarray, "rows"], change: Float[np.ndarray, "rows"]) -> float:
    """How many times what any model is wrong by a change of the prediction is, on the trace of the `chosen` rows where it is most so; inf
    where nothing is said of how wrong models are.
    """
    if rows.form is None:
        return math.inf
    _, trace = np.unique(rows.condition[chosen].astype(str), return_inverse=True)
    moved, wrong = (np.bincount(trace.reshape(-1), each[chosen] ** 2) for each in (change, rows.form))
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(moved > 0, np.sqrt(moved / wrong), 0.0)
    return float(times.max(initial=0.0))
