"""The search for the least sum of squares where the residual at the end is large."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from fingerjax.loop.descent import Place, descend, learned

FAR = np.array([-5.0, -5.0]), np.array([5.0, 5.0])
FAR_ONE = np.array([-5.0]), np.array([5.0])
NEAR = 6e-3  # standard errors; those of this curve are some 27 times the noise
T = np.linspace(0.0, 3.0, 25)


class Curve:
    """exp(a) exp(-exp(b) t) beside data of quite another form, counted."""

    def __init__(self, wall: float = np.inf):
        self.data, self.count, self.wall = 40.0 * np.cos(2.0 * T) + 30.0, 0, wall

    def residual(self, x: np.ndarray) -> np.ndarray:
        self.count += 1
        value = 40.0 * np.exp(x[0] - np.exp(x[1]) * T)
        return value - self.data if x[0] < self.wall else np.full(len(T), np.nan)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        value = 40.0 * np.exp(x[0] - np.exp(x[1]) * T)
        return np.stack([value, -np.exp(x[1]) * T * value], axis=1)


class Counted(Curve):
    """The same beside data that it nearly meets, its Jacobians counted."""

    def __init__(self) -> None:
        super().__init__()
        self.data, self.slopes = 30.0 * np.exp(-0.5 * T) + 2.0 * np.cos(3.0 * T), 0

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        self.slopes += 1
        return super().jacobian(x)


def test_a_large_residual_does_not_slow_the_search() -> None:
    curve = Curve()
    found, reached = descend(curve.residual, curve.jacobian, np.array([0.0, 0.0]), *FAR, NEAR)
    known = least_squares(curve.residual, np.zeros(2), jac=curve.jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert reached and known.cost > 1e3
    assert np.sum(curve.residual(found) ** 2) == pytest.approx(2 * known.cost, rel=1e-5)
    quick, slow = Curve(), Curve()
    descend(quick.residual, quick.jacobian, np.zeros(2), *FAR, NEAR)
    x = np.zeros(2)
    while np.linalg.norm(np.linalg.qr(slow.jacobian(x))[0].T @ slow.residual(x)) > NEAR * 27 and slow.count < 100:
        x = x - np.linalg.lstsq(slow.jacobian(x), slow.residual(x), rcond=None)[0]
    assert quick.count < slow.count / 2


def test_bounds_hold_and_the_other_parameter_is_at_its_best() -> None:
    curve = Curve()
    found, _ = descend(curve.residual, curve.jacobian, np.array([-2.0, 0.0]), np.array([-5.0, -5.0]), np.array([0.2, 5.0]), NEAR)
    known = least_squares(curve.residual, [-2.0, 0.0], jac=curve.jacobian, bounds=([-5.0, -5.0], [0.2, 5.0]), xtol=1e-14, ftol=1e-14)
    assert found == pytest.approx(known.x, abs=5e-3) and found[0] == pytest.approx(0.2)


def test_a_step_to_where_there_is_no_answer_is_refused() -> None:
    curve = Curve(wall=1.2)
    found, _ = descend(curve.residual, curve.jacobian, np.array([-3.0, 2.0]), *FAR, 1e-3)
    assert np.isfinite(curve.residual(found)).all()


def test_what_is_learned_agrees_with_the_gradients_at_both_ends() -> None:
    curve = Curve()
    here, there = (Place(x, curve.residual(x), curve.jacobian(x)) for x in (np.array([0.1, 0.0]), np.array([0.3, 0.1])))
    turned = (there.jacobian - here.jacobian).T @ there.residual
    assert learned(np.diag([1.0, -2.0]), here, there) @ (there.x - here.x) == pytest.approx(turned, rel=1e-9)


def test_a_valley_that_bends_is_followed() -> None:
    def residual(x: np.ndarray) -> np.ndarray:
        count[0] += 1
        return np.array([100.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    count = [0]
    found, reached = descend(
        residual, lambda x: np.array([[-200.0 * x[0], 100.0], [-1.0, 0.0]]), np.array([-1.2, 1.0]), *FAR, 1e-6
    )  # fmt: skip
    assert reached and found == pytest.approx([1.0, 1.0], abs=1e-6) and count[0] < 40


def test_an_edge_to_which_both_slopes_lead_ends_the_search_soon() -> None:
    """Far from the data, 2 + 3 |x| is least at 0, where no slope vanishes: steps promise what neither side holds."""

    def residual(x: np.ndarray) -> np.ndarray:
        count[0] += 1
        return np.array([*np.full(100, 10.0), 2.0 + 3.0 * abs(x[0])])

    count = [0]
    found, reached = descend(residual, lambda x: np.array([*np.zeros(100), 3.0 * np.sign(x[0])])[:, None], np.array([0.7]), *FAR_ONE, 1e-3)
    assert not reached and abs(found[0]) < 0.1 and count[0] < 25  # a standard error is 0.33, or more where all else is as far off


def test_a_step_to_where_there_are_no_slopes_is_refused() -> None:
    curve = Curve()

    def jacobian(x: np.ndarray) -> np.ndarray:
        return curve.jacobian(x) if x[0] < 0.2 else np.full((len(T), 2), np.nan)

    found, reached = descend(curve.residual, jacobian, np.array([-2.0, 0.0]), *FAR, NEAR)
    assert not reached and found[0] < 0.2 and np.isfinite(curve.residual(found)).all()


@pytest.mark.parametrize("start", [(0.0, 0.0), (-2.0, 1.0), (1.0, -1.5)])
def test_dear_slopes_are_asked_for_seldom_and_the_end_is_the_same(start: tuple[float, float]) -> None:
    found, asked = [], []
    for dear in (False, True):
        curve = Counted()
        where, reached = descend(curve.residual, curve.jacobian, np.array(start), *FAR, 1e-3, dear=dear)
        asked.append(curve.slopes)
        true, typical = Curve.jacobian(curve, where), np.linalg.norm(curve.residual(where)) / np.sqrt(len(T))
        assert reached and np.linalg.norm(np.linalg.qr(true)[0].T @ curve.residual(where)) < 1e-3 * typical, "an optimum by true slopes"
        found.append(where)
    assert found[1] == pytest.approx(found[0], abs=1e-3) and asked[1] < asked[0]


def test_a_point_reached_on_trust_that_has_no_slopes_is_left() -> None:
    curve = Curve()
    curve.data = 30.0 * np.exp(-0.5 * T)  # at (-0.29, -0.69)

    def jacobian(x: np.ndarray) -> np.ndarray:
        return curve.jacobian(x) if x[0] < -0.4 else np.full((len(T), 2), np.nan)

    found, reached = descend(curve.residual, jacobian, np.array([-1.0, -0.5]), *FAR, 1e-3, dear=True)
    assert not reached and np.isfinite(curve.residual(found)).all()


def test_a_search_along_dear_slopes_is_given_up_sooner() -> None:
    counts = []
    for dear in (False, True):
        curve = Counted()
        _, reached = descend(curve.residual, curve.jacobian, np.array([-4.0, 3.0]), *FAR, 1e-3, enough=1.0, dear=dear)
        assert not reached, "nothing comes below a sum of squares of 1 beside these data"
        counts.append(curve.slopes)
    assert counts[1] < counts[0]
