"""Steps under constant force (Figs. 12 and 13): contact area, pressure and receptor against the place of the step.

    python -m fits.steps [--out build/steps] [--pad-mm 0.35]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.contact import FORCE, LAYERED, SOLID, STEPS, step_sweep
from fingerjax.contact.indenter import from_spec
from fingerjax.measure.receptor import strain_energy_density
from fingerjax.mesh import Resolution, build_finger

os.environ.setdefault("NPROC", "16")  # jaxlib's dense solves wait for one another on XLA's own threads
jax.config.update("jax_enable_x64", True)


def main(out: Path, pad_mm: float) -> None:
    finger = build_finger(SOLID, Resolution(pad_mm, 3 * pad_mm))
    shifts = np.arange(-4.0, 4.01, 0.2)
    figure, panels = plt.subplots(3, len(STEPS), figsize=(11, 8), sharex=True, sharey="row", layout="constrained", squeeze=False)
    out.mkdir(parents=True, exist_ok=True)
    for column, (name, half) in zip(panels.T, STEPS.items(), strict=True):
        pushed, sequence = step_sweep(finger, from_spec("step", {"amplitude": 0.5, "wavelength": 2 * half}), shifts)
        energy = 1e3 * np.asarray(strain_energy_density(sequence.feel(pushed, LAYERED)))[:, 0]
        lines = [np.asarray(pushed.contact.area), 1e3 * np.asarray(pushed.mean_pressure), energy]
        for panel, values in zip(column, lines, strict=True):
            panel.plot(shifts, values)
        column[0].set_title(f"{name}: half wavelength {half:g} mm, {FORCE:g} N")
        column[2].set_xlabel("step's middle, mm distal of the receptor")
        header = "shift_mm,area_mm2,mean_pressure_kPa,energy_density_kPa"
        np.savetxt(out / f"{name.replace(' ', '_')}.csv", np.column_stack([shifts, *lines]), "%.5g", ",", header=header, comments="")
        print(f"{name}: most energy with the step's middle at {shifts[energy.argmax()]:+.1f} mm, correlation of area and mean pressure "
              f"{np.corrcoef(lines[0], lines[1])[0, 1]:+.3f}")  # fmt: skip
    for panel, label in zip(panels[:, 0], ("area, mm^2", "mean pressure, kPa", "energy density, kPa"), strict=True):
        panel.set_ylabel(label)
    figure.savefig(out / "steps.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/steps"))
    parser.add_argument("--pad-mm", type=float, default=0.35)
    options = parser.parse_args()
    main(options.out, options.pad_mm)
