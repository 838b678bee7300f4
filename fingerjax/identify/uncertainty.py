"""What a fit knows about its parameters: intervals, correlations, and what the data cannot tell.

    estimator's covariance   V = A^-1 (sum over blocks s_b^2 J_b' J_b) A^-1,   A = J' J

in raw parameters. A block whose noise is stated, or comes from replicates, has s_b = 1, so that V = A^-1
where all are. Blocks whose noise was only assumed share one s^2, estimated from their own residuals; the
intervals are then Student's with the degrees of freedom that those residuals have left. Under a robust loss with influence psi

    V = A^-1 (sum over rows psi_i^2 J_i J_i') A^-1 n / (n - p),   A = sum over rows max(psi'_i, 0) J_i J_i'

(Huber, Robust Statistics, 1981, section 7.6), which takes no noise at its word. Intervals are mapped
through the link, so those of a modulus are positive and not symmetric.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fingerjax.identify.fit import Fit
from fingerjax.identify.weighing import Loss
from fingerjax.parameters import Parameter

UNSEEN = (
    1e-6  # singular value of the column-normalised Jacobian, relative to the largest, that counts as nothing
)
VAGUE = math.log(10.0)  # half-width of a log or logit parameter's interval beyond which it is not identified
INVOLVED = 0.05  # share of an unseen direction that makes a parameter part of it


@dataclass(frozen=True)
class Estimate:
    """One parameter as a report prints it. Undefined numbers are NaN, and `reason` says why."""

    name: str
    value: float
    unit: str
    standard_error: float
    lower: float
    upper: float
    start: float
    at_limit: str | None
    identified: bool
    reason: str


@dataclass(frozen=True)
class Uncertainty:
    """What the data say about the parameters at the end of a fit.

    - `covariance` (p, p), `correlations` (p, p): in raw parameters; NaN rows for the undefined ones.
    - `unscaled` (p, p): A^-1, the inverse of half the curvature of chi-square; NaN rows as above.
    - `sigma`: "stated", "estimated", or "robust" under a loss other than squares; `t` is the quantile that widens a standard
      error to half an interval,
      and `noise_dof` the degrees of freedom behind it (inf where sigma is stated).
    - `variance`: chi2 / dof, about 1 where the model fits to within the stated noise.
    - `sentences`: what the data do not see, in words.
    """

    estimates: tuple[Estimate, ...]
    covariance: np.ndarray
    correlations: np.ndarray
    sigma: str
    t: float
    noise_dof: float
    variance: float
    sentences: tuple[str, ...]
    unscaled: np.ndarray

    def __getitem__(self, name: str) -> Estimate:
        return next(estimate for estimate in self.estimates if estimate.name == name)

    @property
    def identified(self) -> bool:
        return all(estimate.identified for estimate in self.estimates)

    def strongest(self, count: int = 5, least: float = 0.5) -> list[tuple[str, str, float]]:
        """The largest correlations in absolute value: (name, name, correlation)."""
        names = [estimate.name for estimate in self.estimates]
        upper = zip(*np.triu_indices(len(names), 1), strict=True)
        pairs = [(names[i], names[j], float(self.correlations[i, j])) for i, j in upper]
        return sorted((p for p in pairs if abs(p[2]) >= least), key=lambda p: -abs(p[2]))[:count]


@dataclass(frozen=True)
class _Seen:
    """Which raw directions the Jacobian sees. Columns of fixed parameters have been taken out before."""

    covariance: np.ndarray  # (k, k) pseudo-inverse of J'J on the seen directions
    unseen: np.ndarray  # (k, n) raw directions along which nothing changes
    involved: np.ndarray  # (k,) bool

    @classmethod
    def of(cls, jacobian: np.ndarray) -> _Seen:
        lengths = np.linalg.norm(jacobian, axis=0)
        scale = np.where(lengths > 0, lengths, 1.0)
        _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=True)
        singular = np.pad(singular, (0, vt.shape[0] - singular.size))
        seen = singular > UNSEEN * np.max(singular, initial=0.0)
        root = vt[seen].T / singular[seen] / scale[:, None]
        unseen = vt[~seen].T / scale[:, None]
        unseen = unseen / np.maximum(np.linalg.norm(unseen, axis=0), 1e-300)
        return cls(root @ root.T, unseen, np.any(np.abs(unseen) > INVOLVED, axis=1))


def uncertainty(fit: Fit, *, level: float = 0.95, spread: np.ndarray | None = None) -> Uncertainty:
    """Standard errors, `level` intervals, correlations, and what the data do not see.

    **Arguments:** `fit` as `identify.fit` returned it. Where it is not settled everything is NaN: the
    linearisation away from an optimum says nothing about the noise. `spread` (p, p), a covariance of the raw parameters that noise
    knows nothing of, is added: what is left of the mesh's error (`refined.Refined.spread`).

    A parameter at its limit has no interval (it does not move with the data), and the others are given it. A
    parameter that takes part in an unseen direction has none either. In the sentences a direction reads as a
    product of powers, because moduli are fitted in their logarithms.

    Seber & Wild, Nonlinear Regression (1989), section 5.1.
    """
    parameters = fit.problem.parameters
    free = np.array([p.name not in fit.limits for p in parameters]) & fit.settled
    jacobian = fit.jacobian[:, free]
    robust = fit.problem.loss != "linear"
    seen = _Seen.of(_bent(fit, jacobian) if robust else jacobian)
    s2, noise_dof = (1.0, float(fit.dof)) if robust else _noise(fit, jacobian, seen)
    covariance = np.full((len(parameters), len(parameters)), np.nan)
    defined = np.flatnonzero(free)[~seen.involved]
    inner = _sandwich(fit, jacobian, seen, s2)[np.ix_(~seen.involved, ~seen.involved)]
    covariance[np.ix_(defined, defined)] = inner if spread is None else inner + spread[np.ix_(defined, defined)]
    unscaled = np.full_like(covariance, np.nan)
    unscaled[np.ix_(defined, defined)] = seen.covariance[np.ix_(~seen.involved, ~seen.involved)]
    t = float(stats.t.ppf(0.5 + level / 2, noise_dof)) if noise_dof > 0 else math.nan
    involved = np.zeros(len(parameters), bool)
    involved[np.flatnonzero(free)] = seen.involved
    width = t * np.sqrt(np.diag(covariance))
    names = [p.name for p, is_free in zip(parameters, free, strict=True) if is_free]
    return Uncertainty(
        estimates=tuple(_estimate(fit, j, width[j], bool(involved[j]), t) for j in range(len(parameters))),
        covariance=covariance,
        correlations=_correlations(covariance),
        sigma="robust" if robust else "estimated" if math.isfinite(noise_dof) else "stated",
        t=t,
        noise_dof=noise_dof,
        variance=fit.chi2 / fit.dof if fit.dof > 0 else math.nan,
        sentences=_sentences([p for p in parameters if p.name in names], jacobian, seen)
        if fit.settled
        else (),
        unscaled=unscaled,
    )


def _assumed_rows(fit: Fit) -> np.ndarray:
    rows = np.zeros(fit.residual.size, bool)
    for block, where in fit.problem.blocks.items():
        rows[where] = fit.problem.sigma_source.get(block) == "assumed"
    return rows


def _noise(fit: Fit, jacobian: np.ndarray, seen: _Seen) -> tuple[float, float]:
    """(s^2 of the assumed rows, degrees of freedom it was estimated with); (1, inf) where none is assumed.

    The degrees of freedom are the rows less their leverage on the fit: n - p where every row is assumed.
    """
    rows = _assumed_rows(fit)
    if not rows.any():
        return 1.0, math.inf
    leverage = np.einsum("ij,jk,ik->", jacobian[rows], seen.covariance, jacobian[rows])
    dof = float(rows.sum() - leverage)
    if dof < 1e-6:
        return math.nan, 0.0
    return float(np.sum(fit.residual[rows] ** 2)) / dof, dof


def _bent(fit: Fit, jacobian: np.ndarray) -> np.ndarray:
    """Rows of the Jacobian by the root of the loss's own curvature there."""
    _, slope = Loss.of(fit.problem, fit.residual.size).influence(fit.residual)
    return np.sqrt(np.maximum(slope, 0.0))[:, None] * jacobian


