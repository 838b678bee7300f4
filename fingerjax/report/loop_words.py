"""A diagnosis in sentences that need no statistician. Each term is explained where it is first used on the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fingerjax.report.loop_record import Record, absorbed, blocks, condition_rows, critical, explanations, kind, named, number

ACTS_ON = {
    "finger": "the finger's shape",
    "tissue": "the tissue",
    "support": "what holds the finger",
    "contact": "contact and indentation",
    "time": "the course of time",
    "instrument": "an instrument",
    "afferent": "the afferent",
}
NOT_CONVERGED = "not converged"
_GATE = {"failed": "not passed, so no small effect is named"}


def spoken(name: Any) -> str:
    """A name for people: `nail_compliance` -> `nail compliance`."""
    return str(name).replace("_", " ")


def listed(names: Sequence[Any], last: str = "and") -> str:
    """`a, b and c`."""
    said = [spoken(name) for name in names]
    return said[0] if len(said) == 1 else f"{', '.join(said[:-1])} {last} {said[-1]}" if said else "nothing"


def short(value: Any) -> str:
    """A number in prose, three significant digits."""
    found = number(value)
    if not math.isfinite(found):
        return "unknown"
    return f"{found:.0f}" if 1000 <= abs(found) < 1e6 else f"{found:.3g}"


def share(value: Any) -> str:
    """0.923 as `92 %`."""
    found = number(value)
    return f"{100 * found:.3g} %" if math.isfinite(found) else "unknown"


# ---- the verdict ----


def verdict(record: Record) -> str:
    """The sentence to read first: the diagnosis's own, or one made from its parts where it has none."""
    text = str((record.get("verdict") or {}).get("text") or "").strip()
    return text or _said(kind(record), named(record) or explanations(record), record)


def _said(what: str, names: Sequence[str], record: Record) -> str:
    part = number((record.get("verdict") or {}).get("share_explained"))
    much = f", which explains {share(part)} of the misfit beyond noise" if math.isfinite(part) else ""
    said = {
        "adequate": "The model as it stands explains these measurements to within their noise.",
        "attributed": f"The model lacks {listed(names)}{much}.",
        "ambiguous": f"The model lacks one of {listed(names, 'or')}; these measurements cannot tell which.",
        "mainly": f"The model mainly lacks {listed(names)}{much}; a small part remains without a name.",
        "two effects": f"The model lacks both {listed(names)}{much}.",
        "unexplained": "The model misses something that no effect in the catalogue explains.",
        "not testable": "These measurements cannot test any of the effects in the catalogue.",
        "mesh limited": "The mesh is too coarse for this question: its own error is as large as what would be diagnosed.",
        "noise unknown": "The noise of these measurements is not known well enough to say whether the model is adequate.",
        NOT_CONVERGED: "The fit did not converge, so nothing can be diagnosed.",
    }
    return said.get(what, f"Verdict: {what or 'none'}.")


def advice(record: Record) -> str:
    """What a reader may do with the numbers after this verdict, and what to do next."""
    what = kind(record) if (record.get("base") or {}).get("converged", True) else NOT_CONVERGED
    return {
        "adequate": "Use the parameters with their intervals. What could have hidden from these measurements is listed below.",
        "attributed": "Use the parameters after the effect was added. Check it where it can be measured directly, if it can.",
        "ambiguous": "Use the parameters with intervals that cover every explanation, and make the next experiment before choosing.",
        "mainly": "Use the parameters after the effect was added; what remains is drawn below, and the intervals know nothing of it.",
        "two effects": "Use the parameters after both were added, with care: it is harder to be sure of two effects than of one.",
        "unexplained": "Do not take the parameters for properties of the tissue: the model is wrong somewhere. Where, is drawn below.",
        "not testable": "Measure under other conditions; the next experiments are listed below.",
        "mesh limited": "Make the mesh finer (finger: resolution:) and run this again. No effect is named from this mesh.",
        "noise unknown": "Repeat each condition at least three times and give the repeats as trials; then the question can be answered.",
        NOT_CONVERGED: "Free fewer parameters, add a prior, or start elsewhere.",
    }.get(what, "")


