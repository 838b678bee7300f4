"""The steps of a fit: optimistix's Levenberg-Marquardt, and a secant step where large residuals bend the valley."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from .box import Box
from .evaluation import Point

DAMPING = 1e-3  # first Levenberg-Marquardt parameter, in units of the squared column lengths (Marquardt 1963)
SHRUNK = 0.1  # a column that falls below this share of its scale has its damping renewed


@cache
def _solver() -> Any:
    # A step is good from three quarters of the predicted reduction; optimistix asks for 0.99, which a curved
    # model reaches too late for the damping to vanish.
    search: Any = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0, low_constant=0.1)
    return eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(rtol=0.0, atol=0.0), search)


@cache
def _blank_state(rows: int, count: int) -> Any:
    """The solver's first state. Kept, because it holds a traced function and a new one would be compiled
    again."""
    z = jnp.zeros(count)
    args = (jnp.zeros(rows), jnp.zeros((rows, count)), z)
    shapes = jax.eval_shape(_linearised, z, args)
    return _solver().init(_linearised, z, args, {}, *shapes, frozenset())


@eqx.filter_jit
def _advance(z: Array, args: tuple[Array, Array, Array], state: Any) -> tuple[Array, Any]:
    z, state, _ = _solver().step(_linearised, z, args, {}, state, frozenset())
    return z, state


class Walk:
    """optimistix's Levenberg-Marquardt on linearisations that somebody else evaluates.

    Coordinates are z = raw * scale, scale being the column lengths of the Jacobian times sqrt(`DAMPING`).
    """

    def __init__(self, box: Box):
        self.box = box
        self.scale = np.array([])
        self.state: Any = None
        self.z: Any = None

    def begin(self, point: Point, step_size: float = 1.0) -> np.ndarray:
        """(Re)start at an evaluated point and say where to evaluate next."""
        lengths = np.linalg.norm(point.jacobian, axis=0)
        fresh = np.where(lengths > 0, lengths, 1.0) * math.sqrt(DAMPING)
        self.scale = fresh if self.scale.size == 0 else np.maximum(fresh, SHRUNK * self.scale)
        self.z = jnp.asarray(point.raw * self.scale)
        self.state = eqx.tree_at(
            lambda s: (s.y_eval, s.search_state.step_size),
            _blank_state(*point.jacobian.shape),
            (self.z, jnp.asarray(step_size)),
        )
        return self.advance(point, point)

    def advance(self, at: Point, best: Point) -> np.ndarray:
        """Tell the solver what was found at its trial point; (p,) raw where it wants to look next.

        A point higher than the best is refused here: after clipping, the solver may have predicted it to be
        so.
        """
        surrogate = self._surrogate(at, refuse=not at.usable or at.chi2 > best.chi2)
        self.z, self.state = _advance(self.z, surrogate, self.state)
        centre = np.asarray(self.z) / self.scale
        trial = self.box.inside(centre, np.asarray(self.state.y_eval) / self.scale)
        self.state = eqx.tree_at(lambda s: s.y_eval, self.state, jnp.asarray(trial * self.scale))
        return trial

    @property
    def accepted(self) -> bool:
        return int(self.state.num_steps_since_acceptance) == 0

    @property
    def step_size(self) -> float:
        return float(self.state.search_state.step_size)

    def outgrown(self, point: Point) -> bool:
        """Has a column grown or shrunk so far from its scale that the damping no longer knows it?"""
        share = np.linalg.norm(point.jacobian, axis=0) * math.sqrt(DAMPING) / self.scale
        return bool(np.any((share > 2.0) | ((share < SHRUNK) & (share > 0) & ~self.box.idle(point))))

    def _surrogate(self, point: Point, refuse: bool = False) -> tuple[Array, Array, Array]:
        residual, jacobian = point.residual, point.jacobian * ~self.box.idle(point)
        if refuse:
            residual, jacobian = np.full_like(residual, np.inf), np.zeros_like(jacobian)
        return jnp.asarray(residual), jnp.asarray(jacobian / self.scale), jnp.asarray(point.raw * self.scale)


def _linearised(z: Array, args: tuple[Array, Array, Array]) -> tuple[Array, None]:
    residual, jacobian, centre = args
    return residual + jacobian @ (z - centre), None


class Secant:
    """What Gauss and Newton leave out of the second derivative where residuals stay large, learnt from pairs of evaluations.

        B = J'J + S,    S s ~ (J+ - J)' r+    along every step s taken

    Without it, steps overshoot across a bent valley and a fit of a wrong model ends by halving its error at every second evaluation.
    Dennis, Gay & Welsch (1981), update (2.10) with their sizing.
    """

    def __init__(self, box: Box):
        self.box = box
        self.curvature = np.zeros((len(box.lower),) * 2)

    def learn(self, at: Point, best: Point) -> None:
        """Take in what one more evaluation says about the curvature on the way from the best point to it."""
        if not at.usable or not math.isfinite(at.chi2):
            return
        s = at.raw - best.raw
        y = at.jacobian.T @ at.residual - best.jacobian.T @ best.residual
        bent = (at.jacobian - best.jacobian).T @ at.residual
        along = float(y @ s)
        if not (along > 1e-10 * float(np.linalg.norm(y) * np.linalg.norm(s)) > 0):
            return
        known = float(s @ self.curvature @ s)
        if known != 0:
            self.curvature = self.curvature * min(1.0, abs(float(s @ bent)) / abs(known))
        wrong = bent - self.curvature @ s
        change = (np.outer(wrong, y) + np.outer(y, wrong)) / along
        self.curvature = self.curvature + change - float(s @ wrong) / along**2 * np.outer(y, y)

    def trial(self, best: Point) -> np.ndarray | None:
        """Where the gradient should vanish, (p,) raw; None where the curvature known so far has no minimum."""
        moving = ~self.box.idle(best) & (np.linalg.norm(best.jacobian, axis=0) > 0)
        jacobian = best.jacobian[:, moving]
        scale = np.linalg.norm(jacobian, axis=0)
        hessian = (jacobian.T @ jacobian + self.curvature[np.ix_(moving, moving)]) / np.outer(scale, scale)
        if not moving.any() or np.linalg.eigvalsh(hessian)[0] < 1e-8:
            return None
        step = np.zeros(len(best.raw))
        step[moving] = -np.linalg.solve(hessian, jacobian.T @ best.residual / scale) / scale
        return self.box.inside(best.raw, best.raw + step)
