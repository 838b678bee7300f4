"""Reads the record of a diagnosis: the object `loop` of `report.json`, with the numbers of every row under `rows`.

What is missing from a record is missing here too: None, NaN, or an empty list. Nothing is filled in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from fingerjax.report.records import Row
from fingerjax.units import split_unit

Record = Mapping[str, Any]
ROLES = {"fit": "fitted", "veto": "held out, as a check", "report": "held out, untouched"}
UNITS = {"depth": "mm", "distance": "mm", "displacement": "mm", "travel": "mm", "position": "mm", "time": "s", "force": "N"}
ALONG = ("time", "distance", "position", "displacement", "travel", "depth", "force")  # where a residual is drawn: the first that varies
NORMAL = 1.959964  # 95 % of a normal law lie within so many standard deviations


def number(value: Any) -> float:
    """A float; NaN where the record has none. Of several numbers (a family with several columns) the largest in size."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        found = [one for one in map(number, value) if math.isfinite(one)]
        return max(found, key=abs, default=math.nan)
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan


def maybe(value: Any) -> float | None:
    """The same for a tidy row: None where there is no number."""
    found = number(value)
    return found if math.isfinite(found) else None


def column(values: Any, length: int) -> Float[np.ndarray, " rows"]:
    """Numbers (rows,) from a list with nulls, or from one number for all; NaN where there are none."""
    if not isinstance(values, (list, tuple)):
        return np.full(length, number(values))
    return np.array([number(one) for one in values]) if len(values) == length else np.full(length, math.nan)


@dataclass(frozen=True, eq=False)
class Block:
    """The rows of one measurement; numbers in `unit`, coordinates in internal units by name.

    - `before`, `after`: predictions of the model as the study has it, and of the one the diagnosis ends with (NaN where there is none).
    - `condition`, `role`: labels of each row; a role is `fit`, `veto` or `report`.
    """

    name: str
    unit: str
    measured: Float[np.ndarray, " rows"]
    sigma: Float[np.ndarray, " rows"]
    before: Float[np.ndarray, " rows"]
    after: Float[np.ndarray, " rows"]
    coordinates: dict[str, Float[np.ndarray, " rows"]]
    condition: tuple[str, ...]
    role: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.measured)

    def left(self, when: str) -> Float[np.ndarray, " rows"]:
        """What the model misses, data - model, `before` or `after`."""
        return self.measured - (self.before if when == "before" else self.after)

    @property
    def has_after(self) -> bool:
        """Whether the diagnosis ends with a model that predicts something else."""
        there = np.isfinite(self.after)
        return bool(there.any() and (self.after[there] != self.before[there]).any())

    def where(self, role: str | None = None, condition: str | None = None) -> np.ndarray:
        """(rows,) true for the rows of a role and a condition; None takes all."""
        roles = np.array([role in (None, one) for one in self.role], bool)
        return roles & np.array([condition in (None, one) for one in self.condition], bool)

    @property
    def conditions(self) -> list[str]:
        return list(dict.fromkeys(self.condition))

    @property
    def along(self) -> str | None:
        """The coordinate over which a residual is drawn: the first of `ALONG` that varies within a condition, else the first to vary."""
        there = [name for name in (*ALONG, *self.coordinates) if name in self.coordinates]
        inside = [name for name in there if any(_varies(self.coordinates[name][self.where(condition=one)]) for one in self.conditions)]
        return next(iter(inside or [name for name in there if _varies(self.coordinates[name])]), None)

    @property
    def series(self) -> dict[str, np.ndarray]:
        """Which rows are joined by a line: those of one condition; all where each condition is one place only."""
        masks = {one: self.where(condition=one) for one in self.conditions}
        along = self.along
        if along is None or any(_varies(self.coordinates[along][mask]) for mask in masks.values()):
            return masks
        return {self.name: self.where()}


def _varies(values: np.ndarray) -> bool:
    values = values[np.isfinite(values)]
    return bool(values.size and np.ptp(values) > 1e-9 * max(1.0, float(np.abs(values).max())))


