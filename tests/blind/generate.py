"""Write a simulated laboratory: `python -m tests.blind.generate --out DIR --case NAME [--noise 0.01]
[--seed N] [--coarse F]`.

The folder holds what a user would bring (`experiments.yaml`, `sections.csv`, the data files and their
sidecars) and, apart from it, `truth.yaml`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .bricks import Array
from .laboratory import CASES, POISSON, Case, Forces, Observation, Profiles, Rates, noise_sigma, observe
from .shapes import LAST_SECTION, SURFACES, FingerShape, section_table

SOURCE = "simulated by tests/blind (a separate brick finite-element program); not measured on a finger"
NOTES = {
    Profiles: "Deflection of the skin's midline along the finger; depth counted from first contact.",
    Forces: "Slow loading; travel counted from first contact; a few minutes between trials.",
    Rates: "One SA-I afferent; mean rate over the static part of each indentation. The bar lies across the "
    "finger (along x) and is shifted along z between indentations; depth counted from first contact at each "
    "position; walls steeper than 68 deg do not touch.",
}
KINDS = {Profiles: "deflection_profile", Forces: "force_displacement", Rates: "spike_rate"}


def noisy(
    record: Profiles | Forces | Rates, clean: Array, sigma: Array, trials: int, seed: int, scale: float
) -> Array:
    """Readings of every trial, (trials, ...): clean plus `scale` times Gaussian noise.  A rate below zero
    is recorded as zero."""
    key = [seed, *record.name.encode()]
    values = clean + scale * sigma * np.random.default_rng(key).standard_normal((trials, *clean.shape))
    return np.maximum(values, 0.0) if isinstance(record, Rates) else values


def table(record: Profiles | Forces | Rates, values: Array, sigma: Array) -> tuple[str, list[str]]:
    """Header and rows of a data file; `values` (trials, ...) and `sigma` as in `noisy`."""
    if isinstance(record, Profiles):
        rows = [
            f"{t + 1},{depth:g},{distance:g},{values[t, a, b]:.4f}"
            for t in range(len(values))
            for a, depth in enumerate(record.depths)
            for b, distance in enumerate(record.distances)
        ]
        return "trial,depth_mm,distance_mm,deflection_mm", rows
    if isinstance(record, Forces):
        pairs = [(t, a) for t in range(len(values)) for a in range(len(record.travels))]
        rows = [f"{t + 1},{record.travels[a]:g},{values[t, a]:.5f},{sigma[a]:.5f}" for t, a in pairs]
        return "trial,displacement_mm,force_N,sigma_N", rows
    pairs = [(t, a) for t in range(len(values)) for a in range(len(record.positions))]
    rows = [
        f"{t + 1},{record.stimulus},{record.positions[a]:g},{record.depth:g},{values[t, a]:.2f}"
        for t, a in pairs
    ]
    return "trial,stimulus,position_mm,depth_mm,rate_Hz", rows


def sidecar(case: Case, record: Profiles | Forces | Rates, sigma: Array) -> dict[str, Any]:
    """What the measurement contract asks to be said beside a data file."""
    site = {"z_mm": case.finger.site, "theta_deg": 270.0}
    said: dict[str, Any] = {"kind": KINDS[type(record)], "source": SOURCE, "species": case.finger.species}
    said |= {"finger": case.finger.name, "controlled": "displacement", "direction": "z", "site": site}
    said |= {
        "indenter": dict(record.shape),
        "noise": {"sigma": "per row", "replicates": case.trials},
        "notes": NOTES[type(record)],
    }
    if isinstance(record, Forces):
        return said
    unit = "mm" if isinstance(record, Profiles) else "Hz"
    said["noise"] = {"sigma": float(f"{sigma.max():.4g}"), "unit": unit, "replicates": case.trials}
    if isinstance(record, Rates):
        said["receptor"] = {"afferent": "SA-I", "depth_mm": case.receptor_depth, **site}
    return said


def study(case: Case) -> dict[str, Any]:
    """The `experiments.yaml` a user would start from; its moduli are start values, not the truth."""
    nail = {"z_mm": list(case.finger.nail_z), "theta_deg": list(case.finger.nail_theta)}
    model: dict[str, Any] = {"moduli_MPa": by_layer(case.start), "bone": "held", "poisson_ratio": POISSON}
    if case.receptor_depth is not None:
        model["receptor"] = {"depth_mm": case.receptor_depth, "z_mm": case.finger.site, "theta_deg": 270.0}
    return {
        "version": 1,
        "finger": {"sections": "sections.csv", "nail": nail},
        "model": model,
        "measurements": [{"name": r.name, "data": f"{r.name}.csv"} for r in case.records],
        "fit": {"free": [f"{layer}.modulus" for layer in SURFACES[:4]]},
        "diagnose": {"effects": "all"},
    }


def truth(
    case: Case, seen: Observation, sigmas: dict[str, Array], noise: float, seed: int, command: str
) -> dict[str, Any]:
    """What made the data, for scoring a fit and never for making one."""
    said: dict[str, Any] = {"case": case.name, "made_with": command, "effect": "none", "seed": seed}
    said["mechanics"] = (
        "small strain, linear elastic; contact is the only nonlinearity; bone and nail patch fixed, "
        "proximal cut free"
    )
    said |= {"moduli_MPa": by_layer(case.moduli), "bone": "held", "poisson_ratio": POISSON}
    shape = {k: list(v) if isinstance(v, tuple) else v for k, v in vars(case.finger).items()}
    said["finger"] = shape | {"length_of_the_table": round(case.finger.length - LAST_SECTION, 4)}
    for record in case.records:
        if isinstance(record, Rates):
            law = {
                "scale_Hz_per_MPa": record.scale,
                "threshold_MPa": record.threshold,
                "place_xyz_mm": [round(v, 5) for v in case.receptor or ()],
            }
            said["receptor"] = {
                "depth_mm": case.receptor_depth,
                "measure": "strain energy density, MPa",
                **law,
            }
    said["noise"] = {"fraction": noise, "kind": "independent Gaussian; a rate below zero is recorded as zero"}
    said["noise"]["sigma_mean"] = {k: float(f"{v.mean():.4g}") for k, v in sigmas.items()}
    said["noiseless"] = {k: [float(f"{x:.5g}") for x in v.ravel()] for k, v in seen.clean.items()}
    mesh = {
        "element": "20-node brick, half of the finger by symmetry in x",
        "nodes": seen.figures["nodes"],
        "bricks": seen.figures["bricks"],
    }
    said["mesh"] = mesh | {k: list(v) if isinstance(v, tuple) else v for k, v in vars(case.divisions).items()}
    return said


def by_layer(values: tuple[float, float, float, float]) -> dict[str, float]:
    """The values of the four soft layers by their names."""
    return dict(zip(SURFACES[:4], values, strict=True))


def sections_csv(finger: FingerShape) -> str:
    """The finger's table of sections."""
    header = "z_mm,theta_deg,cx_mm,cy_mm," + ",".join(f"r_{name}_mm" for name in SURFACES)
    rows = [f"{r[0]:.4f},{r[1]:g}," + ",".join(f"{v:.4f}" for v in r[2:]) for r in section_table(finger)]
    return "\n".join([header, *rows]) + "\n"


