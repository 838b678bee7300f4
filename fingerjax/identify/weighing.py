"""How residuals are weighed before they are squared: a robust loss, a resampled set of rows, or data drawn anew.

    least squares of  f_i(r_i)        r_i = (prediction - data) / sigma

Each of these is a change of the rows that needs no other run of the model, so that a thousand repeats share one compiled program.
Choose a loss: `linear` for what is normal, `huber` for a few outliers, `soft_l1` between the two, `cauchy` where outliers are wild.
"""

from __future__ import annotations

import abc
import dataclasses
from dataclasses import dataclass

import numpy as np

from ..forward.problem import LOSSES, Problem
from .evaluation import Point

TURN = 1.345  # sigmas beyond which a Huber loss grows straight: 95 % of the efficiency where all is normal (Huber 1981, section 4.5)


class AbstractWeighing(abc.ABC):
    """From a point as the model gave it to the point that is fitted; the former is kept in `Point.plain`."""

    @abc.abstractmethod
    def rows(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(f(r), df/dr), both (rows,)."""

    def __call__(self, point: Point) -> Point:
        if not point.usable:
            return point
        residual, slope = self.rows(point.residual)
        plain = point if point.plain is None else point.plain
        return dataclasses.replace(point, residual=residual, jacobian=slope[:, None] * point.jacobian, plain=plain)


@dataclass(frozen=True)
class Loss(AbstractWeighing):
    """A loss by name, on all rows but those of priors: f(r) = sign(r) sqrt(rho(r^2))."""

    name: str
    robust: np.ndarray  # (rows,) bool

    @classmethod
    def of(cls, problem: Problem, rows: int) -> Loss:
        robust = np.ones(rows, bool)
        if "prior" in problem.blocks:
            robust[problem.blocks["prior"]] = False
        return cls(problem.loss, robust)

    def rows(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rho, first, _ = rho_of(self.name, residual**2)
        small = np.abs(residual) < 1e-8
        root = np.sign(residual) * np.sqrt(np.where(small, residual**2, rho))
        slope = np.where(small, 1.0, first * residual / np.where(small, 1.0, root))
        return np.where(self.robust, root, residual), np.where(self.robust, slope, 1.0)

    def influence(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(psi, dpsi/dr), (rows,): half the slope of the loss in r, and its own slope."""
        _, first, second = rho_of(self.name, residual**2)
        psi = np.where(self.robust, first * residual, residual)
        return psi, np.where(self.robust, first + 2 * residual**2 * second, 1.0)


def rho_of(name: str, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """rho(z) of squared residuals z, and its first two derivatives; z itself near zero."""
    if name not in LOSSES:
        raise ValueError(f"unknown loss {name!r}; choose one of {', '.join(LOSSES)}")
    one, zero = np.ones_like(z), np.zeros_like(z)
    if name == "huber":
        root = np.sqrt(np.maximum(z, TURN**2))
        inside = z <= TURN**2
        rho = np.where(inside, z, 2 * TURN * root - TURN**2)
        return rho, np.where(inside, one, TURN / root), np.where(inside, zero, -TURN / 2 / root**3)
    if name == "soft_l1":
        root = np.sqrt(1 + z)
        return 2 * (root - 1), 1 / root, -0.5 / root**3
    if name == "cauchy":
        return np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2
    return z, one, zero


@dataclass(frozen=True)
class Redrawn(AbstractWeighing):
    """Data drawn anew: `shift` (rows,), in sigmas, is taken off every residual."""

    shift: np.ndarray

    def rows(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return residual - self.shift, np.ones_like(residual)


@dataclass(frozen=True)
class Counted(AbstractWeighing):
    """Rows that count several times, or not at all: `weight` (rows,) stands before the square."""

    weight: np.ndarray

    def rows(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        root = np.sqrt(self.weight)
        return root * residual, root


@dataclass(frozen=True)
class Chain(AbstractWeighing):
    """One weighing after the other."""

    first: AbstractWeighing
    second: AbstractWeighing

    def rows(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        once, slope = self.first.rows(residual)
        twice, more = self.second.rows(once)
        return twice, slope * more
