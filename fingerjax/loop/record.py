"""What a diagnosis leaves behind, name for name as it is written to `report.json`.

Undefined numbers are NaN here and null there; a field whose name in the file is no name in Python has it as its `key`. Every class is
one object of the file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


def plain(said: Any) -> Any:
    """A record as JSON has it: dictionaries, lists, numbers, text; what is no number is None."""
    if dataclasses.is_dataclass(said) and not isinstance(said, type):
        return {one.metadata.get("key", one.name): plain(getattr(said, one.name)) for one in dataclasses.fields(said)}
    if isinstance(said, Mapping):
        return {str(key): plain(value) for key, value in said.items()}
    if isinstance(said, (list, tuple)):
        return [plain(value) for value in said]
    if isinstance(said, np.ndarray):
        return plain(said.tolist())
    if isinstance(said, (bool, np.bool_)):
        return bool(said)
    if isinstance(said, (int, np.integer)):
        return int(said)
    if isinstance(said, (float, np.floating)):
        return float(said) if math.isfinite(said) else None
    return said


@dataclass(frozen=True)
class Condition:
    """One load case: its rows, the most repeats of any of them, and what it was used for."""

    id: str
    role: str
    n: int
    replicates: int


@dataclass(frozen=True)
class NoiseRecord:
    """`source`: `replicates`, `stated` or `assumed`; `allows`: what may be said with it, in a sentence."""

    source: str
    sigma_by_block: dict[str, float]
    nu: float
    trial_terms: dict[str, dict[str, float]]
    outliers: int = field(metadata={"key": "outlier_weights_lt_0.5"})
    source_by_block: dict[str, str] = field(default_factory=dict)
    allows: str = ""


@dataclass(frozen=True)
class DataRecord:
    """The rows in short; `hash` changes with any measured number."""

    id: str
    hash: str
    kind: str
    conditions: list[Condition]
    noise: NoiseRecord


@dataclass(frozen=True)
class MeshRecord:
    """`gate`: `passed`, `failed` or `not checked`.

    `misfit`: the squared misfit beyond the noise alone; `as_corrected`: what an error as large as the correction would make of it;
    `as_first_order`: what an error leaves that falls with the first power of the element size, at least that; `alike`: the share of the
    misfit that looks like that error; `drowned`: what is expected to be left of the error would make, were it not counted as noise. NaN
    where the mesh was not checked.
    """

    lambda_mesh: float
    theta_shift_sd: dict[str, float]
    rho: float
    gate: str
    misfit: float = math.nan
    as_corrected: float = math.nan
    as_first_order: float = math.nan
    alike: float = math.nan
    drowned: float = math.nan
    nodes: int | None = None
    h: float | None = None
    finer_nodes: int | None = None


@dataclass(frozen=True)
class ModelRecord:
    version: str
    mesh: MeshRecord
    contact: dict[str, Any]


@dataclass(frozen=True)
class ParameterRecord:
    """One base parameter in its own unit. `sd` and `mesh_sd` are of the natural value; `ci` is the 95 % interval."""

    value: float
    unit: str
    sd: float
    profile_ci: tuple[float, float]
    mesh_sd: float
    ci: tuple[float, float]
    at_limit: str | None = None


@dataclass(frozen=True)
class EffectRecord:
    """One effect as fitted, in its own unit."""

    value: float
    unit: str
    ci: tuple[float, float]
    family: str


@dataclass(frozen=True)
class LackOfFit:
    """p values of the tests of adequacy; of the last, whether kinds of measurement agree on an explanation, NaN where it is not asked."""

    omnibus_p: float
    smooth_p: float
    maxT_p: float
    agreement_p: float = math.nan


@dataclass(frozen=True)
class ErrorRecord:
    """Root mean square error over the root mean square of the data; by block: role -> the same, and `noise`, the noise over it."""

    fit: float
    veto: float
    report: float
    by_block: dict[str, dict[str, float]]


@dataclass(frozen=True)
class BaseRecord:
    theta: dict[str, ParameterRecord]
    rss: float
    df: float
    grad_rel: float
    lof: LackOfFit
    error: ErrorRecord
    converged: bool = True
    reason: str = ""


@dataclass(frozen=True)
class Rival:
    """The effect that would be named next, and its score."""

    family: str
    z: float


@dataclass(frozen=True)
class RefitRecord:
    phi: dict[str, float]
    ci: dict[str, tuple[float, float]]
    rss: float
    delta: float
    bic: float
    log_evidence: float
    lof: LackOfFit
    best_rival: Rival | None
    veto_dchi2: float
    eta: float
    converged: bool
    in_set: bool
    reason: str


@dataclass(frozen=True)
class PairRecord:
    """Two effects at once, or more: who, and how the model fits with them."""

    families: list[str]
    refit: RefitRecord


@dataclass(frozen=True)
class CandidateRecord:
    """`times_form`: how many times what any model is wrong by the expected change of the prediction is, where it is most so."""

    family: str
    columns: list[str]
    null: dict[str, float]
    bound: dict[str, tuple[float, float]]
    prior_sd: dict[str, float]
    fraction_left: float
    mde: float
    z: float
    p_adj: float
    epc: dict[str, float]
    theta_shift: dict[str, float]
    testable: bool
    reason: str
    refit: RefitRecord | None
    unit: str = ""
    acts_on: str = ""
    times_form: float = math.nan


@dataclass(frozen=True)
class CriticalRecord:
    """`n_boot` null sets were sent through the same code; `null_fp_measured` of them were rejected."""

    alpha: float
    maxT: float
    n_columns: int
    effective_tests: float
    null_fp_measured: float
    n_boot: int


@dataclass(frozen=True)
class Confusable:
    a: str
    b: str
    cos: float
    lambda_needed: float


@dataclass(frozen=True)
class NextExperiment:
    """`d2_now`, `d2_after`: the least squared distance of any two effects that are still possible; `pairs`: of each two, after."""

    condition: str
    replicates: int
    d2_now: float
    d2_after: float
    pairs: dict[str, float]


@dataclass(frozen=True)
class Absorbed:
    """An effect that these data cannot tell from a change of the base parameters, and of which."""

    family: str
    combination: str


@dataclass(frozen=True)
class VerdictRecord:
    kind: str
    families: list[str]
    share_explained: float
    remainder_p: float
    absorbed: list[Absorbed]
    text: str
    held_out_p: float | None = None


@dataclass(frozen=True)
class AfterRecord:
    """`alongside`: effects that may come with those that were found, which the intervals count."""

    theta: dict[str, ParameterRecord]
    phi: dict[str, EffectRecord]
    error: ErrorRecord
    theta_change_sd: dict[str, float]
    interval_kind: str
    alongside: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Nearest:
    """Where nothing explains the data: the effects that bring the model nearest, none of them named, and what it says with them."""

    families: list[str]
    share_explained: float
    after: AfterRecord


@dataclass(frozen=True)
class Unexplained:
    """The residual as a picture. `gp`: block -> amplitude, length, `mean` and `band` of each of its rows, in the block's unit;
    `share`: by block, by condition and by coordinate; `symmetry`: block -> share of the misfit that is odd about the middle;
    `spectrum`: block -> autocorrelation of neighbours and the wavelength that stands out.
    """

    gp: dict[str, dict[str, Any]]
    share: dict[str, dict[str, float]]
    symmetry: dict[str, float]
    spectrum: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Planted:
    """An effect put into made-up data at a multiple of what they could just show; `rank` 1 is the first."""

    family: str
    size_in_mde: float
    found: bool
    rank: int


@dataclass(frozen=True)
class BlockRows:
    """The rows of one measurement, for pictures."""

    unit: str
    coordinates: dict[str, list[float]]
    measured: list[float]
    sigma: list[float]
    before: list[float]
    after: list[float]
    condition: list[str]
    role: list[str]
    nearest: list[float] | None = None


@dataclass(frozen=True)
class Diagnosis:
    """All that the loop found. `record()` is what `report.json` holds under `loop`."""

    data: DataRecord
    model: ModelRecord
    base: BaseRecord
    candidates: list[CandidateRecord]
    critical: CriticalRecord
    explanations: list[str] = field(metadata={"key": "set"})
    confusable: list[Confusable]
    next_experiment: list[NextExperiment]
    verdict: VerdictRecord
    after: AfterRecord
    unexplained: Unexplained | None
    planted: list[Planted]
    seed: int
    runtime_s: float
    rows: dict[str, BlockRows]
    nearest: Nearest | None = None
    pairs: list[PairRecord] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """The diagnosis as JSON has it."""
        return plain(self)
