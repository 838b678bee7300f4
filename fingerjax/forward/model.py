"""The forward model: parameters in, every reading of every instrument out, with derivatives in every parameter.

For each material the body is condensed once to the skin that can be touched and to the points and receptors that are observed; after
that each indentation is a small dense contact problem, and each reading a product with its nodal forces.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.added import NONE, Effects
from ..errors import InputError
from ..fem.body import Body, body
from ..fem.columns import Columns, columns_from_matrix
from ..fem.condensed import AbstractCondensed, Stiffer, first_like
from ..fem.operator import Lame
from ..fem.solver import AbstractSolver, solver_for
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from ..layers import LAYERS, SOFT_LAYERS
from ..measure.afferent import start
from ..measurements import Measurement
from ..parameters import Parameter
from ..study import Study
from .pressing import settle
from .problem import Health, Problem
from .programs import forget_when_many
from .readings import Instruments, Prediction, Solved
from .rigs import PROBE_SPACING, Skin, foci, lay, plans, tips
from .shape import Tell, mesh_of, solid_of, unheard
from .wiring import Prior, Values, Wiring, priors, wiring

VOLUME = 0.01  # share by which a layer of the mesh may be larger or smaller than the finger's before it is told
SHARP = 0.2  # of its radius: node spacing under a probe where it must not be coarser, whatever the size of elements elsewhere
ASSUMED_NOISE = 0.02  # of a measurement's largest value, where nobody says how noisy it is


class Model(eqx.Module):
    """A study made ready to be computed: the body, how it is solved, and the instruments on it."""

    body: Body
    solver: AbstractSolver
    columns: Columns
    instruments: Instruments

    @property
    def wired(self) -> Wiring:
        return self.instruments.wired

    def solved(self, values: Values, *, moving: tuple[str, ...] = ()) -> Solved:
        """The model with its solves and contacts at these values done: it holds there, and so do derivatives in the `moving` names."""
        forget_when_many()
        lame = [tissue.lame() for tissue in self.instruments.materials(values)]
        bodies = self.condensed(lame)
        known = settle(self.instruments.rigs, bodies, self.body, self._directions(values, moving), self.instruments.added, values)
        return Solved(self.instruments, known)

    def condensed(self, lame: Sequence[Lame]) -> list[AbstractCondensed]:
        """The body at each of these materials; those in proportion to an earlier one take its solves."""
        bodies: list[AbstractCondensed] = []
        for variant, each in enumerate(lame):
            like, times = first_like(self.body, lame, variant)
            bodies.append(self.solver.condense(self.body, each, self.columns) if like == variant else Stiffer(bodies[like], times, each))
        return bodies

    def predict(self, values: Values, quantity: str = "strain_energy_density") -> Prediction:
        """All readings at these values, compiled."""
        asked = {name: jnp.asarray(value, float) for name, value in values.items()}
        return _predict(self.solved(asked), asked, quantity)

    def _directions(self, values: Values, moving: tuple[str, ...]) -> Float[Array, "variants d 2 layers"]:
        """Orthonormal directions that span how each variant's Lame parameters follow the moving values."""
        here = {name: jnp.asarray(values[name], float) for name in moving if name in values}
        slope = _lame_slopes(self.instruments, here, dict(values))
        variants = len(self.instruments.variants)
        flat = np.zeros((variants, 0, 2 * len(LAYERS)))
        if slope:
            flat = np.stack([np.asarray(part).reshape(variants, -1) for part in slope.values()], axis=1)
        _, size, basis = np.linalg.svd(flat, full_matrices=False)
        rank = int((size > 1e-12 * size.max(initial=0.0)).sum(axis=1).max(initial=0))
        return jnp.asarray(basis[:, :rank].reshape(variants, rank, 2, len(LAYERS)))


def _lame_slopes(instruments: Instruments, here: dict[str, Array], values: dict[str, Any]) -> dict[str, Array]:
    def lame(moved: dict[str, Array]) -> Array:
        return jnp.stack([tissue.lame() for tissue in instruments.materials(values | moved)])

    return {name: part for name, part in jax.jacfwd(lame)(here).items() if np.any(np.asarray(part) != 0)} if here else {}


