"""The rows that are fitted, in units of their noise, with one row for each prior below them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..parameters import Parameter
from .noise import Noise
from .subject import AbstractSubject, Evaluation, LogPrior
from .whitening import Whitener


@dataclass(frozen=True, eq=False)
class Sample:
    """What a fit sees: r = L^-1 (y - f - D) of the rows in `chosen`, then (mean - value) / sd of each prior.

    - `freedom`: block -> degrees of freedom that tell its noise. `covariance` (rows, rows): Sigma of all rows.
    - `offset` (rows,): D, what is added to the prediction for the sake of the mesh.
    """

    subject: AbstractSubject
    measured: Float[np.ndarray, "rows"]
    chosen: Bool[np.ndarray, "rows"]
    covariance: Float[np.ndarray, "rows rows"]
    offset: Float[np.ndarray, "rows"]
    whiten: Whitener
    freedom: Mapping[str, float]

    @classmethod
    def of(cls, subject: AbstractSubject, noise: Noise, chosen: Bool[np.ndarray, "rows"]) -> Sample:
        covariance = noise.covariance()
        whiten = Whitener.of(covariance[np.ix_(chosen, chosen)])
        return cls(subject, subject.rows.measured, chosen, covariance, np.zeros(len(chosen)), whiten, noise.freedom)

    def corrected(self, offset: Float[np.ndarray, "rows"], left: Float[np.ndarray, "rows rows"] | None = None) -> Sample:
        """The same with the mesh's correction, and the covariance of what that leaves added."""
        if left is None:
            return replace(self, offset=offset)
        covariance = self.covariance + left
        whiten = Whitener.of(covariance[np.ix_(self.chosen, self.chosen)])
        return replace(self, offset=offset, covariance=covariance, whiten=whiten)

    def error(self, at: Evaluation) -> Float[np.ndarray, "rows"]:
        """Data less prediction of all rows, in their units."""
        return self.measured - at.prediction - self.offset

    def residual(self, at: Evaluation, raw: Float[np.ndarray, "p"]) -> Float[np.ndarray, "sample"]:
        """(fitted rows and priors,) in standard deviations."""
        pairs = zip(self.subject.parameters, raw, strict=True)
        priors = [self._prior(parameter, float(value))[0] for parameter, value in pairs if parameter.name in self.subject.priors]
        return np.concatenate([self.whiten(self.error(at)[self.chosen]), np.array(priors)])

    def jacobian(self, at: Evaluation, raw: Float[np.ndarray, "p"]) -> Float[np.ndarray, "sample p"]:
        """Derivative of the prediction by the raw parameters, whitened, priors below."""
        slopes = [
            np.eye(len(raw))[number] * self._prior(parameter, float(raw[number]))[1]
            for number, parameter in enumerate(self.subject.parameters)
            if parameter.name in self.subject.priors
        ]
        below = np.array(slopes).reshape(len(slopes), len(raw))
        return np.concatenate([self.whiten(at.theta_jacobian[self.chosen]), below])

    def _prior(self, parameter: Parameter, raw: float) -> tuple[float, float]:
        """(mean - value) / sd, and the slope of value / sd by the raw value."""
        prior = self.subject.priors[parameter.name]
        if isinstance(prior, LogPrior):
            return (math.log(prior.value) - raw) / prior.sd, 1.0 / prior.sd
        return (prior.value - float(parameter.natural(raw))) / prior.sd, float(parameter.slope(raw)) / prior.sd

    def columns(self, columns: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "sample k"]:
        """Columns of effects, whitened; no effect moves a prior."""
        below = np.zeros((len(self.subject.priors), columns.shape[1]))
        return np.concatenate([self.whiten(columns[self.chosen]), below])

    @property
    def size(self) -> int:
        """Number of fitted rows and priors."""
        return int(self.chosen.sum()) + len(self.subject.priors)

    def parts(self) -> list[tuple[Int[np.ndarray, "members"], float]]:
        """The fitted rows of each block by their number in the sample, and the degrees of freedom that tell their noise."""
        blocks = self.subject.rows.block[self.chosen]
        return [(np.flatnonzero(blocks == name), float(dof)) for name, dof in self.freedom.items()]

    def settings(self) -> Float[np.ndarray, "sample settings"]:
        """Whitened indicator of each thing that was measured: what a model can predict at all, priors included."""
        numbers = np.unique(self.subject.rows.setting[self.chosen], return_inverse=True)[1].reshape(-1)
        indicator = np.zeros((len(numbers), numbers.max(initial=-1) + 1))
        indicator[np.arange(len(numbers)), numbers] = 1.0
        rows, priors = indicator.shape[1], len(self.subject.priors)
        whole = np.zeros((self.size, rows + priors))
        whole[: len(numbers), :rows] = self.whiten(indicator)
        whole[len(numbers) :, rows:] = np.eye(priors)
        return whole
