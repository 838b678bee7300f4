"""How well diagnoses did: from their `loop` objects and the truths behind the data to shares with intervals.

Pure functions of dictionaries as read from `report.json` and `truth.yaml`. `judge` makes an `Outcome` of one pair; `table` makes the lines
of many. Shares carry the interval of Wilson (1927) at 95 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

NAMING = ("attributed", "ambiguous", "mainly", "two effects")
"""Kinds of verdict that name an effect of the catalogue."""
BANDS = ((5.0, 10.0), (10.0, 20.0), (20.0, 40.0), (40.0, 100.0), (100.0, 400.0), (400.0, np.inf))
"""Ranges of lambda, the excess misfit in units of variance."""
ALPHA = 0.05
SHARES = {"omnibus_p": 0.4, "smooth_p": 0.4, "maxT_p": 0.2}
"""Of the level of all three tests."""


@dataclass(frozen=True)
class Outcome:
    """One diagnosis against its truth.

    - `kind`, `families`, `excess`, `excess_of_each`: of the truth. `verdict`: the kind that was found, as in the loop's words.
    - `named`: families that the verdict names, the first one first; `explanations`: all in its confidence set, and those named.
    - `absorbed`: families listed as taken up by the base parameters. `rejected`: whether the plain model was found wanting.
    - `held_out`: error on conditions kept from the fit against noise-free truth, before and after, as a share of each file's largest
      reading; None where there are none.
    - `covered`: before and after, whether each modulus' interval held the truth; `off`: after, |log error| over its standard deviation.
    """

    case: str
    kind: str
    families: tuple[str, ...]
    excess: float
    excess_of_each: tuple[float, ...]
    verdict: str
    named: tuple[str, ...]
    explanations: frozenset[str]
    absorbed: frozenset[str]
    rejected: bool
    held_out: tuple[float, float] | None
    covered: tuple[tuple[bool, ...], tuple[bool, ...]]
    off: tuple[float, ...]

    @property
    def found(self) -> bool:
        """Whether every family of the truth is among the explanations."""
        return set(self.families) <= self.explanations

    @property
    def wrong(self) -> bool:
        """Whether an effect was named and none of the truth's is anywhere."""
        return bool(self.named) and not set(self.families) & self.explanations


@dataclass(frozen=True)
class Scored:
    """An outcome, the `state` of the program that it is of, the `minutes` that the diagnosis took by its own clock, and the state of the
    numerics that the `truth` is of.
    """

    outcome: Outcome
    state: str
    minutes: float
    truth: str

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        held = {name: sorted(value) if isinstance(value, frozenset) else value for name, value in vars(self.outcome).items()}
        return {**held, "state": self.state, "minutes": self.minutes, "truth": self.truth}

    @classmethod
    def read(cls, kept: Mapping[str, Any]) -> Scored:
        """From what `plain` said."""
        said = dict(kept)
        state, minutes, truth = said.pop("state"), said.pop("minutes"), said.pop("truth")
        sets = {name: frozenset(said.pop(name)) for name in ("explanations", "absorbed")}
        return cls(Outcome(**{name: _tuples(value) for name, value in said.items()}, **sets), state, minutes, truth)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@dataclass(frozen=True)
class Line:
    """A line of the table: a `value` of `count` cases with its interval (NaN where it is no share), and its goal, lowest and highest."""

    name: str
    value: float
    count: int
    low: float = np.nan
    high: float = np.nan
    goal: tuple[float, float] | None = None


