"""What may be written under `finger:` in a study: by which door the geometry comes in, and how it is meshed."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from .errors import InputError
from .layers import SOFT_LAYERS
from .spelling import choose_from
from .strict import Number, Positive, Strict
from .units import to_internal

PRESETS = ("monkey", "human")
BODIES = ("slab", "cylinder")  # doors behind which there is no finger
DOORS = ("preset", "sections", "images", "scan", "mesh", *BODIES)
Share = Annotated[Number, Field(gt=0, lt=1)]
Direction = tuple[Number, Number, Number]


class Nail(Strict):
    """The patch of the outer surface that is held: ranges of `z_mm` and `theta_deg`, lower end first."""

    z_mm: tuple[Number, Number]
    theta_deg: tuple[Number, Number]

    @field_validator("z_mm", "theta_deg")
    @classmethod
    def _rises(cls, ends: tuple[float, float]) -> tuple[float, float]:
        if not ends[0] < ends[1]:
            raise InputError("the range does not rise", seen=ends, remedy="write the lower end first")
        return ends

    @property
    def z(self) -> tuple[float, float]:
        """mm"""
        return self.z_mm

    @property
    def theta(self) -> tuple[float, float]:
        """rad"""
        low, high = to_internal(self.theta_deg, "deg", "angle").tolist()
        return low, high


class MeshResolution(Strict):
    """Node spacing in mm: on the pad, and at the proximal cut; under sharp indenters and at receptors it is not smaller than `least_mm`."""

    pad_mm: Positive = 0.5
    proximal_mm: Positive = 2.0
    least_mm: Positive | None = None


class BoneKeys(Strict):
    """The distal phalanx inside a measured skin: base, shaft and tuft, how long, where it ends; or its own sections."""

    width_mm: tuple[Positive, Positive, Positive] | None = None
    height_mm: tuple[Positive, Positive, Positive] | None = None
    length_mm: Positive | None = None
    end: Share | None = None
    rise: Annotated[Number, Field(ge=0, lt=0.4)] | None = None
    sections: str | None = None


class LayerKeys(Strict):
    """What is known of the inside of a finger of which images or a scan show the skin; the rest is the preset's, scaled."""

    like: Literal["human", "monkey"] = "human"
    epidermis_mm: Positive | None = None
    dermis_mm: Positive | None = None
    varies: Literal["scaled", "even"] = "scaled"
    fibrous: Share | None = None
    bone: BoneKeys = BoneKeys()


class FileKeys(Strict):
    """A file, written alone or with what it does not say itself."""

    file: str
    unit: Literal["mm", "cm", "m", "um"] = "mm"

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, said: Any) -> Any:
        return {"file": said} if isinstance(said, str) else said


class ScanKeys(FileKeys):
    """A scanned surface; `axis` points to the tip and `nail` to the nail, in the scan's own frame, both found where not given."""

    axis: Direction | None = None
    nail: Direction | None = None
    length_mm: Positive | None = None


class SlabKeys(Strict):
    """Layers of constant thickness on a floor, pressed about the middle of their upper face; those that are not named are not there."""

    radius_mm: Positive
    layers_mm: dict[str, Positive] = Field(min_length=1)
    lower: Literal["held", "sliding"] = "held"
    rim: Literal["free", "held"] = "free"

    @field_validator("layers_mm")
    @classmethod
    def _known(cls, layers: dict[str, float]) -> dict[str, float]:
        for layer in layers:
            if layer not in SOFT_LAYERS:
                raise InputError("unknown layer", place=layer, remedy=choose_from(layer, SOFT_LAYERS))
        return layers


class CylinderKeys(Strict):
    """One material, called epidermis, between two plates: a face is `held` where it sticks to its plate, `sliding` without friction.

    The upper face is the one that is pressed; held, it moves with its plate and not sideways.
    """

    diameter_mm: Positive
    height_mm: Positive
    lower: Literal["held", "sliding"]
    upper: Literal["held", "sliding"] = "sliding"


class Finger(Strict):
    """The geometry: exactly one of `preset`, `sections`, `images`, `scan`, `mesh`, or of the bodies `slab` and `cylinder`."""

    preset: str | None = None
    sections: str | None = None
    images: str | None = None
    scan: ScanKeys | None = None
    mesh: FileKeys | None = None
    slab: SlabKeys | None = None
    cylinder: CylinderKeys | None = None
    nail: Nail | None = None
    layers: LayerKeys | None = None
    resolution: MeshResolution = MeshResolution()
    mesher: Literal["columns", "nested"] = "columns"

    @model_validator(mode="after")
    def _one_door(self) -> Finger:
        said = [door for door in DOORS if getattr(self, door) is not None]
        if len(said) != 1:
            remedy = f"write exactly one of {', '.join(DOORS)}"
            raise InputError("the finger needs one geometry", seen=said, remedy=remedy)
        if self.preset is not None and self.preset not in PRESETS:
            remedy = choose_from(self.preset, PRESETS)
            raise InputError("unknown preset", place="preset", seen=self.preset, remedy=remedy)
        if self.sections is not None and self.nail is None:
            remedy = "write nail: {z_mm: [9.0, 15.0], theta_deg: [50, 130]}"
            raise InputError("nothing holds the finger: the nail is not said", remedy=remedy)
        if said[0] in BODIES and self.nail is not None:
            raise InputError(f"a {said[0]} has no nail", place="nail", remedy="take it out; lower: says how its lower face is held")
        if self.layers is not None and said[0] not in ("images", "scan"):
            problem = f"{said[0]} has layers of its own"
            raise InputError(problem, place="layers", remedy="take it out; layers are said for images and scan only")
        return self
