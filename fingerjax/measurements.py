"""The door for measured tables: a tidy CSV and its sidecar become one frozen `Measurement`, or are refused.

| kind | measured value | imposed |
|---|---|---|
| `deflection_profile` | `deflection` of the skin at a `distance` from the load line | `depth` |
| `force_displacement` | `force`; `displacement` under `controlled: force` | the other one |
| `spike_rate` | `rate` with the indenter at a `position` | `depth` or `force` |

The whole contract is in DATA.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from .csvfile import read_table
from .errors import InputError
from .indenter_spec import IndenterSpec, read_indenters
from .row_choice import chosen_rows, joined, repeated
from .spike_windows import RatesKeys, rates_in
from .strict import Number, Positive, Strict, checked
from .tidy import LABELS, QUANTITIES, Tidy
from .traces import from_contact, made_alike, read_at
from .units import internal_unit, to_internal
from .yamlfile import Document, Keys, Origin, located, read_yaml, said_in_python

BESIDE = ("displacement", "depth", "force")  # read beside what was imposed, to find first contact
Kind = Literal["deflection_profile", "force_displacement", "spike_rate"]


class SiteKeys(Strict):
    """Contact point on the skin, as written: `z_mm` from the proximal cut, `theta_deg` about the bone."""

    z_mm: Number = Field(ge=0)
    theta_deg: Number = Field(ge=-360, le=360)


class ReceptorKeys(SiteKeys):
    """The recorded ending, as written: `depth_mm` below the skin at (`z_mm`, `theta_deg`)."""

    afferent: str = "SA-I"
    depth_mm: Positive


class NoiseKeys(Strict):
    """Standard deviation of the measured value, as written: a number with its unit, or `per row`."""

    sigma: Number | str | None = None
    unit: str | None = None
    replicates: int | None = Field(default=None, ge=1)


class SidecarKeys(Strict):
    """Everything a sidecar, or the entry of a study that uses the file, may say."""

    kind: Kind
    source: str = ""
    species: str = ""
    finger: str = ""
    indenter: Any = None
    controlled: Literal["displacement", "force"] | None = None
    direction: Literal["x", "z"] = "z"
    site: SiteKeys | None = None
    receptor: ReceptorKeys | None = None
    noise: NoiseKeys = NoiseKeys()
    notes: str = ""
    columns: dict[str, str | list[str]] = {}  # a list joins columns to one label
    where: dict[str, Any] = {}
    drop: dict[str, Any] | list[dict[str, Any]] = {}
    units: dict[str, str] = {}
    every: dict[str, Number | str] = {}  # what holds for every row and the table does not repeat, as in depth_mm: 1.0
    rates: RatesKeys | None = None  # spike times beside a trace, counted in windows
    contact: dict[str, Number] = {}  # where traces begin: force_mN: 0.05
    at: dict[str, list[Number]] = {}  # where traces are read: time_s: [0.1, 0.2, 0.5]
    alike: dict[str, Number] = {}  # what repeats of one setting differ by at most: displacement_um: 10


@dataclasses.dataclass(frozen=True)
class Site:
    """A point of the skin: `z` mm from the proximal cut, `theta` rad about the section's origin (3 pi/2:
    pad).
    """

    z: float
    theta: float


@dataclasses.dataclass(frozen=True)
class Receptor:
    """A mechanoreceptor: `afferent` by name, `depth` mm below the skin at (`z` mm, `theta` rad)."""

    afferent: str
    depth: float
    z: float
    theta: float


@dataclasses.dataclass(frozen=True, eq=False)
class Measurement:
    """What one file says, in internal units; nothing in it is a guess.

    - `table`: name without unit -> (rows,): float64 in mm, N, Hz, s; text for `subject`, `condition`,
      `trial`, `stimulus`.
    - `value`: the column that was measured; the fit compares it.
    - `sigma`: (rows,) standard deviation of the value, in its unit; None where none was said.
    - `indenters`: by the name in the column `stimulus`; under `""` where there is one for all rows.
    - `controlled`: what was imposed, `displacement` (depth from first contact, mm) or `force` (N).
    - `direction`: `x` or `z`, along which distances and positions are counted.
    - `site`: where the skin is touched; None where the file does not say, then it is the middle of the pad.
    - `rows`: (rows,) the line in the file of each row, for messages.
    - `replicates`: how many trials, or as many as the sidecar states where no column `trial` tells.
    """

    name: str
    kind: str
    table: dict[str, np.ndarray]
    value: str
    sigma: np.ndarray | None
    indenters: dict[str, IndenterSpec]
    controlled: str
    direction: str
    site: Site | None
    receptor: Receptor | None
    notes: str = ""
    source: str = ""
    species: str = ""
    file: Path | None = None
    replicates: int = 1
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.table[self.value])

    @property
    def measured(self) -> np.ndarray:
        """(rows,) the measured value, internal units."""
        return self.table[self.value]

    @property
    def unit(self) -> str:
        """The internal unit of the measured value."""
        return internal_unit(QUANTITIES[self.value])

    @property
    def imposed(self) -> str:
        """The column of what was imposed: `depth`, `displacement` or `force`."""
        if self.controlled == "force":
            return "force"
        return "displacement" if self.kind == "force_displacement" else "depth"


def read_measurement(
    file: Path | str,
    said: Mapping[str, Any] | None = None,
    *,
    name: str | None = None,
    receptor: Receptor | None = None,
    origin: Origin = said_in_python,
) -> Measurement:
    """Read a CSV and the sidecar beside it (`<name>.yaml`), if there is one.

    **Arguments:**

    - `file`: the CSV.
    - `said`: keys of a sidecar that stand above it, each replacing the sidecar's whole key; all of them
      where there is none.
    - `name`: what to call the measurement; the file's stem where None.
    - `receptor`: for a spike-rate file that does not say its own.
    - `origin`: where `said` was written.

    **Raises** `InputError` for whatever is not as DATA.md has it, with file, row, column, what was found and
    what to write.
    """
    file, said = Path(file), dict(said or {})
    sidecar = _sidecar(file)
    origin = _layered(said, origin, sidecar, file)
    below = sidecar.content if sidecar else {}
    keys = checked(SidecarKeys, _with_kind({**below, **said}, file), origin)
    table = repeated(read_table(file), keys.every, origin)
    table, columns = joined(table, keys.columns, origin)
    tidy = Tidy(chosen_rows(table, keys.where, keys.drop, origin), columns, keys.units)
    with located(origin, "columns"):
        tidy.check_columns()
    with located(origin, "units"):
        tidy.check_units()
    return _measurement(name or file.stem, keys, tidy, receptor, origin)


def _sidecar(file: Path) -> Document | None:
    beside = file.with_suffix(".yaml")
    if file.suffix == ".yaml":
        raise InputError(
            "this is a sidecar, not a table", file=file, remedy="name the CSV; its sidecar is found"
        )
    if not beside.exists():
        return None
    document = read_yaml(beside)
    if not isinstance(document.content, Mapping):
        remedy = "write keys and values: kind: ..., indenter: ..."
        raise InputError("the sidecar holds no keys", file=beside, seen=document.content, remedy=remedy)
    return document


def _layered(said: Mapping[str, Any], origin: Origin, sidecar: Document | None, file: Path) -> Origin:
    """Where a key was written when some stand above the sidecar's."""
    below = sidecar.origin() if sidecar else origin

    def find(keys: Keys) -> tuple[Path | None, str]:
        where = (origin if keys and keys[0] in said else below)(keys)
        return where if where[0] is not None else (file, where[1])

    return find


