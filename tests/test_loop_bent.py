"""An effect that base parameters imitate so far that a score no longer shows it where the fit without it ends."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from fingerjax.loop.diagnosis import diagnose
from fingerjax.loop.record import Diagnosis
from fingerjax.loop.subject import NONE, AbstractSubject, Column, Evaluation, Family, Rows
from fingerjax.parameters import Parameter

X = np.linspace(-1.0, 1.0, 120)
ROUGH = np.where(np.arange(X.size) % 2 == 0, 1.0, -1.0)  # orthogonal to all that bends slowly
TRIALS, NOISE = 4, 0.1
FILM = Column("film", "size", "mm", 0.2, 0.0, 0.6, sign=1)
SIZE, SECOND = 0.15, 0.9


class Bent(AbstractSubject):
    """y = a + b x + e (1 + x + 0.3 x^3) + c e^2 rough(x): to first order the effect e is nearly a change of a and b."""

    def __init__(self, truth: float, second: float, seed: int = 0, *, dear: bool = False):
        self.name, self.kind, self.priors, self.second = "bent", "synthetic", {}, second
        self.families = (Family("film", (FILM,), "tissue", dear=dear),)
        self.parameters = tuple(Parameter(name, 0.0, "mm", "identity", -math.inf, math.inf) for name in ("a", "b"))
        self.asked = 0
        exact = self.read(np.array([1.0, 2.0]), truth)
        measured = np.tile(exact, TRIALS) + NOISE * np.random.default_rng(seed).standard_normal(TRIALS * X.size)
        trial = np.repeat(np.arange(TRIALS).astype(str), X.size)
        everywhere = np.full(measured.size, "all")
        kinds = {"data": "deflection_profile"}
        self.rows = Rows(
            {"data": slice(0, measured.size)}, everywhere, measured, {"data": {"x": np.tile(X, TRIALS)}}, {"data": "mm"}, trial, kinds
        )

    def read(self, raw: np.ndarray, size: float) -> np.ndarray:
        return raw[0] + raw[1] * X + size * (1 + X + 0.3 * X**3) + self.second * size**2 * ROUGH

    def slope(self, size: float) -> np.ndarray:
        return 1 + X + 0.3 * X**3 + 2 * self.second * size * ROUGH

    def evaluate(self, raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        size = phi.get(FILM.key, 0.0)
        self.asked += bool(moving)
        block = np.tile(self.slope(size), TRIALS)[:, None] if moving else np.zeros((TRIALS * X.size, 0))
        theta = np.tile(np.stack([np.ones_like(X), X], axis=1), (TRIALS, 1))
        return Evaluation(np.tile(self.read(raw, size), TRIALS), theta, block)

    def columns(self, raw: np.ndarray, phi: Mapping[str, float] = NONE) -> Mapping[str, np.ndarray]:
        return {FILM.key: np.tile(self.slope(phi.get(FILM.key, 0.0)), TRIALS)}


def diagnosed(subject: Bent) -> Diagnosis:
    return diagnose(subject, sets=0)


def test_it_is_refitted_and_named_though_no_test_at_the_end_of_the_fit_sees_it() -> None:
    found = diagnosed(Bent(SIZE, SECOND, 1))
    (film,) = found.candidates
    assert film.z < 1.0 < found.critical.maxT and film.fraction_left < 0.15
    assert film.refit.delta > found.critical.maxT**2
    assert found.verdict.kind == "attributed" and found.verdict.families == ["film"]
    low, high = found.after.phi[FILM.key].ci
    assert low < SIZE < high


def test_where_it_is_not_there_it_is_refitted_and_not_named() -> None:
    kinds = []
    for seed in range(8):
        subject = Bent(0.0, SECOND, seed)
        kinds.append(diagnosed(subject).verdict.kind)
        assert subject.asked
    assert kinds.count("adequate") >= 7


@pytest.mark.parametrize("dear", [True, False])
def test_what_is_dear_is_not_refitted_on_a_guess(dear: bool) -> None:
    subject = Bent(SIZE, SECOND, 1, dear=dear)
    found = diagnosed(subject)
    assert (found.verdict.kind == "adequate") == dear == (subject.asked == 0)