def _sandwich(fit: Fit, jacobian: np.ndarray, seen: _Seen, s2: float) -> np.ndarray:
    if fit.problem.loss == "linear":
        weights = np.where(_assumed_rows(fit), s2, 1.0)
    else:
        psi, _ = Loss.of(fit.problem, fit.residual.size).influence(fit.residual)
        weights = psi**2 * fit.residual.size / max(fit.dof, 1)
    return seen.covariance @ (jacobian.T @ (weights[:, None] * jacobian)) @ seen.covariance


def _correlations(covariance: np.ndarray) -> np.ndarray:
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return covariance / np.outer(deviation, deviation)


def _estimate(fit: Fit, j: int, width: float, involved: bool, t: float) -> Estimate:
    parameter = fit.problem.parameters[j]
    limit = fit.limits.get(parameter.name) if fit.settled else None
    ends = [float(parameter.natural(fit.raw[j] + side * width)) for side in (-1.0, 1.0)]
    vague = parameter.link != "identity" and bool(width > VAGUE)
    identified = fit.settled and limit is None and not involved and not vague
    error = float(parameter.slope(fit.raw[j])) * width / t if width == width else math.nan
    value = fit.values[parameter.name]
    reason = _reason(fit, limit, involved, vague, t)
    return Estimate(
        parameter.name,
        value,
        parameter.unit,
        error,
        ends[0],
        ends[1],
        parameter.value,
        limit,
        identified,
        reason,
    )


