"""What may be written in a study, key by key (DATA.md, "One study"), before it is looked at together with
its files.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from .errors import InputError
from .finger_keys import Finger
from .layers import LAYERS, SOFT_LAYERS
from .measurements import ReceptorKeys, SidecarKeys
from .spelling import choose_from
from .strict import Positive, Strict
from .study_design import DesignKeys
from .units import read_quantity

EPIDERMIS = 0.18
"""MPa: the human mean of Dandekar et al. (2003), Table 1, for a ratio model that says nothing of its
scale.
"""
POISSON_RATIO = 0.48
RIGID_BONES = ("rigid", "held")  # a piece that the tissue carries; one that does not move
RIGID_DECADES = 3


def ratio_decades(name: object) -> dict[str, int]:
    """The digits of a ratio model: `m43338` -> log10 of the moduli of the five layers, bone last.

    Only their differences mean anything (Dandekar et al. 2003, section 3). **Raises** `InputError` for any
    other text.
    """
    if not re.fullmatch(r"m\d{5}", str(name)):
        remedy = "write m and five digits, epidermis to bone, as in m43338"
        raise InputError("not the name of a ratio model", seen=name, remedy=remedy)
    return dict(zip(LAYERS, (int(digit) for digit in str(name)[1:]), strict=True))


def ratio_moduli(name: str, epidermis: float) -> dict[str, float]:
    """Moduli (unit of `epidermis`) of all five layers in the ratios of a model such as `m43338`."""
    decades = ratio_decades(name)
    return {layer: epidermis * 10.0 ** (decade - decades["epidermis"]) for layer, decade in decades.items()}


class Model(Strict):
    """The tissue: start values and what is fixed."""

    moduli_MPa: dict[str, Positive] | None = None
    ratios: str | None = None
    epidermis_MPa: Positive | None = None
    bone: Any = None
    poisson_ratio: Any = POISSON_RATIO
    receptor: ReceptorKeys | None = None

    @field_validator("moduli_MPa")
    @classmethod
    def _four_layers(cls, moduli: dict[str, float] | None) -> dict[str, float] | None:
        for layer in moduli or {}:
            if layer not in SOFT_LAYERS:
                remedy = (
                    "the bone has its own key, bone:" if layer == "bone" else choose_from(layer, SOFT_LAYERS)
                )
                raise InputError("unknown layer", place=layer, remedy=remedy)
        absent = [layer for layer in SOFT_LAYERS if moduli is not None and layer not in moduli]
        if absent:
            raise InputError(
                "a layer has no modulus", seen=absent, remedy=f"write {absent[0]}: and its modulus in MPa"
            )
        return moduli

    @field_validator("ratios")
    @classmethod
    def _five_digits(cls, name: str | None) -> str | None:
        if name is not None:
            ratio_decades(name)
        return name

    @field_validator("bone")
    @classmethod
    def _rigid_or_modulus(cls, bone: Any) -> float | str | None:
        if bone is None or bone in RIGID_BONES:
            return bone
        if isinstance(bone, str) and not bone[:1].isdigit():
            remedy = "write rigid, or held, or a modulus in MPa, or one with its unit: 17 GPa"
            raise InputError("neither rigid, held nor a modulus", seen=bone, remedy=remedy)
        modulus = read_quantity(bone, "pressure", "bone")
        if not 0 < modulus < float("inf"):
            raise InputError("a modulus that is not positive", seen=bone, remedy="write one above 0 MPa")
        return modulus

    @field_validator("poisson_ratio")
    @classmethod
    def _compressible(cls, said: Any) -> float | dict[str, float]:
        if isinstance(said, list):
            if len(said) not in (len(SOFT_LAYERS), len(LAYERS)):
                remedy = f"write one for each of {', '.join(SOFT_LAYERS)}, and of the bone if it is elastic"
                raise InputError("Poisson's ratios do not fit the layers", seen=said, remedy=remedy)
            said = dict(zip(LAYERS, said, strict=False))
        if not isinstance(said, dict):
            return _poisson_ratio(said)
        for layer in said:
            if layer not in LAYERS:
                raise InputError("unknown layer", place=str(layer), remedy=choose_from(layer, LAYERS))
        absent = [layer for layer in SOFT_LAYERS if layer not in said]
        if absent:
            raise InputError(
                "a layer has no Poisson's ratio", seen=absent, remedy=f"write {absent[0]}: and its ratio"
            )
        return {layer: _poisson_ratio(ratio, layer) for layer, ratio in said.items()}

    @model_validator(mode="after")
    def _one_source(self) -> Model:
        if (self.moduli_MPa is None) == (self.ratios is None):
            seen = [key for key in ("moduli_MPa", "ratios") if getattr(self, key) is not None]
            remedy = "write exactly one of moduli_MPa and ratios"
            raise InputError("the model needs one set of moduli", seen=seen, remedy=remedy)
        if self.epidermis_MPa is not None and self.ratios is None:
            remedy = "it sets the scale of `ratios`; moduli_MPa has its own epidermis"
            raise InputError("two moduli for the epidermis", place="epidermis_MPa", remedy=remedy)
        return self

    def moduli(self) -> dict[str, float]:
        """Start moduli in MPa of the layers, and of the bone where it is elastic.

        Of a ratio model, the epidermis is `epidermis_MPa`, or 0.18, the human mean of Dandekar et al.
        (2003), Table 1.
        """
        bone = self.bone_modulus()
        if self.ratios is not None:
            start = self.epidermis_MPa or EPIDERMIS
            soft = {layer: ratio_moduli(self.ratios, start)[layer] for layer in SOFT_LAYERS}
        else:
            soft = {layer: (self.moduli_MPa or {})[layer] for layer in SOFT_LAYERS}
        return soft if bone is None else {**soft, "bone": bone}

    def bone_modulus(self) -> float | None:
        """MPa, or None for a rigid bone.

        Not said, it is rigid; with a ratio model whose bone is less than three decades above its stiffest
        tissue, it has the modulus that the model gives it (m33333 is homogeneous all through).
        """
        if self.bone in RIGID_BONES or (self.bone is None and self.ratios is None):
            return None
        if self.bone is not None:
            return float(self.bone)
        decades = ratio_decades(str(self.ratios))
        if decades["bone"] - max(decades[layer] for layer in SOFT_LAYERS) >= RIGID_DECADES:
            return None
        return ratio_moduli(str(self.ratios), self.epidermis_MPa or EPIDERMIS)["bone"]

    def bone_kind(self) -> str:
        """`rigid` where the tissue carries the bone as one piece, `held` where it does not move, or `elastic`."""
        if self.bone_modulus() is not None:
            return "elastic"
        return self.bone or "rigid"

    def has_layered_poisson_ratio(self) -> bool:
        """Whether every layer has its own Poisson's ratio."""
        return isinstance(self.poisson_ratio, dict)

    def poisson_ratios(self) -> dict[str, float]:
        """Poisson's ratio of all five layers; the bone's is 0.48 where the layers have their own and it has
        none.
        """
        if not isinstance(self.poisson_ratio, dict):
            return dict.fromkeys(LAYERS, float(self.poisson_ratio))
        return {layer: self.poisson_ratio.get(layer, POISSON_RATIO) for layer in LAYERS}


