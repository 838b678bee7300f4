"""One SA-I afferent under the paper's 3 mm bar: which quantity, in which finger, follows its rate (Fig. 11), and the picture of it.

    python -m fits.bars --data FOLDER [--out build/bars] [--pad-mm 0.17]

FOLDER holds `monkey-sa1-bars-and-grating`. For every quantity and window: measured rates, and those of the layered and of the homogeneous
finger with their best scale and threshold.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from benchmarks._bars import WINDOWS, correlation, measured_bar, sweep
from benchmarks.contact import DEPTH, HOMOGENEOUS, LAYERED, SOLID
from fingerjax.measure.afferent import rate, start
from fingerjax.measure.receptor import PAPER_QUANTITIES
from fingerjax.mesh import Resolution, build_finger

os.environ.setdefault("NPROC", "16")  # jaxlib's dense solves wait for one another on XLA's own threads
jax.config.update("jax_enable_x64", True)


def main(data: Path, out: Path, pad_mm: float) -> None:
    finger = build_finger(SOLID, Resolution(pad_mm, max(1.0, 3 * pad_mm)))
    found = sweep(finger, SOLID, {"layered": LAYERED, "homogeneous": HOMOGENEOUS}, DEPTH)
    figure, panels = plt.subplots(len(WINDOWS), len(PAPER_QUANTITIES), figsize=(13, 6), sharex=True, layout="constrained", squeeze=False)
    for row, window in zip(panels, WINDOWS, strict=True):
        position, rates = measured_bar(data, window)
        for panel, name in zip(row, PAPER_QUANTITIES, strict=True):
            panel.plot(position, rates, "ko", markersize=3, label="measured")
            told = []
            for model, felt in found.quantity.items():
                quantity = np.interp(position, found.position, felt[name])
                panel.plot(position, np.asarray(rate(quantity, *start(quantity, rates))), label=model)
                told.append(f"{model[:3]} {correlation(quantity, rates):.2f}")
            panel.set_title(f"{name.replace('_', ' ')}\n{', '.join(told)}", fontsize=9)
            print(f"{window:8} {name:28} {'  '.join(told)}")
        row[0].set_ylabel(f"{window} rate, Hz")
        row[0].legend(fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("receptor on the bar, mm")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "bars.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("build/bars"))
    parser.add_argument("--pad-mm", type=float, default=0.17)
    options = parser.parse_args()
    main(options.data, options.out, options.pad_mm)
