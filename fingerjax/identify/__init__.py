"""From residuals to parameters, and what the data can and cannot tell about them."""

from __future__ import annotations

from fingerjax.forward.problem import Health, Problem
from fingerjax.identify.bootstrap import Bootstrap, bootstrap
from fingerjax.identify.directions import Direction, directions
from fingerjax.identify.fit import Fit, Step, fit
from fingerjax.identify.multistart import Multistart, multistart
from fingerjax.identify.noise import with_own_noise
from fingerjax.identify.posterior import Posterior, sample
from fingerjax.identify.profile import Profile, profile, profiles
from fingerjax.identify.refined import Refined, refined
from fingerjax.identify.sensitivity import Sensitivity, sensitivity
from fingerjax.identify.uncertainty import Estimate, Uncertainty, uncertainty

__all__ = [
    "Bootstrap",
    "Direction",
    "Estimate",
    "Fit",
    "Health",
    "Multistart",
    "Posterior",
    "Problem",
    "Profile",
    "Refined",
    "Sensitivity",
    "Step",
    "Uncertainty",
    "bootstrap",
    "directions",
    "fit",
    "multistart",
    "profile",
    "profiles",
    "refined",
    "sample",
    "sensitivity",
    "uncertainty",
    "with_own_noise",
]
