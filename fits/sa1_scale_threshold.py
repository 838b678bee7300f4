"""Scale and threshold of one SA-I afferent under a bar, and how sure they are: linearised, profile likelihood, bootstrap.

    python fits/sa1_scale_threshold.py               # tables on the terminal, CSV and figures in results/sa1_scale_threshold
    python fits/sa1_scale_threshold.py --coarse 2    # a rough first look

rate = scale max(strain energy density - threshold, 0), as in the paper's section 4.4; the moduli are held at the paper's.
"""

from __future__ import annotations

import dataclasses

from _script import arguments, run, show, study_named

REPEATS = 100


def main() -> None:
    said = arguments(__doc__, "sa1_scale_threshold")
    study = study_named("sa1_bar", said)
    asked = dataclasses.replace(study.fit, profile=study.fit.free, bootstrap=("parametric", REPEATS, 1))
    result = run(dataclasses.replace(study, fit=asked), said.out)
    show(result, "parameters", "intervals", "verdicts", "residuals")
    print(f"CSV and figures: {said.out}")


if __name__ == "__main__":
    main()
