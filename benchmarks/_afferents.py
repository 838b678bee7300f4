"""What the afferents of a study are told by: the paper's four quantities, in a layered and in a homogeneous finger."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks._record import Figure
from fingerjax.forward import assemble
from fingerjax.forward.model import noise_of
from fingerjax.forward.readings import Solved
from fingerjax.layers import SOFT_LAYERS
from fingerjax.loop.findings import Findings
from fingerjax.measure.afferent import rate, start
from fingerjax.measure.receptor import PAPER_QUANTITIES
from fingerjax.measurements import Measurement
from fingerjax.report.records import Row, Table
from fingerjax.study import Study


def more(study: Study, findings: Findings) -> Iterator[Figure | Table]:
    """Every afferent's rate against each quantity with its best scale and threshold."""
    model, moduli = assemble(study).model, study.model.moduli()
    fingers = {"layered": moduli, "homogeneous": dict.fromkeys(moduli, moduli["epidermis"])}
    asked = {name: _named(each) for name, each in fingers.items()}
    felt = {name: jax.tree.map(np.asarray, _felt(model.solved(values), values)) for name, values in asked.items()}
    rows: list[Row] = [
        {"afferent": one.name, "quantity": quantity.replace("_", " "), "finger": finger, **told(felt[finger][quantity][index], one)}
        for index, one in enumerate(study.measurements)
        for quantity in PAPER_QUANTITIES
        for finger in fingers
    ]
    note = (
        "Scale and threshold of every row are the best for it. Correlation with the measured rates; error over the root mean square of "
        "these, and over the stated noise. A quantity that never exceeds its threshold has no correlation."
    )
    yield Table("quantities", "Four quantities, in a layered and a homogeneous finger", rows, note)
    for one in study.measurements:
        own = [row for row in rows if row["afferent"] == one.name and row["finger"] == "layered"]
        best = max(own, key=lambda row: row["correlation"])
        yield Figure(f"{study.name}: {one.name}, best correlation", best["correlation"], "1", note=best["quantity"])


def _named(moduli: Mapping[str, float]) -> dict[str, Array]:
    return {f"{layer}.modulus": jnp.asarray(value) for layer, value in moduli.items() if layer in SOFT_LAYERS}


@eqx.filter_jit
def _felt(model: Solved, values: dict[str, Array]) -> dict[str, list[Array]]:
    """Quantity -> measurement by measurement what the receptor felt."""
    return {name: list(model.predict(values, name).quantity) for name in PAPER_QUANTITIES}


def told(quantity: np.ndarray, one: Measurement) -> dict[str, float]:
    """How well the best scale and threshold on a quantity give the rates."""
    sigma = noise_of(one)[0]
    predicted = np.asarray(rate(quantity, *start(quantity, one.measured, 1 / sigma**2)))
    error = one.measured - predicted
    return {
        "correlation": float(np.corrcoef(predicted, one.measured)[0, 1]) if np.ptp(predicted) > 0 else 0.0,
        "error_share_of_data": float(np.sqrt(np.mean(error**2) / np.mean(one.measured**2))),
        "error_over_noise": float(np.sqrt(np.mean((error / sigma) ** 2))),
    }
