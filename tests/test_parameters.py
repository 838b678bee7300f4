"""Parameters: links there and back, slopes against difference quotients, limits, refusals."""

from __future__ import annotations

import math

import jax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerjax._results import RESULTS
from fingerjax.errors import InputError
from fingerjax.parameters import Parameter

MODULUS = Parameter("epidermis.modulus", 0.18, unit="MPa", link="log", lower=1e-5, upper=1e3)
POISSON = Parameter("poisson_ratio", 0.48, link="logit", lower=0.0, upper=0.5)
OFFSET = Parameter("contact.offset", 0.0, unit="mm", link="identity", lower=-1.0, upper=1.0)
BOTH_WAYS = [MODULUS, POISSON, OFFSET]


@given(st.sampled_from(BOTH_WAYS), st.floats(0.001, 0.999))
@settings(deadline=None)
def test_there_and_back(parameter, share):
    value = parameter.lower + share * (parameter.upper - parameter.lower)
    assert float(parameter.natural(parameter.raw(value))) == pytest.approx(value, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("parameter", BOTH_WAYS, ids=lambda parameter: parameter.link)
@pytest.mark.parametrize("raw", [-0.7, 0.0, 0.9])
def test_slope_is_the_derivative(parameter, raw):
    step = 1e-5
    quotient = (parameter.natural(raw + step) - parameter.natural(raw - step)) / (2 * step)
    assert float(parameter.slope(raw)) == pytest.approx(float(quotient), rel=1e-8)
    assert float(jax.jit(jax.grad(parameter.natural))(raw)) == pytest.approx(
        float(parameter.slope(raw)), rel=1e-14
    )


@given(st.sampled_from([MODULUS, OFFSET]), st.floats(-60.0, 60.0))
@settings(deadline=None)
def test_raw_limits_hold_the_value_inside(parameter, raw):
    low, high = parameter.raw_limits()
    value = float(parameter.natural(min(max(raw, low), high)))
    assert (
        parameter.lower * (1 - 1e-12) <= value <= parameter.upper * (1 + 1e-12)
        or parameter.link == "identity"
    )
    assert low <= parameter.raw() <= high


def test_open_limits_have_no_raw_limit():
    assert Parameter("a.b", 1.0).raw_limits() == (-math.inf, math.inf)
    assert POISSON.raw_limits() == (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("parameter", "value", "limit"),
    [
        (MODULUS, 1e-5, "lower"),
        (MODULUS, 1e3, "upper"),
        (MODULUS, 2e3, "upper"),
        (MODULUS, 1.01e-5, "lower"),
        (MODULUS, 0.18, None),
        (MODULUS, 1e-4, None),
        (POISSON, 0.4999, "upper"),
        (POISSON, 0.48, None),
        (OFFSET, -1.0, "lower"),
        (Parameter("a.b", 1.0), 0.0, "lower"),
        (Parameter("a.b", 1.0), 1e30, None),
        (Parameter("a.b", 1.0, link="identity", lower=-math.inf), -1e9, None),
    ],
)
def test_at_limit(parameter, value, limit):
    assert parameter.at_limit(value) == limit


def test_group():
    one = MODULUS.of_group("MK1 left")
    assert (one.name, one.path, one.group) == ("epidermis.modulus[MK1 left]", "epidermis.modulus", "MK1 left")
    assert MODULUS.group is None and MODULUS.path == MODULUS.name
    assert one.of_group(2).name == "epidermis.modulus[2]"


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"name": "two words"}, "no path.*'two words'.*epidermis.modulus"),
        ({"link": "logg"}, "unknown link.*'logg'.*did you mean 'log'"),
        ({"value": -0.1}, r"outside its limits.*-0\.1.*above 0"),
        ({"value": math.nan}, "outside its limits.*nan"),
        ({"value": 9.0, "upper": 5.0}, r"outside its limits \(found 9\.0\).*between 0 and 5 MPa"),
        ({"lower": 2.0, "upper": 1.0}, r"not below the upper.*\(2\.0, 1\.0\)"),
        ({"lower": -1.0}, "log link.*not negative.*-1"),
        ({"link": "logit"}, "two finite limits.*inf"),
        ({"link": "logit", "value": 0.5, "upper": 0.5}, "outside its limits.*limits excluded"),
    ],
)
def test_refusals(fields, said):
    with pytest.raises(InputError, match=said):
        Parameter(**{"name": "a.b", "value": 0.1, "unit": "MPa", **fields})


def test_raw_refuses_a_value_outside():
    with pytest.raises(InputError, match="epidermis.modulus.*outside its limits"):
        MODULUS.raw(-2.0)


def test_results_say_what_to_try():
    assert [member for member in RESULTS if member.ok] == [RESULTS.successful]
    assert len({member.value for member in RESULTS}) == len(RESULTS.__members__) == 10
    for member in RESULTS:
        assert member.value[0].isupper() and member.value.endswith(".")
        assert member.ok or ";" in member.value  # what happened; what to try
