"""Effects with an amount of their own for each subject, instrument or session."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from loop_toy import FAMILIES, Toy, predicted

from fingerjax.errors import InputError
from fingerjax.loop.apart import Apart
from fingerjax.loop.diagnosis import diagnose

OFFSET = "force_offset.offset"
CELLS = {"point": 0.008, "plate": -0.006}  # N, of each instrument's own load cell


class TwoCells(Toy):
    """Forces of point and plate, each with another zero."""

    def _truth(self):
        exact, blocks = predicted(np.exp([one.raw() for one in self.parameters]) / 1.3, self.truth), _blocks_of_one_repeat()
        for name, zero in CELLS.items():
            exact[blocks[name]] += zero
        return exact


def _blocks_of_one_repeat():
    return Toy(stated=True).rows.blocks


def few(*names):
    return tuple(family for family in FAMILIES if family.name in names)


def by_block(toy):
    return Apart(toy, {"force_offset": toy.rows.block})


def raw_of(toy):
    return np.array([one.raw() for one in toy.parameters])


def test_every_label_has_its_own_number_of_the_effect():
    apart = by_block(Toy())
    family = next(one for one in apart.families if one.name == "force_offset")
    assert [one.key for one in family.columns] == [f"{OFFSET}[{name}]" for name in ("line", "point", "plate", "bar")]
    assert len(family.variants) == 1  # they enter together
    assert {one.name for one in apart.families} == {one.name for one in FAMILIES}


def test_rows_see_the_amount_of_their_own_label():
    toy = Toy()
    apart, raw = by_block(toy), raw_of(toy)
    found = apart.evaluate(raw, {f"{OFFSET}[point]": 0.02, f"{OFFSET}[plate]": -0.01, "camera_scale.scale": 0.03}, ())
    with_all = [toy.evaluate(raw, {OFFSET: size, "camera_scale.scale": 0.03}, ()).prediction for size in (0.02, -0.01, 0.0)]
    for name, expected in zip(("point", "plate", "line", "bar"), (*with_all, with_all[2]), strict=True):
        np.testing.assert_array_equal(found.prediction[toy.rows.blocks[name]], expected[toy.rows.blocks[name]])


def test_slopes_are_those_of_differences():
    toy = Toy()
    apart, raw = by_block(toy), raw_of(toy)
    at = {f"{OFFSET}[point]": 0.02, f"{OFFSET}[plate]": -0.01, "contact_offset.offset": 0.03}
    keys = tuple(at)
    here = apart.evaluate(raw, at, keys)
    for number, key in enumerate(keys):
        step = 1e-6
        ends = [apart.evaluate(raw, at | {key: at[key] + way * step}, ()).prediction for way in (1, -1)]
        np.testing.assert_allclose(here.phi_jacobian[:, number], (ends[0] - ends[1]) / (2 * step), atol=1e-6)
    moved = [apart.evaluate(raw + way * 1e-6 * np.eye(len(raw))[1], at, ()).prediction for way in (1, -1)]
    np.testing.assert_allclose(here.theta_jacobian[:, 1], (moved[0] - moved[1]) / 2e-6, atol=1e-6)


def test_amounts_that_are_alike_are_found_once():
    toy = Toy()
    apart, raw = by_block(toy), raw_of(toy)
    same = {f"{OFFSET}[{name}]": 0.02 for name in toy.rows.blocks}
    before = toy.evaluations
    found = apart.evaluate(raw, same, tuple(same))
    assert toy.evaluations == before + 1
    shared = toy.evaluate(raw, {OFFSET: 0.02}, (OFFSET,))
    np.testing.assert_array_equal(found.prediction, shared.prediction)
    np.testing.assert_array_equal(found.phi_jacobian.sum(axis=1), shared.phi_jacobian[:, 0])


def test_as_many_amounts_as_rows_have_labels_are_found_in_so_many_evaluations():
    toy = Toy(repeats=40)
    apart, raw = Apart(toy, {"force_offset": toy.rows.trial}), raw_of(toy)
    before = toy.evaluations
    apart.evaluate(raw, {f"{OFFSET}[{trial}]": 1e-4 * (1 + trial) for trial in range(40)}, ())
    assert toy.evaluations == before + 40


def test_the_mesh_is_asked_with_each_rows_own_amount():
    toy = Toy(mesh=0.05)
    apart, raw = by_block(toy), raw_of(toy)
    finer = apart.finer(raw, {f"{OFFSET}[point]": 0.02})
    for name in toy.rows.blocks:
        own = toy.finer(raw, {OFFSET: 0.02 if name == "point" else 0.0})
        np.testing.assert_array_equal(finer[toy.rows.blocks[name]], own[toy.rows.blocks[name]])
    assert by_block(Toy()).finer(raw, {}) is None


def test_two_load_cells_with_their_own_zeros_are_told_by_these_and_by_no_shared_one():
    toy = TwoCells(families=few("force_offset", "contact_offset", "camera_scale", "apparatus_compliance"))
    own = diagnose(by_block(toy), sets=0)
    assert (own.verdict.kind, list(own.verdict.families)) == ("attributed", ["force_offset"])
    sizes = own.record()["after"]["phi"]
    for name, zero in CELLS.items():
        low, high = sizes[f"{OFFSET}[{name}]"]["ci"]
        assert low <= zero <= high and low * high > 0
    assert diagnose(toy, sets=0).verdict.kind == "unexplained"


def test_an_effect_that_the_subject_does_not_have_is_refused():
    with pytest.raises(InputError, match="force_offset"):
        Apart(dataclasses.replace(Toy(), families=few("contact_offset")), {"force_offset": Toy().rows.block})
