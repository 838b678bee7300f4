"""The forward model: parameters in, every reading of every instrument out, with derivatives in every parameter.

For each material the body is condensed once to the skin that can be touched and to the points and receptors that are observed; after
that each indentation is a small dense contact problem, and each reading a product with its nodal forces.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact.indentation import Contact, press
from ..errors import InputError
from ..fem.body import Body, Material, body
from ..fem.columns import Columns, columns_from_matrix
from ..fem.compliance import Compliance, compliance
from ..fem.solver import AbstractSolver, solver_for
from ..finger import Finger
from ..geometry.presets import preset
from ..geometry.sections import LayeredSolid, Sections, solid_from_sections
from ..identify.problem import Health, Problem
from ..measure.afferent import rate, start
from ..measure.receptor import QUANTITIES
from ..measure.receptor import Receptor as ReceptorState
from ..measurements import Measurement
from ..mesh import Resolution, build_finger
from ..parameters import Parameter
from ..study import Study
from .rigs import Rig, foci, lay, plans
from .wiring import Prior, Values, Wiring, priors, wiring

ASSUMED_NOISE = 0.02  # of a measurement's largest value, where nobody says how noisy it is


class Prediction(eqx.Module):
    """Readings of every measurement, in its own unit, and the health of all solves and contacts behind them.

    - `readings`: one (rows,) array for each measurement. `quantity`: for spike rates, what the receptor felt, else zeros.
    - `settled`: every contact was decided; `inside`: none reached the edge of the pad that was prepared.
    """

    readings: tuple[Float[Array, " rows"], ...]
    quantity: tuple[Float[Array, " rows"], ...]
    converged: Bool[Array, ""]
    settled: Bool[Array, ""]
    inside: Bool[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]

    @property
    def health(self) -> Health:
        return Health(self.converged & self.settled & self.inside, self.iterations, self.residual)


class Model(eqx.Module):
    """A study made ready to be computed. Arrays are leaves: hand it to compiled functions as an argument."""

    body: Body
    solver: AbstractSolver
    columns: Columns
    rigs: tuple[Rig, ...]
    wired: Wiring = eqx.field(static=True)
    variants: tuple[tuple[tuple[str, str], ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)
    receptor_layer: tuple[tuple[int, int], ...] = eqx.field(static=True)
    row_labels: tuple[tuple[tuple[tuple[str, str], ...], ...], ...] = eqx.field(static=True)

    def condensed(self, values: Values) -> list[Compliance]:
        """One compliance for each material that the rows need."""
        materials = [self.wired.material(dict(labels), values) for labels in self.variants]
        return [compliance(self.body, self.solver, material, self.columns) for material in materials]

    def predict(self, values: Values, quantity: str = "strain_energy_density") -> Prediction:
        """Every reading at these values; names that are missing keep the study's own.

        `quantity` names what the receptor is taken to feel, one of `measure.receptor.QUANTITIES`.
        """
        bodies = self.condensed(values)
        C = jnp.stack([each.matrix for each in bodies])
        readings = [jnp.zeros(length) for length in self.lengths]
        felt = [jnp.zeros(length) for length in self.lengths]
        settled, inside = jnp.asarray(True), jnp.asarray(True)
        for rig in self.rigs:
            contact, observed = pressed(rig, C)
            settled, inside = settled & contact.settled.all(), inside & ~contact.reached_edge.any()
            value, sensed = self._rows(rig, contact, observed, values, quantity)
            readings[rig.measurement] = readings[rig.measurement].at[rig.row].set(value)
            felt[rig.measurement] = felt[rig.measurement].at[rig.row].set(sensed)
        return Prediction(
            tuple(readings),
            tuple(felt),
            jnp.stack([each.converged for each in bodies]).all(),
            settled,
            inside,
            jnp.stack([each.iterations for each in bodies]).max(),
            jnp.stack([each.residual for each in bodies]).max(),
        )

    def _rows(self, rig: Rig, contact: Contact, observed: Array, values: Values, quantity: str) -> tuple[Array, Array]:
        if rig.kind == "force_displacement":
            each = contact.travel if rig.forced else contact.force
            return each[rig.case], jnp.zeros(rig.row.shape)
        if rig.kind == "deflection_profile":
            return observed[rig.case, rig.reading], jnp.zeros(rig.row.shape)
        strain = observed[rig.case[:, None], rig.reading[:, None] + jnp.arange(6)]
        layer = dict(self.receptor_layer)[rig.measurement]
        tissues = [self.wired.material(dict(labels), values) for labels in self.variants]
        E = jnp.stack([tissue.youngs_modulus[layer] for tissue in tissues])[rig.variant[rig.case]]
        nu = jnp.stack([tissue.poisson_ratio[layer] for tissue in tissues])[rig.variant[rig.case]]
        felt = QUANTITIES[quantity](ReceptorState(strain, E, nu))
        return self._rate(rig, felt, values), felt

    def _rate(self, rig: Rig, felt: Array, values: Values) -> Array:
        name = self.names[rig.measurement]
        labels = self.row_labels[rig.measurement]
        rows = [dict(labels[row]) for row in np.unique(np.asarray(labels_index(labels)))]
        which = jnp.asarray(labels_index(labels))[rig.row]
        index = {row: number for number, row in enumerate(np.unique(np.asarray(labels_index(labels))))}
        slot = jnp.zeros(max(index) + 1, int).at[jnp.asarray(list(index))].set(jnp.asarray(list(index.values())))[which]
        scale = jnp.stack([self.wired.value(f"{name}.scale", row, values) for row in rows])[slot]
        threshold = jnp.stack([self.wired.value(f"{name}.threshold", row, values) for row in rows])[slot]
        return rate(felt, scale, threshold)