def _poisson_ratio(value: Any, layer: str | None = None) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 0.5:
        remedy = "write a number between 0 and 0.5, both excluded; soft tissue is near 0.48"
        raise InputError("not a Poisson's ratio that can be solved", place=layer, seen=value, remedy=remedy)
    return float(value)


class Entry(Strict):
    """One file that is used: `name`, `data`, and keys that stand above its sidecar's (checked together with
    those).
    """

    name: str
    data: str
    said: dict[str, Any] = {}

    @model_validator(mode="before")
    @classmethod
    def _only_known_keys(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            raise InputError(
                "keys and values are needed here", seen=data, remedy="write {name: ..., data: ...csv}"
            )
        allowed = ["name", "data", *SidecarKeys.model_fields]
        for key in data:
            if key not in allowed:
                raise InputError("unknown key", place=str(key), remedy=choose_from(key, allowed))
        return {"said": data, **{key: data[key] for key in ("name", "data") if key in data}}

    @field_validator("name")
    @classmethod
    def _plain(cls, name: str) -> str:
        if not re.fullmatch(r"[A-Za-z_][\w-]*", name) or name in LAYERS:
            remedy = "use letters, digits, _ and -, beginning with a letter, and no layer's name"
            raise InputError("this cannot be a measurement's name", seen=name, remedy=remedy)
        return name


class BootstrapKeys(Strict):
    """Repeats of a fit: on new noise, or on cases drawn with replacement."""

    kind: Literal["parametric", "case"] = "parametric"
    repeats: int = Field(default=200, ge=20)
    seed: int = 0


class SampleKeys(Strict):
    """Samples of the posterior: `chains` of `steps` each, a run of the model for every step."""

    steps: int = Field(default=250, ge=50)
    chains: int = Field(default=4, ge=2)
    seed: int = 0


class FitKeys(Strict):
    """Which parameters move, by their names; the loss; and what is done to say how sure their values are.

    `noise`: of measurements that do not say how noisy they are, one share of their largest value, or `each` its own, estimated.
    `finer_mm`: spacings on the pad of meshes that the fit is corrected to. `workers`: how many starts are fitted at once; one for every
    two cores where nothing is said.
    """

    free: list[str] = []
    tie: list[list[str]] = []
    per: dict[str, str] = {}
    priors: dict[str, dict[str, Any]] = {}
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    starts: int = Field(default=1, ge=1, le=1024)
    workers: int | None = Field(default=None, ge=1, le=256)
    profile: bool | list[str] = False
    bootstrap: BootstrapKeys | None = None
    sample: SampleKeys | None = None
    noise: Literal["shared", "each"] = "shared"
    finer_mm: list[Positive] = []


class HoldOutKeys(Strict):
    """Rows kept from the fit: those of one measurement with one of the values in every column."""

    measurement: str
    where: dict[str, Any] = Field(min_length=1)


Share = Annotated[float, Field(ge=0.0, lt=1.0)]
FORM = {"deflection_profile": 0.01, "force_displacement": 0.01, "spike_rate": 0.1}
PLACEMENT = 0.2  # mm
NODES = 10_000
PAIRS, TOGETHER = 3, 4


class FormKeys(Strict):
    """Share of a reading that even the right model is wrong by, through geometry and laws: profiles (of the greatest deflection), forces,
    and rates (of the greatest rate).
    """

    profile: Share = FORM["deflection_profile"]
    force: Share = FORM["force_displacement"]
    rate: Share = FORM["spike_rate"]


class DiagnoseKeys(Strict):
    """Which missing effects are looked for, of all of them `without` some, on which rows the answer is tried, how good any model can be
    (`model_error`), how well the place of an afferent is known (`placement_mm`), how many nodes a mesh may have on which models are fitted
    (`nodes`), how far the catalogue is searched where no effect alone explains the data: `pairs` that are tried, effects `together` in the
    nearest model; and which effects have an amount of their own for each label of a column (`per`).
    """

    effects: Literal["all", "none"] | list[str] = "all"
    without: list[str] = []
    hold_out: list[HoldOutKeys] = []
    model_error: FormKeys = FormKeys()
    placement_mm: Annotated[float, Field(ge=0.0)] = PLACEMENT
    nodes: Annotated[int, Field(ge=500)] = NODES
    pairs: Annotated[int, Field(ge=0)] = PAIRS
    together: Annotated[int, Field(ge=1)] = TOGETHER
    per: dict[str, str] = {}

    @field_validator("effects", mode="before")
    @classmethod
    def _all_or_list(cls, effects: Any) -> Any:
        if effects is None or (isinstance(effects, str) and effects not in ("all", "none")):
            raise InputError(
                "not a choice of effects", seen=effects, remedy="write all, none, or a list of names"
            )
        return effects


class TableKeys(Strict):
    """Options of `kind: table`: rows of force and displacement, here or in a CSV, and the indenters named
    in them; `drivers` asks what a modulus changes with, on a preset finger under a flat plate.
    """

    indenters: dict[str, Any] = Field(min_length=1)
    rows: list[dict[str, Any]] = []
    data: str | None = None
    controlled: Literal["displacement", "force"] = "displacement"
    radii_mm: dict[str, list[Positive]] = {}
    drivers: bool = False

    @model_validator(mode="after")
    def _known_radii(self) -> TableKeys:
        for name in self.radii_mm:
            if name not in self.indenters:
                raise InputError("no such indenter", place="radii_mm", seen=name, remedy=choose_from(name, self.indenters))
        return self

    @model_validator(mode="after")
    def _one_source(self) -> TableKeys:
        if bool(self.rows) == (self.data is not None):
            raise InputError("the table needs one source", remedy="write rows: or data:, one of the two")
        return self


class LayerStudyKeys(Strict):
    """Options of `kind: layer_study`: which ratio models are compared, under which indenter, how deep."""

    models: list[str] = Field(min_length=2)
    depth_mm: Positive
    indenter: Any = "line"
    span_mm: Positive = 5.0
    spacing_mm: Positive = 0.25

    @field_validator("models")
    @classmethod
    def _named(cls, models: list[str]) -> list[str]:
        for name in models:
            ratio_decades(name)
        return models


class StudyKeys(Strict):
    """One study, as written."""

    version: Literal[1] = 1
    kind: Literal["fit", "table", "layer_study", "sweep", "predict"] = "fit"
    notes: str = ""
    finger: Finger
    model: Model
    measurements: list[Entry] = []
    fit: FitKeys | None = None
    diagnose: DiagnoseKeys | None = None
    design: DesignKeys | None = None
    options: dict[str, Any] | None = None
    fallback: str | None = None

    @field_validator("measurements")
    @classmethod
    def _named_once(cls, entries: list[Entry]) -> list[Entry]:
        names = [entry.name for entry in entries]
        twice = next((name for index, name in enumerate(names) if name in names[:index]), None)
        if twice is not None:
            raise InputError("two measurements have one name", seen=twice, remedy="give each its own")
        return entries

    @model_validator(mode="after")
    def _fits_its_kind(self) -> StudyKeys:
        if self.kind in ("fit", "predict") and not self.measurements:
            remedy = "write measurements: [{name: ..., data: ...csv}]"
            raise InputError(
                f"a study of kind {self.kind} needs measurements", place="measurements", remedy=remedy
            )
        if self.kind in ("fit", "predict") and self.options is not None:
            remedy = "take them out, or write kind: table, layer_study or sweep"
            raise InputError(f"a study of kind {self.kind} has no options", place="options", remedy=remedy)
        return self
