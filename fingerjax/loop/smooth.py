"""Errors that are alike where the coordinates of two rows are: a Gaussian kernel, block by block."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .subject import Rows


def smooth(rows: Rows, size: Float[np.ndarray, "rows"], reach: float, elsewhere: float) -> Float[np.ndarray, "rows rows"]:
    """Covariance of an error of standard deviation `size`, none between blocks.

    **Arguments:** `reach`: length of the kernel, in ranges of each coordinate; `elsewhere`: correlation between conditions of one block.
    """
    whole = np.zeros((len(rows), len(rows)))
    for name, where in rows.blocks.items():
        condition = rows.condition[where]
        alike = np.where(condition[:, None] == condition, 1.0, elsewhere)
        for values in rows.coordinates.get(name, {}).values():
            span = float(np.ptp(values))
            place = np.asarray(values, dtype=float) / (reach * span) if span > 0 else np.zeros(len(condition))
            alike = alike * np.exp(-0.5 * (place[:, None] - place) ** 2)
        whole[where, where] = np.outer(size[where], size[where]) * alike
    return whole