def warnings(record: Record) -> list[str]:
    """What a reader must know before using a number of this diagnosis, most serious first."""
    said = []
    what = kind(record)
    if what in ("unexplained", "mainly"):
        said.append("Parameters are conditional on a model that is known to miss something.")
    if what == "mesh limited":
        said.append("The mesh limits this diagnosis: small effects and mesh error look alike here.")
    if what == "noise unknown":
        said.append("Without a measured noise nothing can be said about whether the model is adequate.")
    hidden = [one["family"] for one in absorbed(record)]
    if hidden:
        said.append(
            f"These measurements cannot see {listed(hidden, 'or')}: if there is such an effect, the parameters are wrong by it and the "
            "residuals look clean."
        )
    outliers = _count(((record.get("data") or {}).get("noise") or {}).get("outlier_weights_lt_0.5"))
    if outliers:
        said.append(f"{outliers} readings lie so far out that they were given less than half their weight; none was deleted.")
    return said


def _count(said: Any) -> int:
    return len(said) if isinstance(said, (list, tuple, Mapping)) else int(number(said)) if math.isfinite(number(said)) else 0


# ---- chapters ----


def about_errors(record: Record) -> list[str]:
    """How large the misfit is, before and after."""
    return [
        "Error is the root mean square of data minus model. It is given as a share of the root mean square of the data, and in units of "
        "noise: the scatter that repeated readings have by themselves. At 1 nothing is left but noise.",
        "Fitted conditions were used to find the parameters. Conditions held out as a check were not, but an effect had to predict them "
        "to be accepted. Those held out untouched decided nothing: they are the fairest look at how well the model predicts.",
        *_lack_of_fit(record),
    ]


def _lack_of_fit(record: Record) -> list[str]:
    said = (record.get("base") or {}).get("lof") or {}
    names = {"omnibus_p": "misfit of any kind", "smooth_p": "smooth misfit", "maxT_p": "misfit shaped like an effect of the catalogue"}
    told = [f"{name} {_chance(said[key])}" for key, name in names.items() if math.isfinite(number(said.get(key)))]
    if not told:
        return []
    return [f"Were the model right before any effect was added, chance would give as much {'; '.join(told)}."]


def _chance(p: Any) -> str:
    found = number(p)
    return "less than once in 1000 repeats" if found < 1e-3 else f"in {share(found)} of repeats"


def about_residuals(record: Record) -> list[str]:
    """What the pictures of the residual show."""
    return [
        "Data minus model, above with the model as the study has it, below with the effect added. The grey band holds 95 % of the noise of "
        "single readings. What follows a line out of the band, rather than scattering about zero, is what the model misses.",
        *([] if any(block.has_after for block in blocks(record)) else ["No effect was added, so there is no picture after."]),
    ]


def about_effects(record: Record) -> list[str]:
    """What the ranking of effects shows."""
    said = record.get("critical") or {}
    alpha = number(said.get("alpha"))
    rarely = f"in {share(alpha)} of data sets" if math.isfinite(alpha) else "rarely"
    line = f" ({short(critical(record))})" if math.isfinite(critical(record)) else ""
    wide = f" among {said['n_columns']} directions that were tried" if said.get("n_columns") else ""
    return [
        "The score of an effect says how well its trace in the measurements matches what is left, after the model's own parameters have "
        f"moved as far as they can to take its place. Chance alone passes the dashed line{line} {rarely}, anywhere{wide}.",
        "The right half says how small an effect these measurements could have shown (bar) and how large it seems (diamond), "
        "both as multiples of a plausible size. A bar beyond 3 means that no effect of credible size would have been seen here.",
        "A high score is a suspicion. What decides is the fit made anew with the effect in it, in the table below the picture: it must "
        "remove the misfit, leave nothing that another effect would explain, be the same to all kinds of measurement, keep to a plausible "
        "size, and not spoil conditions held out.",
    ]