def blocks(record: Record) -> list[Block]:
    """The measurements of a record, in its order."""
    return [_block(str(name), said) for name, said in (record.get("rows") or {}).items()]


def _block(name: str, said: Record) -> Block:
    length = len(said["measured"])
    coordinates = {_bare(key): column(values, length) for key, values in (said.get("coordinates") or {}).items()}
    return Block(
        name=name,
        unit=str(said.get("unit") or "1"),
        measured=column(said["measured"], length),
        sigma=column(said.get("sigma"), length),
        before=column(said.get("before"), length),
        after=column(said.get("after"), length),
        coordinates=coordinates,
        condition=_labels(said.get("condition"), length, name),
        role=_labels(said.get("role"), length, "fit"),
    )


def _bare(key: str) -> str:
    name, unit = split_unit(key)
    return name if UNITS.get(name) == unit else key


def _labels(said: Any, length: int, usual: str) -> tuple[str, ...]:
    if isinstance(said, (list, tuple)):
        return tuple(str(one) for one in said)
    return (str(said) if said is not None else usual,) * length


def with_unit(name: str, unit: str | None) -> str:
    """A column's name: `distance`, `mm` -> `distance_mm`; a number without a unit keeps its name."""
    return name if unit in (None, "", "1") else f"{name}_{unit}"


def interval(entry: Any) -> tuple[float, float]:
    """The 95 % interval of a parameter, in its unit: the one stated (`ci`, `hull`, `profile_ci`), else value -+ 1.96 sd; NaN for none."""
    if not isinstance(entry, Mapping):
        return math.nan, math.nan
    for key in ("ci", "hull", "profile_ci", "ci95"):
        if isinstance(entry.get(key), (list, tuple)) and len(entry[key]) == 2:
            return number(entry[key][0]), number(entry[key][1])
    value, sd = number(entry.get("value")), number(entry.get("sd"))
    return value - NORMAL * sd, value + NORMAL * sd


def value_of(entry: Any) -> float:
    """The value of an entry that is a number, or an object with one."""
    return number(entry.get("value")) if isinstance(entry, Mapping) else number(entry)


def kind(record: Record) -> str:
    """The kind of verdict in lower case with spaces: `attributed`, `mesh limited`, ...; `mainly` whatever follows it."""
    said = str((record.get("verdict") or {}).get("kind") or "").lower().replace("_", " ").replace("-", " ").strip()
    return "mainly" if said.startswith("mainly") else said


def named(record: Record) -> list[str]:
    """The families that the verdict names."""
    return [str(one) for one in (record.get("verdict") or {}).get("families") or []]


def nearest(record: Record) -> Record | None:
    """The record as if it ended with the nearest model of the catalogue, where it ends with none; None where it has no such model."""
    said = record.get("nearest")
    if not isinstance(said, Mapping):
        return None
    rows = {name: {**each, "after": each.get("nearest")} for name, each in (record.get("rows") or {}).items()}
    return {**record, "after": said["after"], "rows": rows}


def explanations(record: Record) -> list[str]:
    """Families in the set of explanations, those of a pair (`a + b`) one by one."""
    return list(dict.fromkeys(one for each in record.get("set") or [] for one in str(each).split(" + ")))


def candidates(record: Record) -> list[dict[str, Any]]:
    """Effects that were asked for: those that could be tested by falling size of their score, then the others."""
    said = [dict(one) for one in record.get("candidates") or []]

    def order(one: Record) -> tuple[bool, bool, float]:
        score = abs(number(one.get("z")))
        return one.get("testable") is False, wrong_way(one), -score if math.isfinite(score) else 0.0

    return sorted(said, key=order)


def wrong_way(one: Record) -> bool:
    """Whether every number of an effect is estimated on the side of its null where it cannot be: then its score speaks for nothing."""
    sizes, nulls, bounds = (one.get(key) for key in ("epc", "null", "bound"))
    if not (isinstance(sizes, Mapping) and isinstance(nulls, Mapping) and isinstance(bounds, Mapping)) or not sizes:
        return False
    return all(_outside(number(size), number(nulls.get(key)), bounds.get(key)) for key, size in sizes.items())


