"""Rao's score: what every sleeping effect would explain, from one fit, the base parameters being free to move.

    s~ = Q S,   z = s~' r / |s~|,   expected change = s~' r / |s~|^2,   implied shift of theta = -J^+ S change

An effect on a grid counts by its best node; one that enters by several columns counts by z' (S~' S~)^-1 z, lowered by what more columns
reach by chance; a one-sided effect counts only on its own side. A column of which less than 3 % is left by Q is absorbed: these data
cannot tell it from a change of the base parameters. It is listed with the change that imitates it.

Rao (1948); Silvapulle & Sen, Constrained Statistical Inference (2005) for one-sided tests.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from ..identify.uncertainty import combination
from ..parameters import Parameter
from .refit import Optimum
from .subject import Column, Family
from .whitening import Projection

LEFT = 0.03  # share of a column's length that Q leaves, below which it is absorbed
FELT = 1e-3  # standard deviations by which a plausible size must move all rows together to be felt at all
POWER = 1.28  # normal quantile of 90 %: how surely the smallest detectable size is detected
_QUANTILE = 0.998  # at which statistics of several columns are made to agree with those of one


@dataclass(frozen=True, eq=False)
class Score:
    """One family, ranked.

    - `variant`: its columns at the best node; `z`: signed where it is one column, else the root of the block statistic, lowered.
    - `statistic`: what is compared with the critical value: |z|, or z on its own side.
    - `by_variant`: the statistic of each node that can be tested, best first.
    - `change`: key -> expected change from null; `theta_shift` (p,): what it does to the raw base parameters.
    - `left`: |Q S| / |S| of its first column; `length`: |Q S|, per unit. `direction` (sample,): Q S change, as a unit vector.
    - `testable`, and `reason` where it is not; `imitation`: the change of base parameters that looks the same.
    """

    family: Family
    variant: tuple[Column, ...]
    z: float
    statistic: float
    by_variant: tuple[tuple[tuple[Column, ...], float], ...]
    change: Mapping[str, float]
    theta_shift: Float[np.ndarray, "p"]
    left: float
    length: float
    direction: Float[np.ndarray, "sample"]
    testable: bool
    reason: str = ""
    imitation: str = ""

    def smallest(self, critical: float) -> float:
        """The size that these data would have shown with 90 % probability, in the unit of the first column; inf where none."""
        return (critical + POWER) / self.length if self.testable and self.length > 0 else math.inf


@dataclass(frozen=True, eq=False)
class Ranking:
    """All families at one optimum, best first.

    - `tested`: for each variant of each family that can be tested its columns, projected and normalised (sample, k).
    """

    scores: tuple[Score, ...]
    tested: tuple[tuple[tuple[Column, ...], Float[np.ndarray, "sample k"]], ...]

    def __getitem__(self, family: str) -> Score:
        return next(score for score in self.scores if score.family.name == family)

    @property
    def testable(self) -> tuple[Score, ...]:
        return tuple(score for score in self.scores if score.testable)

    @property
    def absorbed(self) -> tuple[Score, ...]:
        return tuple(score for score in self.scores if score.imitation)


def rank(best: Optimum, families: Sequence[Family], columns: Mapping[str, Float[np.ndarray, "rows"]]) -> Ranking:
    """Every family's score at an optimum.

    **Arguments:** `columns`: key -> (rows,) in the units of the rows per unit of the effect, as the subject gives them.
    """
    whitened = {key: best.sample.columns(np.asarray(column, dtype=float)[:, None])[:, 0] for key, column in columns.items()}
    work = _Work(best, best.projection, best.projection(best.residual), whitened)
    scores = sorted((work.score(family) for family in families), key=lambda score: (not score.testable, -score.statistic))
    tested = [
        (variant, work.normalised(variant)) for score in scores if score.testable for variant in (pair[0] for pair in score.by_variant)
    ]
    return Ranking(tuple(scores), tuple((work.seen(variant), block) for variant, block in tested))


@dataclass(frozen=True, eq=False)
class _Work:
    best: Optimum
    projection: Projection
    residual: Float[np.ndarray, "sample"]
    whitened: Mapping[str, Float[np.ndarray, "sample"]]

    def share_left(self, column: Column) -> float:
        whole = float(np.linalg.norm(self.whitened[column.key]))
        return float(np.linalg.norm(self.projection(self.whitened[column.key]))) / whole if whole > 0 else 0.0

    def felt(self, column: Column) -> bool:
        values = self.whitened[column.key]
        return bool(np.isfinite(values).all()) and float(np.linalg.norm(values)) * column.scale > FELT

    def seen(self, variant: Sequence[Column]) -> tuple[Column, ...]:
        """The columns of a variant that can be tested."""
        return tuple(column for column in variant if self.felt(column) and self.share_left(column) >= LEFT)

    def normalised(self, variant: Sequence[Column]) -> Float[np.ndarray, "sample k"]:
        block = np.stack([self.projection(self.whitened[column.key]) for column in self.seen(variant)], axis=1)
        return block / np.linalg.norm(block, axis=0)

    def score(self, family: Family) -> Score:
        ranked = [(variant, self.statistic(variant)) for variant in family.variants if self.seen(variant)]
        ranked.sort(key=lambda pair: -pair[1])
        if not ranked:
            return self._untestable(family)
        variant = ranked[0][0]
        columns = self.seen(variant)
        block = self.normalised(variant)
        lengths = np.array([np.linalg.norm(self.projection(self.whitened[column.key])) for column in columns])
        sizes = np.linalg.lstsq(block, self.residual, rcond=1e-9)[0] / lengths
        z = float(block[:, 0] @ self.residual) if len(columns) == 1 else ranked[0][1]
        change = {column.key: float(size) for column, size in zip(columns, sizes, strict=True)}
        moved = sum((self.whitened[key] * size for key, size in change.items()), np.zeros_like(self.residual))
        shift = -self.projection.inverse @ moved
        direction = self.projection(moved)
        direction = direction / max(float(np.linalg.norm(direction)), 1e-300)
        p = len(self.best.raw)
        return Score(
            family,
            variant,
            z,
            ranked[0][1],
            tuple(ranked),
            change,
            shift[:p],
            self.share_left(columns[0]),
            float(lengths[0]),
            direction,
            True,
        )

    def statistic(self, variant: Sequence[Column]) -> float:
        columns = self.seen(variant)
        return float(statistics(self.normalised(variant), columns, self.residual[:, None])[0])

    def _untestable(self, family: Family) -> Score:
        column = family.columns[0]
        felt = [one for one in family.columns if self.felt(one)]
        nothing, p = np.zeros_like(self.residual), len(self.best.raw)
        if not felt:
            reason = "a plausible size of it does not move these data"
            return Score(family, (column,), 0.0, 0.0, (), {}, np.zeros(p), 0.0, 0.0, nothing, False, reason)
        column = felt[0]
        shift = (self.projection.inverse @ self.whitened[column.key])[:p] * column.scale
        likeness = imitation(self.best.sample.subject.parameters, shift, column)
        reason = "absorbed by the base parameters: these data cannot tell it from a change of them"
        left = self.share_left(column)
        return Score(family, (column,), 0.0, 0.0, (), {}, -shift, left, 0.0, nothing, False, reason, likeness)


def statistics(
    block: Float[np.ndarray, "sample k"], columns: Sequence[Column], residuals: Float[np.ndarray, "sample draws"]
) -> Float[np.ndarray, "draws"]:
    """The statistic of one variant for many residuals: |z|, z on its own side, or the lowered root of a block's."""
    scores = block.T @ residuals
    if len(columns) == 1:
        sign = columns[0].sign
        return np.maximum(sign * scores[0], 0.0) if sign else np.abs(scores[0])
    values, vectors = np.linalg.eigh(block.T @ block)
    kept = values > 1e-9 * values[-1]
    squares = np.sum((vectors[:, kept].T @ scores) ** 2 / values[kept][:, None], axis=0)
    by_chance = stats.chi2.ppf(_QUANTILE, int(kept.sum())) - stats.chi2.ppf(_QUANTILE, 1)
    return np.sqrt(np.maximum(squares - by_chance, 0.0))


def imitation(parameters: tuple[Parameter, ...], shift: Float[np.ndarray, "p"], column: Column) -> str:
    """In words, the change of base parameters that a plausible size of an effect passes for."""
    if not np.any(shift):
        return "no base parameter"
    signs = np.where(np.abs(shift) > 0.05 * np.max(np.abs(shift)), shift, 0.0)
    moved = ", ".join(
        f"{parameter.name} {math.expm1(size):+.1%}" if parameter.link == "log" else f"{parameter.name} {size:+.3g} ({parameter.link})"
        for parameter, size in zip(parameters, signs, strict=True)
        if size != 0
    )
    return f"{combination(parameters, signs)}: {column.scale:g} {column.unit} of it passes for {moved}"