def _reason(fit: Fit, limit: str | None, involved: bool, vague: bool, t: float) -> str:
    if not fit.settled:
        return f"no optimum: {fit.reason}"
    if limit is not None:
        return f"ran towards its {limit} limit"
    if involved:
        return "not seen by these data"
    if t != t:
        return "the noise was assumed and no observation is left over to estimate it from"
    return "seen only to within a factor of ten or worse" if vague else ""


# ---- in words ----


def _sentences(parameters: Sequence[Parameter], jacobian: np.ndarray, seen: _Seen) -> tuple[str, ...]:
    lengths = np.linalg.norm(jacobian, axis=0)
    blind = lengths == 0
    said = [f"no observation depends on {p.name}" for p, dead in zip(parameters, blind, strict=True) if dead]
    mixed = seen.involved & ~blind
    if not mixed.any():
        return tuple(said)
    group = [p for p, inside in zip(parameters, mixed, strict=True) if inside]
    _, singular, vt = np.linalg.svd(jacobian[:, mixed], full_matrices=True)
    rank = int(np.sum(singular > UNSEEN * singular[0]))
    if rank == 1:
        said.append(
            f"these data see only {combination(group, vt[0])}, not {_listed(group)} one by one: "
            "fix one, tie them, or measure something that tells them apart"
        )
    else:
        said += [
            f"of {_listed(group)} these data see {rank} combinations: "
            f"moving along {combination(group, direction)} changes nothing that was measured"
            for direction in _sparse(vt[rank:])
        ]
    return tuple(said)


def _sparse(directions: np.ndarray) -> np.ndarray:
    """An equivalent basis with as many zeros as elimination can make, so that each sentence names few
    parameters."""
    basis = directions.copy()
    for row in range(basis.shape[0]):
        column = int(np.argmax(np.abs(basis[row])))
        basis[row] /= basis[row, column]
        others = [k for k in range(basis.shape[0]) if k != row]
        basis[others] -= np.outer(basis[others, column], basis[row])
    return basis


def combination(parameters: Sequence[Parameter], weights: np.ndarray) -> str:
    """A raw direction in words: `dermis.modulus x adipose.modulus^0.8`, or a sum where a link is not the
    log."""
    kept = [(p, w) for p, w in zip(parameters, weights / _largest(weights), strict=True) if abs(w) > INVOLVED]
    kept.sort(key=lambda pair: -abs(pair[1]))
    if all(parameter.link == "log" for parameter, _ in kept):
        return " x ".join(p.name + ("" if f"{w:.2g}" == "1" else f"^{w:.2g}") for p, w in kept)
    return " + ".join(("" if f"{w:.2g}" == "1" else f"({w:.2g}) ") + _linked(p) for p, w in kept)


def _linked(parameter: Parameter) -> str:
    return parameter.name if parameter.link == "identity" else f"{parameter.link}({parameter.name})"


def _largest(weights: np.ndarray) -> float:
    return float(weights[int(np.argmax(np.abs(weights)))])


def _listed(parameters: Sequence[Parameter]) -> str:
    names = [parameter.name for parameter in parameters]
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
