"""Records of made-up diagnoses, one for each kind of verdict, as `report.json` has them under `loop`."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np

KINDS = ("attributed", "ambiguous", "two effects", "mainly", "unexplained", "adequate", "not testable", "mesh-limited", "noise unknown")
ACTS_ON = {
    "nail_compliance": "support",
    "bed_compliance": "support",
    "strain_stiffening": "tissue",
    "skin_poisson": "tissue",
    "epidermis_thickness": "finger",
    "receptor_depth": "finger",
    "contact_offset": "contact",
    "indenter_tilt": "contact",
    "tip_radius": "contact",
    "relaxation": "time",
    "force_offset": "instrument",
    "force_gain": "instrument",
    "camera_scale": "instrument",
    "rate_saturation": "afferent",
}
UNITS = {"nail_compliance": "mm/N", "bed_compliance": "mm/N", "contact_offset": "mm", "epidermis_thickness": "mm", "tip_radius": "mm"}
SCORES = (14.2, 9.8, 2.9, -2.1, 1.9, 1.4, -1.2, 0.9, 0.7, 0.6, -0.4, 0.0, 0.2, 0.1)
NAMED = {
    "attributed": ["nail_compliance"],
    "ambiguous": ["nail_compliance", "bed_compliance"],
    "two effects": ["nail_compliance", "contact_offset"],
    "mainly": ["nail_compliance"],
}
TEXT = {
    "attributed": "The nail gives way: with an elastic nail bed the model explains these measurements to within their noise.",
    "ambiguous": "Either the nail or the bone's bed gives way; these measurements cannot tell which.",
}


def record(kind: str = "attributed", *, repeats: int = 3, seed: int = 1, **changes: Any) -> dict[str, Any]:
    """A whole record of one kind, as it is read from a file; `changes` replace its first keys."""
    found = {
        "data": _data(kind, repeats),
        "model": {
            "version": "0.1",
            "mesh": {
                "nodes": 9512, "h": 0.5, "finer_nodes": 61230, "rho": 0.25,
                "lambda_mesh": 7.4 if kind == "mesh-limited" else 0.42, "gate": "failed" if kind == "mesh-limited" else "passed",
                "misfit": 210.0, "as_corrected": 400.0, "as_first_order": 400.0, "alike": 0.62,
                "theta_shift_sd": {"epidermis.modulus": 0.11, "dermis.modulus": 0.06, "line.scale": None},
            },
            "contact": {"penalty": None, "smoothing": 0.0},
        },
        "base": {
            "theta": _theta(kind, after=False), "rss": 1412.5, "df": 318.0, "grad_rel": 3e-8, "converged": True, "reason": "",
            "lof": {"omnibus_p": 2e-5, "smooth_p": 1e-9, "maxT_p": 0.004}, "error": _error(0.061),
        },
        "candidates": [_candidate(kind, name, score) for name, score in zip(ACTS_ON, SCORES, strict=True)],
        "critical": {"alpha": 0.05, "maxT": 2.82, "n_columns": 25, "effective_tests": 10.5, "null_fp_measured": 0.045, "n_boot": 200},
        "set": [" + ".join(NAMED[kind])] if kind == "two effects" else NAMED.get(kind, []),
        "confusable": [
            {"a": "nail_compliance", "b": "bed_compliance", "cos": 0.985, "lambda_needed": 436.0},
            {"a": "skin_poisson", "b": "receptor_depth", "cos": -0.71, "lambda_needed": 26.3},
        ],
        "next_experiment": [
            {"condition": "plate near the nail, 1.0 mm", "replicates": 3, "d2_now": 1.9, "d2_after": 41.0,
             "pairs": {"nail_compliance/bed_compliance": 41.0}},
            {"condition": "sphere on the side of the finger, 0.8 mm", "replicates": 4, "d2_now": 1.9, "d2_after": 15.5,
             "pairs": {"nail_compliance/bed_compliance": 15.5}},
        ] if kind == "ambiguous" else [],
        "verdict": {
            "kind": kind, "families": NAMED.get(kind, []), "share_explained": 0.981 if kind in NAMED else None,
            "remainder_p": 3e-6 if kind == "unexplained" else 0.41,
            "absorbed": [{"family": "force_gain", "combination": "all moduli +10 %"}], "text": TEXT.get(kind, ""),
        },
        "after": {
            "theta": _theta(kind, after=True), "phi": _phi(kind), "error": _error(0.021 if kind in NAMED else 0.061),
            "theta_change_sd": {"epidermis.modulus": 3.1, "dermis.modulus": -1.2, "line.scale": 0.1}, "interval_kind": "hull",
        },
        "unexplained": None,
        "planted": [
            {"family": "nail_compliance", "size_in_mde": 2.0, "found": True, "rank": 1},
            {"family": "skin_poisson", "size_in_mde": 2.0, "found": True, "rank": 2},
            {"family": "tip_radius", "size_in_mde": 2.0, "found": False, "rank": 5},
        ],
        "seed": seed,
        "runtime_s": 512.0,
        "rows": _rows(kind, repeats, np.random.default_rng(seed)),
    }  # fmt: skip
    if kind == "unexplained":
        found["unexplained"] = _unexplained(found["rows"])
    return json.loads(json.dumps(copy.deepcopy(found | changes)))


def _data(kind: str, repeats: int) -> dict[str, Any]:
    known = kind != "noise unknown"
    noise = {
        "source": "replicates" if known else "assumed",
        "sigma_by_block": {"line": 0.01, "plate": 0.004, "hold": 0.003, "bar": 4.0},
        "nu": 212.0 if known else 0.0,
        "trial_terms": {"plate": {"gain": 0.01}} if known else {},
        "outlier_weights_lt_0.5": 2 if kind == "mainly" else 0,
        "allows": "" if known else "The noise was assumed; whether the model is adequate cannot be said.",
    }
    conditions = [
        {"id": "line, depth 0.5 mm", "role": "fit", "n": 15 * repeats, "replicates": repeats},
        {"id": "line, depth 2 mm", "role": "veto", "n": 15 * repeats, "replicates": repeats},
        {"id": "bar", "role": "report", "n": 17 * repeats, "replicates": repeats},
    ]
    return {"id": "made-up <finger>", "hash": "0f3a", "kind": "synthetic", "conditions": conditions, "noise": noise}


def _theta(kind: str, *, after: bool) -> dict[str, Any]:
    moved = after and kind in NAMED
    values = {"epidermis.modulus": (0.148 if moved else 0.121, "MPa"), "dermis.modulus": (0.0161 if moved else 0.0173, "MPa")}
    values["line.scale"] = (2310.0, "Hz/MPa")
    return {
        name: {
            "value": value, "unit": unit, "sd": 0.06 * value, "ci": [0.88 * value, 1.13 * value], "profile_ci": [None, None],
            "mesh_sd": 0.01 * value, "at_limit": None, "raw": float(np.log(value)), "link": "log",
        }
        for name, (value, unit) in values.items()
    }  # fmt: skip


def _phi(kind: str) -> dict[str, Any]:
    sizes = {"nail_compliance": ("depth", 0.21), "bed_compliance": ("depth", 0.18), "contact_offset": ("offset", 0.07)}
    named = NAMED.get(kind, [])[: 1 if kind == "ambiguous" else 2]
    return {
        f"{name}.{sizes[name][0]}": {"value": size, "unit": UNITS[name], "ci": [0.8 * size, 1.2 * size], "family": name}
        for name in named
        for size in [sizes[name][1]]
    }


def _error(size: float) -> dict[str, Any]:
    return {"fit": size, "veto": 1.1 * size, "report": 1.2 * size, "by_block": {}}


def _candidate(kind: str, name: str, score: float) -> dict[str, Any]:
    strong = kind not in ("adequate", "not testable", "noise unknown", "mesh-limited")
    score = score if strong else 0.17 * score
    keys = [f"{name}.share@tau_s=0.3", f"{name}.share@tau_s=3"] if name == "relaxation" else [f"{name}.size"]
    plausible = {"force_gain": 0.05, "camera_scale": 0.02}.get(name, 0.1)
    testable = name != "force_gain" and kind != "not testable"
    visible = 0.02 + 0.3 * plausible * (1 + len(name) % 5)
    refit = None
    if strong and name in ("nail_compliance", "bed_compliance", "strain_stiffening", "relaxation"):
        refit = {
            "phi": {key: 0.21 for key in keys}, "ci": {key: [0.17, 0.25] for key in keys}, "rss": 1412.5 - score**2,
            "delta": score**2, "bic": 900.0 - score**2, "log_evidence": 0.5 * score**2 - 4.0, "lof": {},
            "best_rival": {"family": "tip_radius", "z": 1.7}, "veto_dchi2": -80.0, "eta": 0.98, "converged": True,
            "in_set": name in NAMED.get(kind, []), "reason": "" if name in NAMED.get(kind, []) else "leaves a trace of nail_compliance",
        }  # fmt: skip
    return {
        "family": name, "columns": keys, "null": {key: 0.0 for key in keys}, "bound": {key: [-0.3, 0.3] for key in keys},
        "prior_sd": {key: plausible for key in keys}, "fraction_left": 0.004 if name == "force_gain" else 0.4,
        "mde": visible, "z": score, "p_adj": min(1.0, float(np.exp(-abs(score)))), "epc": {key: 0.07 * score * plausible for key in keys},
        "theta_shift": {"epidermis.modulus": 0.1}, "testable": testable,
        "reason": "" if testable else "absorbed: every modulus 10 % higher does the same", "refit": refit,
        "unit": UNITS.get(name, "1"), "acts_on": ACTS_ON[name],
    }  # fmt: skip


def _rows(kind: str, repeats: int, rng: np.random.Generator) -> dict[str, Any]:
    misses = 0.0 if kind in ("adequate", "noise unknown", "not testable") else 1.0
    stays = {"unexplained": 1.0, "mesh-limited": 1.0, "mainly": 0.15}.get(kind, 0.0)
    blocks = {}
    z, depths = np.linspace(-3.0, 3.0, 15), (0.5, 1.0, 1.5, 2.0)
    depth, distance = (np.repeat(np.ravel(each), repeats) for each in np.meshgrid(depths, z, indexing="ij"))
    shape = depth * np.exp(-np.abs(distance) / 1.6)
    lack = 0.03 * depth * np.exp(-((distance - 0.8) ** 2))
    labels = [f"line, depth {one:g} mm" for one in depth]
    roles = ["veto" if one == 2.0 else "fit" for one in depth]
    blocks["line"] = ("mm", shape, lack, 0.01, {"depth": depth, "distance": distance}, labels, roles)
    travel = np.repeat(np.linspace(0.2, 1.6, 8), repeats)
    force = 0.12 * travel**1.8
    blocks["plate"] = ("N", force, -0.012 * travel**2, 0.004, {"displacement": travel}, [f"plate, {one:g} mm" for one in travel], "fit")
    time = np.tile(np.geomspace(0.05, 20.0, 12), repeats)
    held = 0.2 * (1 + 0.3 * np.exp(-time / 2.0))
    blocks["hold"] = ("N", held, 0.01 * np.exp(-time / 1.5), 0.003, {"displacement": np.full_like(time, 1.0), "time": time}, "hold", "fit")
    position = np.tile(np.linspace(-4.0, 4.0, 17), repeats)
    rate = 60.0 * np.exp(-(position**2) / 2.0)
    blocks["bar"] = ("Hz", rate, 12.0 * np.exp(-((position - 1.0) ** 2)), 4.0, {"position": position}, "bar", "report")
    found = {}
    for name, (unit, truth, lack, sigma, coordinates, labels, roles) in blocks.items():
        measured = truth + sigma * rng.standard_normal(truth.size)
        known = [sigma] * truth.size if kind != "noise unknown" else [None] * truth.size
        found[name] = {
            "unit": unit, "coordinates": {key: list(map(float, value)) for key, value in coordinates.items()},
            "measured": measured.tolist(), "sigma": known,
            "before": (truth - misses * lack).tolist(), "after": (truth - misses * stays * lack).tolist(),
            "condition": labels if isinstance(labels, list) else [labels] * truth.size,
            "role": roles if isinstance(roles, list) else [roles] * truth.size,
        }  # fmt: skip
    return found


def _unexplained(rows: dict[str, Any]) -> dict[str, Any]:
    smooth = {}
    for name in ("line", "bar"):
        place = np.array(rows[name]["coordinates"]["distance" if name == "line" else "position"])
        if name == "line":  # as the loop has it, of the rows that were fitted
            place = place[np.array(rows[name]["role"]) == "fit"]
        size = float(np.std(np.array(rows[name]["measured"]) - np.array(rows[name]["after"])))
        mean = 1.5 * size * np.exp(-((place - 0.9) ** 2))
        smooth[name] = {"amplitude": size, "length": 1.0, "mean": mean.tolist(), "band": [0.2 * size] * place.size}
    return {
        "gp": smooth,
        "share": {"block": {"line": 0.71, "bar": 0.29}, "condition": {"line, depth 2 mm": 0.4}},
        "symmetry": {"line": 0.35, "bar": 0.48},
        "spectrum": {"line": {"neighbours": 0.6, "wavelength": 2.1, "share": 0.5}},
    }
