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

from ..contact.footprint import Interface
from ..contact.indentation import Contact, press
from ..errors import InputError
from ..fem.body import Body, Material, body
from ..fem.columns import Columns, columns_from_matrix
from ..fem.compliance import Condensed, condense
from ..fem.solver import AbstractSolver, Known, known, solver_for
from ..finger import Finger
from ..geometry.presets import preset
from ..geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from ..measure.afferent import rate, start
from ..measure.receptor import QUANTITIES
from ..measure.receptor import Receptor as ReceptorState
from ..measurements import Measurement
from ..mesh import Resolution, build_finger
from ..parameters import Parameter
from ..study import Study
from .problem import Health, Problem
from .rigs import Rig, foci, lay, plans
from .wiring import Prior, Values, Wiring, priors, wiring

ASSUMED_NOISE = 0.02  # of a measurement's largest value, where nobody says how noisy it is


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
    known: tuple[Known, ...] | None = None

    def materials(self, values: Values) -> list[Material]:
        """The tissue of each variant: of every subject, say, that has moduli of its own."""
        return [self.wired.material(dict(labels), values) for labels in self.variants]

    def solved(self, values: Values) -> Model:
        """The same model with the linear solves at these values done: it holds there, and so do its derivatives."""
        found = tuple(known(self.solver, self.body, tissue.lame(), self.columns) for tissue in self.materials(values))
        # Without its solver, whose host memory compiled code would otherwise keep alive as part of its key.
        return dataclasses.replace(self, known=found, solver=found[0])

    def predict(self, values: Values, quantity: str = "strain_energy_density") -> Prediction:
        """Every reading at these values; names that are missing keep the study's own.

        `quantity` names what the receptor is taken to feel, one of `measure.receptor.QUANTITIES`.
        """
        solvers = self.known or (self.solver,) * len(self.variants)
        pairs = zip(solvers, self.materials(values), strict=True)
        bodies = [condense(self.body, solver, tissue, self.columns) for solver, tissue in pairs]
        readings = [jnp.zeros(length) for length in self.lengths]
        felt = [jnp.zeros(length) for length in self.lengths]
        settled, inside = jnp.asarray(True), jnp.asarray(True)
        for rig in self.rigs:
            contact, observed = pressed(rig, bodies)
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
        tissues = self.materials(values)
        E = jnp.stack([tissue.youngs_modulus[layer] for tissue in tissues])[rig.variant[rig.case]]
        nu = jnp.stack([tissue.poisson_ratio[layer] for tissue in tissues])[rig.variant[rig.case]]
        felt = QUANTITIES[quantity](ReceptorState(strain, E, nu))
        return self._rate(rig, felt, values), felt

    def _rate(self, rig: Rig, felt: Array, values: Values) -> Array:
        name, labels = self.names[rig.measurement], [dict(each) for each in self.variants]
        scale = jnp.stack([self.wired.value(f"{name}.scale", each, values) for each in labels])
        threshold = jnp.stack([self.wired.value(f"{name}.threshold", each, values) for each in labels])
        which = rig.variant[rig.case]
        return rate(felt, scale[which], threshold[which])


def pressed(rig: Rig, bodies: list[Condensed]) -> tuple[Contact, Float[Array, "cases m"]]:
    """Every indentation of a rig, and every column's reading under it.

    The contact is found with the compliance held. Then the nodal forces it ended with say which change of the compliance matters,
    and one more solve on the same active set carries the derivatives: a product with the stiffness for each case, not for each column.
    """
    C = jnp.stack([each.matrix for each in bodies])

    def geometry(pose: Array) -> Interface:
        return jax.tree.map(lambda leaf: leaf[pose], rig.interface)

    def push(interface: Interface, between: Array, imposed: Array, start: Array | None) -> Contact:
        force, travel = (imposed, None) if rig.forced else (None, imposed)
        return press(between, interface, travel=travel, force=force, start=start)

    def settle(pose: Array, imposed: Array, variant: Array) -> tuple[Contact, Array]:
        columns = rig.columns[pose]
        contact = push(geometry(pose), C[variant][columns[:, None], columns[None, :]], imposed, None)
        return contact, jnp.zeros(C.shape[1]).at[columns].add(contact.nodal_forces)

    def carry(pose: Array, imposed: Array, variant: Array, active: Array, change: Array) -> tuple[Contact, Array]:
        columns, interface = rig.columns[pose], geometry(pose)
        shifted = eqx.tree_at(lambda one: one.overlap, interface, interface.overlap - interface.load.T @ change[columns])
        contact = push(shifted, C[variant][columns[:, None], columns[None, :]], imposed, active)
        return contact, C[variant][:, columns] @ contact.nodal_forces + change

    # One case after the other: jaxlib's batched dense solves wait for one another on XLA's own threads, and two at once can take them all.
    cases = (rig.pose, rig.imposed, rig.variant)
    first, forces = jax.lax.stop_gradient(jax.lax.map(lambda case: settle(*case), cases))
    changes = jnp.stack([each.changes(forces) for each in bodies])
    change = changes[rig.variant, jnp.arange(len(rig.variant))]
    return jax.lax.map(lambda case: carry(*case), (*cases, first.active, change))


