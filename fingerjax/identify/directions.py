"""What the data see, combination by combination: the singular directions of the scaled Jacobian, stiff ones first, in words.

    J = U S V'        raw parameters move along v_k by 1 / s_k standard deviations of the data

A direction is known to 1 / s_k in the logarithm of a product of powers. Whether two moduli enter as a product, a ratio, a sum or something
else cannot be told from one point, so a pair that is seen in one combination only is moved a finite way along each, and the model is asked.

Brown & Sethna, Phys. Rev. E 68 (2003) 021904.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..parameters import Parameter
from .box import Box
from .evaluation import evaluator
from .fit import Fit
from .uncertainty import Uncertainty, combination, uncertainty

MAIN = 0.2  # share of a direction's largest part that a parameter needs to be named
SLOPPY = math.log(10.0)  # of half an interval: a direction is known to a factor of ten, or worse
UNSEEN = math.log(1000.0)  # a factor of a thousand: not seen
FACTOR = 2.0  # by which a pair is moved when it is asked how it enters
SAME = 0.3  # rise of chi2, as a share of that for moving one parameter alone, below which a combination is what counts


@dataclass(frozen=True)
class Direction:
    """One combination of the parameters.

    - `weights` (p,): unit vector of raw parameters. `spread`: half a 95 % interval along it, inf where nothing changes.
    - `words`: the combination; `known`: how well it is known, in words.
    """

    weights: np.ndarray
    spread: float
    words: str
    known: str

    @property
    def sloppy(self) -> bool:
        return self.spread > SLOPPY

    def row(self, names: tuple[str, ...]) -> dict[str, object]:
        parts: dict[str, object] = {name: float(weight) for name, weight in zip(names, self.weights, strict=True)}
        return {"combination": self.words, "half_interval_of_its_logarithm": self.spread, "known": self.known, **parts}


def directions(fit: Fit, known: Uncertainty | None = None) -> tuple[Direction, ...]:
    """The singular directions at the end of a fit, best known first; parameters at a limit take no part."""
    known = uncertainty(fit) if known is None else known
    free = np.array([name not in fit.limits for name in fit.problem.names])
    scale = _noise_scale(known)
    _, s, vt = np.linalg.svd(fit.jacobian[:, free], full_matrices=True)
    s = np.concatenate([s, np.zeros(len(vt) - len(s))])
    floor = 1e-9 * float(s.max(initial=0.0))
    found = []
    for size, part in zip(s, vt, strict=True):
        weights = np.zeros(len(free))
        weights[free] = part * (1 if part[np.argmax(np.abs(part))] > 0 else -1)
        spread = float(known.t * scale / size) if size > floor else math.inf
        found.append(Direction(weights, spread, _named(fit.problem.parameters, weights), _how_well(spread)))
    return tuple(found)


def _noise_scale(known: Uncertainty) -> float:
    """Standard deviation of the residuals in units of the sigma that they were divided by: 1 where that is stated."""
    with np.errstate(invalid="ignore"):
        ratio = known.covariance.diagonal() / known.unscaled.diagonal()
    return math.sqrt(float(np.nanmedian(ratio))) if np.isfinite(ratio).any() else 1.0


def _named(parameters: tuple[Parameter, ...], weights: np.ndarray) -> str:
    largest = np.max(np.abs(weights))
    return combination(parameters, np.where(np.abs(weights) >= MAIN * largest, weights, 0.0))


def _how_well(spread: float) -> str:
    if spread > UNSEEN:
        return "not seen"
    if spread > SLOPPY:
        return f"to a factor of {math.exp(spread):.0f} only"
    return f"to a factor of {math.exp(spread):.1f}" if spread > math.log(1.5) else f"to {100 * math.expm1(spread):.2g} %"


def sentences(fit: Fit, found: tuple[Direction, ...] | None = None, *, ask: bool = True) -> list[str]:
    """What the data do not see, one sentence for each sloppy direction.

    **Arguments:** `ask` runs the model a few times more for each pair that is seen in one combination only, to tell sums from products.
    """
    found = directions(fit) if found is None else found
    said = []
    for one in found:
        if not one.sloppy:
            continue
        main = np.flatnonzero(np.abs(one.weights) >= MAIN * np.max(np.abs(one.weights)))
        names = [fit.problem.names[i] for i in main]
        if len(main) == 1:
            said.append(f"{names[0]} is not seen by these data: known {one.known}")
        elif len(main) == 2 and ask and (how := how_a_pair_enters(fit, int(main[0]), int(main[1]))):
            said.append(f"these data see only the {how} of {names[0]} and {names[1]}, not the two one by one")
        else:
            said.append(f"moving along {one.words} changes next to nothing that was measured: known {one.known}")
    return said


def how_a_pair_enters(fit: Fit, i: int, j: int) -> str | None:
    """`sum`, `product` or `ratio`, whichever can be kept while both parameters move far with the least change; None where all change.

    Costs four runs of the model.
    """
    a, b = fit.raw[i], fit.raw[j]
    pair = [fit.problem.parameters[k] for k in (i, j)]
    if any(parameter.link != "log" for parameter in pair):
        return None
    step, (E, F) = math.log(FACTOR), (math.exp(a), math.exp(b))
    moved = E * (FACTOR - 1) if E < F else -E * (1 - 1 / FACTOR)
    ends = {"sum": (math.log(E + moved), math.log(F - moved)) if moved < F else None}
    ends |= {"product": (a + step, b - step), "ratio": (a + step, b + step)}
    rise = _rise(fit, i, j)
    alone = rise((a + step, b))
    changes = {name: rise(end) for name, end in ends.items() if end is not None}
    best = min(changes, key=lambda name: changes[name])
    return best if changes[best] < SAME * alone else None


def _rise(fit: Fit, i: int, j: int) -> Callable[[tuple[float, float]], float]:
    """Squared change of the residuals that moving two parameters brings; infinite where a solve fails."""
    evaluate, box = evaluator(fit.problem), Box.around(fit.problem.parameters)

    def rise(end: tuple[float, float]) -> float:
        raw = fit.raw.copy()
        raw[[i, j]] = end
        point = evaluate(np.clip(raw, box.lower, box.upper))
        return float(np.sum((point.residual - fit.residual) ** 2)) if point.usable else math.inf

    return rise
