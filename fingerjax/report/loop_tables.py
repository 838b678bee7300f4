"""The tables of a diagnosis, from its record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fingerjax.report.loop_record import (
    ROLES,
    Record,
    absorbed,
    candidates,
    condition_rows,
    error_rows,
    explanations,
    interval,
    maybe,
    nearest,
    number,
    value_of,
    wrong_way,
)
from fingerjax.report.loop_words import listed, remedy, short, spoken
from fingerjax.report.records import Row, Table


def errors(record: Record) -> Table:
    """Errors before and after by measurement, fitted and held out."""
    note = "Root mean squares of data - model: as shares of the data's own, and over the noise (1: noise alone)."
    return Table("loop_errors", "Error before and after", error_rows(record), note)


def nearest_errors(record: Record) -> Table:
    """The same for the nearest model of the catalogue; no rows where there is none."""
    said = nearest(record)
    title = f"Error before, and with {listed(record['nearest']['families'])}" if said is not None else ""
    return Table("loop_nearest_errors", title, error_rows(said) if said is not None else [], errors(record).note)


def nearest_parameters(record: Record) -> Table:
    """Parameters before, and of the nearest model of the catalogue."""
    said = nearest(record)
    note = "The intervals are widened by what remains. This model is contradicted too: none of its effects is named."
    title = "Parameters before, and of the nearest model, with 95 % intervals"
    return Table("loop_nearest_parameters", title, parameter_rows(said) if said is not None else [], note)


def effects(record: Record) -> Table:
    """Every effect that was asked for: score, size, and what these data could have seen."""
    rows = [_effect(record, one) for one in candidates(record)]
    note = (
        "Score: beyond the critical value chance is unlikely. Chance: how often the catalogue's largest score would be as large were "
        "nothing missing. Size estimated, smallest visible and plausible size are in the unit given. Trace left: the share of an effect's "
        "trace that the model's own parameters cannot imitate."
    )
    return Table("loop_effects", "Effects, ranked", rows, note)


def outlook(record: Record, shown: int) -> Table:
    """The effects for a terminal, those that explain the data first: with the sizes of their own fits where they were fitted."""
    named = explanations(record)
    asked = sorted(candidates(record), key=lambda one: str(one["family"]) not in named)
    rows = [_seen(one, str(one["family"]) in named, number((record.get("critical") or {}).get("maxT"))) for one in asked[:shown]]
    more = f"{len(asked) - shown} more in the report" if len(asked) > shown else ""
    return Table("loop_outlook", "Effects, ranked", rows, more)


def _seen(one: Mapping[str, Any], named: bool, critical: float) -> Row:
    fitted = one["refit"] if isinstance(one.get("refit"), Mapping) else {}
    score_says = size_of(one)[0]
    size = fitted_sizes(one, fitted) or (short(score_says) if math.isfinite(score_says) else "")
    return {
        "effect": spoken(one["family"]),
        "score": maybe(one.get("z")),
        "size": f"{size} {unit_of(one)}".strip() if size else "",
        "visible_from": maybe(one.get("mde")),
        "remark": "explains these data" if named else _in_brief(one, str(fitted.get("reason") or ""), critical),
    }


def _in_brief(one: Mapping[str, Any], against: str, critical: float) -> str:
    if against:
        return "far behind: given up" if against.startswith("was given up") else against
    return "no more than chance" if one.get("testable") is not False and abs(number(one.get("z"))) < critical else remark(one)


def _effect(record: Record, one: Mapping[str, Any]) -> Row:
    return {
        "effect": spoken(one["family"]),
        "acts_on": one.get("acts_on") or "",
        "score": maybe(one.get("z")),
        "chance": maybe(one.get("p_adj")),
        "size_estimated": maybe(size_of(one)[0]),
        "smallest_visible": maybe(one.get("mde")),
        "plausible_size": maybe(size_of(one)[1]),
        "unit": unit_of(one),
        "trace_left": maybe(one.get("fraction_left")),
        "in_the_set": str(one["family"]) in explanations(record),
        "remark": remark(one),
    }


def remark(one: Mapping[str, Any]) -> str:
    """Why an effect could not be tested, or why its score speaks for nothing; empty for the others."""
    if one.get("testable") is False:
        return remedy(one)
    if wrong_way(one):
        return "the wrong way round: it can only be the other way"
    return "smaller than what any model is wrong by" if number(one.get("times_form")) < 1.0 else ""


def size_of(one: Mapping[str, Any]) -> tuple[float, float]:
    """(estimated size, plausible size) of an effect, of the column in which it is furthest from its null in plausible sizes."""
    estimated, plausible = one.get("epc"), one.get("prior_sd")
    if not isinstance(estimated, Mapping) or not isinstance(plausible, Mapping):
        return number(estimated), number(plausible)
    pairs = [(number(estimated.get(key)), number(scale)) for key, scale in plausible.items()]
    known = [pair for pair in pairs if math.isfinite(pair[0]) and pair[1] > 0]
    return max(known, key=lambda pair: abs(pair[0]) / pair[1], default=(math.nan, number(plausible)))


def unit_of(one: Mapping[str, Any]) -> str:
    """The unit of an effect's numbers: its own, or that of its first column; empty where the record says none."""
    columns = one.get("columns")
    first = columns[0] if isinstance(columns, (list, tuple)) and columns else None
    said = one.get("unit") or (first.get("unit") if isinstance(first, Mapping) else None) or ""
    return "" if said == "1" else str(said)