class Residuals(eqx.Module):
    """(prediction - data) / sigma of every row, then one residual for each prior; a function of the raw free parameters."""

    model: Model | Solved
    data: tuple[Float[Array, " _"], ...]
    sigma: tuple[Float[Array, " _"], ...]
    priors: tuple[Prior, ...]
    parameters: tuple[Parameter, ...] = eqx.field(static=True)

    def values(self, raw: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        return {parameter.name: parameter.natural(raw[i]) for i, parameter in enumerate(self.parameters)}

    def prepared(self, raw: Float[Array, " p"]) -> Residuals:
        """The same residuals with the linear solves at `raw` done."""
        assert isinstance(self.model, Model), "residuals are prepared once"
        names = tuple(parameter.name for parameter in self.parameters)
        return dataclasses.replace(self, model=self.model.solved(self.values(raw), moving=names))

    def __call__(self, raw: Float[Array, " p"]) -> tuple[Float[Array, " rows"], Health]:
        values = self.values(raw)
        assert isinstance(self.model, Solved), "residuals are read once they are prepared"
        prediction = self.model.predict(values)
        rows = [(f - y) / s for f, y, s in zip(prediction.readings, self.data, self.sigma, strict=True)]
        known = [jnp.atleast_1d((values[prior.name] - prior.mean) / prior.sd) for prior in self.priors]
        return jnp.concatenate([*rows, *known]), prediction.health


@dataclasses.dataclass(frozen=True)
class Assembled:
    """A study with its mesh and model: what runs, reports and notebooks work with.

    `mesh` is the finger as it was meshed, with its bone and before any of the `effects`; `skin` is what its indenters touch.
    """

    study: Study
    solid: AbstractSolid
    finger: Finger
    model: Model
    mesh: Finger
    effects: Effects = NONE
    skin: Skin | None = None

    def predict(self, values: Values | None = None, quantity: str = "strain_energy_density") -> Prediction:
        """All readings at these values, compiled."""
        return self.model.predict(values or {}, quantity)

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
        sources = {name: source for name, (_, source) in noise.items()}
        return Problem(parameters, residuals, blocks, sources, residuals.prepared, self._reseat(parameters), self.study.fit.loss)

    def _reseat(self, parameters: tuple[Parameter, ...]) -> Callable[[np.ndarray], np.ndarray] | None:
        """The best scale and threshold of every afferent whose two are free, have no prior, and are shared with no other."""
        names = [one.name for one in parameters]
        shared = {name for group in self.study.fit.tie for name in group} | set(self.study.fit.priors)
        alone = {
            index: (names.index(f"{one.name}.scale"), names.index(f"{one.name}.threshold"))
            for index, one in enumerate(self.study.measurements)
            if {f"{one.name}.scale", f"{one.name}.threshold"} <= set(names) - shared
        }

        def reseated(raw: np.ndarray) -> np.ndarray:
            felt = self.predict({one.name: float(one.natural(each)) for one, each in zip(parameters, raw, strict=True)}).quantity
            best = np.array(raw, float)
            for index, places in alone.items():
                one, quantity = self.study.measurements[index], np.asarray(felt[index])
                if not np.ptp(quantity) > 0:
                    continue
                for place, value in zip(places, start(quantity, one.measured, 1 / noise_of(one)[0] ** 2), strict=True):
                    best[place] = _within(parameters[place], value).raw()
            return best

        return reseated if alone else None

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
    return _within(parameter, value)


def _within(parameter: Parameter, value: float) -> Parameter:
    return dataclasses.replace(parameter, value=float(np.clip(value, 10 * parameter.lower, 0.1 * parameter.upper)))


@eqx.filter_jit
def _predict(model: Solved, values: dict[str, Array], quantity: str) -> Prediction:
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


def assemble(
    study: Study, *, solver: str = "auto", size: float = 1.0, even: bool = False, focused: bool = True, sharp: bool = False,
    tell: Tell = unheard,
) -> Assembled:  # fmt: skip
    """Mesh a study's finger and lay its measurements out on it. `tell(share, what)` hears of the progress.

    `size`: elements so many times as large as the study's own, everywhere; `even`: hardly larger far from the pad. `focused`: smaller ones
    under sharp indenters and at receptors; else no more than it takes for probes to touch any. `sharp`: under probes a fifth of their
    radius, whatever the `size`.

    **Raises** `InputError` where a measurement cannot be made on this finger: a site or a surface point beyond the skin, a receptor
    outside the tissue, rows that do not say to which subject they belong although moduli differ between subjects.
    """
    wired = wiring(study)
    _check_labels(study, wired)
    solid, finger = meshed(study, size=size, even=even, focused=focused, sharp=sharp, tell=tell)
    return lay_out(study, solid, finger, wired, solver)


def meshed(
    study: Study, *, size: float = 1.0, even: bool = False, focused: bool = True, sharp: bool = False, tell: Tell = unheard
) -> tuple[AbstractSolid, Finger]:
    """A study's finger and the mesh that `assemble` takes for it."""
    solid = solid_of(study, tell)
    planned = plans(study.measurements, solid, wiring(study))
    tell(0.9, "meshing")
    asked = study.finger.resolution
    pad = math.inf if even else asked.pad_mm  # an even mesh is fine under probes however coarse its pad is
    under_probes = min(SHARP / size, PROBE_SPACING) if sharp else PROBE_SPACING
    fine = foci(planned, solid, pad, asked.least_mm or 0.0, under_probes) if focused else tips(planned, solid, size * asked.pad_mm)
    finger = mesh_of(study, solid, fine, size, even)
    if coarse := _too_coarse(finger):
        tell(1.0, coarse)
    return solid, finger


def _too_coarse(finger: Finger) -> str:
    """What to say of a mesh with a soft layer of another volume than the finger's; nothing where there is none."""
    off = {layer: finger.quality.get("volume_error", {}).get(layer, 0.0) for layer in SOFT_LAYERS}
    worst = max(off, key=lambda layer: abs(off[layer]))
    if abs(off[worst]) <= VOLUME:
        return ""
    more = "larger" if off[worst] > 0 else "smaller"
    return f"the mesh is too coarse: its {worst} is {100 * abs(off[worst]):.1f} % {more} than the finger's; ask for a smaller proximal_mm"


def lay_out(
    study: Study,
    solid: AbstractSolid,
    finger: Finger,
    wired: Wiring,
    solver: str | AbstractSolver = "auto",
    effects: Effects = NONE,
    dilatation: str = "pointwise",
    beside: Assembled | None = None,
) -> Assembled:
    """A study on a mesh that is already there, with effects in it. `solver`: its kind, or that of a body with the same elements and
    supports; `beside`: the study on the same mesh with others, whose skin serves where it is the same.

    **Raises** `ValueError` where an effect turns elements inside out.
    """
    bone, whole = study.model.bone_kind(), finger
    finger = effects.shape(finger, solid)
    finger = finger if bone == "elastic" else finger.without_bone()
    tissue = effects.support(body(finger, bone=bone, dilatation=dilatation), finger, solid)
    skin = None if beside is None or beside.skin is None or not beside.skin.is_alike(finger, beside.finger) else beside.skin
    return _instrumented(study, solid, whole, finger, tissue, wired, solver, effects, skin)


def softened(ready: Assembled) -> Assembled:
    """A study on the same mesh whose elements have the mean dilatation: they are softer than those with one at every point."""
    return lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, effects=ready.effects, dilatation="mean")


