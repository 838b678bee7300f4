"""What a mechanoreceptor may feel: scalars of the strain and stress at its place.

Strain is a vector (..., 6) in the order xx, yy, zz, yz, xz, xy with engineering shears (gamma = 2 epsilon);
stress likewise in MPa. Tissue is linear and isotropic: Young's modulus E in MPa and Poisson's ratio nu, those
of the layer that holds the receptor.

Four of them are the paper's candidates for what drives SA-I afferents (Dandekar, Raju & Srinivasan 2003, Fig.
11). All grow when skin is pressed: `mean_normal_stress` and `vertical_compressive_stress` are positive in
compression.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

Voigt = Float[Array, "*b 6"]
Scalar = Float[Array, "*b"]


class Receptor(eqx.Module):
    """State of the tissue at one receptor, or at many along leading axes."""

    strain: Float[Array, "*b 6"] = eqx.field(converter=jnp.asarray)
    youngs_modulus: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    poisson_ratio: Float[Array, "..."] = eqx.field(converter=jnp.asarray)

    @property
    def stress(self) -> Float[Array, "*b 6"]:
        """Stress in MPa by Hooke's law."""
        return stress(self.strain, self.youngs_modulus, self.poisson_ratio)


def stress(
    strain: Voigt, youngs_modulus: Float[ArrayLike, "..."], poisson_ratio: Float[ArrayLike, "..."]
) -> Voigt:
    """sigma = lambda tr(epsilon) 1 + 2 mu epsilon, in MPa."""
    modulus, ratio = jnp.asarray(youngs_modulus)[..., None], jnp.asarray(poisson_ratio)[..., None]
    shear = modulus / (2.0 * (1.0 + ratio))
    bulk_part = (
        modulus * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio)) * jnp.sum(strain[..., :3], -1, keepdims=True)
    )
    return jnp.concatenate([bulk_part + 2.0 * shear * strain[..., :3], shear * strain[..., 3:]], axis=-1)


def strain_energy_density(receptor: Receptor) -> Scalar:
    """sigma : epsilon / 2 in MPa (N mm per mm^3)."""
    return 0.5 * jnp.sum(receptor.stress * receptor.strain, axis=-1)


def maximum_compressive_strain(receptor: Receptor) -> Scalar:
    """Minus the smallest principal strain."""
    return -_principal(receptor.strain, 0.5)[..., 0]


def mean_normal_stress(receptor: Receptor) -> Scalar:
    """-(sigma_xx + sigma_yy + sigma_zz)/3 in MPa, positive in compression."""
    return -jnp.sum(receptor.stress[..., :3], axis=-1) / 3.0


def vertical_compressive_stress(receptor: Receptor) -> Scalar:
    """-sigma_yy in MPa, positive in compression along the direction of indentation."""
    return -receptor.stress[..., 1]


def von_mises_stress(receptor: Receptor) -> Scalar:
    """sqrt(3/2 s : s) in MPa, s the deviatoric stress; slope 0 where s = 0."""
    sigma = receptor.stress
    normal = sigma[..., :3] - jnp.mean(sigma[..., :3], axis=-1, keepdims=True)
    square = 1.5 * jnp.sum(normal**2, axis=-1) + 3.0 * jnp.sum(sigma[..., 3:] ** 2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def maximum_shear_stress(receptor: Receptor) -> Scalar:
    """Half the difference of the largest and the smallest principal stress, in MPa."""
    principal = _principal(receptor.stress, 1.0)
    return 0.5 * (principal[..., 2] - principal[..., 0])


QUANTITIES: dict[str, Callable[[Receptor], Scalar]] = {
    "strain_energy_density": strain_energy_density,
    "maximum_compressive_strain": maximum_compressive_strain,
    "mean_normal_stress": mean_normal_stress,
    "vertical_compressive_stress": vertical_compressive_stress,
    "von_mises_stress": von_mises_stress,
    "maximum_shear_stress": maximum_shear_stress,
}
PAPER_QUANTITIES = tuple(QUANTITIES)[:4]
AXES = ("xx", "yy", "zz", "yz", "xz", "xy")


def _component(kind: str, number: int) -> Callable[[Receptor], Scalar]:
    return lambda receptor: getattr(receptor, kind)[..., number]


COMPONENTS: dict[str, Callable[[Receptor], Scalar]] = {
    f"{kind}_{axes}": _component(kind, number) for kind in ("strain", "stress") for number, axes in enumerate(AXES)
}
"""Single components, `strain_yy` or `stress_xz`: tension positive, shear strains engineering ones."""

EVERY = QUANTITIES | COMPONENTS
UNITS = {name: "1" if "strain" in name and "energy" not in name else "MPa" for name in EVERY}


def _principal(voigt: Voigt, shear: float) -> Float[Array, "*b 3"]:
    """Eigenvalues, ascending, of the symmetric tensor whose shears are `shear` times the vector's.

    The eigenvectors are held while differentiating: d lambda = v' dA v. That is exact for simple eigenvalues,
    a directional derivative at repeated ones, and never divides by their difference. Second derivatives are
    not those of an eigenvalue.
    """
    xx, yy, zz, yz, xz, xy = jnp.moveaxis(voigt * jnp.array([1.0, 1.0, 1.0, shear, shear, shear]), -1, 0)
    rows = [jnp.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    tensor = jnp.stack(rows, -2)
    vectors = jnp.linalg.eigh(jax.lax.stop_gradient(tensor))[1]
    return jnp.einsum("...ia,...ij,...ja->...a", vectors, tensor, vectors)  # a principal direction, i j space
