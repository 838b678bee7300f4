"""What a checked study holds: records in internal units, and the parameters of its model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .errors import InputError
from .indenter_spec import IndenterSpec
from .layers import SOFT_LAYERS
from .measurements import Measurement, Receptor
from .parameters import Parameter
from .spelling import choose_from
from .study_design import Design
from .study_keys import FORM, NODES, PAIRS, PLACEMENT, TOGETHER, Finger, Model
from .study_sweep import Sweep


@dataclasses.dataclass(frozen=True)
class Prior:
    """A value measured elsewhere: normal about `value` (internal unit), standard deviation `sd` in the same
    unit.
    """

    value: float
    sd: float

    @property
    def relative_sd(self) -> float:
        """`sd` as a share of `value`."""
        return self.sd / self.value


@dataclasses.dataclass(frozen=True)
class Fit:
    """Which parameters move.

    - `free`: their names; every spike-rate file's scale and threshold are among them.
    - `tie`: groups that share one value, that of their first member.
    - `per`: name -> the label column (`subject`, ...) of which every value has its own; in a tie it holds
      for the group.
    - `priors`: name -> what was measured elsewhere.
    - `loss`: by name, see `identify.weighing`; `starts`: from how many places the fit begins; `workers`: how many of them at once, None
      where the machine decides.
    - `profile`: the parameters whose likelihood is profiled. `bootstrap`: kind, repeats and seed; `sample`: steps, chains and seed; None
      where none is asked for.
    - `own_noise`: whether every measurement that says nothing of its noise has its own. `finer`: mm, spacings on the pad of the meshes
      that the fit is corrected to, coarsest first.
    """

    free: tuple[str, ...] = ()
    tie: tuple[tuple[str, ...], ...] = ()
    per: dict[str, str] = dataclasses.field(default_factory=dict)
    priors: dict[str, Prior] = dataclasses.field(default_factory=dict)
    loss: str = "linear"
    starts: int = 1
    workers: int | None = None
    profile: tuple[str, ...] = ()
    bootstrap: tuple[str, int, int] | None = None
    sample: tuple[int, int, int] | None = None
    own_noise: bool = False
    finer: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Rows kept from the fit: of one measurement, where every column has one of the values (internal
    units).
    """

    measurement: str
    where: dict[str, tuple[float | str, ...]]


@dataclasses.dataclass(frozen=True)
class Reach:
    """How far the catalogue is searched where no effect alone explains the data: `pairs` that are tried, the most promising first, and
    effects `together` in the nearest model, at most.
    """

    pairs: int = PAIRS
    together: int = TOGETHER


MEASUREMENT = "measurement"  # what rows of one measurement have in common, where a column of labels may be named


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """`effects`: `all`, `none`, or a tuple of names; `without`: what `all` is not to mean; `hold_out`: empty where whole conditions are
    held out in turn; `form`: by kind, the share of a reading that a model of the right effects may still be wrong by; `placement`: mm, how
    well the place of an afferent is known; `nodes`: of the mesh that is fitted on, at most about so many; `per`: effect -> column of
    labels, or `measurement`, of which each has an amount of its own.
    """

    effects: str | tuple[str, ...] = "all"
    hold_out: tuple[HeldOut, ...] = ()
    form: Mapping[str, float] = dataclasses.field(default_factory=lambda: dict(FORM))
    placement: float = PLACEMENT
    nodes: int = NODES
    reach: Reach = dataclasses.field(default_factory=Reach)
    per: Mapping[str, str] = dataclasses.field(default_factory=dict)
    without: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class TableRow:
    """One line of a table of forces: `force` in N at `displacement` in mm, and the published `modulus` in
    MPa.
    """

    indenter: str
    subject: str
    force: float
    displacement: float
    modulus: float | None


@dataclasses.dataclass(frozen=True)
class ForceTable:
    """Options of `kind: table`: the rows, and the indenter of each name in them; `controlled` says what was
    imposed; `radii`, mm, are those at which an indenter of unknown radius is tried; `drivers` asks what a
    modulus changes with.
    """

    rows: tuple[TableRow, ...]
    indenters: dict[str, IndenterSpec]
    controlled: str
    radii: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    drivers: bool = False


