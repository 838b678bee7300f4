"""The column mesh: volumes, conformity, labels and orientation on a preset and on the practice sections."""

from __future__ import annotations

import dataclasses
import math
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fingerjax import mesh
from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.forward.shape import nail_rim
from fingerjax.geometry.presets import preset
from fingerjax.geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from fingerjax.layers import BONE, LAYERS
from fingerjax.mesh import Resolution, build_finger
from fingerjax.mesh.bodies import block, sphere_shell
from fingerjax.mesh.columns import Rays, columns
from fingerjax.mesh.contour import along_nail, beyond, fairness
from fingerjax.mesh.jacobian import POINTS, WEIGHTS, determinants, relaxed, volumes
from fingerjax.mesh.quality import dihedral_angles, figures, radius_ratios, table
from fingerjax.mesh.smooth import smoothed, worst_of
from fingerjax.mesh.topology import EDGES, boundary, faces, prism_tets, quadratic, signed_volumes

DATA = Path(os.environ.get("FINGERJAX_DATA", Path(__file__).parents[2] / "shared" / "data"))
COARSE = Resolution(0.8, 1.5)  # edges half as long as the finger's radius; at 0.8 of it a mesh in six has midsides off its skin
ROUNDEST = 2.0  # mm: less than the radius of any curve that an edge of eight such meshes spans, 2.7 mm and more


COARSE_BONE = 0.05  # of its volume: edges as long as its radius, some of them straight; four meshes lost 2.0 to 3.5 per cent


@cache
def monkey() -> tuple[LayeredSolid, Finger]:
    solid = preset("monkey")
    return solid, build_finger(solid, COARSE)


def check(solid: LayeredSolid, finger: Finger) -> None:
    """What every mesh of a layered solid must be."""
    corners = finger.tets[:, :4]
    assert signed_volumes(finger.nodes, corners).min() > 0
    assert determinants(finger.nodes, finger.tets).min() > 0
    _, element, shared = faces(corners)
    # Columns meet at the axis, where on a coarse mesh two of them may have the same face; that is inside the bone, which is left out.
    assert set(np.unique(shared[finger.layer[element] != BONE])) == {1, 2}
    size = volumes(finger.nodes, finger.tets)
    for layer, name in enumerate(LAYERS):
        bar = COARSE_BONE if layer == BONE else 0.02
        assert size[finger.layer == layer].sum() == pytest.approx(solid.volume(layer), rel=bar), name
    check_surfaces(solid, finger)


def check_surfaces(solid: LayeredSolid, finger: Finger) -> None:
    skin = np.unique(finger.skin)
    off = np.abs(solid.level(0, finger.nodes[skin]))
    assert (off > 1e-6).sum() <= finger.quality.get("on_chord", 0) and off.max() < 0.1
    a, b, c = (finger.nodes[finger.skin[:, i]] for i in range(3))
    outwards = (a + b + c) / 3.0
    outwards[:, :2] -= solid.centre(outwards[:, 2])
    outwards[:, 2] -= 0.7 * outwards[:, 2]
    assert (np.einsum("fi,fi->f", np.cross(b - a, c - a), outwards) > 0).all()
    cut = boundary(finger.tets[:, :4])
    cut = cut[finger.proximal[cut].all(axis=1)]
    assert len(cut) + len(finger.skin) == len(boundary(finger.tets[:, :4]))
    assert np.abs(finger.nodes[finger.proximal, 2]).max() == 0.0
    nail = finger.nodes[finger.nail]
    assert len(nail) > 5 and np.isin(np.flatnonzero(finger.nail), skin).all()
    assert beyond(solid, nail).max() < 0.5 * np.linalg.norm(b - a, axis=1).max()


def test_a_preset_meshes_within_the_bars() -> None:
    check(*monkey())