def about_alike(record: Record) -> list[str]:
    """What the look-alikes and the next experiments say."""
    said = [
        "Two effects look alike when their traces point the same way after the parameters have moved: 1 or -1 is the same, 0 has nothing "
        "in common. The strength needed is the squared size of an effect, in units of noise, from which the two can be told apart."
    ]
    names = explanations(record)
    if len(names) > 1 and kind(record) == "ambiguous":
        said.append(f"Not told apart here: {listed(names)}.")
    if record.get("next_experiment"):
        said.append(
            "The next experiments are ranked by how far apart they would push the two explanations that are hardest to tell apart. "
            "From 13 on the right one is found in 95 % of repeats."
        )
        reach = max((number(one.get("d2_after")) for one in record["next_experiment"]), default=math.nan)
        if reach < 13:
            said.append(f"None of those considered gets there: the best reaches {short(reach)}. Think of another kind of measurement.")
    return said


def about_parameters(record: Record) -> list[str]:
    """What the parameters and their intervals mean."""
    after = record.get("after") or {}
    wide = after.get("interval_kind")
    said = ["An interval holds the true value in 95 % of repeats, if the model is right otherwise."]
    if wide == "hull":
        said.append("The intervals after cover every explanation that is still possible, and what the mesh adds.")
    elif str(wide).startswith("inflated"):
        said.append("The intervals after are widened by what remains, because the model that they belong to does not explain these data.")
    elif wide:
        said.append("The intervals after are those of the one explanation, with what the mesh adds.")
    if after.get("alongside"):
        found = listed((record.get("nearest") or record["verdict"])["families"])
        said.append(
            f"They count {listed(after['alongside'])}, which may come with {found} and be too little to be seen: as much of it as is "
            "plausible and these data allow."
        )
    if absorbed(record):
        said.append(
            "The effects in the second table leave no trace of their own: the parameters move as it says and hide them. A clean residual "
            "does not rule them out."
        )
    return said


def about_rest(record: Record) -> list[str]:
    """Where something remains."""
    rows = [row for row in condition_rows(record) if row["after_over_noise"] is not None]
    p = number((record.get("verdict") or {}).get("remainder_p"))
    said = [f"Were nothing more missing, chance would leave as much as remains {_chance(p)}."] if math.isfinite(p) else []
    if rows:
        worst = max(rows, key=lambda row: row["after_over_noise"])
        said.append(f"Most remains in {worst['measurement']}, {worst['condition']}: {short(worst['after_over_noise'])} times its noise.")
    if record.get("nearest"):
        said.append(
            f"The catalogue comes nearest with {listed(record['nearest']['families'])}: that removes "
            f"{share(record['nearest'].get('share_explained'))} of the misfit beyond noise. It is how far the catalogue goes, not a cause: "
            "this model is contradicted by the data too."
        )
    if (record.get("unexplained") or {}).get("gp"):
        said.append(
            "The smooth line is the part of what remains that no change of the parameters could take away, drawn for the conditions that "
            "were fitted, with the band where it lies in 95 % of repeats. It is a picture of what is missing, not a cause."
        )
    return said