def _with_kind(said: dict[str, Any], file: Path) -> dict[str, Any]:
    if "kind" not in said:
        remedy = f"write kind: in {file.with_suffix('.yaml').name} beside it, or in the entry that uses it"
        kinds = "deflection_profile, force_displacement or spike_rate"
        raise InputError(f"nothing says what kind of measurement this is: {kinds}", file=file, remedy=remedy)
    return said


def _measurement(
    name: str, keys: SidecarKeys, tidy: Tidy, receptor: Receptor | None, origin: Origin
) -> Measurement:
    imposed, value = _roles(keys, tidy, origin)
    whole = _columns(keys, imposed, value, tidy)
    sigma = _sigma(keys.noise, value, tidy, origin)
    if not keys.contact:
        _check_imposed(whole[imposed], imposed, tidy)
    table, rows = _traced(whole if sigma is None else {**whole, "sigma": sigma}, keys, imposed, value, tidy, origin)
    return Measurement(
        name=name,
        kind=keys.kind,
        table=table,
        value=value,
        sigma=table.get("sigma"),
        indenters=read_indenters(keys.indenter, keys.direction, whole, tidy, origin),
        controlled="force" if imposed == "force" else "displacement",
        direction=keys.direction,
        site=_site(keys, receptor),
        receptor=_receptor(keys, receptor, tidy),
        notes=keys.notes,
        source=keys.source,
        species=keys.species,
        file=tidy.table.file,
        replicates=len(set(table["trial"])) if "trial" in table else keys.noise.replicates or 1,
        rows=rows,
    )


