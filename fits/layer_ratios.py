"""Ratios between the layers' moduli from skin profiles: which values, how sure, and what trades off against what.

    python fits/layer_ratios.py --data FOLDER        # measured profiles of a human finger
    python fits/layer_ratios.py                      # simulated ones
    python fits/layer_ratios.py --grid               # the paper's powers of ten beside the fit

Every parameter's likelihood is profiled, and combinations that the data do not see are named.
"""

from __future__ import annotations

import dataclasses
import sys

from _script import arguments, run, show, shown, study_named

from fingerjax.forward import assemble
from fingerjax.identify.grid import grid
from fingerjax.report.records import Table, write_csv


def main() -> None:
    beside = "--grid" in sys.argv
    sys.argv = [one for one in sys.argv if one != "--grid"]
    said = arguments(__doc__, "layer_ratios")
    study = study_named("layer_ratios", said)
    study = dataclasses.replace(study, fit=dataclasses.replace(study.fit, profile=study.fit.free))
    result = run(study, said.out)
    show(result, "parameters", "layer_ratios", "intervals", "verdicts", "directions", "stations")
    if beside:
        tried = grid(assemble(study), tell=lambda share, doing: print(f"\r{share:4.0%} {doing}", end="", flush=True))
        table = Table("grid", f"The best of 256 models, {tried.solves} solves in {tried.seconds:.0f} s", tried.rows())
        print()
        shown(table)
        write_csv(said.out / "grid.csv", table.rows)
    print(f"CSV and figures: {said.out}")


if __name__ == "__main__":
    main()