def changed(ready: Assembled, effects: Effects) -> Assembled:
    """A study on the same mesh with other effects in it, solved as before; the body is the very same one where no effect changes it.

    **Raises** `ValueError` where an effect turns elements inside out.
    """
    known = ready.model
    if effects.reshape or ready.effects.reshape:
        return lay_out(ready.study, ready.solid, ready.mesh, known.wired, known.solver, effects, known.body.dilatation, ready)
    return _instrumented(ready.study, ready.solid, ready.mesh, ready.finger, known.body, known.wired, known.solver, effects, ready.skin)


def _instrumented(
    study: Study,
    solid: AbstractSolid,
    mesh: Finger,
    finger: Finger,
    tissue: Body,
    wired: Wiring,
    solver: str | AbstractSolver,
    effects: Effects,
    skin: Skin | None = None,
) -> Assembled:
    """A study's measurements laid out on a body; `skin`: what others touch of it."""
    laid = lay([plan.changed(effects) for plan in plans(study.measurements, solid, wired)], finger, tissue, solid, skin)
    model = Model(
        body=tissue,
        solver=solver_for(tissue, solver) if isinstance(solver, str) else solver,
        columns=columns_from_matrix(laid.columns),
        instruments=Instruments(
            rigs=laid.rigs,
            wired=wired,
            variants=wired.variants(study.measurements),
            names=tuple(one.name for one in study.measurements),
            lengths=tuple(len(one) for one in study.measurements),
            receptor_layer=tuple(laid.receptor_layer.items()),
            added=effects.added,
        ),
    )
    return Assembled(study, solid, finger, model, mesh, effects, laid.skin)


def _check_labels(study: Study, wired: Wiring) -> None:
    for owner, column in wired.per.items():
        for one in study.measurements:
            concerned = not owner.endswith((".scale", ".threshold")) or owner.startswith(f"{one.name}.")
            if concerned and column not in one.table:
                remedy = f"add the column, or take {owner} out of fit.per"
                raise InputError(f"rows do not say their {column}, by which {owner} differs", file=one.file, place=column, remedy=remedy)