def refits(record: Record) -> Table:
    """The fits made anew with one effect in the model, best first."""
    fitted = [one for one in candidates(record) if isinstance(one.get("refit"), Mapping)]
    rows = [_refit(record, one) for one in sorted(fitted, key=lambda one: -_finite(one["refit"].get("delta")))]
    note = (
        "Misfit removed: drop of the summed squares over squared noise. Explained: share of the misfit beyond noise (above 1 by chance). "
        "Strongest rival: what would explain most of what still remains. Held out, change: of the squared misfit there, negative "
        "is better. BIC and log evidence weigh the misfit against the number of parameters: a falling BIC and a gain speak for the effect."
    )
    return Table("loop_refits", "Fitted anew with each of the best effects", rows, note)


def pairs(record: Record) -> Table:
    """The fits made anew with two effects at once, best first."""
    found = sorted(record.get("pairs") or [], key=lambda one: -_finite(one["refit"].get("delta")))
    rows: list[Row] = [{"effects": listed(one["families"]), "sizes": _sizes(one["refit"])} | _judged(one["refit"]) for one in found]
    return Table("loop_pairs", "Fitted anew with two effects at once", rows, "Columns as in the table of single effects.")


def _sizes(refit: Mapping[str, Any]) -> str:
    ends = refit.get("ci") or {}
    return ", ".join(_with_ends(spoken(key), value, ends.get(key)) for key, value in (refit.get("phi") or {}).items())


def _refit(record: Record, one: Mapping[str, Any]) -> Row:
    said = {"effect": spoken(one["family"]), "size": fitted_sizes(one, one["refit"]), "unit": unit_of(one)}
    return said | _judged(one["refit"], str(one["family"]) in explanations(record))


def _judged(refit: Mapping[str, Any], in_the_set: bool = False) -> Row:
    rival = refit.get("best_rival") or {}
    return {
        "misfit_removed": maybe(refit.get("delta")),
        "explained": maybe(refit.get("eta")),
        "strongest_rival": spoken(rival.get("family") or ""),
        "rival_score": maybe(rival.get("z")),
        "held_out_change": maybe(refit.get("veto_dchi2")),
        "BIC_change": maybe(refit.get("bic")),
        "log_evidence_gain": maybe(refit.get("log_evidence")),
        "converged": refit.get("converged"),
        "in_the_set": bool(refit.get("in_set", in_the_set)),
        "remark": str(refit.get("reason") or ""),
    }


def fitted_sizes(one: Mapping[str, Any], refit: Mapping[str, Any]) -> str:
    """The numbers of an effect as fitted, each with its 95 % interval: `0.12 (0.08 to 0.16)`."""
    sizes, ends = _by_name(one, refit.get("phi")), _by_name(one, refit.get("ci"))
    return ", ".join(_with_ends(name if len(sizes) > 1 else "", value, ends.get(name)) for name, value in sizes.items())


def _by_name(one: Mapping[str, Any], said: Any) -> dict[str, Any]:
    if said is None:
        return {}
    return {column_name(one, key): entry for key, entry in said.items()} if isinstance(said, Mapping) else {"": said}


def column_name(one: Mapping[str, Any], key: str) -> str:
    """A column without its family: `relaxation.share@tau_s=1` -> `share@tau_s=1`."""
    return spoken(str(key).removeprefix(f"{one['family']}."))


def _with_ends(name: str, value: Any, ends: Any) -> str:
    lower, upper = interval({"ci": ends}) if isinstance(ends, (list, tuple)) else (math.nan, math.nan)
    known = f" ({short(lower)} to {short(upper)})" if math.isfinite(lower) and math.isfinite(upper) else ""
    return f"{name} {short(value_of(value))}{known}".strip()


def _finite(value: Any) -> float:
    found = number(value)
    return found if math.isfinite(found) else -math.inf


