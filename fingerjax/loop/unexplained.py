"""What no effect explains, as a picture: a smooth curve through the residual that leaves every parameter where it is.

    r = g + eps,   g ~ N(0, Q K Q) in whitened rows,   K = a^2 exp(-|x - x'|^2 / 2) by block

so that g cannot be imitated by the base parameters (Plumlee 2017). Beside it: where the misfit sits, how much of it is odd about the
middle, and what repeats along a coordinate.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.signal import lombscargle

from .record import Unexplained
from .refit import Optimum
from .subject import Rows

LENGTHS = (0.08, 0.16, 0.32, 0.64)  # of the kernel, in ranges of a coordinate
AMPLITUDES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # in standard deviations of the block's noise
_SPAN = 0.1  # of a range: bins of a coordinate


def picture(best: Optimum) -> Unexplained:
    """Everything at once, of the rows that were fitted."""
    return Unexplained(curves(best), shares(best), symmetry(best), spectrum(best))


def curves(best: Optimum) -> dict[str, dict[str, Any]]:
    """Block -> `amplitude` and `length` of the kernel, `mean` and `band` (one standard deviation) of each of its fitted rows.

    The kernel of each block is the likeliest for it; the curve is drawn through all blocks at once, since only then it leaves every
    parameter alone.
    """
    rows, chosen = best.sample.subject.rows, best.sample.chosen
    block = rows.block[chosen]
    likeliest = {name: _likeliest(best, name) for name in rows.blocks if np.sum(block == name) > 2}
    roots = [amplitude * _root(best, name, length) for name, (amplitude, length) in likeliest.items() if amplitude > 0]
    mean, band = _posterior(best, roots)
    return {
        name: {"amplitude": amplitude, "length": length, "mean": mean[block == name], "band": band[block == name]}
        for name, (amplitude, length) in likeliest.items()
    }


def _likeliest(best: Optimum, name: str) -> tuple[float, float]:
    """(amplitude, length) of largest marginal likelihood; (0, 0) where no curve is likelier than any."""
    size = float(np.median(np.sqrt(np.diag(best.sample.covariance)[best.sample.subject.rows.blocks[name]])))
    choices = [(0.0, 0.0, 0.0)]
    for length in LENGTHS:
        values, vectors = _eigen(_root(best, name, length))
        seen = (vectors.T @ best.residual) ** 2
        for amplitude in AMPLITUDES:
            grown = 1.0 + (amplitude * size) ** 2 * values
            choices.append((float(np.sum(np.log(grown) + seen / grown - seen)), amplitude * size, length))
    return min(choices)[1:]


def _posterior(best: Optimum, roots: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(mean, standard deviation) of the curve at the fitted rows, in their units."""
    count = int(best.sample.chosen.sum())
    if not roots:
        return np.zeros(count), np.zeros(count)
    values, vectors = _eigen(np.concatenate(roots, axis=1))
    shrink = values / (1.0 + values)
    back = best.sample.whiten.back(vectors[:count])
    return back @ (shrink * (vectors.T @ best.residual)), np.sqrt((back**2) @ shrink)


def _root(best: Optimum, name: str, length: float) -> Float[np.ndarray, "sample members"]:
    """Q L^-1 K^(1/2) of one block, for a kernel of amplitude 1; rows of two conditions are half as alike."""
    rows, chosen = best.sample.subject.rows, best.sample.chosen
    where = rows.blocks[name]
    inside = np.flatnonzero(chosen[where])
    condition = rows.condition[where][inside]
    alike = np.where(condition[:, None] == condition, 1.0, 0.5)
    for values in rows.coordinates.get(name, {}).values():
        span = float(np.ptp(values))
        if span > 0:
            x = np.asarray(values, dtype=float)[inside] / (length * span)
            alike = alike * np.exp(-0.5 * (x[:, None] - x) ** 2)
    values, vectors = np.linalg.eigh(alike)
    column = np.zeros((len(rows), len(inside)))
    column[np.arange(len(rows))[where][inside]] = vectors * np.sqrt(np.maximum(values, 0.0))
    return best.projection(best.sample.columns(column))