def about_mesh(record: Record) -> list[str]:
    """Whether the mesh could have made the misfit."""
    mesh = (record.get("model") or {}).get("mesh") or {}
    contact = (record.get("model") or {}).get("contact") or {}
    said = []
    if mesh.get("finer_nodes"):
        said.append(
            f"The model was also solved on a finer mesh ({_nodes(mesh.get('nodes'))} -> {_nodes(mesh['finer_nodes'])} nodes); the "
            "difference is taken off the misfit, and what may be left of it is counted as noise."
        )
    strength = number(mesh.get("lambda_mesh"))
    if math.isfinite(strength):
        said.append(
            f"What the mesh may still add has strength {short(strength)} in squared units of noise; up to 1 it cannot be mistaken for "
            "an effect."
        )
    drowned = number(mesh.get("drowned"))
    if math.isfinite(drowned):
        said.append(f"In the noise of the measurements alone, of which it is no part, that strength would be {short(drowned)}.")
    misfit, made, slowly, alike = (number(mesh.get(name)) for name in ("misfit", "as_corrected", "as_first_order", "alike"))
    if misfit > 0 and made > 0:
        more = f" ({short(slowly)} if the mesh converges in first order only)" if slowly > made else ""
        said.append(
            f"The misfit beyond the noise is {short(misfit)} in the same units; an error as large as that difference would make "
            f"{short(made)}{more}, and {share(min(max(alike, 0.0), 1.0))} of the misfit looks like it."
        )
    gate = str(mesh.get("gate") or "")
    if gate:
        said.append(f"Mesh guard: {_GATE.get(gate, gate)}.")
    if math.isfinite(number(contact.get("smoothing"))):
        smooth = number(contact["smoothing"])
        said.append("Contact is exact." if smooth == 0 else f"Contact is smoothed over {short(smooth)} mm.")
    return said or ["The record says nothing about the mesh."]


def _nodes(count: Any) -> str:
    return f"{number(count):.0f}" if math.isfinite(number(count)) else "unknown"


def about_noise(record: Record) -> list[str]:
    """Where the noise comes from and what it allows."""
    noise = (record.get("data") or {}).get("noise") or {}
    source, nu = str(noise.get("source") or "unknown"), number(noise.get("nu"))
    enough = f" {short(nu)} degrees of freedom stand behind it" if math.isfinite(nu) else ""
    if source.startswith("replicate"):
        weak = math.isfinite(nu) and nu < 30
        allows = "that is few, so the verdict is cautious" if weak else "so whether the model is adequate can be judged"
        said = f"Noise was measured from repeated readings;{enough + ',' if enough else ''} {allows}."
    elif source.startswith("stated"):
        said = (
            f"Noise is what the files state{';' + enough if enough else ''}. Effects can be compared by it; whether the model is adequate "
            "stands and falls with what was stated."
        )
    else:
        said = f"Noise: {spoken(source)}. Effects can be ranked, but whether the model is adequate cannot be said."
    terms = noise.get("trial_terms")
    told = listed(list(terms)) if isinstance(terms, (list, tuple, Mapping)) and terms else ""
    more = [f"Whole trials also vary together, in {told}; this is part of the noise."] if told else []
    return [str(noise.get("allows") or "") or said, *more]


def about_trust(record: Record) -> list[str]:
    """How often the method itself errs, as measured on these very conditions."""
    said = record.get("critical") or {}
    alpha, boots = said.get("alpha"), said.get("n_boot")
    found = []
    measured = said.get("null_fp_measured")
    rates = measured if isinstance(measured, Mapping) else {"the model was called wrong": measured}
    for what, value in rates.items():
        if math.isfinite(number(value)):
            sets = f"{short(boots)} simulated data sets" if boots else "simulated data"
            found.append(f"In {sets} from which nothing is missing, {spoken(what)} in {share(value)} (meant: {share(alpha)}).")
    planted = record.get("planted") or []
    if planted:
        hits = sum(bool(one.get("found")) for one in planted)
        found.append(f"Of {len(planted)} effects planted in simulated data, {hits} were found; the table says how large they were.")
    return found or ["The method was not tried on simulated data in this run."]


def remedy(one: Record) -> str:
    """Why a candidate cannot be tested, in words."""
    reason = str(one.get("reason") or "").strip()
    return reason or "absorbed by the parameters: they can move so that nothing of it is left"