def amounts(said: Any) -> str:
    """Several numbers as text: `0.2, 1.5`, or `curvature 0.2, onset 1.5`."""
    if isinstance(said, Mapping):
        return ", ".join(f"{spoken(name)} {short(value_of(entry))}" for name, entry in said.items())
    return ", ".join(short(entry) for entry in said)


def look_alikes(record: Record) -> Table:
    """Pairs of effects that these measurements cannot, or can hardly, tell apart."""
    rows: list[Row] = [
        {
            "effect": spoken(one["a"]),
            "looks_like": spoken(one["b"]),
            "likeness": maybe(one.get("cos")),
            "strength_needed": maybe(one.get("lambda_needed")),
        }
        for one in sorted(record.get("confusable") or [], key=lambda one: -abs(number(one.get("cos"))))
    ]
    note = "Likeness: the cosine between the traces of two effects; the sign says whether more of one looks like more or less of the other."
    return Table("loop_look_alikes", "Look-alikes", rows, note)


def next_experiments(record: Record) -> Table:
    """Conditions that would tell the remaining explanations apart, best first."""
    rows: list[Row] = [
        {
            "condition": amounts(one["condition"]) if isinstance(one.get("condition"), Mapping) else str(one.get("condition")),
            "repeats": one.get("replicates"),
            "apart_now": maybe(one.get("d2_now")),
            "apart_after": maybe(one.get("d2_after")),
            "tells_apart": _pairs(one.get("pairs")),
        }
        for one in record.get("next_experiment") or []
    ]
    note = "Apart: squared distance, in units of noise, of the explanations hardest to tell apart; 13 tells them in 95 % of repeats."
    return Table("loop_next", "What to measure next", rows, note)


def _pairs(said: Any) -> str:
    if isinstance(said, Mapping):
        return "; ".join(f"{spoken(pair)} ({short(apart)})" for pair, apart in said.items())
    if not isinstance(said, (list, tuple)):
        return "" if said is None else str(said)
    if len(said) == 2 and all(isinstance(one, str) for one in said):
        said = [said]
    return "; ".join(" / ".join(map(spoken, one)) if isinstance(one, (list, tuple)) else spoken(one) for one in said)


def parameters(record: Record) -> Table:
    """Parameters before and after with 95 % intervals, natural and as the fit moves them."""
    rows = parameter_rows(record)
    raw = any("raw_before" in row for row in rows)
    note = "Change: over the standard deviation before. Mesh: standard deviation that the mesh adds."
    more = " Raw: as the fit moves it, which for a modulus is its natural logarithm." if raw else ""
    return Table("loop_parameters", "Parameters before and after, with 95 % intervals", rows, note + more)


def parameter_rows(record: Record) -> list[Row]:
    """One row a parameter, then one for each number of an effect that was added."""
    after = record.get("after") or {}
    later = after.get("theta") or {}
    rows = [_parameter(name, said, later.get(name), after) for name, said in ((record.get("base") or {}).get("theta") or {}).items()]
    return rows + [_added(record, name, said) for name, said in (after.get("phi") or {}).items()]


def _parameter(name: str, before: Mapping[str, Any], after: Any, whole: Mapping[str, Any]) -> Row:
    first, second = interval(before), interval(after)
    raw = {
        f"raw_{when}": maybe(one["raw"])
        for when, one in (("before", before), ("after", after))
        if isinstance(one, Mapping) and "raw" in one
    }
    change = whole.get("theta_change_sd")
    return {
        "parameter": name,
        "unit": str(before.get("unit") or ""),
        "before": maybe(value_of(before)),
        "before_lower": maybe(first[0]),
        "before_upper": maybe(first[1]),
        "after": maybe(value_of(after)),
        "after_lower": maybe(second[0]),
        "after_upper": maybe(second[1]),
        "change_over_sd": maybe(change.get(name)) if isinstance(change, Mapping) else None,
        "mesh": maybe(before.get("mesh_sd")),
        **raw,
    }


def _added(record: Record, name: str, said: Any) -> Row:
    entry = said if isinstance(said, Mapping) else {"value": said}
    label = str(entry.get("family") or name.split(".")[0])
    family = next((one for one in candidates(record) if str(one["family"]) == label), {"family": label})
    null = family.get("null")
    before, ends = number(null.get(name) if isinstance(null, Mapping) else null), interval(entry)
    unit = str(entry.get("unit") or "")
    return {
        "parameter": f"{spoken(label)}: {column_name(family, name)}" if name != label else spoken(name),
        "unit": "" if unit == "1" else unit or unit_of(family),
        "before": maybe(before),
        "before_lower": None,
        "before_upper": None,
        "after": maybe(value_of(entry)),
        "after_lower": maybe(ends[0]),
        "after_upper": maybe(ends[1]),
        "change_over_sd": None,
        "mesh": None,
    }


