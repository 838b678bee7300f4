"""Whether a study's own derivatives and balances hold: every slope that a fit would use, three ways, and statics of every indentation.

    forward  J t          reverse  J' w          differences  (r(x + h e) - r(x - h e)) / 2h

compared on a few random projections w of the residuals; and the adjoint identity w . (J t) = (J' w) . t. A difference is taken across no
change of contact: where the touching skin differs between its ends, its step is made smaller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..forward import Assembled
from ..forward.balance import Check, balances
from ..forward.problem import Problem
from ..forward.readings import Solved
from .evaluation import linearise

PROJECTIONS = 3
SAME_SLOPE = 1e-9  # forward against reverse: the same products in another order, but for small solves
DIFFERENCED = 1e-5  # against differences, where the solver's noise over the step allows it
NOISE = 10.0  # how much of its relative residual a solve may leave in a reading
FAINT = 0.01  # a parameter that is seen less than this share of the best seen one is judged by that share
SHORTER = (1.0, 0.25, 0.0625, 0.015625)  # steps tried, in units of the first

Tell = Callable[[float, str], None]


@dataclass(frozen=True)
class Slopes:
    """Derivatives of projected residuals (projections, p), three ways.

    `steps` (p,) are those of the differences, `scale` (p,) the lengths of the columns; `pushed` and `pulled` are w . (J t) and (J' w) . t
    for random w and t; `noise` is the solves' relative residual.
    """

    names: tuple[str, ...]
    forward: np.ndarray
    reverse: np.ndarray
    difference: np.ndarray
    steps: np.ndarray
    scale: np.ndarray
    pushed: float
    pulled: float
    noise: float


def derivative_checks(slopes: Slopes) -> list[Check]:
    """One row for each parameter and pair of modes, and the adjoint identity."""
    found = []
    for i, name in enumerate(slopes.names):
        reverse = np.max(np.abs(slopes.reverse[:, i] - slopes.forward[:, i])) / slopes.scale[i]
        difference = np.max(np.abs(slopes.difference[:, i] - slopes.forward[:, i])) / slopes.scale[i]
        allowed = max(DIFFERENCED, NOISE * slopes.noise / slopes.steps[i])
        found.append(Check(f"d residuals / d {name}: reverse against forward", float(reverse), SAME_SLOPE))
        found.append(Check(f"d residuals / d {name}: differences against forward", float(difference), allowed))
    apart = abs(slopes.pushed - slopes.pulled) / np.linalg.norm(slopes.scale)
    return [*found, Check("adjoint: w . (J t) is (J' w) . t", float(apart), SAME_SLOPE)]


def slopes_of(problem: Problem, tell: Tell = lambda share, doing: None) -> Slopes:
    """Differentiate a problem's residuals at its start in all three ways."""
    raw, rng = problem.start(), np.random.default_rng(0)
    held = _prepared(problem, raw)
    residual, tangents, health = linearise(held, jnp.asarray(raw))
    jacobian, noise = np.asarray(tangents), float(health.residual)
    w = rng.choice([-1.0, 1.0], size=(PROJECTIONS, len(residual)))
    t = rng.standard_normal(len(raw))
    reverse = np.asarray(_pull(held, jnp.asarray(raw), jnp.asarray(w)))
    pushed = float(w[0] @ np.asarray(_push(held, jnp.asarray(raw), jnp.asarray(t))))
    difference, steps = _differences(problem, raw, noise, _touching(held), tell)
    length = np.linalg.norm(jacobian, axis=0)
    scale = np.maximum(length, max(FAINT * length.max(), np.finfo(float).tiny))
    return Slopes(problem.names, w @ jacobian, reverse, w @ difference, steps, scale, pushed, float(reverse[0] @ t), noise)


def verify(assembled: Assembled, tell: Tell = lambda share, doing: None) -> list[Check]:
    """All checks of one study on its mesh, at the values where its fit begins."""
    tell(0.0, "balances")
    problem = assembled.problem()
    values = {one.name: jnp.asarray(one.value) for one in problem.parameters}
    found = balances(assembled.model, values)
    return [*found, *derivative_checks(slopes_of(problem, lambda share, doing: tell(0.2 + 0.8 * share, doing)))]


def _differences(
    problem: Problem, raw: np.ndarray, noise: float, held: tuple[bytes, ...], tell: Tell
) -> tuple[np.ndarray, np.ndarray]:
    """Central differences (rows, p) and their steps (p,)."""
    first = max(noise, 1e-13) ** (1 / 3)  # balances the noise over h against the truncation in h^2
    columns, steps = [], []
    for i, name in enumerate(problem.names):
        tell(i / len(problem.names), f"differences, {name}")
        column, step = _difference(problem, raw, i, first, held)
        columns.append(column)
        steps.append(step)
    return np.stack(columns, axis=1), np.array(steps)


def _difference(problem: Problem, raw: np.ndarray, which: int, first: float, held: tuple[bytes, ...]) -> tuple[np.ndarray, float]:
    direction = np.eye(len(raw))[which]
    column, step = np.full(0, np.nan), first
    for step in (first * shorter for shorter in SHORTER):
        ends = [raw + way * step * direction for way in (1, -1)]
        prepared = [_prepared(problem, end) for end in ends]
        up, down = (np.asarray(_value(one, jnp.asarray(end))) for one, end in zip(prepared, ends, strict=True))
        column = (up - down) / (2 * step)
        if all(_touching(one) == held for one in prepared):
            break
    return column, step


def _prepared(problem: Problem, raw: np.ndarray) -> Any:
    return problem.residuals if problem.prepare is None else problem.prepare(jnp.asarray(raw))


def _touching(residuals: Any) -> tuple[bytes, ...]:
    """Which skin touches in every contact behind prepared residuals; nothing for residuals without contacts."""
    model = getattr(residuals, "model", None)
    return tuple(np.asarray(rig.active).tobytes() for rig in model.known.rigs) if isinstance(model, Solved) else ()


@eqx.filter_jit
def _value(residuals: Any, raw: Array) -> Array:
    return residuals(raw)[0]


@eqx.filter_jit
def _push(residuals: Any, raw: Array, direction: Array) -> Array:
    return jax.jvp(lambda x: residuals(x)[0], (raw,), (direction,))[1]


@eqx.filter_jit
def _pull(residuals: Any, raw: Array, weights: Array) -> Array:
    _, back = jax.vjp(lambda x: residuals(x)[0], raw)
    return jax.lax.map(lambda w: back(w)[0], weights)
