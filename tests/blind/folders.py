"""Write a scenario as a laboratory would: `python -m tests.blind.folders --out DIR [NAME ...] [--noise 0.02] [--seed N] [--thin]`.

`DIR/NAME/` holds what a user would bring; `DIR/truths/NAME.yaml` is for scoring alone and lies apart from it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .bricks import Array
from .generate import SOURCE, by_layer, dump, sections_csv
from .laboratory import Profiles
from .protocol import Record, Trace
from .scenarios import HELD_OUT, SCENARIOS, Scenario, World
from .shapes import SURFACES
from .truths import MODEL_ERROR, PLACED, Readings, Truths, coordinates, deviation, held_out, in_order

TRIALS = 4
START = {"human": (0.18, 0.018, 0.018, 0.018), "monkey": (0.14, 0.014, 0.014, 0.014)}
INSTANT = ("relaxation",)
"""Families with which a modulus has no one value: at once, or in the end."""
COLUMNS = {"depth": "depth_mm", "distance": "distance_mm", "displacement": "displacement_mm", "position": "position_mm", "time": "time_s"}


def measured(world: World, record: Record, clean: Array, sigma: Array, seed: int, name: str) -> Array:
    """Readings of every trial, (trials, ...), with Gaussian noise; an afferent that is silent is so in every trial."""
    random = np.random.default_rng([seed, *name.encode(), *record.name.encode()])
    noise = random.standard_normal((TRIALS, *clean.shape))
    gain = 1.0 + world.trial_gain * random.standard_normal((TRIALS, *(1,) * clean.ndim))
    values = clean * (1.0 if isinstance(record, Profiles) else gain) + sigma * noise
    return values if isinstance(record, (Profiles, Trace)) else np.where(clean > 0.0, np.maximum(values, 0.0), 0.0)


def table(record: Record, values: Array, sigma: Array) -> str:
    """A data file; `values` (trials, ...), `sigma` (...)."""
    where, (column, unit) = coordinates(record), _measured(record)
    names = [COLUMNS.get(name, name) for name in where]
    lines = [",".join(["trial", *names, f"{column}_{unit}", f"sigma_{unit}"])]
    for trial, one in enumerate(values.reshape(len(values), -1), 1):
        for row in zip(*where.values(), one, sigma.ravel(), strict=True):
            lines.append(",".join([str(trial), *(cell if isinstance(cell, str) else f"{cell:.6g}" for cell in row)]))
    return "\n".join(lines) + "\n"


def _measured(record: Record) -> tuple[str, str]:
    if isinstance(record, Profiles):
        return "deflection", "mm"
    return ("force", "N") if isinstance(record, Trace) else ("rate", "Hz")


def sidecar(world: World, record: Record) -> dict[str, Any]:
    """What is said beside a data file."""
    along = record.along if isinstance(record, Trace) else 0.0
    site = {"z_mm": world.nominal.site + along, "theta_deg": 270.0}
    kinds = {"deflection": "deflection_profile", "force": "force_displacement", "rate": "spike_rate"}
    said: dict[str, Any] = {"kind": kinds[_measured(record)[0]], "source": SOURCE, "species": world.nominal.species}
    said |= {"finger": world.nominal.name, "controlled": "displacement", "direction": "z", "site": site}
    said["noise"] = {"sigma": "per row", "replicates": TRIALS}
    if isinstance(record, (Profiles, Trace)):
        return said | {"indenter": dict(record.shape)}
    said["indenter"] = {"stimuli": {name: dict(shape) for name, _, shape in record.stimuli}}
    return said | {"receptor": {"afferent": "SA-I", "depth_mm": world.flesh.receptors[0][1], **site}}


def study(scenario: Scenario, world: World) -> dict[str, Any]:
    """The `experiments.yaml` that a user would write; it knows nothing of the effect."""
    nail = {"z_mm": list(world.nominal.nail_z), "theta_deg": list(world.nominal.nail_theta)}
    pad, proximal = world.resolution
    model: dict[str, Any] = {"moduli_MPa": by_layer(START[scenario.finger]), "bone": "held", "poisson_ratio": 0.48}
    if world.flesh.receptors:
        model["receptor"] = {"depth_mm": world.flesh.receptors[0][1], "z_mm": world.nominal.site, "theta_deg": 270.0}
    there = [record.name for record in world.records]
    kept = [one for one in HELD_OUT[scenario.finger] if one["measurement"] in there] if scenario.hold_out else []
    asked: dict[str, Any] = {"effects": "all", "model_error": dict(MODEL_ERROR), "placement_mm": PLACED}
    asked |= {"hold_out": kept} if kept else {}
    asked |= {"nodes": world.nodes} if world.nodes else {}
    return {
        "version": 1,
        "finger": {"sections": "sections.csv", "nail": nail, "resolution": {"pad_mm": pad, "proximal_mm": proximal}},
        "model": model,
        "measurements": [{"name": name, "data": f"{name}.csv"} for name in there],
        "fit": {"free": [f"{layer}.modulus" for layer in SURFACES[:4]]},
        "diagnose": asked,
    }


def truth(scenario: Scenario, world: World, clean: Readings, noise: float, seed: int, excess: dict[str, float]) -> dict[str, Any]:
    """What made the data: for scoring alone."""
    said: dict[str, Any] = {"case": scenario.name, "kind": scenario.kind, "families": list(scenario.families)}
    said |= {"hidden": scenario.hidden, "seed": seed, "noise": noise, "trials": TRIALS}
    said |= {"lambda": excess["all"], "lambda_of_each": {name: excess[name] for name in scenario.families if name in excess}}
    said["moduli_MPa"] = by_layer(world.flesh.moduli)
    said["moduli_scored"] = not set(INSTANT) & set(scenario.families)
    said["rows"] = {record.name: _rows(scenario, record, clean[record.name], noise) for record in world.records}
    return said


def _rows(scenario: Scenario, record: Record, clean: Array, noise: float) -> dict[str, Any]:
    sigma = deviation(record, clean, noise).ravel()
    said: dict[str, Any] = {"coordinates": coordinates(record), "clean": [float(f"{v:.6g}") for v in clean.ravel()]}
    return said | {"sigma": [float(f"{v:.4g}") for v in sigma], "held_out": held_out(scenario, record).tolist()}


def write(scenario: Scenario, truths: Truths, folder: Path, truth_file: Path, *, noise: float, seed: int) -> None:
    """Write one laboratory into `folder` and its truth to `truth_file`."""
    world, clean = scenario.world(thin=truths.thin), truths.clean(scenario)
    folder.mkdir(parents=True, exist_ok=True)
    for record in world.records:
        sigma = deviation(record, clean[record.name], noise)
        values = measured(world, record, clean[record.name], sigma, seed, scenario.name)
        (folder / f"{record.name}.csv").write_text(table(record, values, sigma), encoding="utf-8")
        dump(folder / f"{record.name}.yaml", sidecar(world, record))
    (folder / "sections.csv").write_text(sections_csv(world.nominal), encoding="utf-8")
    dump(folder / "experiments.yaml", study(scenario, world))
    truth_file.parent.mkdir(parents=True, exist_ok=True)
    excess = {"all": truths.excess(scenario, noise, TRIALS)}
    if scenario.kind == "double":
        excess |= truths.excess_of_each(scenario, noise, TRIALS)
    said = truth(scenario, world, clean, noise, seed, {name: float(f"{value:.4g}") for name, value in excess.items()})
    truth_file.write_text(yaml.safe_dump(said, sort_keys=False, width=140, default_flow_style=None), encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.folders", description="Write blind laboratories.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of: {', '.join(SCENARIOS)}; all where none is named")
    parser.add_argument("--out", type=Path, required=True, help="folder that the laboratories' folders are written into")
    parser.add_argument("--noise", type=float, default=0.02, help="share of the largest reading")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--thin", action="store_true", help="a coarse study with few rows")
    said = parser.parse_args(arguments)
    if unknown := sorted(set(said.names) - set(SCENARIOS)):
        parser.error(f"no scenario is called {', '.join(unknown)}")
    truths = Truths(said.out / "clean", said.thin, tell=print)
    for name in in_order(said.names or SCENARIOS):
        write(SCENARIOS[name], truths, said.out / name, said.out / "truths" / f"{name}.yaml", noise=said.noise, seed=said.seed)
        print(f"{name}: lambda {truths.excess(SCENARIOS[name], said.noise, TRIALS):.3g}", flush=True)


if __name__ == "__main__":
    main()
