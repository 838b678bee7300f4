"""From residuals to parameters, and what the data can and cannot tell about them."""

from __future__ import annotations

from fingerjax.forward.problem import Health, Problem
from fingerjax.identify.fit import Fit, Step, fit
from fingerjax.identify.sensitivity import Sensitivity, sensitivity
from fingerjax.identify.uncertainty import Estimate, Uncertainty, uncertainty

__all__ = [
    "Estimate",
    "Fit",
    "Health",
    "Problem",
    "Sensitivity",
    "Step",
    "Uncertainty",
    "fit",
    "sensitivity",
    "uncertainty",
]
