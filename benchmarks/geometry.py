"""Geometry in figures: what photographs give back of a known replica, how good meshes are, how far the answers on them are from converged.

The replica is SYNTHETIC: the human preset, photographed by `fingerjax.geometry.replica`. `--quick` takes fewer views, coarser ladders and
fewer repeats, and leaves out nested shells and the table from images.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from benchmarks._parts import run_parts
from benchmarks._record import Figure, at_most
from benchmarks.slice import rows
from fingerjax.finger import Finger
from fingerjax.forward import Prediction
from fingerjax.forward.model import lay_out
from fingerjax.forward.rigs import foci, plans
from fingerjax.forward.shape import mesh_of
from fingerjax.forward.wiring import wiring
from fingerjax.geometry.borders import border
from fingerjax.geometry.outline import Outline
from fingerjax.geometry.presets import preset
from fingerjax.geometry.replica import Camera, photograph, write_views
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.geometry.silhouette import outline_from_borders
from fingerjax.geometry.views import Views
from fingerjax.layers import BONE, LAYERS
from fingerjax.mesh import PAPER, Focus, Resolution, build_finger, ladder
from fingerjax.mesh.jacobian import POINTS, gradients
from fingerjax.mesh.nested import straddling
from fingerjax.mesh.quality import dihedral_angles
from fingerjax.report.records import Context, StudyResult
from fingerjax.runners import RUNNERS
from fingerjax.study import Study, load_studies

PAD, DORSUM = (200.0, 340.0), (20.0, 160.0)  # deg
PAGE = Path(__file__).resolve().parent.parent / "docs" / "geometry.md"
BUILD_LIMIT = {"monkey": 40.0, "human": 40.0, "monkey fine": 180.0}  # s
COARSE = Resolution(1.5, 2.0)  # of the first rung of the ladder: the third has nine times its triangles, and three elements through a layer
TABLE = """
version: 1
studies:
  known:
    {kind: table, finger: {preset: human, RESOLUTION}, MODEL, OPTIONS}
  images:
    {kind: table, finger: {images: replica, RESOLUTION}, MODEL, OPTIONS}
"""
RESOLUTION = "resolution: {pad_mm: 0.9, proximal_mm: 2.7}"
MODEL = "model: {ratios: m43338, epidermis_MPa: 0.18}"
OPTIONS = """options: {indenters: {point: {shape: point, radius_mm: 0.25}, flat_plate: {shape: flat_plate}}, rows: [
      {indenter: point, subject: 1, force_gf: 5.29, displacement_mm: 1.0, epidermis_modulus_MPa: 0.28},
      {indenter: flat_plate, subject: 1, force_gf: 23.59, displacement_mm: 1.0, epidermis_modulus_MPa: 0.21}]}"""
PRESSED = """
version: 1
kind: predict
finger: {preset: monkey, resolution: {pad_mm: 0.5, proximal_mm: 1.5}}
model: {ratios: m43338, epidermis_MPa: 0.14, receptor: {depth_mm: 0.75, z_mm: Z, theta_deg: 270}}
measurements: [{name: line, data: line.csv}, {name: plate, data: plate.csv}, {name: profile, data: profile.csv}, {name: bar, data: bar.csv}]
"""
TABLES = {
    "line.csv": "displacement_mm,force_N\n0.8,0.1\n",
    "plate.csv": "displacement_mm,force_N\n0.8,0.1\n",
    "profile.csv": "depth_mm,distance_mm,deflection_mm\n" + "".join(f"0.8,{x},0.1\n" for x in (0.25, 0.5, 1.0, 2.0, 3.0)),
    "bar.csv": "position_mm,depth_mm,rate_Hz\n0.0,0.8,10\n1.5,0.8,10\n",
}
LINE = "indenter: {shape: line, width_mm: 0.05, along: x}\n"
SIDECARS = {
    "line.yaml": "kind: force_displacement\n" + LINE,
    "plate.yaml": "kind: force_displacement\nindenter: {shape: flat_plate}\n",
    "profile.yaml": "kind: deflection_profile\ndirection: z\n" + LINE,
    "bar.yaml": "kind: spike_rate\ndirection: z\nindenter: {shape: bar, width_mm: 3.0, edge_radius_mm: 0.1}\n",
}


def built(quick: bool) -> Iterator[Figure]:
    """The paper's meshes, made anew and timed."""
    with own_cache():
        yield from meshes(quick)


def repeated(quick: bool) -> Iterator[Figure]:
    """Meshes of one solid, made anew."""
    with own_cache():
        yield from scatter(3 if quick else 5)


