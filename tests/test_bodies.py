"""Bodies that are no finger: exact volumes and tags of their meshes, a cylinder between plates, a slab under a punch."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from fingerjax.effects import catalogue
from fingerjax.errors import InputError
from fingerjax.fem.tissue import FiniteStrain
from fingerjax.forward import Assembled, assemble
from fingerjax.forward.balance import balances
from fingerjax.forward.strained import strained_readings
from fingerjax.geometry.account import told
from fingerjax.geometry.disc import Disc
from fingerjax.mesh.discs import disc_mesh
from fingerjax.mesh.jacobian import volumes
from fingerjax.mesh.surface import Resolution
from fingerjax.runners.subject import FingerSubject
from fingerjax.study import load_studies

SLAB = Disc("slab", 5.0, (0.0, 0.4, 2.0, 0.0))
PLATES = {"kind": "force_displacement", "indenter": "flat_plate", "noise": {"sigma": 0.01, "unit": "N"}}
E, NU = 0.07, 0.45
MODULI = dict.fromkeys(("epidermis", "dermis", "adipose", "fibrous"), E)


def study(folder: Path, finger: dict[str, Any], entry: dict[str, Any], csv: str, **more: Any) -> Assembled:
    (folder / "table.csv").write_text(csv)
    said = {
        "version": 1,
        "finger": finger,
        "model": {"moduli_MPa": MODULI, "poisson_ratio": NU},
        "measurements": [{"name": "force", "data": "table.csv", **entry}],
        "fit": {"free": ["epidermis.modulus"]},
        **more.pop("said", {}),
    }
    (folder / "study.yaml").write_text(yaml.safe_dump(said))
    (loaded,) = load_studies(folder / "study.yaml").values()
    return assemble(loaded, **more)


def cylinder(folder: Path, lower: str, upper: str, pad: float = 5.0, **more: Any) -> Assembled:
    finger = {
        "cylinder": {"diameter_mm": 50.0, "height_mm": 30.0, "lower": lower, "upper": upper},
        "resolution": {"pad_mm": pad, "proximal_mm": pad},
    }
    return study(folder, finger, PLATES, "displacement_mm,force_N\n1.0,1.0\n3.0,3.0\n", **more)


def forces(ready: Assembled) -> np.ndarray:
    found = ready.predict()
    assert bool(found.converged) and bool(found.settled) and bool(found.inside)
    return np.asarray(found.readings[0])


@pytest.mark.parametrize(
    "disc", [SLAB, Disc("cylinder", 25.0, (30.0, 0.0, 0.0, 0.0)), Disc("skin", 4.0, (0.05, 0.3, 0.0, 0.0), rim="held")]
)
def test_volumes_are_exact(disc: Disc) -> None:
    mesh = disc_mesh(disc, Resolution(0.1 * disc.outline, 0.3 * disc.outline))
    size = volumes(mesh.nodes, mesh.tets)
    assert size.min() > 0
    for layer in range(5):
        assert size[mesh.layer == layer].sum() == pytest.approx(disc.volume(layer), rel=1e-12, abs=1e-12)
    assert mesh.quality["min_dihedral_deg"] > 1.0
    assert len(mesh.nodes) < 6000


def test_faces_are_marked() -> None:
    mesh = disc_mesh(SLAB, Resolution(0.2, 1.0))
    low, high = np.isclose(mesh.nodes[:, 1], 2.4), np.isclose(mesh.nodes[:, 1], 0.0, atol=1e-12)
    assert np.array_equal(mesh.nail, low) and mesh.rollers is None and not mesh.bone.any() and not mesh.proximal.any()
    middle = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)[:, 1]
    assert np.array_equal(mesh.layer, np.where(middle < 0.4, 1, 2))
    corners = mesh.nodes[mesh.skin[:, :3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = corners.mean(axis=1) - [0.0, 1.2, 5.0]
    assert (np.einsum("fi,fi->f", normal, away) > 0).all(), "normals look outwards"
    both = disc_mesh(Disc("skin", 5.0, (0.0, 2.4, 0.0, 0.0), lower="sliding", upper="held"), Resolution(0.4, 1.0))
    assert not both.nail.any() and both.rollers is not None
    low, high = np.isclose(both.nodes[:, 1], 2.4), np.isclose(both.nodes[:, 1], 0.0, atol=1e-12)
    assert np.array_equal(both.rollers, np.column_stack([high, low, high]))
    rim = disc_mesh(Disc("skin", 5.0, (0.0, 2.4, 0.0, 0.0), rim="held"), Resolution(0.4, 1.0))
    outer = np.hypot(rim.nodes[:, 0], rim.nodes[:, 2] - 5.0)
    assert rim.nail[outer > 5.0].all() and not rim.nail[(outer < 4.7) & (rim.nodes[:, 1] < 2.3)].any()


def test_edges_are_as_long_as_was_asked() -> None:
    mesh = disc_mesh(SLAB, Resolution(0.1, 0.8))
    top = mesh.nodes[np.isclose(mesh.nodes[:, 1], 0.0, atol=1e-12)]
    away = np.unique(np.round(np.hypot(top[:, 0], top[:, 2] - 5.0), 9))
    assert away[1] == pytest.approx(0.1, rel=0.15), "nodes are half an edge apart"
    fine = disc_mesh(SLAB, Resolution(0.05, 0.4))
    assert 6 < len(fine.tets) / len(mesh.tets) < 10, "half the size is eight times as many"


def test_a_cylinder_between_frictionless_plates_is_in_uniaxial_stress(tmp_path: Path) -> None:
    ready = cylinder(tmp_path, "sliding", "sliding")
    stiffness = E * math.pi * 25.0**2 / 30.0
    np.testing.assert_allclose(forces(ready), stiffness * np.array([1.0, 3.0]), rtol=1e-8)
    for check in balances(ready.model, {}):
        assert check.ok, check


def test_multigrid_knows_faces_that_slide(tmp_path: Path) -> None:
    ready = cylinder(tmp_path, "sliding", "sliding", pad=8.0, solver="multigrid")
    stiffness = E * math.pi * 25.0**2 / 30.0
    np.testing.assert_allclose(forces(ready), stiffness * np.array([1.0, 3.0]), rtol=1e-7)
    assert int(ready.predict().iterations) < 60


@pytest.mark.slow
def test_plates_that_stick_stiffen_a_cylinder(tmp_path: Path) -> None:
    free = E * math.pi * 25.0**2 / 30.0
    one, both = (forces(cylinder(tmp_path, "held", upper, pad=3.75))[0] / free for upper in ("sliding", "held"))
    mirrored = {"cylinder": {"diameter_mm": 50.0, "height_mm": 15.0, "lower": "held"}, "resolution": {"pad_mm": 3.75, "proximal_mm": 3.75}}
    half = forces(study(tmp_path, mirrored, PLATES, "displacement_mm,force_N\n0.5,1.0\n"))[0] / free
    assert 1.0 < one < both < 1.6
    assert both == pytest.approx(half, rel=5e-3), "half a cylinder stuck to one plate is a mirror image of the other half"


def test_a_cylinder_of_large_strain_is_neo_hookean(tmp_path: Path) -> None:
    """Uniaxial stress of W = mu/2 (tr C - 3 - 2 ln J) + lam/4 (J^2 - 1 - 2 ln J) at a stretch of 0.7."""
    ready = study(
        tmp_path,
        {"cylinder": {"diameter_mm": 50.0, "height_mm": 30.0, "lower": "sliding"}, "resolution": {"pad_mm": 8.0, "proximal_mm": 8.0}},
        PLATES,
        "displacement_mm,force_N\n9.0,40.0\n",
    )
    found = strained_readings(ready.model, {}, FiniteStrain(jnp.asarray(1.0)))
    assert bool(found.prediction.converged)
    np.testing.assert_allclose(np.asarray(found.prediction.readings[0])[0], _uniaxial(0.7), rtol=1e-6)


def _uniaxial(stretch: float) -> float:
    """Force, N, of a cylinder of 50 mm, from the law at homogeneous stretch: the sides bear nothing."""
    from scipy.optimize import brentq

    lam, mu = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))

    def sideways(across: float) -> float:
        return mu * (across - 1 / across) + lam / 2 * ((stretch * across**2) ** 2 - 1) / across

    across = brentq(sideways, 0.8, 2.0)
    return -math.pi * 25.0**2 * (mu * (stretch - 1 / stretch) + lam / 2 * ((stretch * across**2) ** 2 - 1) / stretch)


@pytest.mark.slow
def test_a_punch_on_a_thick_slab_is_a_punch_on_a_half_space(tmp_path: Path) -> None:
    """F = 2 E a d / (1 - nu^2) (Boussinesq 1885); the finite slab and its mesh add some per cent, as finer meshes take them away."""
    punch = {"kind": "force_displacement", "indenter": {"shape": "flat_cylinder", "radius_mm": 0.5}, "noise": {"sigma": 0.001, "unit": "N"}}
    slab = {"radius_mm": 20.0, "layers_mm": {"dermis": 5.0, "adipose": 10.0}}
    finger = {"slab": slab, "resolution": {"pad_mm": 0.0625, "proximal_mm": 4.0}}
    exact = 2 * E * 0.5 * 0.1 / (1 - NU**2)
    found = forces(study(tmp_path, finger, punch, "displacement_mm,force_N\n0.1,0.01\n", said={"fit": {"free": ["dermis.modulus"]}}))[0]
    assert found == pytest.approx(exact, rel=0.06) and found > exact


def test_a_thin_slab_between_floor_and_plate_is_in_uniaxial_strain(tmp_path: Path) -> None:
    """Far wider than thick and held from below, it cannot spread: F = A M d / h with M = E (1 - nu) / ((1 + nu) (1 - 2 nu))."""
    finger = {"slab": {"radius_mm": 5.0, "layers_mm": {"dermis": 0.2}}, "resolution": {"pad_mm": 0.25, "proximal_mm": 0.25}}
    ready = study(tmp_path, finger, PLATES, "displacement_mm,force_N\n0.01,1.0\n", said={"fit": {"free": ["dermis.modulus"]}})
    confined = E * (1 - NU) / ((1 + NU) * (1 - 2 * NU))
    share = forces(ready)[0] / (confined * math.pi * 25.0 * 0.01 / 0.2)
    assert 0.85 < share < 1.0, "all but the rim is confined"


def test_bodies_are_told_before_they_are_meshed() -> None:
    lines = "\n".join(told(SLAB))
    assert "2.40 mm thick, radius 5.00 mm" in lines and "0.400 mm at the centre of the pad, 0.400 to 0.400 mm all over" in lines
    assert "the lower face is held" in lines


@pytest.mark.slow
def test_effects_that_a_cylinder_cannot_have_are_said_to_be_absent(tmp_path: Path) -> None:
    subject = FingerSubject(cylinder(tmp_path, "sliding", "sliding", pad=8.0), catalogue())
    for name in ("bone_offset", "bed_compliance", "nail_compliance", "epidermis_thickness", "dermis_thickness", "depth_gradient"):
        assert name in subject.absent, name
    assert "finite_strain" in subject.effects
    left = subject.columns(np.array([one.raw() for one in subject.parameters]))
    assert all(np.isfinite(each).all() for each in left.values())


def test_the_thickness_of_a_slab_follows_its_layers(tmp_path: Path) -> None:
    thicker = next(effect for effect in catalogue() if effect.name == "dermis_thickness")
    mesh = disc_mesh(SLAB, Resolution(0.2, 1.0))
    changed = thicker.shape(mesh, SLAB, {"share": 0.25})
    size = volumes(changed.nodes, changed.tets)
    assert size[mesh.layer == 1].sum() == pytest.approx(1.25 * SLAB.volume(1), rel=1e-9)
    assert size.sum() == pytest.approx(SLAB.volume(1) + SLAB.volume(2), rel=1e-9)


@pytest.mark.parametrize(
    ("finger", "words"),
    [
        ({"slab": {"radius_mm": 5.0, "layers_mm": {"skin": 1.0}}}, "unknown layer"),
        ({"slab": {"radius_mm": 5.0, "layers_mm": {}}}, "layers_mm"),
        ({"cylinder": {"diameter_mm": 5.0, "height_mm": 1.0}}, "lower"),
        ({"cylinder": {"diameter_mm": 5.0, "height_mm": 1.0, "lower": "glued"}}, "held"),
        ({"cylinder": {"diameter_mm": 5.0, "height_mm": 1.0, "lower": "held"}, "preset": "human"}, "one geometry"),
        ({"cylinder": {"diameter_mm": 5, "height_mm": 1, "lower": "held"}, "nail": {"z_mm": [0, 1], "theta_deg": [50, 130]}}, "no nail"),
    ],
)
def test_a_body_that_is_said_wrongly_is_refused(tmp_path: Path, finger: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        study(tmp_path, finger, PLATES, "displacement_mm,force_N\n1.0,1.0\n")