@dataclasses.dataclass(frozen=True)
class LayerStudy:
    """Options of `kind: layer_study`.

    - `models`: names such as `m43338`; the first is what the others are compared with.
    - `depth`: mm, of every profile; `span`, `spacing`: mm, the profile goes from -span to span.
    """

    models: tuple[str, ...]
    depth: float
    indenter: IndenterSpec
    span: float
    spacing: float


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """One study, checked.

    - `kind`: `fit`, `table`, `layer_study`, `sweep` or `predict`.
    - `finger`, `model`: as written, see `study_keys`; `sections` is where the geometry's CSV is, `shape` the file of its images,
      scan or mesh, `bone` that of the bone's own sections; None where there is none.
    - `missing_data`: files in the data folder that are not there; while there are any, `fallback` (if not
      None) is the name of the study to run instead, and `measurements` holds only what could be read.
    - `options`: of a `table`, a `layer_study` or a `sweep`; None for the other kinds, and where its file is missing.
    """

    name: str
    kind: str
    file: Path
    finger: Finger
    sections: Path | None
    model: Model
    receptor: Receptor | None
    measurements: tuple[Measurement, ...]
    fit: Fit
    diagnose: Diagnose | None
    design: Design | None = None
    options: ForceTable | LayerStudy | Sweep | None = None
    missing_data: tuple[str, ...] = ()
    fallback: str | None = None
    notes: str = ""
    shape: Path | None = None
    bone: Path | None = None
    written: dict[str, Any] = dataclasses.field(default_factory=dict)

    def measurement(self, name: str) -> Measurement:
        """One of the measurements. **Raises** `InputError` naming the nearest where there is none of that
        name.
        """
        by_name = {measurement.name: measurement for measurement in self.measurements}
        if name not in by_name:
            raise InputError(
                f"study {self.name!r} has no measurement {name!r}", remedy=choose_from(name, by_name)
            )
        return by_name[name]

    def parameters(self) -> tuple[Parameter, ...]:
        """Every number of the model that a fit may free, at its start value and with generous limits."""
        return base_parameters(self.model, self.measurements)


def base_parameters(model: Model, measurements: Sequence[Measurement] = ()) -> tuple[Parameter, ...]:
    """The parameters of a model and of the afferents that were recorded.

    `<layer>.modulus` (MPa), `stiffness` (a factor on the moduli of all soft layers, so that fingers of the same ratios can differ by it),
    `poisson_ratio` or `<layer>.poisson_ratio`, and for every spike-rate measurement
    its `scale` (Hz/MPa) and `threshold` (MPa): rate = scale * max(quantity - threshold, 0). The bone's
    modulus is there where it is elastic.
    """
    afferents = [one for one in measurements if one.kind == "spike_rate"]
    return (
        *_moduli(model),
        Parameter("stiffness", 1.0, "1", "log", 1e-6, 1e6),
        *_poisson_ratios(model),
        *(p for one in afferents for p in _afferent(model, one)),
    )


def _moduli(model: Model) -> list[Parameter]:
    moduli = model.moduli()
    soft = [Parameter(f"{layer}.modulus", moduli[layer], "MPa", "log", 1e-6, 1e4) for layer in SOFT_LAYERS]
    if model.bone_modulus() is None:
        return soft
    return [*soft, Parameter("bone.modulus", moduli["bone"], "MPa", "log", 1e-6, 1e12)]


def _poisson_ratios(model: Model) -> list[Parameter]:
    ratios = model.poisson_ratios()
    if not model.has_layered_poisson_ratio():
        return [Parameter("poisson_ratio", ratios["epidermis"], "1", "logit", 0.0, 0.5)]
    layers = SOFT_LAYERS if model.bone_modulus() is None else tuple(ratios)
    return [Parameter(f"{layer}.poisson_ratio", ratios[layer], "1", "logit", 0.0, 0.5) for layer in layers]


def _afferent(model: Model, measurement: Measurement) -> list[Parameter]:
    # Starts only. A quarter of strain in the dermis, where the ending lies, is taken to give the largest
    # rate seen.
    density = 0.5 * model.moduli()["dermis"] * 0.25**2
    scale = max(float(measurement.measured.max()), 1.0) / density
    return [
        Parameter(f"{measurement.name}.scale", scale, "Hz/MPa", "log", scale * 1e-9, scale * 1e9),
        Parameter(
            f"{measurement.name}.threshold", 0.1 * density, "MPa", "log", density * 1e-9, density * 1e9
        ),
    ]