@contextmanager
def own_cache() -> Iterator[None]:
    """An empty folder for meshes, so that each is built here and timed."""
    before = os.environ.get("FINGERJAX_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FINGERJAX_CACHE"] = folder
        try:
            yield
        finally:
            os.environ.pop("FINGERJAX_CACHE")
            if before is not None:
                os.environ["FINGERJAX_CACHE"] = before


def replicas(quick: bool) -> Iterator[Figure]:
    """Radius found less radius known, on the pad and on the dorsum, at sections that crowd towards the tip."""
    aligned = "SYNTHETIC; noise, blur, 40 % light gradient, 1.5 deg roll, 0.3 mm offset"
    for count in (40,) if quick else (100, 40):
        pad, dorsum = replica_errors(count, Camera())
        limit = 0.005 if count == 100 else 0.015
        yield at_most(f"replica, {count} views: pad, rms", rms(pad), "mm", limit, aligned)
        if count == 100:
            yield at_most(f"replica, {count} views: pad, max", float(np.abs(pad).max()), "mm", 0.03, aligned)
            yield at_most(f"replica, {count} views: dorsum, rms", rms(dorsum), "mm", 0.02, aligned)
    pad, dorsum = replica_errors(40, Camera(elevation=1.5))
    yield Figure("replica, 40 views, camera 1.5 deg above the axis too: pad, rms", rms(pad), "mm")
    yield Figure("replica, 40 views, camera 1.5 deg above the axis too: pad, max", float(np.abs(pad).max()), "mm")


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def replica_errors(count: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """mm, on the pad and on the dorsum, of the human preset photographed from so many sides."""
    solid = preset("human")
    turned = np.arange(count) * 2 * np.pi / count
    borders, width = [], 0
    for number, angle in enumerate(turned):
        picture = photograph(solid, float(angle), camera, seed=number)
        borders.append(border(picture.astype(float), 255.0))
        width = picture.shape[1]
    views = Views(Path("synthetic"), (), turned, camera.pixel, solid.length, 0.0, "up", "counterclockwise")
    outline, _ = outline_from_borders(borders, views, width)
    return tuple(_radius_error(outline, solid, camera.eccentric, part) for part in (PAD, DORSUM))  # type: ignore[return-value]


def _radius_error(outline: Outline, solid: LayeredSolid, shift: float, degrees: tuple[float, float]) -> np.ndarray:
    theta = np.radians(np.arange(*degrees, 1.0))
    centre = solid.centre(outline.z) + np.array([shift, 0.0])
    return outline.radii(centre, theta) - solid.radius(0, outline.z[:, None], theta[None, :])


def meshes(quick: bool) -> Iterator[Figure]:
    """Volumes, straddling, shapes and build times of the paper's meshes, built anew."""
    for name, resolution in PAPER.items():
        if quick and name == "monkey fine":
            continue
        began = time.perf_counter()
        finger = build_finger(preset(name.split()[0]), resolution)
        seconds = time.perf_counter() - began
        yield from mesh_figures(f"{name}, columns", preset(name.split()[0]), finger)
        yield at_most(f"{name}, columns: build time", seconds, "s", BUILD_LIMIT[name], f"{len(finger.nodes)} nodes")
    with pressed_monkey() as study:
        solid = preset("monkey")
        yield from mesh_figures("monkey, refined for line, receptor and nail", solid, mesh_of(study, solid, _foci(study, solid)))
    if not quick:
        began = time.perf_counter()
        finger = build_finger(preset("monkey"), Resolution(1.0), mesher="nested")
        seconds = time.perf_counter() - began
        yield from mesh_figures("monkey, nested", preset("monkey"), finger)
        yield Figure("monkey, nested: build time", seconds, "s", note=f"{len(finger.nodes)} nodes, pad spacing 1.0 mm")


def mesh_figures(name: str, solid: LayeredSolid, finger: Finger) -> Iterator[Figure]:
    error = finger.quality["volume_error"]
    worst = max((layer for layer in LAYERS[:BONE]), key=lambda layer: abs(error[layer]))
    yield at_most(f"{name}: worst layer volume", 100 * abs(error[worst]), "%", 1.0, worst)
    yield at_most(f"{name}: bone volume", 100 * abs(error["bone"]), "%", 3.0)
    soft = finger.layer < BONE
    over = straddling(solid, finger.nodes, finger.tets[soft][:, :4], finger.layer[soft])
    note = "corners beyond a tenth of the layer; soft tissue"
    yield at_most(f"{name}: elements that straddle an interface", 100 * over, "%", 0.5, note)
    angle = dihedral_angles(finger.nodes, finger.tets[:, :4]).min(axis=1)
    yield Figure(f"{name}: worst dihedral angle", float(angle.min()), "deg", note=f"1 % below {np.quantile(angle, 0.01):.2f}")
    condition = conditions(finger)
    yield Figure(f"{name}: worst condition of an element's map", float(condition.max()), "1", note=f"median {np.median(condition):.1f}")


def conditions(finger: Finger) -> np.ndarray:
    """Largest over smallest singular value of dx/dxi, from the regular element, the worst of the quadrature points, `(e,)`."""
    regular = np.array([[1.0, 0.5, 0.5], [0.0, np.sqrt(0.75), np.sqrt(1 / 12)], [0.0, 0.0, np.sqrt(2 / 3)]])
    slope = np.einsum("qai,eaj->eqji", gradients(POINTS), finger.nodes[finger.tets], optimize=True) @ np.linalg.inv(regular)
    size = np.linalg.svd(slope, compute_uv=False)
    return np.asarray((size[..., 0] / size[..., 2]).max(axis=1))


@dataclasses.dataclass(frozen=True)
class Answers:
    """What the monkey's finger answers on one mesh: forces of line and plate, deflections beside the line, SED under a bar."""

    nodes: int
    line: float
    plate: float
    profile: np.ndarray
    density: np.ndarray

    @classmethod
    def on(cls, study: Study, solid: LayeredSolid, finger: Finger) -> Answers:
        prediction: Prediction = lay_out(study, solid, finger, wiring(study)).predict()
        if not bool(prediction.converged & prediction.settled):
            return cls(len(finger.nodes), math.nan, math.nan, np.full(5, math.nan), np.full(2, math.nan))
        line, plate, profile, _ = (np.asarray(one) for one in prediction.readings)
        return cls(len(finger.nodes), float(line[0]), float(plate[0]), profile, np.asarray(prediction.quantity[3]))

    def numbers(self) -> dict[str, float]:
        """By name."""
        return {
            "line-load force": self.line,
            "plate force": self.plate,
            "deflection 1 mm beside the line": float(self.profile[2]),
            "SED at the receptor, bar's middle": float(self.density[0]),
            "SED at the receptor, bar's edge": float(self.density[1]),
        }


@contextmanager
def pressed_monkey() -> Iterator[Study]:
    """The study that convergence and scatter are told of."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in {**TABLES, **SIDECARS}.items():
            (Path(folder) / name).write_text(text)
        (Path(folder) / "pressed.yaml").write_text(PRESSED.replace("Z,", f"{preset('monkey').pad_centre:.2f},"))
        yield load_studies(Path(folder) / "pressed.yaml")["pressed"]


def _foci(study: Study, solid: LayeredSolid) -> tuple[Focus, ...]:
    return foci(plans(study.measurements, solid, wiring(study)), solid, study.finger.resolution.pad_mm)


def convergence(quick: bool) -> Iterator[Figure]:
    """Forces and SED along a ladder of meshes whose edges are once, twice and three times as short, under the line as well."""
    solid = preset("monkey")
    with pressed_monkey() as study:
        focus = _foci(study, solid)
        steps = (1, 2) if quick else (1, 2, 3)
        rungs = [Answers.on(study, solid, ladder(solid, step, COARSE, tuple(_finer(one, step) for one in focus))) for step in steps]
        paper = Answers.on(study, solid, mesh_of(study, solid, focus))
    sizes = ", ".join(str(rung.nodes) for rung in rungs)
    for name in rungs[0].numbers():
        values = np.array([rung.numbers()[name] for rung in rungs])
        told = "; ".join(f"{value:.5g}" for value in values)
        if quick:
            yield Figure(f"ladder: {name}, last step", 100 * (values[1] / values[0] - 1), "%", note=f"{told} on {sizes} nodes")
            continue
        order, limit, doubt = extrapolated(values)
        yield Figure(f"ladder: {name}, observed order", order, "1", note=f"{told} on {sizes} nodes")
        unit = "N" if "force" in name else "mm" if "mm" in name else "MPa"
        yield Figure(f"ladder: {name}, extrapolated", limit, unit, note=f"+- {doubt:.2g}")
        error = 100 * (paper.numbers()[name] / limit - 1)
        yield Figure(f"discretisation error at the paper's resolution: {name}", error, "%", note=f"{paper.nodes} nodes")


def _finer(focus: Focus, step: int) -> Focus:
    return dataclasses.replace(focus, size=2.5 * focus.size / step)


def extrapolated(values: np.ndarray) -> tuple[float, float, float]:
    """Order p, limit F and its error, of F_h = F + C h^p at h = 1, 1/2, 1/3; NaN order where the three do not fall that way.

    The error is the distance from the finest, or of the extrapolation at order 1 and at 3, whichever is less.
    """
    first, last = values[0] - values[1], values[1] - values[2]

    def misfit(p: float) -> float:
        return (1.0 - 2.0**-p) * last - (2.0**-p - 3.0**-p) * first

    def limit(p: float) -> float:
        return float(values[2] - last * 3.0**-p / (2.0**-p - 3.0**-p))

    if first * last <= 0 or misfit(0.2) * misfit(8.0) > 0:
        spread = float(np.abs(np.diff(values)).max())
        return math.nan, float(values[2]), spread
    order = float(brentq(misfit, 0.2, 8.0))
    return order, limit(order), min(abs(limit(order) - values[2]), abs(limit(1.0) - limit(3.0)))


def scatter(count: int) -> Iterator[Figure]:
    """How far answers differ between meshes of one solid at the paper's resolution, made again from the start."""
    solid = preset("monkey")
    with pressed_monkey() as study:
        focus = _foci(study, solid)
        found = [Answers.on(study, solid, mesh_of(study, solid, focus, repeat=number)) for number in range(count)]
    note = f"standard deviation over {count} meshes of {min(a.nodes for a in found)} to {max(a.nodes for a in found)} nodes"
    note += "; limited by one element through each layer, and by elements along the rim of the nail"
    for name in found[0].numbers():
        values = np.array([each.numbers()[name] for each in found])
        goal = 3.0 if "SED" in name else 1.0
        yield at_most(f"mesh-to-mesh scatter: {name}", 100 * float(values.std(ddof=1) / abs(values.mean())), "%", goal, note)


def table_from_images(quick: bool) -> Iterator[Figure]:
    """Moduli of two rows of Table 1 on the finger that images show, against those on the preset itself."""
    if quick:
        return
    with tempfile.TemporaryDirectory() as folder:
        write_views(Path(folder) / "replica", preset("human"))
        text = TABLE
        for key, said in {"RESOLUTION": RESOLUTION, "MODEL": MODEL, "OPTIONS": OPTIONS}.items():
            text = text.replace(key, said)
        (Path(folder) / "experiments.yaml").write_text(text)
        studies = load_studies(Path(folder) / "experiments.yaml")
        results = {name: RUNNERS["table"](study, Context(Path(folder))) for name, study in studies.items()}
    yield from _compared(results)


def _compared(results: dict[str, StudyResult]) -> Iterator[Figure]:
    known, images = (rows(results[name], "moduli") for name in ("known", "images"))
    for one, other in itertools.zip_longest(known, images):
        if one is None or other is None:
            yield Figure("Table 1 from images", math.nan, "%", "<= 2", False, "not converged")
            continue
        error = 100 * abs(other["our_epidermis_modulus_MPa"] / one["our_epidermis_modulus_MPa"] - 1)
        note = f"{other['our_epidermis_modulus_MPa']:.4g} MPa, {one['our_epidermis_modulus_MPa']:.4g} on the preset; SYNTHETIC replica"
        note += "; two meshes, limited by their scatter"
        yield at_most(f"Table 1 from images: modulus under the {one['indenter']}, off the preset's by", error, "%", 2.0, note)


def page(figures: Sequence[Figure]) -> str:
    """The figures as a page."""
    lines = [("what", "value", "goal", "on what"), ("---", "---:", "---", "---")]
    for one in figures:
        unit = "" if one.unit == "1" else f" {one.unit}"
        goal = "" if one.goal is None else f"{one.goal}: {'met' if one.met else 'NOT MET'}"
        lines.append((one.figure, f"{one.value:.3g}{unit}", goal, one.note))
    return TEXT.format(table="\n".join(f"| {' | '.join(line)} |" for line in lines))


TEXT = """# Geometry: how exact the doors are, and how far answers are from converged

The replica is synthetic: the human preset, photographed by `fingerjax.geometry.replica`. Ladders and scatter are of the monkey preset,
with layers in the ratios of m43338: a line of 0.05 mm across the finger and a plate 0.8 mm deep, a bar of 3 mm 0.8 mm deep over a
receptor 0.75 mm below the skin, where the dermis ends; on an interface a receptor is read in the outer layer. A finger whose bone hangs
from the nail is meshed more finely along the nail's rim, where most of the error in forces is. Written by
`python -m benchmarks.geometry --write`.

{table}

- The discretisation error at the paper's resolution is systematic: coarse meshes are too stiff. A modulus fitted to one force on such
  a mesh is too low by as much. It is not part of any stated interval.
- Mesh-to-mesh scatter comes on top: pytetwild does not make the same mesh twice. Meshes are kept, so a study repeats itself; two
  studies on two meshes differ by this much.
- Silhouettes crowd their sections towards the tip, and errors are taken over all of them.
"""


PARTS = {"replica": replicas, "meshes": built, "convergence": convergence, "scatter": repeated, "images": table_from_images}

if __name__ == "__main__":
    run_parts(PARTS, __doc__, (PAGE, page))
