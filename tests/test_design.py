"""The next experiment against exact algebra, the grid against data made by one of its own models, and both through the study's door."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fingerjax.errors import InputError
from fingerjax.forward import Assembled, assemble
from fingerjax.identify import fit, profile, uncertainty
from fingerjax.identify.design import BEFOREHAND, information_of, jacobians, recommend
from fingerjax.identify.grid import grid
from fingerjax.parameters import Parameter
from fingerjax.study import Study, load_studies

from .test_forward import MODULI, PLATE, SITE, study_of
from .test_profile import X, layers, problem, straight

DENT = {"indenter": {"shape": "sphere", "radius_mm": 2.0}, "site": SITE, "noise": {"sigma": 0.01, "unit": "mm"}}
BALL = {"kind": "deflection_profile", **DENT}
FLAT = {"name": "flat", "indenter": "flat_plate", "displacement_mm": [0.4, 0.8], "site": SITE, "noise": {"sigma": 0.001, "unit": "N"}}
DESIGN = {
    "criterion": "c",
    "target": "dermis.modulus",
    "candidates": [
        FLAT,
        {**DENT, "name": "dent", "depth_mm": [0.6], "span_mm": 2, "spacing_mm": 1},
    ],
}


def rows_of(x: list[float]) -> np.ndarray:
    return np.stack([np.array(x), np.ones(len(x))], axis=1) / 0.1


CANDIDATES = {"near": rows_of([0.1]), "middle": rows_of([1.5]), "far": rows_of([6.0]), "pair": rows_of([0.1, 0.2])}


@pytest.mark.parametrize("criterion", ["D", "A", "c"])
def test_the_best_set_is_the_best_of_all(criterion: str) -> None:
    found, target = straight(), "slope" if criterion == "c" else None
    advice = recommend(found, CANDIDATES, criterion=criterion, target=target)
    assert advice.singles[0].names == advice.best[0].names
    assert [len(one.names) for one in advice.best] == [1, 2, 3]
    values = [advice.before.criterion, *(one.criterion for one in advice.best)]
    assert all(b < a for a, b in itertools.pairwise(values))
    if criterion == "c":
        assert advice.best[1].names == ("far", "far")


def test_the_predicted_interval_is_that_of_a_fit_with_the_new_data() -> None:
    found = straight()
    advice = recommend(found, CANDIDATES, criterion="c", target="slope", choose=2)
    x = np.concatenate([X, [6.0, 6.0]])
    parameters = [Parameter(name, 1.0, "1", "identity", -math.inf, math.inf) for name in ("slope", "offset")]
    again = uncertainty(fit(problem(lambda b: b[0] * x + b[1], 2.0 * x + 1.0, parameters, 0.1)))
    assert math.sqrt(advice.best[1].covariance[0, 0]) == pytest.approx(again["slope"].standard_error, rel=2e-2)
    rows = advice.intervals(advice.best[1])
    assert rows[0]["upper_after"] - rows[0]["lower_after"] == pytest.approx(2 * 1.96 * again["slope"].standard_error, rel=2e-2)
    assert advice.narrowing(advice.best[1]) < 0.5


def test_a_ratio_can_be_aimed_at() -> None:
    found = layers(lambda a, b: a + b)
    # One indentation sees the ratio, the other the product: no data have seen either alone.
    seen = {"ratio": np.array([[1.0, -1.0]]) / 0.1, "product": np.array([[1.0, 1.0]]) / 0.1}
    advice = recommend(found, seen, criterion="c", target="dermis.modulus / adipose.modulus", choose=1)
    assert advice.best[0].names == ("ratio",)
    assert advice.best[0].criterion == pytest.approx(0.01, rel=1e-2)
    assert advice.before.criterion > 10


def test_what_nothing_has_seen_is_known_to_a_factor_of_a_thousand() -> None:
    found = layers(lambda a, b: a + 0 * b, trace=0.0)
    assert 1.96 / math.sqrt(information_of(found)[1, 1]) == pytest.approx(math.log(1000.0))
    assert BEFOREHAND > 3 and profile(found, "adipose.modulus").ends == ("open", "open")


def test_many_candidates_are_exchanged() -> None:
    many = {f"at {x:.2f}": rows_of([x]) for x in np.linspace(0.1, 6.0, 90)}
    advice = recommend(straight(), many, criterion="c", target="slope")
    assert set(advice.best[2].names) == {"at 6.00"}


@pytest.mark.parametrize(
    ("said", "match"),
    [
        ({"criterion": "E"}, "unknown criterion 'E'"),
        ({"criterion": "c"}, "aims at one target"),
        ({"criterion": "D", "target": "slope"}, "aims at one target"),
        ({"criterion": "c", "target": "bone"}, "no free parameter 'bone'"),
    ],
)
def test_what_cannot_be_aimed_at_is_refused(said: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        recommend(straight(), CANDIDATES, **said)


# ---- on a finger ----


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A plate and a dent on a coarse finger, all four moduli free, and a design asked for."""
    measured = {
        "plate": (PLATE, [{"displacement_mm": d, "force_N": 0.1 * d} for d in (0.37, 0.81)]),
        "ball": (BALL, [{"depth_mm": 0.9, "distance_mm": s, "deflection_mm": 0.5} for s in (-2.6, -1.5, -0.6, 0.8, 2.3)]),
    }
    return study_of(tmp_path_factory.mktemp("small"), measured, design=DESIGN)


