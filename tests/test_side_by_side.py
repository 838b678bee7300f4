"""Independent work on several threads: in order, no more begun after a failure, and the same factorisations as one after another."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from fingerjax.contact.chord import Chording, tangent_chord
from fingerjax.fem.equilibrium import Tissue
from fingerjax.fem.tissue import Exponential, FiniteStrain
from fingerjax.forward import Assembled, load_path, strained, strained_slopes
from fingerjax.forward.strained import place_of, strained_readings
from fingerjax.side_by_side import processors, side_by_side

from .test_bodies import PLATES, cylinder

HERE, TIGHT = jnp.array([0.07, 1.0, 8.0]), Chording(tolerance=1e-10)


def of(at):
    """Modulus, MPa, homotopy and stiffening."""
    return {"epidermis.modulus": at[0]}, Exponential(FiniteStrain(at[1]), jnp.full(5, at[2]))


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    """Two load paths: between the plates, and under a sphere."""
    folder = tmp_path_factory.mktemp("cylinder")
    (folder / "other.csv").write_text("displacement_mm,force_N\n0.5,1.0\n1.0,3.0\n1.5,3.0\n")
    ball = PLATES | {"name": "ball", "data": "other.csv", "indenter": {"shape": "sphere", "radius_mm": 20.0}}
    both = [PLATES | {"name": "force", "data": "table.csv"}, ball]
    return cylinder(folder, "held", "held", pad=8.0, said={"measurements": both})


def test_results_come_in_the_order_of_the_items_though_all_run_at_once() -> None:
    meet = threading.Barrier(3, timeout=20)

    def work(item: int) -> tuple[int, int]:
        meet.wait()  # would never end one after another
        return item, max(pool["num_threads"] for pool in threadpool_info())

    before = [pool["num_threads"] for pool in threadpool_info()]
    assert side_by_side(work, [3, 1, 2], workers=3) == [(3, 1), (1, 1), (2, 1)]
    assert [pool["num_threads"] for pool in threadpool_info()] == before


@pytest.mark.parametrize("workers", [1, 2])
def test_what_one_raises_is_raised_and_no_more_are_begun(workers: int) -> None:
    begun = []

    def work(item: int) -> int:
        begun.append(item)
        if item == 0:
            raise ZeroDivisionError("the first")
        time.sleep(0.005)
        return item

    with pytest.raises(ZeroDivisionError, match="the first"):
        side_by_side(work, list(range(1000)), workers)
    assert len(begun) < 1000


def test_no_more_processors_are_used_than_openmp_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert processors() == 1
    monkeypatch.setenv("OMP_NUM_THREADS", "several")
    some = processors()
    monkeypatch.setenv("OMP_NUM_THREADS", "100000")
    assert processors() == some >= 1


def test_tangents_of_one_body_are_factorised_and_asked_on_several_threads_at_once(ready: Assembled) -> None:
    model = ready.model
    values, law = of(HERE)
    tissue = Tissue(model.body, law, model.instruments.materials(values)[0].lame(), model.solver)
    place, _ = place_of(model, model.instruments.rigs[0], 0, tissue)
    random = np.random.default_rng(4)
    bent = [1e-3 * random.normal(size=model.body.nodes.size) for _ in range(8)]
    load = np.asarray(model.body.moves * jnp.ones((model.body.nodes.shape[0], 3))).ravel()

    def answered(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chord = tangent_chord(tissue, place, u)
        assert chord is not None
        linear = model.solver.condense(model.body, tissue.lame, model.columns)  # between the strained ones, as a path may ask for it
        return chord(load), np.asarray(linear.held.matrix)

    alone = [answered(u) for u in bent]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(answered, bent))
    for (one, matrix), (other, its) in zip(alone, together, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-9 * np.abs(one).max())
        np.testing.assert_array_equal(its, matrix)
    assert np.abs(alone[0][0] - alone[1][0]).max() > 1e-6 * np.abs(alone[0][0]).max()  # they are different tangents


def test_paths_and_slopes_are_the_same_however_many_are_followed_at_once(ready: Assembled, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for workers in (1, 3):
        for module in (strained, strained_slopes):
            monkeypatch.setattr(module, "side_by_side", lambda work, items, _, workers=workers: side_by_side(work, items, workers))
        known = strained_readings(ready.model, *of(HERE), chording=TIGHT)
        rows, _ = strained_slopes.strained_slopes(ready.model, of, HERE, known)
        found.append((np.concatenate([np.asarray(each) for each in known.prediction.readings]), np.asarray(rows)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-7 * np.abs(one).max())


def test_a_path_without_an_equilibrium_ends_those_beside_it(ready: Assembled, monkeypatch: pytest.MonkeyPatch) -> None:
    found, begun = load_path._found, []

    def without(tissue, place, chord, imposed, *rest):
        begun.append(imposed)
        return (load_path.UNTRIED, chord) if imposed.travel == 0.5 else found(tissue, place, chord, imposed, *rest)

    monkeypatch.setattr(load_path, "_found", without)
    monkeypatch.setattr(strained, "side_by_side", lambda work, items, _: side_by_side(work, items, 1))
    known = strained_readings(ready.model, *of(HERE), chording=TIGHT)
    assert not bool(known.prediction.health.converged)
    assert [imposed.travel for imposed in begun] == [0.5]  # of the longest path; the other is not begun
    assert all(ended.rest is None for rig in known.cases for ended in rig)