def area(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def nail_area(solid: LayeredSolid) -> float:
    z, theta = np.linspace(*solid.nail.z, 200)[:, None], np.linspace(*solid.nail.theta, 100)[None]
    points = solid.surface(z, theta)
    across, other = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    return float(0.5 * np.linalg.norm(np.cross(across, other), axis=-1).sum())


def test_what_is_held_has_the_area_of_the_nail() -> None:
    # Six such meshes lacked up to 2 per cent of it; with edges of 5 mm, as long as the nail is wide, two of six a quarter.
    solid = preset("monkey")
    finger = build_finger(solid, Resolution(0.8, 1.2))
    held = finger.skin[finger.nail[finger.skin].all(axis=1)][:, :3]
    assert area(finger.nodes, held) == pytest.approx(nail_area(solid), rel=0.05)
    rim = np.abs(beyond(solid, finger.nodes[np.unique(held)])) < 1e-6
    assert rim.sum() >= 8


def test_a_skin_that_touches_itself_is_made_again_and_refused_in_the_end(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sound = np.array([[0, 1, 2], [2, 1, 3]])
    touching = np.array([[0, 1, 2], [2, 1, 3], [1, 2, 4], [2, 1, 5]])  # four triangles at one edge
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(mesh, "skin_triangles", lambda solid, resolution: (np.zeros((6, 3)), touching))
    monkeypatch.setattr(mesh, "smoothed", lambda rays, points, triangles: (points, triangles))
    monkeypatch.setattr(mesh, "outlined", lambda rays, points, triangles: (points, triangles))
    with pytest.raises(InputError, match="proximal_mm"):
        mesh._skin(preset("monkey"), COARSE, "refused")
    turned, reaching = sound[:1], sound[1:]
    qualities = {len(sound): 0.2, (0, 1): -1.0, (2, 1): 0.0}
    monkeypatch.setattr(
        mesh, "worst_of", lambda rays, points, triangles: qualities[tuple(triangles[0, :2]) if len(triangles) == 1 else len(triangles)]
    )

    def first(*made: np.ndarray, name: str) -> np.ndarray:
        those = iter(made)
        monkeypatch.setattr(mesh, "outlined", lambda rays, points, triangles: (points, next(those)))
        return mesh._skin(preset("monkey"), COARSE, name)["triangles"]

    np.testing.assert_array_equal(first(touching, turned, sound, name="found"), sound)
    np.testing.assert_array_equal(first(turned, touching, reaching, turned, turned, name="best"), reaching)


@pytest.mark.parametrize(("rings", "turns"), [(4, 6), (6, 6)])
def test_coarse_triangles_go_round_the_finger(rings: int, turns: int) -> None:
    # Flipped for their shape alone they reached across the finger, and cutting them left dents as deep as the bone.
    solid = preset("monkey")
    rays = Rays(solid)
    points, triangles = smoothed(rays, *skin(solid, rings, turns))
    sides = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    middle = points[sides].mean(axis=1)
    above = rays.foot(middle)
    sag = np.linalg.norm(above - middle, axis=1) / np.linalg.norm(above - rays.axis(rays.aim(above[:, 2])), axis=1)
    assert sag.max() < 0.35  # edges seen under a right angle sag by 1 - cos 45 deg = 0.29, those near the tip by a little more
    assert worst_of(rays, points, triangles) > 0.0


def test_a_coarse_finger_refined_keeps_the_volumes_of_its_layers() -> None:
    # Dents had made the epidermis of every other such mesh far too large.
    quality = build_finger(preset("monkey"), Resolution(1.5, 3.0), nail_rim(preset("monkey"), 1.2)).quality
    assert quality["on_chord"] <= 2
    for name, off in quality["volume_error"].items():
        assert abs(off) < 0.05, name


def test_triangles_are_cut_along_the_nail_and_stay_conforming() -> None:
    solid = preset("human")
    points, triangles = skin(solid, 14, 26)
    more, cut, on = along_nail(solid, points, triangles)
    assert np.abs(beyond(solid, more[on])).max() < 0.5 and on.sum() > 12
    sides = np.sort(cut[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, times = np.unique(sides, axis=0, return_counts=True)
    assert set(times) == {1, 2} and (times == 1).sum() == 26
    assert area(more, cut) == pytest.approx(area(points, triangles), rel=0.02)
    assert fairness(more, more, cut).min() > 0.05
    inside = beyond(solid, more[cut].mean(axis=1)) < 0
    assert area(more, cut[inside]) == pytest.approx(nail_area(solid), rel=0.06)


def check_on_interface(solid: LayeredSolid, finger: Finger, layer: int, nodes: np.ndarray) -> None:
    off = nodes[np.abs(solid.level(layer, finger.nodes[nodes])) > 1e-6]
    assert len(off) <= finger.quality["straightened"] <= 0.01 * len(finger.nodes)
    assert not np.isin(off, finger.tets[:, :4]).any()
    # What is left is the sag of a straight edge: how long the straightened ones are differs from mesh to mesh.
    mid, ends = finger.tets[:, 4:].ravel(), finger.tets[:, EDGES].reshape(-1, 2)
    ends = ends[[np.flatnonzero(mid == node)[0] for node in off]]
    length = np.linalg.norm(finger.nodes[ends[:, 1]] - finger.nodes[ends[:, 0]], axis=1)
    assert (np.abs(solid.level(layer, finger.nodes[off])) <= length**2 / (8 * ROUNDEST)).all()


def test_interfaces_lie_on_the_solids_own() -> None:
    """Nodes between two layers, midsides too, are on the outer surface of the inner one.

    A few midsides are pulled straight where an element would turn inside out; the mesh counts them.
    """
    solid, finger = monkey()
    of = [np.unique(finger.tets[finger.layer == layer]) for layer in range(len(LAYERS))]
    for layer in range(1, len(LAYERS)):
        check_on_interface(solid, finger, layer, np.intersect1d(of[layer - 1], of[layer]))
    np.testing.assert_array_equal(np.flatnonzero(finger.bone), of[BONE])


def test_elements_lie_in_their_layers() -> None:
    """Ten-node centroids; a straight one may fall through a curved interface."""
    solid, finger = monkey()
    weight = np.r_[np.full(4, -0.125), np.full(6, 0.25)]
    centroid = np.einsum("a,eai->ei", weight, finger.nodes[finger.tets])
    assert np.mean(solid.layer_of(centroid) == finger.layer) > 0.995


def test_the_pad_is_as_fine_as_asked() -> None:
    solid, finger = monkey()
    corners = finger.nodes[finger.skin[:, :3]]
    middle = corners.mean(axis=1)
    pad = (np.abs(middle[:, 2] - solid.pad_centre) < 1.5) & (np.abs(middle[:, 0]) < 1.5) & (middle[:, 1] < 0)
    edge = np.linalg.norm(corners[pad] - corners[pad][:, [1, 2, 0]], axis=-1)
    assert 0.7 < np.median(edge) / (2 * COARSE.pad) < 1.3


def test_without_bone_keeps_its_surface_and_nothing_loose() -> None:
    solid, finger = monkey()
    soft = finger.without_bone()
    assert set(np.unique(soft.layer)) == {0, 1, 2, 3}
    np.testing.assert_array_equal(np.unique(soft.tets), np.arange(len(soft.nodes)))
    check_on_interface(solid, soft, BONE, np.flatnonzero(soft.bone))
    np.testing.assert_allclose(soft.nodes[soft.skin], finger.nodes[finger.skin])
    assert soft.nail.sum() == finger.nail.sum()
    assert block().without_bone() is not None and len(block().without_bone().tets) == len(block().tets)


def test_quality_is_said_in_numbers_and_in_text() -> None:
    _, finger = monkey()
    quality = finger.quality
    # Thin skin, coarse mesh: an angle is a thickness over an edge, 0.17 mm over up to 3 mm on the dorsum.
    assert quality["min_dihedral_deg"] > 0.1 and quality["p1_dihedral_deg"] > 1.2
    assert quality["nodes"] == len(finger.nodes) and quality["tets"] == len(finger.tets)
    lost = {name: abs(error) for name, error in quality["volume_error"].items()}
    assert lost.pop("bone") < COARSE_BONE and max(lost.values()) < 0.02
    text = table(quality)
    assert "min_dihedral_deg" in text and "volume_error bone" in text


@pytest.mark.parametrize("case", ["plain", "nail_bed", "stiffening"])
def test_practice_sections_load_and_mesh(case: str) -> None:
    path = DATA / "practice" / case / "sections.csv"
    if not path.exists():
        pytest.skip(f"no practice data at {path}; set FINGERJAX_DATA")
    sections = Sections.from_csv(path)
    span = sections.z[-1]
    nail = Patch(z=(0.42 * span, 0.88 * span), theta=(math.radians(50), math.radians(130)))
    solid = solid_from_sections(sections, nail, case)
    check(solid, build_finger(solid, Resolution(1.2) if case == "nail_bed" else COARSE))


def skin(solid: LayeredSolid, rings: int = 12, turns: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A structured skin, so that columns are tested without the mesher of surfaces."""
    from fingerjax.mesh.surface import grid_triangles

    z = solid.length * (1.0 - np.linspace(1.0, 0.0, rings) ** 1.5)[:-1]
    points = solid.surface(z[:, None], 2 * np.pi * np.arange(turns)[None, :] / turns).reshape(-1, 3)
    tip = np.array([*solid.centre(np.array([solid.length]))[0], solid.length])
    triangles = grid_triangles(len(z), turns)
    triangles = triangles[~(triangles == len(points)).any(axis=1)]
    return np.vstack([points, tip]), np.where(triangles == len(points) + 1, len(points), triangles)


def test_a_layer_of_no_thickness_is_given_the_least_and_counted() -> None:
    solid = preset("monkey")
    radii = solid.sections.radii.copy()
    radii[:, :, 2] = radii[:, :, 1]  # no dermis
    flat = dataclasses.replace(solid, sections=dataclasses.replace(solid.sections, radii=radii))
    mesh = columns(flat, *skin(flat), thinnest=0.05)
    assert mesh.notes["thickened"] > 0
    assert signed_volumes(mesh.vertices, mesh.tets).min() > 0
    feet = mesh.feet[mesh.t == 0]
    met, _ = mesh.rays.depths(feet)
    length = np.linalg.norm(mesh.rays.axis(mesh.rays.aim(feet[:, 2])) - feet, axis=1)
    assert ((met[:, 2] - met[:, 1]) * length).min() == pytest.approx(0.05)


def test_a_finger_without_bone_at_its_cut_is_refused() -> None:
    solid = preset("monkey")
    radii = solid.sections.radii.copy()
    radii[:5, :, 4] = 0.0
    hollow = dataclasses.replace(solid, sections=dataclasses.replace(solid.sections, radii=radii))
    with pytest.raises(InputError, match="bone does not reach the proximal cut"):
        columns(hollow, *skin(hollow))


def test_reference_depths_are_interfaces_and_the_cut_stays_flat() -> None:
    solid = preset("human")
    rays = Rays(solid)
    feet = rays.foot(solid.surface(np.array([0.0, 5.0, 13.0, 22.0]), np.array([1.0, 3.0, 4.7, 6.0])))
    for layer in range(1, BONE + 1):
        assert np.abs(solid.level(layer, rays.position(feet, np.full(4, float(layer))))).max() < 1e-9
    half = rays.position(feet, np.full(4, 1.5))
    ends = rays.position(feet, np.full(4, 1.0)), rays.position(feet, np.full(4, 2.0))
    np.testing.assert_allclose(half, 0.5 * (ends[0] + ends[1]), atol=1e-12)
    assert half[0, 2] == 0.0


def test_quadrature_is_exact_to_degree_five() -> None:
    for power in np.ndindex(6, 6, 6, 6):
        if sum(power) <= 5:
            true = 6 * math.prod(math.factorial(p) for p in power) / math.factorial(sum(power) + 3)
            assert WEIGHTS @ np.prod(POINTS ** np.array(power), axis=1) == pytest.approx(true, abs=1e-15)


def test_shapes_of_known_tetrahedra() -> None:
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    both, tets = np.vstack([regular, corner]), np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    np.testing.assert_allclose(dihedral_angles(both, tets)[0], math.degrees(math.acos(1 / 3)))
    assert sorted(np.round(dihedral_angles(both, tets)[1])) == [55, 55, 55, 90, 90, 90]
    inscribed = 0.5 / (1.5 + math.sqrt(3) / 2)
    np.testing.assert_allclose(radius_ratios(both, tets), [1.0, 3 * inscribed / (math.sqrt(3) / 2)])


def test_a_midside_that_folds_its_element_is_pulled_straight() -> None:
    nodes, tets, _ = quadratic(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])
    )
    folded = nodes.copy()
    folded[tets[0, 4]] = [0.5, 0.6, 0.6]
    assert determinants(folded, tets).min() < 0
    mended, count = relaxed(folded, tets, 4)
    assert count == 6 and determinants(mended, tets).min() > 0
    untouched, count = relaxed(nodes, tets, 4)
    assert count == 0 and (untouched == nodes).all()


def test_prisms_of_any_ranking_conform() -> None:
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    vertices = np.vstack([points, points + np.array([0, 0, 1])])
    for seed in range(5):
        rank = np.random.default_rng(seed).permutation(5)
        tets = prism_tets(triangles, triangles + 5, rank=rank[triangles])
        assert np.abs(signed_volumes(vertices, tets)).sum() == pytest.approx(2.0)
        assert len(boundary(tets)) == 2 * 4 + 2 * 4


def test_bodies_have_their_volume_surface_and_supports() -> None:
    body = block((4.0, 2.0, 3.0), (4, 3, 4), grading=1.5, interfaces=(0.3,))
    assert volumes(body.nodes, body.tets).sum() == pytest.approx(24.0)
    assert determinants(body.nodes, body.tets).min() > 0
    assert set(np.unique(body.layer)) == {0, 1}
    corner = body.nodes[body.skin[:, :3]]
    normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(normal.sum(axis=0), [0.0, -12.0, 0.0], atol=1e-12)
    assert (normal[:, 1] < 0).all() and (body.nodes[body.skin][:, :, 1] == 0.0).all()
    np.testing.assert_allclose(body.nodes[body.skin[:, 3]], corner[:, :2].mean(axis=1))
    assert (body.nodes[body.bone, 1] == 2.0).all() and (body.nodes[body.proximal, 2] == 0.0).all()
    ball = sphere_shell(1.0, 2.0, n=2, shells=3)
    assert volumes(ball.nodes, ball.tets).sum() == pytest.approx(28.0 / 3.0 * np.pi, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(ball.nodes[ball.skin], axis=-1), 2.0)
    np.testing.assert_allclose(np.linalg.norm(ball.nodes[ball.bone], axis=-1), 1.0)


def test_a_wrong_finger_is_refused() -> None:
    body = block()
    with pytest.raises(ValueError, match="layer has shape"):
        dataclasses.replace(body, layer=body.layer[:-1])
    with pytest.raises(ValueError, match="float64"):
        dataclasses.replace(body, nodes=body.nodes.astype(np.float32))


def test_figures_need_no_solid() -> None:
    body = block((1.0, 1.0, 1.0), (2, 2, 2))
    assert "volume_error" not in figures(body.nodes, body.tets, body.layer)