def _outside(size: float, null: float, bound: Any) -> bool:
    lower, upper = (number(bound[0]), number(bound[1])) if isinstance(bound, (list, tuple)) and len(bound) == 2 else (math.nan, math.nan)
    return (lower >= null and size < 0) or (upper <= null and size > 0)


def absorbed(record: Record) -> list[dict[str, Any]]:
    """Effects that would hide in the model's own parameters, each with the combination that hides it."""
    return [dict(one) for one in (record.get("verdict") or {}).get("absorbed") or []]


def critical(record: Record) -> float:
    """The score that chance alone rarely reaches anywhere in the catalogue."""
    return number((record.get("critical") or {}).get("maxT"))


# ---- sizes of what is left ----


@dataclass(frozen=True)
class Left:
    """Errors of some rows before and after: root mean squares of data - model.

    - `count`: rows. `share_*`: over the root mean square of the measurement's data. `noise_*`: of (data - model) / sigma; 1 is noise alone.
    """

    count: int
    share_before: float
    share_after: float
    noise_before: float
    noise_after: float

    def row(self) -> Row:
        """The same for a tidy row."""
        said = {
            "rows": self.count,
            "before_share_of_data": self.share_before,
            "after_share_of_data": self.share_after,
            "before_over_noise": self.noise_before,
            "after_over_noise": self.noise_after,
        }
        return {key: maybe(value) if key != "rows" else value for key, value in said.items()}


def left(block: Block, mask: np.ndarray) -> Left:
    """Errors of the rows of a mask."""
    size = rms(block.measured)
    before, after, sigma = block.left("before")[mask], block.left("after")[mask], block.sigma[mask]
    share = [rms(one) / size if size > 0 else math.nan for one in (before, after)]
    return Left(int(mask.sum()), share[0], share[1], rms(_over(before, sigma)), rms(_over(after, sigma)))


def _over(values: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    return values / np.where(sigma > 0, sigma, math.nan)


def rms(values: np.ndarray) -> float:
    """Root mean square of what is finite; NaN where nothing is."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def error_rows(record: Record) -> list[Row]:
    """Errors before and after by measurement and role."""
    return [
        {"measurement": block.name, "used": ROLES.get(role, role), **left(block, block.where(role)).row()}
        for block in blocks(record)
        for role in _in_order(block.role)
    ]


def condition_rows(record: Record) -> list[Row]:
    """Errors before and after by condition, with the share of the whole squared misfit (in units of noise) that each holds."""
    found: list[Row] = []
    for block in blocks(record):
        for label in block.conditions:
            mask = block.where(condition=label)
            role = next(one for one, chosen in zip(block.role, mask, strict=True) if chosen)
            found.append({"measurement": block.name, "condition": label, "used": ROLES.get(role, role), **left(block, mask).row()})
    for when in ("before", "after"):
        squares = [row["rows"] * (row[f"{when}_over_noise"] or 0.0) ** 2 for row in found]
        whole = math.fsum(squares)
        for row, square in zip(found, squares, strict=True):
            row[f"share_of_misfit_{when}"] = square / whole if whole > 0 else None
    return found


def _in_order(roles: Sequence[str]) -> list[str]:
    there = list(dict.fromkeys(roles))
    return [one for one in ROLES if one in there] + [one for one in there if one not in ROLES]


def residual_rows(block: Block) -> list[Row]:
    """Every row of a measurement with its coordinates, readings, and what is left of them."""
    unit = block.unit
    return [
        {
            "condition": block.condition[i],
            "used": ROLES.get(block.role[i], block.role[i]),
            **{with_unit(name, UNITS.get(name)): maybe(values[i]) for name, values in block.coordinates.items()},
            with_unit("measured", unit): maybe(block.measured[i]),
            with_unit("sigma", unit): maybe(block.sigma[i]),
            with_unit("before", unit): maybe(block.before[i]),
            with_unit("after", unit): maybe(block.after[i]),
            with_unit("left_before", unit): maybe(block.left("before")[i]),
            with_unit("left_after", unit): maybe(block.left("after")[i]),
        }
        for i in range(len(block))
    ]
