"""What the loop needs to know of a model: the rows that were measured, the effects that may be missing, and how both move it.

    data y,   model f(theta, phi),   phi = null: the effect is asleep

`theta` are the raw values of the base parameters, `phi` the sizes of effects in their own units. Nothing here knows of meshes or
fingers, so that the statistics can be tested on a model that is a formula.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int, Shaped

from ..errors import InputError
from ..parameters import Parameter
from ..spelling import choose_from
from ..study_records import Prior

ROLES = ("fit", "veto", "report")
NONE: Mapping[str, float] = {}  # no effect is awake
_ALIKE = 1e-9  # share of a coordinate's range within which two rows have the same one


@dataclass(frozen=True)
class Column:
    """One scalar through which an effect enters the model.

    - `family`, `name`, `unit`: whose it is and what it is called; `key` is all of it in one word.
    - `scale`: a plausible size in `unit`: the standard deviation of the prior about `null`.
    - `lower`, `upper`: where it may go, in `unit`: within 3 `scale` of `null`, and physically possible.
    - `null`: the value that changes nothing.
    - `sign`: +1 or -1 where it can only be above or below `null`, 0 where both are possible.
    - `step`: size of the step by which its column is a secant, where the tangent vanishes or misleads; None for the tangent.
    - `fixed`: values of nuisance parameters that go with this column, `{"tau_s": 1.0}`. Columns of a family that differ in `fixed` are
      the nodes of a grid, of which the best counts; those that agree in it enter together.
    """

    family: str
    name: str
    unit: str
    scale: float
    lower: float
    upper: float
    null: float = 0.0
    sign: int = 0
    step: float | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (self.scale > 0 and math.isfinite(self.scale)):
            raise InputError(f"{self.key}: the plausible size is not positive", seen=self.scale, remedy="give a prior sd above 0")
        if self.sign not in (-1, 0, 1):
            raise InputError(f"{self.key}: no sign", seen=self.sign, remedy="write -1, 0 or 1")
        if not (self.lower <= self.null <= self.upper and self.lower < self.upper):
            seen = (self.lower, self.null, self.upper)
            raise InputError(f"{self.key}: the null value is not inside the bounds", seen=seen, remedy="widen the bounds")
        if (self.sign > 0 and self.lower < self.null) or (self.sign < 0 and self.upper > self.null):
            ends = (self.lower, self.upper)
            raise InputError(f"{self.key}: the bounds allow the wrong sign", seen=ends, remedy="end them at the null value")

    @property
    def key(self) -> str:
        """`relaxation.share@tau_s=1`."""
        return f"{self.family}.{self.name}" + "".join(f"@{name}={value:g}" for name, value in self.fixed.items())

    def clipped(self, value: float) -> float:
        """The nearest value inside the bounds."""
        return float(min(max(value, self.lower), self.upper))


@dataclass(frozen=True)
class Family:
    """One effect of the catalogue: the columns that it may enter by.

    - `acts_on`: finger, tissue, support, contact, time, instrument or afferent.
    - `leaves`: the residual that it leaves behind, `confused_with`: what looks like it, both in words.
    - `second`: columns of a second term of the same effect (a second Prony term), tried before another effect is.
    - `dear`: a model with it costs many times one without, as tissue of another law does: it is refitted after the others, and given up
      early where one of them is far ahead.
    - `comes_with`: effects that are there, by an unknown amount, where this one is: intervals count what they may do to the parameters.
    """

    name: str
    columns: tuple[Column, ...]
    acts_on: str = ""
    leaves: str = ""
    confused_with: str = ""
    second: tuple[Column, ...] = ()
    dear: bool = False
    comes_with: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.columns:
            raise InputError(f"effect {self.name}: it has no column", remedy="give one scalar at least")
        keys = [column.key for column in (*self.columns, *self.second)]
        if len(set(keys)) < len(keys):
            raise InputError(f"effect {self.name}: two columns have one key", seen=keys, remedy="name them apart")
        strangers = [column.family for column in (*self.columns, *self.second) if column.family != self.name]
        if strangers:
            raise InputError(f"effect {self.name}: a column of another effect", seen=strangers[0], remedy=f"write {self.name}")

    @property
    def variants(self) -> tuple[tuple[Column, ...], ...]:
        """The columns of each node of the grid; one entry where there is no grid."""
        return variants(self.columns)


def variants(columns: tuple[Column, ...]) -> tuple[tuple[Column, ...], ...]:
    """Columns grouped by what is `fixed` with them, in the order in which it is first met."""
    groups: dict[tuple[tuple[str, float], ...], list[Column]] = {}
    for column in columns:
        groups.setdefault(tuple(column.fixed.items()), []).append(column)
    return tuple(tuple(group) for group in groups.values())


@dataclass(frozen=True, eq=False)
class Rows:
    """What each row is: one number that was measured once. Repeats are rows of their own.

    - `blocks`: the rows of each measurement; every row is in one.
    - `condition`: (rows,) text: the load case; held out as a whole or not at all.
    - `measured`: (rows,) in the block's unit, `units` by block.
    - `coordinates`: block -> name -> (rows of the block,): depth, distance, position, travel, time. The first is drawn along.
    - `trial`: (rows,) text that tells repeats of one condition apart.
    - `kinds`: block -> `deflection_profile`, `force_displacement` or `spike_rate`; the noise of a rate grows with it.
    - `sigma`: (rows,) stated standard deviations, NaN where none is; `stated_repeats`: block -> the repeats that stand behind them.
    - `roles`: condition -> `fit`, `veto` (decides whether an effect is kept) or `report` (touched by nothing). Conditions that are not
      named are fitted; where none is named roles are chosen.
    - `calibration`: name -> (rows,): what one standard deviation of an instrument's calibration adds to every row.
    - `form`: (rows,): standard deviation of what is wrong with any such model, by its geometry and laws, alike in all repeats; None: 0.
    - `repeats`: (rows,) equal numbers for rows that measure the same thing; None: rows that agree in block, condition and coordinates.
    - `setup`: (rows,) text: subject, shape and whatever else no coordinate tells; conditions of one set-up differ in coordinates alone.
      None: every condition is one of its own.
    """

    blocks: Mapping[str, slice]
    condition: Shaped[np.ndarray, "rows"]
    measured: Float[np.ndarray, "rows"]
    coordinates: Mapping[str, Mapping[str, np.ndarray]]
    units: Mapping[str, str]
    trial: Shaped[np.ndarray, "rows"]
    kinds: Mapping[str, str] = field(default_factory=dict)
    sigma: Float[np.ndarray, "rows"] | None = None
    stated_repeats: Mapping[str, int] = field(default_factory=dict)
    roles: Mapping[str, str] = field(default_factory=dict)
    calibration: Mapping[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)
    form: Float[np.ndarray, "rows"] | None = None
    repeats: Int[np.ndarray, "rows"] | None = None
    setup: Shaped[np.ndarray, "rows"] | None = None

    def __post_init__(self) -> None:
        covered = np.zeros(len(self), dtype=int)
        for where in self.blocks.values():
            covered[where] += 1
        if (covered != 1).any():
            raise InputError("the blocks do not hold every row once", seen=int(np.argmax(covered != 1)), remedy="check their slices")
        for condition, role in self.roles.items():
            if role not in ROLES:
                raise InputError(f"condition {condition!r}: no such role", seen=role, remedy=choose_from(role, ROLES))
            if condition not in set(self.condition.tolist()):
                known = list(dict.fromkeys(self.condition.tolist()))
                raise InputError("a role for a condition that no row has", seen=condition, remedy=choose_from(condition, known))

    def __len__(self) -> int:
        return len(self.measured)

    @cached_property
    def block(self) -> Shaped[np.ndarray, "rows"]:
        """(rows,) the block of each row."""
        names = np.empty(len(self), dtype=object)
        for name, where in self.blocks.items():
            names[where] = name
        return names.astype(str)

    @property
    def setups(self) -> Shaped[np.ndarray, "rows"]:
        """(rows,) the set-up of each row."""
        return self.condition if self.setup is None else self.setup

    @property
    def conditions(self) -> tuple[str, ...]:
        """The load cases in the order in which they come."""
        return tuple(dict.fromkeys(self.condition.tolist()))

    def along(self, block: str) -> Float[np.ndarray, "members"]:
        """(rows of the block,) the coordinate that a block is drawn along: its first one that varies within conditions, else its number."""
        where = self.blocks[block]
        condition = self.condition[where]
        for values in self.coordinates.get(block, {}).values():
            if any(np.ptp(values[condition == name]) > 0 for name in set(condition.tolist())):
                return np.asarray(values, dtype=float)
        return np.arange(len(condition), dtype=float)

    @cached_property
    def setting(self) -> Int[np.ndarray, "rows"]:
        """(rows,) a number for each thing that was measured: repeats share it."""
        if self.repeats is not None:
            return np.unique(self.repeats, return_inverse=True)[1].reshape(-1)
        seen: dict[tuple[object, ...], int] = {}
        numbers = np.empty(len(self), dtype=int)
        for name, where in self.blocks.items():
            grid = [_steps(np.asarray(values, dtype=float)) for values in self.coordinates.get(name, {}).values()]
            for inside, row in enumerate(range(*where.indices(len(self)))):
                what = (name, str(self.condition[row]), *(int(steps[inside]) for steps in grid))
                what = what if grid else (*what, row)
                numbers[row] = seen.setdefault(what, len(seen))
        return numbers


def _steps(values: np.ndarray) -> np.ndarray:
    """Coordinates as whole numbers of a step too small to matter."""
    span = float(np.ptp(values)) or max(float(np.max(np.abs(values), initial=0.0)), 1.0)
    return np.round((values - values.min()) / (_ALIKE * span)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The model at one point. Where it did not converge nothing in it may be used.

    - `prediction`: (rows,) in the units of the rows.
    - `theta_jacobian`: (rows, p) by the raw parameters. `phi_jacobian`: (rows, k) by the effects that move, in the order asked for.
    """

    prediction: Float[np.ndarray, "rows"]
    theta_jacobian: Float[np.ndarray, "rows p"]
    phi_jacobian: Float[np.ndarray, "rows k"]
    converged: bool = True

    @property
    def usable(self) -> bool:
        """Whether every solve converged and every number is one."""
        parts = (self.prediction, self.theta_jacobian, self.phi_jacobian)
        return self.converged and all(bool(np.isfinite(part).all()) for part in parts)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A measurement that could be made next: one repeat of a condition, linearised.

    - `theta_jacobian`: (new, p) by the raw parameters; `columns`: key -> (new,), as `columns` of the subject gives them.
    - `sigma`: (new,) the standard deviation that one repeat would have.
    """

    condition: str
    theta_jacobian: Float[np.ndarray, "new p"]
    columns: Mapping[str, Float[np.ndarray, "new"]]
    sigma: Float[np.ndarray, "new"]


@dataclass(frozen=True)
class LogPrior:
    """What is plausible of a parameter with a log link: the logarithm is normal about that of `value`, standard deviation `sd`."""

    value: float
    sd: float


class AbstractSubject(abc.ABC):
    """A model, its data, and the effects that it may lack.

    - `name`: what the data are called; `kind`: `measured` or `synthetic`.
    - `parameters`: the free base parameters, in the order of the raw vector; their values are the start.
    - `priors`: parameter name -> normal prior in its own unit, or on its logarithm.
    - `refinement`: element size of the finer mesh over that of the mesh.
    """

    name: str
    parameters: tuple[Parameter, ...]
    rows: Rows
    families: tuple[Family, ...]
    priors: Mapping[str, Prior | LogPrior] = NONE  # type: ignore[assignment]
    kind: str = "measured"
    refinement: float = 0.5
    version: ClassVar[str] = ""

    @abc.abstractmethod
    def evaluate(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """The model at raw base parameters and the effects in `phi` (key -> value in its unit; the others are asleep), with its
        derivatives by the raw parameters and by the effects in `moving`.
        """

    def glance(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Evaluation | None:
        """The same without derivatives, (rows, 0), where that is far less work: searches look so at where a step would lead. None else."""
        return None

    def value(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Evaluation:
        """The same without derivatives in any effect, and in nothing at all where derivatives are dear."""
        at = self.glance(raw, phi)
        return self.evaluate(raw, phi, ()) if at is None else at

    @abc.abstractmethod
    def columns(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float] = NONE) -> Mapping[str, Float[np.ndarray, "rows"]]:
        """Key -> (rows,) change of the prediction per unit of every column of every family, second terms included: the tangent, or
        the secant over `step`. `phi` are the effects that are awake meanwhile; a subject to which that makes little difference may leave
        them out of account.
        """

    def finer(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Float[np.ndarray, "rows"] | None:
        """The prediction on a finer mesh; None where there is none."""
        return None

    def softness(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Float[np.ndarray, "rows"] | None:
        """Half of what softer elements on the finer mesh predict more; None where there are none."""
        return None

    def proposals(self, raw: Float[np.ndarray, "p"]) -> tuple[Proposal, ...]:
        """Measurements that could be made next. Repeats of the conditions that were measured need not be among them."""
        return ()

    def account(self) -> Mapping[str, object]:
        """What a report says of the model: `version`, `mesh` and `contact`, as far as there is something to say."""
        return {}
