"""What every instrument reads, once the linear solves are done and the contacts are decided."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..contact.indentation import Contact
from ..contact.line import sharp_compliance
from ..effects.added import Added
from ..effects.records import Felt, Reading
from ..fem.body import Material
from ..measure.afferent import rate
from ..measure.receptor import EVERY
from ..measure.receptor import Receptor as ReceptorState
from .pressing import Known, pressed
from .problem import Health
from .rigs import Rig
from .wiring import Values, Wiring


class Prediction(eqx.Module):
    """Readings of every measurement, in its own unit, and the health of all solves and contacts behind them.

    - `readings`: one (rows,) array for each measurement. `quantity`: for spike rates, what the receptor felt, else zeros.
    - `settled`: every contact was decided; `inside`: none reached the edge of the pad that was prepared.
    """

    readings: tuple[Float[Array, " _"], ...]
    quantity: tuple[Float[Array, " _"], ...]
    converged: Bool[Array, ""]
    settled: Bool[Array, ""]
    inside: Bool[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]

    @property
    def health(self) -> Health:
        return Health(self.converged & self.settled & self.inside, self.iterations, self.residual)


class Instruments(eqx.Module):
    """The rigs of a study, and how its parameters reach them."""

    rigs: tuple[Rig, ...]
    wired: Wiring = eqx.field(static=True)
    variants: tuple[tuple[tuple[str, str], ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)
    receptor_layer: tuple[tuple[int, int], ...] = eqx.field(static=True)
    added: Added = Added()

    def materials(self, values: Values) -> list[Material]:
        """The tissue of each variant: of every subject, say, that has moduli of its own."""
        return [self.added.material(self.wired.material(dict(labels), values), values) for labels in self.variants]

    def read(
        self,
        known: Known,
        values: Values,
        quantity: str = "strain_energy_density",
        away: Float[Array, "variants d"] | None = None,
    ) -> Prediction:
        """Every reading at values where the solves are known; names that are missing keep the study's own.

        `quantity` names what the receptor is taken to feel, one of `measure.receptor.EVERY`. `away`: how far along the known slopes, where
        that is not for the values to say.
        """
        lame = [tissue.lame() for tissue in self.materials(values)]
        away = known.away(lame) if away is None else away
        together = zip(self.rigs, known.rigs, strict=True)
        found = [pressed(rig, each, known, away, self.added, values, jnp.stack(lame)) for rig, each in together]
        converged, iterations, residual = (
            jnp.stack([getattr(each, name) for each in known.held]) for name in ("converged", "iterations", "residual")
        )
        return self.told(found, values, Health(converged.all(), iterations.max(), residual.max()), quantity)

    def told(
        self, found: Sequence[tuple[Contact, Array]], values: Values, health: Health, quantity: str = "strain_energy_density"
    ) -> Prediction:
        """Every reading from the contacts of each rig, what all columns read under them (cases, m), and how well they were found."""
        readings = [jnp.zeros(length) for length in self.lengths]
        felt = [jnp.zeros(length) for length in self.lengths]
        settled, inside = jnp.asarray(True), jnp.asarray(True)
        for rig, (contact, observed) in zip(self.rigs, found, strict=True):
            settled, inside = settled & contact.settled.all(), inside & ~contact.reached_edge.any()
            value, sensed = self._rows(rig, contact, observed, values, quantity)
            force, travel, grown = (each[rig.case] for each in (contact.force, contact.travel, growth(rig, contact.area)))
            read = self.added.read(Reading(value, force, travel, grown, rig.context), values)
            readings[rig.measurement] = readings[rig.measurement].at[rig.row].set(read.value)
            felt[rig.measurement] = felt[rig.measurement].at[rig.row].set(sensed)
        return Prediction(tuple(readings), tuple(felt), health.converged, settled, inside, health.iterations, health.residual)

    def _rows(self, rig: Rig, contact: Contact, observed: Array, values: Values, quantity: str) -> tuple[Array, Array]:
        if rig.kind == "force_displacement":
            each = contact.travel if rig.forced else contact.force
            return each[rig.case], jnp.zeros(rig.row.shape)
        if rig.kind == "deflection_profile":
            return observed[rig.case, rig.reading] + self._beneath(rig, contact, values), jnp.zeros(rig.row.shape)
        strain = observed[rig.case[:, None], rig.reading[:, None] + jnp.arange(6)]
        layer = dict(self.receptor_layer)[rig.measurement]
        tissues = self.materials(values)
        E = jnp.stack([tissue.youngs_modulus[layer] for tissue in tissues])[rig.variant[rig.case]]
        nu = jnp.stack([tissue.poisson_ratio[layer] for tissue in tissues])[rig.variant[rig.case]]
        state = ReceptorState(strain, E, nu)
        felt = self.added.feel(Felt(EVERY[quantity](state), state, rig.context), values).quantity
        return self._rate(rig, felt, values), felt

    def _beneath(self, rig: Rig, contact: Contact, values: Values) -> Array:
        """How much deeper skin under the tip of a line lies than the mesh shows, mm, at each row."""
        if rig.beneath is None:
            return jnp.zeros(rig.row.shape)
        sharp = sharp_compliance(jnp.stack([tissue.lame() for tissue in self.materials(values)]), rig.layer)
        return sharp[rig.variant[rig.case]] * jnp.sum(rig.beneath * contact.pressure[rig.case], axis=1)

    def _rate(self, rig: Rig, felt: Array, values: Values) -> Array:
        name, labels = self.names[rig.measurement], [dict(each) for each in self.variants]
        scale = jnp.stack([self.wired.value(f"{name}.scale", each, values) for each in labels])
        threshold = jnp.stack([self.wired.value(f"{name}.threshold", each, values) for each in labels])
        which = rig.variant[rig.case]
        return rate(felt, scale[which], threshold[which])


def growth(rig: Rig, area: Float[Array, " cases"]) -> Float[Array, " cases"]:
    """Contact area, mm^2, that each mm of travel adds, or each N where force is imposed, from the cases of a rig: a power law through the
    next shallower and the next deeper one at the same place in the same tissue; in proportion where there is no other.
    """
    x = rig.imposed
    same = (rig.pose[:, None] == rig.pose) & (rig.variant[:, None] == rig.variant) & ((x > 0) & (area > 0))
    own = jnp.arange(len(x))
    shallower, deeper = same & (x < x[:, None]), same & (x > x[:, None])
    low = jnp.where(shallower.any(axis=1), jnp.argmax(jnp.where(shallower, x, -jnp.inf), axis=1), own)
    high = jnp.where(deeper.any(axis=1), jnp.argmin(jnp.where(deeper, x, jnp.inf), axis=1), own)
    touches = (x > 0) & (area > 0)
    log_x, log_area = (jnp.log(jnp.where(touches, each, 1.0)) for each in (x, area))
    power = jnp.where(high == low, 1.0, (log_area[high] - log_area[low]) / jnp.where(high == low, 1.0, log_x[high] - log_x[low]))
    return jnp.where(touches, power * area / jnp.where(touches, x, 1.0), 0.0)


class Solved(eqx.Module):
    """A model with the solves and contacts at some values done: what compiled code reads and differentiates."""

    instruments: Instruments
    known: Known

    def predict(self, values: Values, quantity: str = "strain_energy_density") -> Prediction:
        """Every reading at the values that the model was solved at."""
        return self.instruments.read(self.known, values, quantity)