def hidden(record: Record) -> Table:
    """Effects that the parameters absorb, with the change of the parameters that hides them."""
    rows: list[Row] = [
        {"effect": spoken(one["family"]), "hidden_by_a_change_of": _combination(one.get("combination"))} for one in absorbed(record)
    ]
    note = "Were there such an effect, the parameters above would be wrong by this much, and nothing else would show it."
    return Table("loop_absorbed", "Effects that the parameters hide", rows, note)


def _combination(said: Any) -> str:
    if isinstance(said, Mapping):
        return ", ".join(f"{name} {number(value):+.3g}" for name, value in said.items())
    return ", ".join(map(str, said)) if isinstance(said, (list, tuple)) else str(said or "")


def by_condition(record: Record) -> Table:
    """Errors and shares of the misfit by condition."""
    note = "Share of misfit: of the summed squares of (data - model) / noise over all measurements."
    return Table("loop_by_condition", "Error by condition", condition_rows(record), note)


def shares(record: Record) -> Table:
    """How what remains is dealt out, as the diagnosis has it: by measurement, condition, coordinate."""
    said = (record.get("unexplained") or {}).get("share") or {}
    rows: list[Row] = [
        {"by": spoken(by), "where": str(where), "share": maybe(value)}
        for by, each in said.items()
        for where, value in (each.items() if isinstance(each, Mapping) else [("all", each)])
    ]
    return Table("loop_shares", "Shares of what remains", rows, "Of the summed squares of (data - model) / noise.")


def patterns(record: Record) -> Table:
    """What else is known of the form of the remainder: symmetry, spectrum."""
    said = record.get("unexplained") or {}
    rows = [row for what in ("symmetry", "spectrum") for row in _leaves((what,), said.get(what))]
    note = (
        "Symmetry: share of the misfit that is odd about the middle, 0.5 for noise, 1 for a tilt. Spectrum: correlation of neighbouring "
        "readings, and the wavelength that stands out with the share of the misfit that it holds."
    )
    return Table("loop_patterns", "Form of what remains", rows, note)


def _leaves(path: tuple[str, ...], said: Any) -> list[Row]:
    """Numbers of a nested record with the names that lead to them; lists are left to the figures."""
    if isinstance(said, Mapping):
        return [row for name, entry in said.items() for row in _leaves((*path, str(name)), entry)]
    if maybe(said) is None or isinstance(said, (list, tuple)):
        return []
    return [{"form": path[0], "where": ", ".join(map(spoken, path[1:])), "value": number(said)}]


def mesh(record: Record) -> Table:
    """How far the mesh may have moved each parameter, in its standard deviations."""
    moved = ((record.get("model") or {}).get("mesh") or {}).get("theta_shift_sd") or {}
    rows: list[Row] = [{"parameter": name, "moved_by_the_mesh_over_sd": maybe(value)} for name, value in moved.items()]
    return Table("loop_mesh", "What the mesh may add to each parameter", rows, "Up to 0.2 standard deviations the mesh guard lets pass.")


def noise(record: Record) -> Table:
    """The noise of each measurement."""
    units = {name: str(said.get("unit") or "") for name, said in (record.get("rows") or {}).items()}
    sigmas = ((record.get("data") or {}).get("noise") or {}).get("sigma_by_block") or {}
    rows: list[Row] = [{"measurement": name, "noise": maybe(value), "unit": units.get(name, "")} for name, value in sigmas.items()]
    return Table("loop_noise", "Noise of a single reading", rows)


def conditions(record: Record) -> Table:
    """Which conditions were fitted and which held out."""
    said = (record.get("data") or {}).get("conditions") or []
    rows: list[Row] = [
        {"condition": one.get("id"), "used": _role(one.get("role")), "readings": one.get("n"), "repeats": one.get("replicates")}
        for one in said
    ]
    return Table("loop_conditions", "Conditions", rows)


def _role(role: Any) -> str:
    return ROLES.get(str(role), str(role))


def planted(record: Record) -> Table:
    """Effects planted in simulated data, and whether they were found."""
    rows: list[Row] = [
        {
            "planted": spoken(one.get("family")),
            "size_over_smallest_visible": maybe(one.get("size_in_mde")),
            "found": one.get("found"),
            "rank": one.get("rank"),
        }
        for one in record.get("planted") or []
    ]
    return Table("loop_planted", "Effects planted in simulated data", rows)
