"""A grade that accepts everything would make every other test worthless."""

from __future__ import annotations

import helpers
import numpy as np
import pytest

GRADES = [grade for grade in vars(helpers).values() if isinstance(grade, helpers.Grade)]


@pytest.mark.parametrize("grade", GRADES, ids=lambda grade: grade.because)
def test_a_grade_accepts_what_is_inside_and_refuses_what_is_outside(grade: helpers.Grade) -> None:
    expected = np.array([0.0, 1.0, -4.0])
    grade.check(expected + 3.9 * grade.relative, expected)
    with pytest.raises(AssertionError, match="not the same"):
        grade.check(expected + 4.2 * grade.relative + 2 * grade.absolute, expected)


def test_a_grade_refuses_nan_and_another_shape() -> None:
    with pytest.raises(AssertionError):
        helpers.STATISTICAL.check([1.0, np.nan], [1.0, 1.0])
    with pytest.raises(AssertionError):
        helpers.STATISTICAL.check([1.0, 1.0, 1.0], [1.0, 1.0])
