"""A study's fingertip before it is computed on: the layered solid behind whichever door it came in by, and its mesh."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..finger import Finger
from ..finger_keys import LayerKeys
from ..geometry.disc import Disc
from ..geometry.layers import LayerPlan, layered
from ..geometry.outline import Outline
from ..geometry.presets import preset
from ..geometry.scan import Frame, outline_from_scan
from ..geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from ..geometry.silhouette import outline_from_views
from ..geometry.solid import AbstractSolid
from ..geometry.views import Views, read_views
from ..layers import SOFT_LAYERS
from ..mesh import Focus, Resolution, build_finger
from ..mesh.cache import Arrays, content_key, kept
from ..mesh.discs import disc_mesh
from ..mesh.imported import read_mesh
from ..mesh.refine import TIP_GROWTH
from ..study import Study

SILHOUETTE = "silhouette 1"  # part of every key: raise it when the same pictures would give another outline
COARSEST = 1.6  # of the resolution that was asked for
EVEN = 2.0  # largest node spacing over the pad's, of an even mesh
EVEN_WEDGE = 5.0  # of the spacing under a wedge: there hardly finer than on the pad, or it would have most of an even mesh's nodes
ROUND = 4.0  # node spacings to a finger's largest radius, at least, of an even mesh
RIM = 2.0 / 3.0  # of the coarsest spacing: nodes along the rim of the nail
EVEN_RIM = 0.8  # of the pad's spacing: the same of an even mesh
Tell = Callable[[float, str], object]


def unheard(share: float, what: str) -> None:
    """Tells nobody."""


def solid_of(study: Study, tell: Tell = unheard) -> AbstractSolid:
    """The study's fingertip, or other body, before it is meshed; `tell(share, what)` hears of the progress on its images.

    **Raises** `InputError` for whatever is wrong with the files behind the door.
    """
    body = _body(study)
    return _fingertip(study, tell) if body is None else body


def _body(study: Study) -> Disc | None:
    """The body that is no finger; None where it is one."""
    if (slab := study.finger.slab) is not None:
        thickness = tuple(float(slab.layers_mm.get(layer, 0.0)) for layer in SOFT_LAYERS)
        return Disc(study.name, slab.radius_mm, thickness, lower=slab.lower, rim=slab.rim)  # type: ignore[arg-type]
    if (cylinder := study.finger.cylinder) is not None:
        height = (cylinder.height_mm, 0.0, 0.0, 0.0)
        return Disc(study.name, 0.5 * cylinder.diameter_mm, height, lower=cylinder.lower, upper=cylinder.upper)
    return None


def _fingertip(study: Study, tell: Tell) -> LayeredSolid:
    finger, nail = study.finger, _nail(study)
    if finger.preset is not None:
        solid = preset(finger.preset)
        return solid if nail is None else dataclasses.replace(solid, nail=nail)
    if finger.sections is not None:
        assert nail is not None  # the door has checked
        return solid_from_sections(Sections.from_csv(_there(study.sections, finger.sections)), nail, study.name)
    if finger.mesh is not None:
        return read_mesh(_there(study.shape, finger.mesh.file), nail, finger.mesh.unit, study.name)[1]
    return layered(_outline(study, tell), _plan(study), nail, study.name)


def mesh_of(
    study: Study, solid: AbstractSolid, focus: tuple[Focus, ...] = (), size: float = 1.0, even: bool = False, repeat: int = 0
) -> Finger:
    """The mesh of a study's fingertip. One that was made elsewhere is taken as it is, whatever the indenters ask for, and so are bodies
    of rings and levels. `repeat` asks for another mesh of the same solid.

    A bone that only tissue holds hangs from the nail, and forces depend on the rim where the nail lets the skin go as much as on the skin
    under the indenter: there such a finger is refined as well. Elements `size` times as large are coarser first of all under wedges, where
    most of them are, for elsewhere they must follow the bone. An `even` mesh is hardly coarser far from the pad, finer still along the rim
    of the nail, hardly finer under wedges, and its elements scale alike: errors of two such meshes differ by what their element sizes say.
    Under the tip of a probe they are never larger than it is, or it would touch no node.
    """
    said = study.finger
    if said.mesh is not None:
        return read_mesh(_there(study.shape, said.mesh.file), _nail(study), said.mesh.unit, study.name)[0]
    if isinstance(solid, Disc):
        pad, proximal = size * said.resolution.pad_mm, size * said.resolution.proximal_mm
        return disc_mesh(solid, Resolution(pad, max(pad, proximal)))
    assert isinstance(solid, LayeredSolid), "a finger's surfaces come from its sections"
    everywhere, wedge = (size, EVEN_WEDGE * size) if even else (min(size, COARSEST), size * max(size, 1.0))
    pad, coarsest = said.resolution.pad_mm, said.resolution.proximal_mm
    resolution = Resolution(everywhere * pad, everywhere * (min(coarsest, EVEN * pad) if even else coarsest))
    if even:  # as round as a finger must be to be meshed at all
        round_ = solid.largest_radius / ROUND
        resolution = Resolution(min(resolution.pad, round_), min(resolution.coarsest, EVEN * round_))
    focus = tuple(part for one in focus for part in _coarser(one, wedge if one.kind == "line" else size))
    if study.model.bone_kind() == "rigid":
        focus += nail_rim(solid, size * EVEN_RIM * pad if even else RIM * resolution.coarsest)
    return build_finger(solid, resolution, focus, said.mesher, repeat)


def _coarser(focus: Focus, size: float) -> tuple[Focus, ...]:
    """Elements `size` times as large there; where a probe of that extent could then fall between nodes, with smaller ones at its tip."""
    coarse = dataclasses.replace(focus, size=focus.size * size)
    if focus.kind == "line" or focus.extent is None or coarse.size <= max(focus.size, focus.extent):
        return (coarse,)
    tip = dataclasses.replace(focus, kind="tip", size=max(focus.size, focus.extent), growth=TIP_GROWTH)
    return (tip,) if focus.kind == "tip" else (coarse, tip)


def nail_rim(solid: LayeredSolid, spacing: float) -> tuple[Focus, ...]:
    """Refinement along the four sides of the nail."""
    (low, high), (right, left) = solid.nail.z, solid.nail.theta
    middle, top = 0.5 * (low + high), 0.5 * (right + left)
    wide = 0.5 * (left - right) * float(solid.radius(0, np.array([middle]), np.array([right]))[0])
    across = [Focus("line", z, top, spacing, wide, "x", growth=1.0) for z in (low, high)]
    return (*across, *(Focus("line", middle, theta, spacing, 0.5 * (high - low), "z", growth=1.0) for theta in (right, left)))


def _nail(study: Study) -> Patch | None:
    nail = study.finger.nail
    return None if nail is None else Patch(nail.z, nail.theta)


def _there(path: Path | None, written: str) -> Path:
    """A file of the data folder may be missing until here."""
    if path is None:
        raise InputError("the finger's file is not there", seen=written, remedy="name the data folder with --data")
    return path


def _outline(study: Study, tell: Tell) -> Outline:
    finger = study.finger
    if finger.scan is not None:
        said = finger.scan
        return outline_from_scan(_there(study.shape, said.file), Frame(said.axis, said.nail, said.length_mm), said.unit)
    assert finger.images is not None  # the last door
    views = read_views(_there(study.shape, finger.images))
    return _outline_of(kept(f"{_key(views)}-outline", lambda: _arrays(outline_from_views(views, tell))))


def _key(views: Views) -> str:
    """What the pictures and the file beside them hold."""
    hashed = hashlib.sha256(views.file.read_bytes())
    for picture in views.pictures:
        hashed.update(picture.read_bytes())
    return content_key(SILHOUETTE, hashed.hexdigest())


def _arrays(outline: Outline) -> Arrays:
    return {
        "z": outline.z,
        "curves": np.concatenate(outline.curves),
        "lengths": np.array([len(curve) for curve in outline.curves]),
        "apex": outline.apex,
        "notes": np.frombuffer(json.dumps(outline.notes).encode(), np.uint8),
    }


def _outline_of(arrays: Arrays) -> Outline:
    curves = tuple(np.split(arrays["curves"], np.cumsum(arrays["lengths"])[:-1]))
    notes = tuple(json.loads(arrays["notes"].tobytes().decode()))
    return Outline(arrays["z"], curves, arrays["apex"], notes)


def _plan(study: Study) -> LayerPlan:
    said = study.finger.layers or LayerKeys()
    if said.bone.sections is not None:
        _there(study.bone, said.bone.sections)
    return LayerPlan(
        like=said.like,
        epidermis=said.epidermis_mm,
        dermis=said.dermis_mm,
        varies=said.varies,
        fibrous=said.fibrous,
        bone_width=said.bone.width_mm,
        bone_height=said.bone.height_mm,
        bone_length=said.bone.length_mm,
        bone_end=said.bone.end,
        rise=said.bone.rise,
        bone_sections=study.bone,
    )
