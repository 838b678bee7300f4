"""What a population of receptors feels: strain energy density 0.75 mm below the skin, and in section, under a bar and under a step.

    python -m fits.population [--out build/population] [--pad-mm 0.3]

Writes, for each stimulus, a map over the skin, the same map as a surface in three dimensions, a section along the middle of the finger,
and the numbers that they were drawn from.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from fingerjax.contact.indenter import Bar, Step
from fingerjax.contact.shape import AbstractIndenter
from fingerjax.fem.body import material
from fingerjax.forward.sequence import check, population, prepare
from fingerjax.geometry.presets import preset
from fingerjax.measure.receptor import strain_energy_density
from fingerjax.measure.sites import below, plane
from fingerjax.mesh import Resolution, build_finger

os.environ.setdefault("NPROC", "16")  # jaxlib's dense solves wait for one another on XLA's own threads
jax.config.update("jax_enable_x64", True)

SKIN = material({"epidermis": 0.14, "dermis": 0.014, "adipose": 0.014, "fibrous": 0.014})  # MPa: m43338
DEPTH = 0.75  # mm
STIMULI: dict[str, tuple[AbstractIndenter, dict[str, float]]] = {
    "bar": (Bar(3.0, 0.1), {"travel": 1.0}),
    "step": (Step(0.5, 3.1), {"force": 0.2}),
}


def main(out: Path, pad_mm: float) -> None:
    solid = preset("monkey")
    finger = build_finger(solid, Resolution(pad_mm, 1.5))
    out.mkdir(parents=True, exist_ok=True)
    x, z = np.linspace(-2.5, 2.5, 31), solid.pad_centre + np.linspace(-3.5, 3.5, 43)
    depth = np.linspace(0.05, 2.0, 24)
    for name, (shape, pressed) in STIMULI.items():
        sequence = prepare(finger, shape, np.array([[0.0, solid.pad_centre]]), 1.5)
        condensed = sequence.condense(SKIN)
        pushed = sequence.press(condensed.held.matrix, shape, **pressed)
        check(sequence, pushed)
        over = population(sequence, condensed, pushed, SKIN, plane(solid, DEPTH, x, z))
        within = population(sequence, condensed, pushed, SKIN, below(solid, depth[:, None], z[None, :]))
        felt = 1e3 * np.asarray(strain_energy_density(over)).reshape(len(x), len(z))
        section = 1e3 * np.asarray(strain_energy_density(within)).reshape(len(depth), len(z))
        draw(out, name, x, z - solid.pad_centre, depth, felt, section)
        print(f"{name}: force {float(pushed.contact.force[0]):.4f} N, most energy {felt.max():.4g} kPa at depth {DEPTH} mm")


def draw(out: Path, name: str, x: np.ndarray, z: np.ndarray, depth: np.ndarray, felt: np.ndarray, section: np.ndarray) -> None:
    """The three pictures of one stimulus, and their numbers."""
    rows = np.column_stack([np.repeat(x, len(z)), np.tile(z, len(x)), felt.ravel()])
    np.savetxt(out / f"{name}_map.csv", rows, "%.5g", ",", header="x_mm,z_mm,energy_density_kPa", comments="")
    rows = np.column_stack([np.repeat(depth, len(z)), np.tile(z, len(depth)), section.ravel()])
    np.savetxt(out / f"{name}_section.csv", rows, "%.5g", ",", header="depth_mm,z_mm,energy_density_kPa", comments="")
    figure = plt.figure(figsize=(10, 7), layout="constrained")
    flat, tall = figure.add_subplot(2, 2, 1), figure.add_subplot(2, 2, 2, projection="3d")
    low = figure.add_subplot(2, 1, 2)
    shown = flat.pcolormesh(z, x, felt, shading="gouraud", cmap="viridis")
    flat.set(xlabel="along the finger, mm", ylabel="across, mm", title=f"{DEPTH} mm below the skin", aspect="equal")
    figure.colorbar(shown, ax=flat, label="energy density, kPa", shrink=0.7)
    along, across = np.meshgrid(z, x)
    tall.plot_surface(along, across, felt, cmap="viridis", linewidth=0)
    tall.set(xlabel="along, mm", ylabel="across, mm", zlabel="kPa")
    shown = low.pcolormesh(z, depth, np.log10(np.maximum(section, 1e-4)), shading="gouraud", cmap="viridis")
    low.axhline(DEPTH, color="white", linewidth=0.8)
    low.set(xlabel="along the finger, mm", ylabel="depth, mm", title="section along the middle of the finger")
    low.invert_yaxis()
    figure.colorbar(shown, ax=low, label="log10 of energy density, kPa")
    figure.savefig(out / f"{name}.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/population"))
    parser.add_argument("--pad-mm", type=float, default=0.3)
    options = parser.parse_args()
    main(options.out, options.pad_mm)