def wilson(hits: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """Interval of a share (Wilson 1927); from 0 to 1 where nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    share, spread = hits / count, z**2 / count
    middle, half = share + 0.5 * spread, z * np.sqrt(share * (1 - share) / count + 0.25 * spread / count)
    return float(max((middle - half) / (1 + spread), 0.0)), float(min((middle + half) / (1 + spread), 1.0))


def judge(report: Mapping[str, Any], truth: Mapping[str, Any]) -> Outcome:
    """One `report.json` against its truth."""
    loop = report["loop"]
    verdict = loop["verdict"]
    kind = _plain(verdict["kind"])
    named = tuple(_families(verdict.get("families", ()))) if kind in NAMING else ()
    before, _ = _coverage(loop["base"]["theta"], truth)
    after, off = _coverage((loop.get("after") or loop["base"])["theta"], truth)
    return Outcome(
        truth["case"],
        truth["kind"],
        tuple(truth["families"]),
        float(truth["lambda"]),
        tuple(truth.get("lambda_of_each", {}).values()),
        kind,
        named,
        frozenset([*named, *(_families(loop.get("set") or ()) if kind in NAMING else ())]),
        frozenset(one["family"] for one in verdict.get("absorbed") or ()),
        _rejected(loop, kind),
        _held_out(loop.get("rows") or {}, truth),
        (before, after),
        off,
    )


def _plain(kind: str) -> str:
    words = kind.lower().replace("_", " ").replace("-", " ")
    return "mainly" if words.startswith("mainly") else words


def _families(said: Iterable[Any]) -> list[str]:
    """Names out of a list in which two effects may be one entry, as a list or as `a+b`."""
    parts = [part for one in said for part in (one.split("+") if isinstance(one, str) else one)]
    return list(dict.fromkeys(part.strip() for part in parts))


def _rejected(loop: Mapping[str, Any], kind: str) -> bool:
    """Whether one of the three tests of the plain model fails at its share of the level, or a verdict says so without them."""
    tests = {key: value for key, value in (loop["base"].get("lof") or {}).items() if key in SHARES and value is not None}
    alpha = (loop.get("critical") or {}).get("alpha") or ALPHA
    return any(value < SHARES[key] * alpha for key, value in tests.items()) if tests else kind in (*NAMING, "unexplained")


def _coverage(theta: Mapping[str, Any], truth: Mapping[str, Any]) -> tuple[tuple[bool, ...], tuple[float, ...]]:
    """Whether each modulus' interval holds the truth, and by how many of its standard deviations its logarithm is off."""
    covered, off = [], []
    for layer, right in truth["moduli_MPa"].items() if truth.get("moduli_scored", True) else ():
        found = theta.get(f"{layer}.modulus")
        ends = found and _interval(found)
        if not found or not ends:
            continue
        low, high = ends
        covered.append(low <= right <= high)
        if 0.0 < low < high < np.inf:
            off.append(abs(np.log(found["value"] / right)) / (np.log(high / low) / 3.92))
    return tuple(covered), tuple(off)


def _interval(found: Mapping[str, Any]) -> tuple[float, float] | None:
    for key in ("ci", "ci95", "profile_ci", "interval"):
        ends = found.get(key)
        if ends and None not in ends:
            return float(ends[0]), float(ends[1])
    sd = found.get("sd")
    return None if sd is None else (found["value"] - 1.96 * sd, found["value"] + 1.96 * sd)


def _held_out(rows: Mapping[str, Any], truth: Mapping[str, Any]) -> tuple[float, float] | None:
    """Root mean square error of the rows that were kept from the fit, before and after, against noise-free readings."""
    parts = [errors for block, right in truth["rows"].items() if block in rows and len(errors := _errors(rows[block], right))]
    if not parts:
        return None
    before, after = np.sqrt((np.concatenate(parts) ** 2).mean(0))
    return float(before), float(after)


def _errors(said: Mapping[str, Any], right: Mapping[str, Any]) -> np.ndarray:
    """(rows, 2): prediction minus noise-free reading, before and after, over the largest reading, of rows kept from the fit."""
    clean, held = np.array(right["clean"], float), np.array(right["held_out"], bool)
    at = _matched(said, right)
    held = held[at] | np.isin(_roles(said), ("veto", "report"))
    both = np.array([said["before"], said["after"]], float).T - clean[at][:, None]
    return both[held & np.isfinite(both).all(1)] / np.abs(clean).max()


ALIASES = {"travel": "displacement"}


def _matched(said: Mapping[str, Any], right: Mapping[str, Any]) -> np.ndarray:
    """Which row of the truth each row of the report is.

    Trials follow each other in a file: rows in the file's order are known by it. Else they are told by their coordinates. Raises
    ValueError where neither tells.
    """
    columns = {ALIASES.get(name, name): np.array(values) for name, values in said["coordinates"].items()}
    names = [name for name in sorted(columns) if name in right["coordinates"] and name != "condition"]
    rows, count = len(said["before"]), len(right["clean"])
    theirs = np.array([_rounded(columns[name]) for name in names], object).reshape(len(names), rows)
    ours = np.array([_rounded(np.array(right["coordinates"][name])) for name in names], object).reshape(len(names), count)
    order = np.arange(rows) % count
    if rows % count == 0 and np.array_equal(theirs, ours[:, order]):
        return order
    places = [tuple(place) for place in ours.T]
    known = dict(zip(places, range(count), strict=True))
    strange = next((tuple(place) for place in theirs.T if tuple(place) not in known), None)
    if strange is not None:
        raise ValueError(f"the report has a row at {dict(zip(names, strange, strict=True))} that the truth does not know")
    if len(known) < count:
        raise ValueError(f"rows of the truth share {', '.join(names)}, and the report does not keep their order")
    return np.array([known[tuple(place)] for place in theirs.T])


def _rounded(column: np.ndarray) -> list[Any]:
    return column.tolist() if column.dtype.kind == "U" else [round(value, 3) + 0.0 for value in column.astype(float).tolist()]


def _roles(said: Mapping[str, Any]) -> list[str]:
    role = said.get("role", "fit")
    return [role] * len(said["before"]) if isinstance(role, str) else list(role)


def table(outcomes: Sequence[Outcome]) -> list[Line]:
    """All lines: nulls, singles by lambda, doubles, strangers, traps, held-out error, moduli."""
    return [*_nulls(outcomes), *_singles(outcomes), *_doubles(outcomes), *_strangers(outcomes), *_held(outcomes), *_moduli(outcomes)]


def share(name: str, of: Iterable[Outcome], holds: Callable[[Outcome], bool], goal: tuple[float, float] | None = None) -> Line:
    """The share of outcomes for which something holds; NaN of none."""
    seen = [holds(outcome) for outcome in of]
    value = float(np.mean(seen)) if seen else np.nan
    return Line(name, value, len(seen), *wilson(sum(seen), len(seen)), goal)


def _nulls(outcomes: Sequence[Outcome]) -> list[Line]:
    nulls = [one for one in outcomes if one.kind == "none"]
    return [
        share("no effect: plain model rejected", nulls, lambda one: one.rejected, (0.04, 0.06)),
        share("no effect: an effect named", nulls, lambda one: bool(one.named), (0.0, 0.01)),
        share("no effect, trials with gains of their own: an effect named", _called(nulls, "trial_gain"), lambda one: bool(one.named)),
    ]


def _called(outcomes: Iterable[Outcome], case: str) -> list[Outcome]:
    return [one for one in outcomes if one.case == case]


def _singles(outcomes: Sequence[Outcome]) -> list[Line]:
    single = [one for one in outcomes if one.kind == "single"]
    strong, middle = [one for one in single if one.excess >= 40], _between(single, 20, 40)
    seen = [one for one in single if one.rejected]
    lines = [
        share("one effect, plain model rejected: among the explanations", seen, lambda one: one.found, (0.95, 1.0)),
        share("one effect, plain model rejected: another named, the right one nowhere", seen, lambda one: one.wrong, (0.0, 0.015)),
        share("one effect, lambda >= 40: among the explanations", strong, lambda one: one.found, (0.99, 1.0)),
        share("one effect, lambda >= 40: named first", strong, _first, (0.97, 1.0)),
        share("one effect, lambda 20-40: among the explanations", middle, lambda one: one.found, (0.98, 1.0)),
        _mean("one effect, lambda 20-40: size of the set", [len(one.explanations) for one in middle if one.named], (0.0, 1.7)),
        share(
            "one effect, lambda >= 20: another named, the right one nowhere",
            [one for one in single if one.excess >= 20],
            lambda one: one.wrong,
            (0.0, 0.003),
        ),
    ]
    for low, high in BANDS:
        some, words = _between(single, low, high), f"lambda {low:g}-{high:g}" if high < np.inf else f"lambda > {low:g}"
        lines.append(share(f"one effect, {words}: detected", some, lambda one: one.rejected))
        lines.append(share(f"one effect, {words}: among the explanations", some, lambda one: one.found))
        lines.append(share(f"one effect, {words}: named first", some, _first))
        lines.append(share(f"one effect, {words}: another named, the right one nowhere", some, lambda one: one.wrong))
    return lines


def _between(outcomes: Iterable[Outcome], low: float, high: float) -> list[Outcome]:
    return [one for one in outcomes if low <= one.excess < high]


def _first(one: Outcome) -> bool:
    return one.named[:1] == one.families


def _doubles(outcomes: Sequence[Outcome]) -> list[Line]:
    double = [one for one in outcomes if one.kind == "double"]
    strong = [one for one in double if one.excess_of_each and min(one.excess_of_each) >= 40]
    return [
        share("two effects, lambda of each >= 40: both in one set", strong, lambda one: one.found, (0.95, 1.0)),
        share("two effects: both in one set", double, lambda one: one.found),
        share("two effects: at least one", double, lambda one: bool(set(one.families) & one.explanations)),
    ]


def _strangers(outcomes: Sequence[Outcome]) -> list[Line]:
    outside = [one for one in outcomes if one.kind == "outside"]
    strong = [one for one in outside if one.excess >= 40]
    absorbed, coarse = ([one for one in outcomes if one.kind == kind] for kind in ("absorbed", "mesh_limited"))
    return [
        share("outside the catalogue: detected", outside, lambda one: one.rejected),
        share("outside the catalogue, detected: unexplained", [one for one in outside if one.rejected], _unexplained),
        share("outside the catalogue: an effect named", outside, lambda one: bool(one.named), (0.0, 0.05)),
        share("outside the catalogue, lambda >= 40: an effect named", strong, lambda one: bool(one.named), (0.0, 0.02)),
        share("taken up by the moduli: listed as absorbed, nothing named", absorbed, _listed, (1.0, 1.0)),
        share("mesh too coarse: said to be", coarse, lambda one: one.verdict == "mesh limited", (1.0, 1.0)),
    ]


def _unexplained(one: Outcome) -> bool:
    return one.verdict == "unexplained"


def _listed(one: Outcome) -> bool:
    return set(one.families) <= one.absorbed and not one.named


def _held(outcomes: Sequence[Outcome]) -> list[Line]:
    seen = [one for one in outcomes if one.named and one.held_out is not None and one.kind in ("single", "double")]
    lines = [*_removed("", seen), *_removed("one effect: ", [one for one in seen if one.kind == "single"])]
    return [*lines, share("held-out error larger after an effect was named", seen, _worse, (0.0, 0.005))]


def _removed(of: str, seen: Sequence[Outcome]) -> list[Line]:
    """Means of held-out error before and after, and the share by which the second is smaller."""
    pairs = np.array([one.held_out for one in seen]).reshape(-1, 2)
    before, after = pairs.mean(0) if len(pairs) else (np.nan, np.nan)
    return [
        _mean(f"{of}held-out error before, share of the largest reading", pairs[:, 0]),
        _mean(f"{of}held-out error after", pairs[:, 1]),
        Line(f"{of}held-out error removed", float(1 - after / before), len(pairs), goal=(0.9, 1.0)),
    ]


def _worse(one: Outcome) -> bool:
    return one.held_out is not None and one.held_out[1] > one.held_out[0]


def _moduli(outcomes: Sequence[Outcome]) -> list[Line]:
    named = [one for one in outcomes if one.named and one.kind in ("single", "double")]
    lines = []
    for which, word, goal in ((0, "before", None), (1, "after", (0.93, 0.97))):
        flat = [held for one in named for held in one.covered[which]]
        value = float(np.mean(flat)) if flat else np.nan
        lines.append(Line(f"moduli within their intervals {word}", value, len(flat), *wilson(sum(flat), len(flat)), goal))
    off = [value for one in named for value in one.off]
    return [*lines, _mean("error of log modulus after, over its standard deviation", off, (0.0, 1.0))]


def _mean(name: str, values: Sequence[float] | np.ndarray, goal: tuple[float, float] | None = None) -> Line:
    return Line(name, float(np.mean(values)) if len(values) else np.nan, len(values), goal=goal)