class Residuals(eqx.Module):
    """(prediction - data) / sigma of every row, then one residual for each prior; a function of the raw free parameters."""

    model: Model
    data: tuple[Float[Array, " _"], ...]
    sigma: tuple[Float[Array, " _"], ...]
    priors: tuple[Prior, ...]
    parameters: tuple[Parameter, ...] = eqx.field(static=True)

    def values(self, raw: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        return {parameter.name: parameter.natural(raw[i]) for i, parameter in enumerate(self.parameters)}

    def prepared(self, raw: Float[Array, " p"]) -> Residuals:
        """The same residuals with the linear solves at `raw` done."""
        return dataclasses.replace(self, model=self.model.solved(self.values(raw)))

    def __call__(self, raw: Float[Array, " p"]) -> tuple[Float[Array, " rows"], Health]:
        values = self.values(raw)
        prediction = self.model.predict(values)
        rows = [(f - y) / s for f, y, s in zip(prediction.readings, self.data, self.sigma, strict=True)]
        known = [jnp.atleast_1d((values[prior.name] - prior.mean) / prior.sd) for prior in self.priors]
        return jnp.concatenate([*rows, *known]), prediction.health


@dataclasses.dataclass(frozen=True)
class Assembled:
    """A study with its mesh and model: what runs, reports and notebooks work with."""

    study: Study
    solid: LayeredSolid
    finger: Finger
    model: Model

    def predict(self, values: Values | None = None, quantity: str = "strain_energy_density") -> Prediction:
        """All readings at these values, compiled."""
        asked = {name: jnp.asarray(float(value)) for name, value in (values or {}).items()}
        return _predict(self.model.solved(asked), asked, quantity)

    def problem(self) -> Problem:
        """The study's fit as least squares; afferents start from the best scale and threshold at the start moduli."""
        noise = {one.name: noise_of(one) for one in self.study.measurements}
        known = priors(self.study, self.model.wired)
        parameters = self._started()
        residuals = Residuals(
            self.model,
            tuple(jnp.asarray(one.measured) for one in self.study.measurements),
            tuple(jnp.asarray(noise[one.name][0]) for one in self.study.measurements),
            known,
            parameters,
        )
        ends = np.cumsum([0, *(len(one) for one in self.study.measurements)])
        blocks = {one.name: slice(int(a), int(b)) for one, a, b in zip(self.study.measurements, ends[:-1], ends[1:], strict=True)}
        if known:
            blocks["prior"] = slice(int(ends[-1]), int(ends[-1]) + len(known))
        return Problem(parameters, residuals, blocks, {name: source for name, (_, source) in noise.items()}, residuals.prepared)

    def _started(self) -> tuple[Parameter, ...]:
        rates = [(index, one) for index, one in enumerate(self.study.measurements) if one.kind == "spike_rate"]
        if not rates:
            return self.model.wired.free
        felt = self.predict().quantity
        begun: dict[str, float] = {}
        for index, one in rates:
            scale, threshold = start(np.asarray(felt[index]), one.measured, 1 / noise_of(one)[0] ** 2)
            begun |= {f"{one.name}.scale": scale, f"{one.name}.threshold": threshold}
        return tuple(_begin(parameter, begun) for parameter in self.model.wired.free)


def _begin(parameter: Parameter, begun: Mapping[str, float]) -> Parameter:
    value = begun.get(parameter.path)
    if value is None:
        return parameter
    return dataclasses.replace(parameter, value=float(np.clip(value, 10 * parameter.lower, 0.1 * parameter.upper)))


@eqx.filter_jit
def _predict(model: Model, values: dict[str, Array], quantity: str) -> Prediction:
    return model.predict(values, quantity)


def noise_of(measurement: Measurement) -> tuple[np.ndarray, str]:
    """(rows,) standard deviations and where they come from: `stated`, pooled from `replicates`, or `assumed`."""
    if measurement.sigma is not None:
        return np.asarray(measurement.sigma, float), "stated"
    pooled = _pooled(measurement)
    if pooled is not None:
        return np.full(len(measurement), pooled), "replicates"
    return np.full(len(measurement), ASSUMED_NOISE * float(np.abs(measurement.measured).max())), "assumed"


def _pooled(measurement: Measurement) -> float | None:
    """Standard deviation within groups of rows that differ in their trial alone."""
    if "trial" not in measurement.table:
        return None
    apart = (measurement.value, "trial", "sigma", "time")
    keys = [np.unique(column, return_inverse=True)[1] for name, column in measurement.table.items() if name not in apart]
    _, group = np.unique(np.column_stack(keys), axis=0, return_inverse=True)
    count = np.bincount(group.reshape(-1))
    mean = np.bincount(group.reshape(-1), measurement.measured) / count
    freedom = int((count - 1).sum())
    spread = float(np.sum((measurement.measured - mean[group.reshape(-1)]) ** 2))
    return float(np.sqrt(spread / freedom)) if freedom >= 3 and spread > 0 else None


def solid_of(study: Study) -> LayeredSolid:
    """The study's fingertip before it is meshed."""
    finger = study.finger
    if finger.preset is not None:
        solid = preset(finger.preset)
        return solid if finger.nail is None else dataclasses.replace(solid, nail=Patch(finger.nail.z, finger.nail.theta))
    assert finger.nail is not None and study.sections is not None  # the door has checked
    return solid_from_sections(Sections.from_csv(study.sections), Patch(finger.nail.z, finger.nail.theta), study.name)


def assemble(study: Study, *, solver: str = "auto") -> Assembled:
    """Mesh a study's finger and lay its measurements out on it.

    **Raises** `InputError` where a measurement cannot be made on this finger: a site or a surface point beyond the skin, a receptor
    outside the tissue, rows that do not say to which subject they belong although moduli differ between subjects.
    """
    solid, wired = solid_of(study), wiring(study)
    _check_labels(study, wired)
    spacing = study.finger.resolution
    planned = plans(study.measurements, solid, wired)
    finger = build_finger(solid, Resolution(spacing.pad_mm, spacing.proximal_mm), foci(planned, solid, spacing.pad_mm))
    return lay_out(study, solid, finger, wired, solver)


def lay_out(study: Study, solid: LayeredSolid, finger: Finger, wired: Wiring, solver: str = "auto") -> Assembled:
    """A study on a mesh that is already there."""
    bone = study.model.bone_kind()
    finger = finger if bone == "elastic" else finger.without_bone()
    tissue = body(finger, bone=bone)
    laid = lay(plans(study.measurements, solid, wired), finger, tissue, solid)
    model = Model(
        body=tissue,
        solver=solver_for(tissue, solver),
        columns=columns_from_matrix(laid.columns),
        rigs=laid.rigs,
        wired=wired,
        variants=wired.variants(study.measurements),
        names=tuple(one.name for one in study.measurements),
        lengths=tuple(len(one) for one in study.measurements),
        receptor_layer=tuple(laid.receptor_layer.items()),
    )
    return Assembled(study, solid, finger, model)


def _check_labels(study: Study, wired: Wiring) -> None:
    for owner, column in wired.per.items():
        for one in study.measurements:
            concerned = not owner.endswith((".scale", ".threshold")) or owner.startswith(f"{one.name}.")
            if concerned and column not in one.table:
                remedy = f"add the column, or take {owner} out of fit.per"
                raise InputError(f"rows do not say their {column}, by which {owner} differs", file=one.file, place=column, remedy=remedy)
