"""The door for units: exact conversions, and refusals that name the column and what would be accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerjax.errors import InputError
from fingerjax.units import (
    ACCEPTED,
    dimension_of,
    factor,
    internal_unit,
    read_quantity,
    split_unit,
    to_internal,
)

LISTED = [(unit, dimension) for dimension, units in ACCEPTED.items() for unit in units]


@pytest.mark.parametrize(
    ("column", "parts"),
    [
        ("force_gf", ("force", "gf")),
        ("r_epidermis_mm", ("r_epidermis", "mm")),
        ("sigma_N", ("sigma", "N")),
        ("rate_ips", ("rate", "ips")),
        ("subject", ("subject", None)),
        ("depth_furlong", ("depth_furlong", None)),
        ("force_n", ("force_n", None)),
        ("mm", ("mm", None)),
        ("_mm", ("_mm", None)),
    ],
)
def test_split(column, parts):
    assert split_unit(column) == parts


@pytest.mark.parametrize(
    ("value", "unit", "dimension", "inside"),
    [
        (1.0, "gf", "force", 9.80665e-3),
        (250.0, "mN", "force", 0.25),
        (1.0, "kgf", "force", 9.80665),
        (18.0, "kPa", "pressure", 0.018),
        (1.0, "N/mm^2", "pressure", 1.0),
        (270.0, "deg", "angle", 1.5 * math.pi),
        (50.0, "um", "length", 0.05),
        (1.0, "inch", "length", 25.4),
        (20.0, "ms", "time", 0.02),
        (35.0, "ips", "rate", 35.0),
        (7.0, "kPa/mm", "foundation", 0.007),
        (12.0, "px", "pixel", 12.0),
        (4.0, "%", "number", 0.04),
    ],
)
def test_conversion(value, unit, dimension, inside):
    assert to_internal(value, unit, dimension) == pytest.approx(inside, rel=1e-14)


@pytest.mark.parametrize(("unit", "dimension"), LISTED)
def test_every_listed_unit_converts(unit, dimension):
    assert 0 < factor(unit, dimension) < math.inf
    assert dimension_of(unit) == dimension
    assert factor(internal_unit(dimension), dimension) == 1.0


@given(st.lists(st.floats(-1e6, 1e6), min_size=1), st.sampled_from(LISTED))
@settings(deadline=None)
def test_conversion_is_a_factor(values, listed):
    array = np.array(values)
    inside = to_internal(array, *listed)
    assert inside.dtype == np.float64 and inside.shape == array.shape
    np.testing.assert_allclose(inside, array * factor(*listed), rtol=1e-15)


@pytest.mark.parametrize("unit", ["furlong", "MPa", "n", "gram", "lbs", "px"])
def test_wrong_unit_is_refused(unit):
    with pytest.raises(InputError, match="'force_x'") as refusal:
        to_internal([1.0], unit, "force", column="force_x")
    assert repr(unit) in str(refusal.value) and "N, mN, uN, kN, gf, kgf" in str(refusal.value)


@pytest.mark.parametrize("unit", [None, ""])
def test_missing_unit_is_refused(unit):
    with pytest.raises(InputError, match="column 'depth' has no unit.*depth_mm.*`units:`.*mm, um"):
        to_internal([1.0], unit, "length", column="depth")


@pytest.mark.parametrize(
    ("text", "inside"), [(1800, 1800.0), ("17 GPa", 17000.0), ("18 kPa", 0.018), ("0.5", 0.5)]
)
def test_quantity(text, inside):
    assert read_quantity(text, "pressure") == pytest.approx(inside)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("hard", "not a quantity"),
        ("nan MPa", "not a quantity"),
        (True, "not a quantity"),
        ("3 N", "pressure"),
    ],
)
def test_quantity_refused(text, said):
    with pytest.raises(InputError, match=said):
        read_quantity(text, "pressure", column="bone")