def _traced(
    table: dict[str, np.ndarray], keys: SidecarKeys, imposed: str, value: str, tidy: Tidy, origin: Origin
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The columns after `contact`, `at` and `alike`, and the line in the file of each row."""
    rows = np.array(tidy.table.rows, dtype=np.int64)
    clock = table.get("time")
    if keys.contact:
        with located(origin, "contact"):
            table, rows = from_contact(table if clock is None else {**table, "clock": clock}, rows, keys.contact)
    if keys.rates is not None:
        with located(origin, "rates"):
            table, rows = rates_in(table, rows, keys.rates, tidy.table.file, keys.every)
    if (table[imposed] < 0).any():
        remedy = "choose a later contact, or correct the zero of the force"
        raise InputError(f"a negative {imposed} after first contact", file=tidy.table.file, place=imposed, remedy=remedy)
    unused = {"clock", *BESIDE} - {imposed, value}
    table = {name: each for name, each in table.items() if name not in unused}
    if keys.at:
        with located(origin, "at"):
            table, rows = read_at(table, rows, keys.at)
    if keys.alike:
        with located(origin, "alike"):
            table = made_alike(table, keys.alike, value)
    return table, rows


def _roles(keys: SidecarKeys, tidy: Tidy, origin: Origin) -> tuple[str, str]:
    """Which column was imposed and which was measured."""
    if keys.kind == "force_displacement":
        return ("force", "displacement") if keys.controlled == "force" else ("displacement", "force")
    imposed = "depth" if keys.kind == "deflection_profile" else _depth_or_force(tidy, keys.controlled)
    controlled = "force" if imposed == "force" else "displacement"
    if keys.controlled not in (None, controlled):
        file, where = origin(("controlled",))
        remedy = f"write controlled: {controlled}, or give the column of what was imposed"
        problem = f"a {keys.kind} with a column of {imposed} was not controlled by {keys.controlled}"
        raise InputError(problem, file=file, place=where, seen=keys.controlled, remedy=remedy)
    return imposed, "deflection" if keys.kind == "deflection_profile" else "rate"


def _depth_or_force(tidy: Tidy, controlled: str | None) -> str:
    there = [name for name in ("depth", "force") if tidy.find(name)]
    if len(there) == 2 and controlled is not None:
        return "force" if controlled == "force" else "depth"
    if len(there) != 1:
        found = [str(tidy.find(name)) for name in there]
        problem = "a spike_rate needs exactly one column of depth_mm, force_N or force_gf"
        remedy = "keep the one that was imposed, or name it under controlled:" if there else "add the depth or force of every row"
        seen = found or list(tidy.table.cells)
        raise InputError(problem, file=tidy.table.file, seen=seen, remedy=remedy)
    return there[0]


def _columns(keys: SidecarKeys, imposed: str, value: str, tidy: Tidy) -> dict[str, np.ndarray]:
    along = {"deflection_profile": ["distance"], "spike_rate": ["position"]}.get(keys.kind, [])
    counted = [] if keys.rates is not None else [value]
    table = {name: tidy.needed(name, QUANTITIES[name]) for name in [imposed, *along, *counted]}
    beside = {name: tidy.optional(name, QUANTITIES[name]) for name in BESIDE if keys.contact and name not in table}
    more = {"time": tidy.optional("time", "time"), **{name: tidy.label(name) for name in LABELS}}
    return table | {name: column for name, column in (beside | more).items() if column is not None}


def _check_imposed(values: np.ndarray, name: str, tidy: Tidy) -> None:
    if (values < 0).any():
        column = str(tidy.find(name))
        problem = f"a negative {name}: it is counted from first contact, into the skin"
        remedy = "correct the zero or the sign, or leave the row out with `drop:`"
        raise tidy.table.refuse(int(np.argmax(values < 0)), column, problem, remedy)


def _sigma(noise: NoiseKeys, value: str, tidy: Tidy, origin: Origin) -> np.ndarray | None:
    """Standard deviations (rows,): the number that is stated, or else the column, or else nothing."""
    if noise.sigma is not None and noise.sigma != "per row":
        with located(origin, "noise"):
            return np.full(len(tidy.table), _stated_sigma(noise, QUANTITIES[value]))
    dimension = QUANTITIES[value]
    sigma = tidy.needed("sigma", dimension) if noise.sigma == "per row" else tidy.optional("sigma", dimension)
    if sigma is not None and (sigma <= 0).any():
        remedy = "write a standard deviation above 0, or leave the row out with `drop:`"
        problem = "a standard deviation that is not positive"
        raise tidy.table.refuse(int(np.argmax(sigma <= 0)), str(tidy.find("sigma")), problem, remedy)
    return sigma


def _stated_sigma(noise: NoiseKeys, dimension: str) -> float:
    if isinstance(noise.sigma, str):
        remedy = "write a number with its `unit:`, or the words: per row"
        raise InputError("not a standard deviation", place="sigma", seen=noise.sigma, remedy=remedy)
    if noise.sigma is None or noise.sigma <= 0:
        remedy = "write a number above 0"
        raise InputError(
            "a standard deviation that is not positive", place="sigma", seen=noise.sigma, remedy=remedy
        )
    if noise.unit is None:
        remedy = f"write unit: {internal_unit(dimension)} beside it"
        raise InputError(
            "a standard deviation without a unit", place="sigma", seen=noise.sigma, remedy=remedy
        )
    return float(to_internal(noise.sigma, noise.unit, dimension, "noise.sigma"))


def _angle(degrees: float) -> float:
    return float(to_internal(degrees, "deg", "angle")) % (2 * np.pi)


def _site(keys: SidecarKeys, fallback: Receptor | None) -> Site | None:
    if keys.site is not None:
        return Site(keys.site.z_mm, _angle(keys.site.theta_deg))
    if keys.kind != "spike_rate":
        return None
    if keys.receptor is not None:
        return Site(keys.receptor.z_mm, _angle(keys.receptor.theta_deg))
    return Site(fallback.z, fallback.theta) if fallback else None


def receptor_from(keys: ReceptorKeys) -> Receptor:
    """The record of what was written under `receptor:`."""
    return Receptor(keys.afferent, keys.depth_mm, keys.z_mm, _angle(keys.theta_deg))


def _receptor(keys: SidecarKeys, fallback: Receptor | None, tidy: Tidy) -> Receptor | None:
    if keys.kind != "spike_rate":
        return None
    found = receptor_from(keys.receptor) if keys.receptor else fallback
    if found is None:
        remedy = "write receptor: {depth_mm: ..., z_mm: ..., theta_deg: ...} in the sidecar or under model:"
        raise InputError("nothing says where the receptor is", file=tidy.table.file, remedy=remedy)
    return found