def _eigen(root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    left, singular, _ = np.linalg.svd(root, full_matrices=False)
    kept = singular > 1e-8 * max(float(singular[0]), 1e-300)
    return singular[kept] ** 2, left[:, kept]


def shares(best: Optimum) -> dict[str, dict[str, float]]:
    """`block`, `condition` and each coordinate (`block.name`, in tenths of its range) -> share of the squared standardised misfit."""
    rows, chosen = best.sample.subject.rows, best.sample.chosen
    squares = _standardised(best) ** 2
    total = max(float(squares[chosen].sum()), 1e-300)

    def by(labels: np.ndarray, where: np.ndarray) -> dict[str, float]:
        return {str(one): float(squares[where & (labels == one)].sum()) / total for one in dict.fromkeys(labels[where].tolist())}

    found = {"block": by(rows.block, chosen), "condition": by(rows.condition, chosen)}
    for name, where in rows.blocks.items():
        for coordinate, values in rows.coordinates.get(name, {}).items():
            if np.ptp(values) > 0:
                labels, inside = np.full(len(rows), "", dtype=object), np.zeros(len(rows), dtype=bool)
                share = (np.asarray(values, dtype=float) - np.min(values)) / np.ptp(values)
                bins = np.minimum((share / _SPAN).astype(int), int(1 / _SPAN) - 1)
                labels[where] = [f"{np.min(values) + (one + 0.5) * _SPAN * np.ptp(values):.4g}" for one in bins]
                inside[where] = chosen[where]
                found[f"{name}.{coordinate}"] = by(labels, inside)
    return found


def _standardised(best: Optimum) -> Float[np.ndarray, "rows"]:
    return best.sample.error(best.at) / np.sqrt(np.diag(best.sample.covariance))


def _curve_of(best: Optimum, rows: Rows, name: str, condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Places along a condition and the mean standardised residual at each, rising."""
    where = rows.blocks[name]
    here = (rows.condition[where] == condition) & best.sample.chosen[where]
    places, number = np.unique(rows.along(name)[here], return_inverse=True)
    values = _standardised(best)[where][here]
    return places, np.bincount(number.reshape(-1), values) / np.maximum(np.bincount(number.reshape(-1)), 1)


def _conditions(rows: Rows, name: str) -> list[str]:
    return list(dict.fromkeys(rows.condition[rows.blocks[name]].tolist()))


def symmetry(best: Optimum) -> dict[str, float]:
    """Block -> share of the misfit that is odd about 0, where its coordinate has two sides: 1/2 for noise, 1 for a tilt."""
    rows, found = best.sample.subject.rows, {}
    for name in rows.blocks:
        odd = even = 0.0
        for condition in _conditions(rows, name):
            places, values = _curve_of(best, rows, name, condition)
            if len(places) > 3 and places[0] < 0 < places[-1]:
                reach = min(-places[0], places[-1])
                here = np.linspace(0.05 * reach, reach, 20)
                right, left = np.interp(here, places, values), np.interp(-here, places, values)
                odd += float(np.sum((right - left) ** 2))
                even += float(np.sum((right + left) ** 2))
        if odd + even > 0:
            found[name] = odd / (odd + even)
    return found


def spectrum(best: Optimum) -> dict[str, dict[str, float]]:
    """Block -> `neighbours`, the correlation of neighbouring settings, and `wavelength` with the `share` of variance that it holds."""
    rows, found = best.sample.subject.rows, {}
    for name in rows.blocks:
        parts = [_curve_of(best, rows, name, condition) for condition in _conditions(rows, name)]
        parts = [(places, values - values.mean()) for places, values in parts if len(places) > 4]
        squares = sum(float(np.sum(values**2)) for _, values in parts)
        if squares > 0:
            near = sum(float(np.sum(values[1:] * values[:-1])) for _, values in parts) / squares
            wavelength, share = _line(parts, squares)
            found[name] = {"neighbours": near, "wavelength": wavelength, "share": share}
    return found


def _line(parts: list[tuple[np.ndarray, np.ndarray]], squares: float) -> tuple[float, float]:
    """The wavelength that holds most of the variance of all conditions together (Lomb 1976, Scargle 1982), and its share."""
    span = max(float(np.ptp(places)) for places, _ in parts)
    waves = np.linspace(1.0, 0.5 * max(len(places) for places, _ in parts), 60)
    angular = 2 * math.pi * waves / span
    power = np.sum([lombscargle(places, values, angular) for places, values in parts], axis=0)
    best = int(np.argmax(power))
    return float(span / waves[best]), float(min(power[best] / (0.5 * squares), 1.0))