@pytest.fixture(scope="module")
def assembled(small: Study) -> Assembled:
    return assemble(small)


def with_readings(assembled: Assembled, moduli: dict[str, float]) -> Assembled:
    """The same finger with the model's own readings at some moduli as its data."""
    prediction = assembled.predict({f"{layer}.modulus": value for layer, value in moduli.items()})
    measured = tuple(
        dataclasses.replace(one, table={**one.table, one.value: np.asarray(reading)})
        for one, reading in zip(assembled.study.measurements, prediction.readings, strict=True)
    )
    return dataclasses.replace(assembled, study=dataclasses.replace(assembled.study, measurements=measured))


def test_the_grid_finds_the_model_that_made_the_data_and_its_scale(assembled: Assembled) -> None:
    truth = dict(zip(MODULI, (0.21, 0.021, 0.21, 0.021), strict=True))
    found = grid(with_readings(assembled, truth), (3, 4))
    assert found.best.name == "m43438" and found.best.chi2 < 1e-8
    assert found.best.moduli == pytest.approx(truth, rel=1e-6)
    assert len(found.models) == 16 and found.solves == 15
    assert found.rows(16)[-1]["chi2"] > 1.0 and "m33338 = m44448" in {row["model"] for row in found.rows(16)}


def test_what_the_grid_cannot_scale_is_refused(assembled: Assembled) -> None:
    forced = dataclasses.replace(assembled.study.measurements[0], controlled="force")
    study = dataclasses.replace(assembled.study, measurements=(forced,))
    with pytest.raises(InputError, match="the grid of ratios cannot read this measurement"):
        grid(dataclasses.replace(assembled, study=study))


def test_candidates_are_indentations_on_the_same_finger(small: Study, assembled: Assembled) -> None:
    found = fit(with_readings(assembled, MODULI).problem(), gradient_tolerance=1e-3)
    assert found.settled and small.design is not None
    seen = jacobians(small, found, small.design.candidates)
    assert {name: J.shape for name, J in seen.items()} == {"flat at 0.4 mm": (1, 4), "flat at 0.8 mm": (1, 4), "dent at 0.6 mm": (5, 4)}
    # Forces at given travel grow with the scale of all moduli, profiles do not change: slopes in logarithms add up to the reading.
    assert abs(float(seen["dent at 0.6 mm"].sum(axis=1).max())) < 1e-6 * float(np.abs(seen["dent at 0.6 mm"]).max())
    assert float(seen["flat at 0.8 mm"].sum()) > 2 * float(seen["flat at 0.4 mm"].sum()) > 0


def test_a_design_that_cannot_be_read_is_refused(small: Study, tmp_path: Path) -> None:
    written = yaml.safe_load(small.file.read_text())
    for change, match in (
        ({"target": "bone.modulus"}, "this parameter is not free"),
        ({"criterion": "D"}, "criterion c aims at one target"),
        ({"candidates": [{**FLAT, "name": "plate"}]}, "a measurement has this name"),
        ({"candidates": [{**FLAT, "depth_mm": [1.0]}]}, "a candidate needs one instrument"),
        ({"candidates": [{**FLAT, "noise": {}}]}, "a candidate needs the noise"),
    ):
        path = small.file.parent / "wrong.yaml"
        path.write_text(yaml.safe_dump({**written, "design": {**DESIGN, **change}}))
        with pytest.raises(InputError, match=match):
            load_studies(path)


def test_what_is_asked_of_a_fit_is_read(small: Study) -> None:
    written = yaml.safe_load(small.file.read_text())
    path = small.file.parent / "asked.yaml"
    asked = {"loss": "huber", "starts": 4, "profile": True, "bootstrap": {"kind": "case", "repeats": 50, "seed": 3}}
    path.write_text(yaml.safe_dump({**written, "fit": {**written["fit"], **asked}}))
    said = load_studies(path)["asked"].fit
    assert (said.loss, said.starts, said.bootstrap) == ("huber", 4, ("case", 50, 3)) and said.profile == said.free
    path.write_text(yaml.safe_dump({**written, "fit": {**written["fit"], "profile": ["bone.modulus"]}}))
    with pytest.raises(InputError, match="not free"):
        load_studies(path)
