"""Tissue laws: one energy density for each point, of which stress and stiffness are derivatives. Energies in MPa (N mm per mm^3).

| law | for |
|---|---|
| `Linear` | small strain, Hooke's law: what the linear engine solves |
| `FiniteStrain` | large strain and rotation: compressible neo-Hookean at homotopy 1, linear at 0 |
| `Exponential` | strain stiffening of any of these |

All have the Lame parameters of their layer in the limit of small strain. Where a law does not hold, an element turned inside out or an
exponent beyond all numbers, its energy and every derivative of it are infinite or NaN, so that whoever tries such a step can tell.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

SERIES_BELOW, LOG_SERIES_BELOW, TERMS = 0.5, 0.1, 16  # series are taken up to here: the rest is below rounding, in three derivatives too


class AbstractTissue(eqx.Module):
    """How much energy a strained tissue stores."""

    @abstractmethod
    def density(self, gradient: Float[Array, "3 3"], lame: Float[Array, "2"], layer: Int[Array, ""]) -> Float[Array, ""]:
        """Energy per undeformed volume, MPa, at a displacement gradient du_i/dX_j, for the Lame parameters, MPa, of a layer."""


class Linear(AbstractTissue):
    """Hooke's law: W = lambda/2 (tr eps)^2 + mu eps:eps with eps = sym grad u."""

    def density(self, gradient: Float[Array, "3 3"], lame: Float[Array, "2"], layer: Int[Array, ""]) -> Float[Array, ""]:
        strain = (gradient + gradient.T) / 2
        return lame[0] / 2 * jnp.trace(strain) ** 2 + lame[1] * jnp.sum(strain * strain)


class FiniteStrain(AbstractTissue):
    """Compressible neo-Hookean tissue, whose turns and strains count s times.

        W_s(H) = W_neo(s H) / s^2,    W_neo(H) = mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)

    with F = I + H, J = det F, C = F'F: the stress under displacements s times as large, over s.

    At `homotopy` s = 0 this is `Linear` to the last bit, with a finite slope there; at s = 1 it is frame indifferent and polyconvex. At
    every s one measure of volume resists, so that nearly incompressible tissue is not held by two; a weighted sum of both energies would do
    that, and is far stiffer at s = 0.02 than at either end. An element that s times its displacement turns inside out has the energy NaN.

    Bonet & Wood (Nonlinear continuum mechanics for finite element analysis, 2nd ed. 2008, chapter 6: the shear part), Simo & Hughes
    (Computational inelasticity, 1998, chapter 9: the volumetric part), Ciarlet & Geymonat (1982: the two together).
    """

    homotopy: Float[Array, ""] = eqx.field(default=1.0, converter=lambda s: jnp.asarray(s, float))

    def density(self, gradient: Float[Array, "3 3"], lame: Float[Array, "2"], layer: Int[Array, ""]) -> Float[Array, ""]:
        s, trace, third = self.homotopy, jnp.trace(gradient), _third(gradient)
        bend = _second(gradient) + s * third
        growth = trace + s * bend  # (det(I + s H) - 1) / s
        upright = s * growth > -1.0
        growth = jnp.where(upright, growth, 0.0)
        # Beyond Hooke's law, per s: what is linear and quadratic in H cancels on paper.
        volume, log = bend * (growth + trace), growth**3 * log_remainder(s * growth)
        further = lame[1] * (volume / 2 + log - third) + lame[0] / 2 * (volume + log)
        # Multiplied, not chosen: a branch of constants would have no slope, and a force of zero is no warning.
        return Linear().density(gradient, lame, layer) + s * further * jnp.where(upright, 1.0, jnp.nan)


class Exponential(AbstractTissue):
    """A tissue that stiffens exponentially with strain: W = mu/b (exp(b W_0/mu) - 1), W_0 the energy of the tissue that it holds.

    `stiffening` b (layers,), dimensionless, at least 0: strains of 1/sqrt(b) are where it sets in. Zero leaves the tissue as it is, to the
    last bit, with a finite slope there. The form of Fung's law (Am. J. Physiol. 213, 1967) with the energy as its exponent, so that it
    inherits the held tissue's convexity and its indifference to rotation.
    """

    tissue: AbstractTissue
    stiffening: Float[Array, " layers"]

    def density(self, gradient: Float[Array, "3 3"], lame: Float[Array, "2"], layer: Int[Array, ""]) -> Float[Array, ""]:
        energy = self.tissue.density(gradient, lame, layer)
        return energy * relative_growth(self.stiffening[layer] * energy / lame[1])


def volume_growth(gradient: Float[Array, "3 3"]) -> Float[Array, ""]:
    """det(I + H) - 1 without the loss of digits in the difference: the sum of H's three invariants."""
    return jnp.trace(gradient) + _second(gradient) + _third(gradient)


def relative_growth(x: Float[Array, ""]) -> Float[Array, ""]:
    """(e^x - 1)/x, exactly 1 at 0 and smooth there; infinite beyond what numbers can hold."""
    near = jnp.abs(x) < SERIES_BELOW
    small, large = jnp.where(near, x, 0.0), jnp.where(near, 1.0, x)
    series = jnp.ones_like(x)
    for n in range(TERMS, 0, -1):
        series = 1.0 + series * small / (n + 1)
    return jnp.where(near, series, jnp.expm1(large) / large)


def log_remainder(x: Float[Array, ""]) -> Float[Array, ""]:
    """c(x) of x - ln(1 + x) = x^2 (1/2 + x c(x)), x > -1: -1/3 at 0 and smooth there."""
    near = jnp.abs(x) < LOG_SERIES_BELOW
    small, large = jnp.where(near, x, 0.0), jnp.where(near, 1.0, x)
    series = jnp.polyval(jnp.array([(-1.0) ** (n + 1) / (n + 3) for n in reversed(range(TERMS))]), small)
    return jnp.where(near, series, ((large - jnp.log1p(large)) / large**2 - 0.5) / large)


def _second(gradient: Float[Array, "3 3"]) -> Float[Array, ""]:
    return (jnp.trace(gradient) ** 2 - jnp.sum(gradient * gradient.T)) / 2


def _third(gradient: Float[Array, "3 3"]) -> Float[Array, ""]:
    a, b, c = gradient
    return jnp.sum(a * jnp.cross(b, c))
