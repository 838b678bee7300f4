"""A fit in sentences: the verdict to read first, and the warnings to read before using a number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fingerjax._results import RESULTS
from fingerjax.identify import Estimate, Fit, Uncertainty

POOR = 1.5  # chi2 / dof beyond which the stated noise does not explain the residuals


def verdict(fit: Fit, known: Uncertainty) -> str:
    """The sentence to read first: what was found and how well it is known, or that there is nothing to
    read.
    """
    if fit.result is RESULTS.interrupted:
        return f"Interrupted: {fit.reason}. No value is reported."
    if not fit.settled:
        return f"Not converged: {fit.reason}. No value is reported."
    told = "; ".join(_value(one) for one in known.estimates[:6])
    more = "" if len(known.estimates) <= 6 else f"; and {len(known.estimates) - 6} more below"
    return f"{told}{more}."


def _value(one: Estimate) -> str:
    unit = "" if one.unit == "1" else f" {one.unit}"
    if one.at_limit:
        return f"{one.name} ran towards its {one.at_limit} limit and stopped at {one.value:.3g}{unit}"
    if not one.identified and math.isnan(one.lower):
        return f"{one.name} is undefined ({one.reason})"
    vague = "" if one.identified else ", hardly seen"
    return f"{one.name} = {one.value:.3g}{unit} ({one.lower:.3g} to {one.upper:.3g}{vague})"


def warnings(fit: Fit, known: Uncertainty) -> list[str]:
    """What a reader must know before using a number of this fit, most serious first."""
    if not fit.settled:
        return [f"{fit.result.value} Here: {fit.reason}."]
    said = [
        f"{name} ran towards its {side} limit: {RESULTS.at_limit.value}" for name, side in fit.limits.items()
    ]
    if fit.edge:
        said.append(f"{fit.reason[0].upper()}{fit.reason[1:]}.")
    said += [f"{sentence[0].upper()}{sentence[1:]}." for sentence in known.sentences]
    said += [f"{one.name}: {one.reason}." for one in known.estimates if _hardly(one)]
    assumed = [name for name, kind in fit.problem.sigma_source.items() if kind == "assumed"]
    if assumed:
        said.append(
            f"The noise of {', '.join(assumed)} was assumed, not measured: intervals come from the scatter "
            "of the residuals, and nothing can be said about whether the model is adequate."
        )
    elif known.variance > POOR:
        said.append(
            f"The residuals are {math.sqrt(known.variance):.2g} times the stated noise: the model misses "
            "something, and the intervals, which know of the noise only, are too narrow."
        )
    return said


def _hardly(one: Estimate) -> bool:
    return not one.identified and not one.at_limit and not math.isnan(one.lower)


def mesh_sentence(name: str, mesh: Mapping[str, Any]) -> str:
    """A mesh in one line: how large, how good."""
    quality = mesh.get("quality") or {}
    told = ", ".join(f"{_quality_name(key)} {_quality_value(value)}" for key, value in quality.items())
    return f"{name}: {mesh['nodes']} nodes, {mesh['elements']} elements" + (f"; {told}" if told else "")


def _quality_name(key: str) -> str:
    return key.replace("_", " ")


def _quality_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "(" + ", ".join(f"{key} {_quality_value(entry)}" for key, entry in value.items()) + ")"
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_quality_value(entry) for entry in value) + ")"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
