"""What several tests share: how close is close, in named grades."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Grade:
    """How far two numbers may be apart, and why that far.

    `relative` is measured against the largest entry of what was expected, so that a zero among forces is
    judged by the forces around it; `absolute` is in the unit of the numbers.
    """

    relative: float
    absolute: float
    because: str

    def check(self, found: Any, expected: Any) -> None:
        """Raise `AssertionError` with the grade's reason when `found` is not `expected` to this grade."""
        found, expected = np.asarray(found, dtype=float), np.asarray(expected, dtype=float)
        room = self.absolute + self.relative * np.max(np.abs(expected), initial=0.0)
        reason = f"not the same: {self.because}"
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=room, err_msg=reason)


SAME_ARITHMETIC = Grade(1e-12, 1e-14, "the same sums in another order, float64")
SOLVED = Grade(1e-7, 1e-12, "a linear solve stopped at a relative residual of 1e-8 lies between")
DIFFERENCED = Grade(1e-5, 1e-9, "a difference quotient stands on one side")
STATISTICAL = Grade(0.1, 0.0, "an average over random repeats")