def write(
    case: Case,
    seen: Observation,
    folder: Path,
    *,
    noise: float = 0.01,
    seed: int | None = None,
    command: str = "",
) -> None:
    """Write one laboratory into `folder`.  Without noise the files still state the standard deviations of 1
    per cent noise."""
    seed = case.seed if seed is None else seed
    folder.mkdir(parents=True, exist_ok=True)
    sigmas = {r.name: noise_sigma(r, seen.clean[r.name], noise or 0.01) for r in case.records}
    for record in case.records:
        clean, sigma = seen.clean[record.name], sigmas[record.name]
        values = noisy(record, clean, sigma, case.trials, seed, float(noise > 0))
        header, rows = table(record, values, sigma)
        (folder / f"{record.name}.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
        dump(folder / f"{record.name}.yaml", sidecar(case, record, sigma))
    (folder / "sections.csv").write_text(sections_csv(case.finger), encoding="utf-8")
    dump(folder / "experiments.yaml", study(case), f"# Simulated. {case.title}\n")
    dump(
        folder / "truth.yaml",
        truth(case, seen, sigmas, noise, seed, command),
        "# For scoring a fit only; nothing that fits may read this.\n",
    )


def dump(path: Path, value: dict[str, Any], head: str = "") -> None:
    """Write YAML, its first lines given."""
    path.write_text(
        head + yaml.safe_dump(value, sort_keys=False, width=120, default_flow_style=None), encoding="utf-8"
    )


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.blind.generate", description="Write one simulated laboratory."
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write; made if it is not there")
    parser.add_argument("--case", choices=sorted(CASES), required=True)
    parser.add_argument(
        "--noise",
        type=float,
        default=0.01,
        help="profile noise over largest depth; forces have twice, rates 1.5 times it",
    )
    parser.add_argument("--seed", type=int, default=None, help="the case's own when not given")
    parser.add_argument(
        "--coarse",
        type=float,
        default=1.0,
        help="every element this many times as long, for a look at mesh error",
    )
    said = parser.parse_args(arguments)
    if said.noise < 0 or said.coarse <= 0:
        parser.error("--noise must not be negative and --coarse must be positive")
    case = CASES[said.case]
    seed = case.seed if said.seed is None else said.seed
    seen = observe(case, case.divisions.scaled(said.coarse))
    coarse = "" if said.coarse == 1.0 else f" --coarse {said.coarse:g}"
    options = f"--case {case.name} --noise {said.noise:g} --seed {seed}{coarse}"
    command = f"python -m tests.blind.generate --out DIR {options}"
    write(case, seen, said.out, noise=said.noise, seed=seed, command=command)


if __name__ == "__main__":
    main()
