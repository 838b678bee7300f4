"""Which parameter enters where: ties share one value, `per` gives each subject, finger or session its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..fem.body import Material
from ..layers import LAYERS, SOFT_LAYERS
from ..measurements import Measurement
from ..parameters import Parameter
from ..study import Study

RIGID_BONE = (1e3, 0.3)  # MPa and Poisson's ratio of a bone that is not meshed; no reading depends on them
Values = Mapping[str, Float[Array, ""] | float]


@dataclasses.dataclass(frozen=True, eq=False)
class Wiring:
    """The free parameters of a study and the way to them from every row.

    - `free`: one `Parameter` for each value that moves; `fixed`: name -> value of the rest.
    - `owner`: name -> the name whose value it shares (itself, unless tied).
    - `per`: owner -> label column of which every value has its own, named `owner[label]`.
    """

    free: tuple[Parameter, ...]
    fixed: dict[str, float]
    owner: dict[str, str]
    per: dict[str, str]

    def name(self, name: str, labels: Mapping[str, str]) -> str:
        """The parameter that holds `name` for a row with these labels."""
        owner = self.owner[name]
        column = self.per.get(owner)
        return f"{owner}[{labels[column]}]" if column is not None and column in labels else owner

    def value(self, name: str, labels: Mapping[str, str], values: Values) -> Float[Array, ""]:
        key = self.name(name, labels)
        return jnp.asarray(values[key] if key in values else self.fixed[self.owner[name]])

    def material(self, labels: Mapping[str, str], values: Values) -> Material:
        """The tissue of a row with these labels."""
        stiffness = self.value("stiffness", labels, values)
        soft = [stiffness * self.value(f"{layer}.modulus", labels, values) for layer in SOFT_LAYERS]
        E = [*soft, self._of("bone.modulus", RIGID_BONE[0], labels, values)]
        nu = [self._poisson_ratio(layer, labels, values) for layer in LAYERS]
        return Material(jnp.stack(E), jnp.stack(nu))

    def _of(self, name: str, otherwise: float, labels: Mapping[str, str], values: Values) -> Float[Array, ""]:
        return self.value(name, labels, values) if name in self.owner else jnp.asarray(otherwise)

    def _poisson_ratio(self, layer: str, labels: Mapping[str, str], values: Values) -> Float[Array, ""]:
        if layer == "bone" and "bone.modulus" not in self.owner:
            return jnp.asarray(RIGID_BONE[1])
        if "poisson_ratio" in self.owner:
            return self.value("poisson_ratio", labels, values)
        return self._of(f"{layer}.poisson_ratio", RIGID_BONE[1], labels, values)

    def variants(self, measurements: tuple[Measurement, ...]) -> tuple[tuple[tuple[str, str], ...], ...]:
        """The different materials that the rows need, as labels of the columns that moduli differ by."""
        found: dict[tuple[tuple[str, str], ...], None] = {}
        for measurement in measurements:
            for labels in self.labels(measurement):
                found.setdefault(labels)
        return tuple(found)

    def labels(self, measurement: Measurement) -> list[tuple[tuple[str, str], ...]]:
        """Of each row: the labels of the columns named under `per`."""
        columns = [column for column in sorted(set(self.per.values())) if column in measurement.table]
        texts = [np.asarray(measurement.table[column]).astype(str).tolist() for column in columns]
        return [tuple(zip(columns, row, strict=True)) for row in zip(*texts, strict=True)] if texts else [()] * len(measurement)


def wiring(study: Study) -> Wiring:
    """The wiring of a study's fit; every name in it was checked when the study was read."""
    known = {parameter.name: parameter for parameter in study.parameters()}
    owner = {name: name for name in known} | {name: group[0] for group in study.fit.tie for name in group}
    per = {owner[name]: column for name, column in study.fit.per.items()}
    free: list[Parameter] = []
    for name in dict.fromkeys(owner[name] for name in study.fit.free):
        free += _instances(known[name], per.get(name), study.measurements)
    return Wiring(tuple(free), {name: parameter.value for name, parameter in known.items()}, owner, per)


def _instances(parameter: Parameter, column: str | None, measurements: tuple[Measurement, ...]) -> list[Parameter]:
    if column is None:
        return [parameter]
    having = [np.asarray(one.table[column]).astype(str) for one in measurements if column in one.table]
    labels = dict.fromkeys(str(label) for texts in having for label in texts)
    return [dataclasses.replace(parameter, name=f"{parameter.name}[{label}]") for label in labels]


class Prior(eqx.Module):
    """A value measured elsewhere, as one more residual: (value - mean) / sd, in the parameter's own unit."""

    name: str = eqx.field(static=True)
    mean: float
    sd: float


def priors(study: Study, wired: Wiring) -> tuple[Prior, ...]:
    """One prior for each free value of a parameter that has one."""
    names = {parameter.name for parameter in wired.free}
    found = []
    for name, prior in study.fit.priors.items():
        owner = wired.owner.get(name, name)
        found += [Prior(each, prior.value, prior.sd) for each in sorted(names) if each == owner or each.startswith(f"{owner}[")]
    return tuple(found)
