"""Every reading of a study with tissue of any law: the full nonlinear equilibrium of each indentation, followed from the one before it.

The cases of a rig that share pose and material are a load path (`load_path`). Each begins with the last one's displacement, or with that
of the same case at neighbouring values.

What is read is what the linear engine reads, of another displacement: heights of the skin, and receptor strains as the symmetric part of
the displacement gradient.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import accumulate
from threading import Event, Lock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ..contact.chord import Chord, Chording, Chords, Imposed, Place
from ..contact.indentation import Contact
from ..contact.line import sharp_compliance
from ..effects.added import Added
from ..effects.records import Push
from ..fem.columns import Columns
from ..fem.condensed import AbstractCondensed, first_like
from ..fem.equilibrium import Tissue
from ..fem.tissue import AbstractTissue
from ..side_by_side import side_by_side
from .echoes import firsts
from .load_path import UNTRIED, Ended, Known, LoadPath, along
from .model import Model
from .problem import Health
from .readings import Instruments, Prediction
from .rigs import Rig
from .wiring import Values

FARTHEST = 0.2  # of a displacement: what is expected of a change of parameters is followed so far


@dataclasses.dataclass(frozen=True)
class Strained:
    """Readings of every measurement, and the equilibria behind them: for each rig and case how it ended. A warm start for the next.

    Readings of a case without an equilibrium are NaN, and `prediction.converged` is then False. `slopes`, where they were computed: (d, 3n)
    for each rig and case, the change of its displacement with each parameter.
    """

    prediction: Prediction
    cases: tuple[tuple[Ended, ...], ...]
    slopes: tuple[tuple[Float[np.ndarray, "d _"] | None, ...], ...] | None = None

    @property
    def iterations(self) -> int:
        return sum(ended.iterations for rig in self.cases for ended in rig)

    @property
    def factorisations(self) -> int:
        return sum(ended.factorisations for rig in self.cases for ended in rig)

    def after(self, change: Float[np.ndarray, " d"]) -> Strained:
        """Where the equilibria are expected after a change of the parameters, a start for them: to first order, and not far from here."""
        if self.slopes is None or not np.any(change):
            return self
        pairs = (zip(cases, slopes, strict=True) for cases, slopes in zip(self.cases, self.slopes, strict=True))
        moved = tuple(tuple(_moved(ended, None if slope is None else change @ slope) for ended, slope in pair) for pair in pairs)
        return dataclasses.replace(self, cases=moved, slopes=None)


def strained_readings(
    model: Model,
    values: Values,
    law: AbstractTissue,
    *,
    start: Strained | None = None,
    chording: Chording | None = None,
    chords: Chords | None = None,
    quantity: str = "strain_energy_density",
) -> Strained:
    """Every reading at these values of a study whose tissue follows a law; outside of compiled code.

    Load paths are followed side by side. A case without an equilibrium ends all of them: the others would be looked for long, and are of
    no use alone.

    **Arguments:** `start`, what was found at neighbouring values or of a neighbouring law. `chords`: tangents of its cases, which are
    renewed. `quantity`: what the receptor is taken to feel.
    """
    chording, chords = Chording() if chording is None else chording, Chords() if chords is None else chords
    rigs = model.instruments.rigs
    cases: list[list[Ended]] = [[UNTRIED] * len(rig.pose) for rig in rigs]
    tissues = [Tissue(model.body, law, material.lame(), model.solver) for material in model.instruments.materials(values)]
    linear = {number: _once(partial(model.solver.condense, model.body, one.lame, model.columns)) for number, one in enumerate(tissues)}
    likes = [first_like(model.body, [one.lame for one in tissues], variant)[0] for variant in range(len(tissues))]
    imposed = [impositions(model.instruments.added, rig, values) for rig in rigs]
    first, count = firsts(model, imposed), numbered(rigs)
    for variant, (tissue, like) in enumerate(zip(tissues, likes, strict=True)):
        condensed = linear[like] if like in likes[variant + 1 :] else linear.pop(like)
        own_paths, echoes = [], []
        for number, rig in enumerate(rigs):
            for pose, on_path in paths(rig, variant):
                if all(first[number][case] != (number, case) for case in on_path):
                    echoes += [(number, case) for case in on_path]
                    continue
                before = [None if start is None else start.cases[number][case] for case in on_path]
                twins = [None if like == variant else twin(rig, case, like) for case in on_path]
                warm = [before[i] if other is None else _rest(cases[number][other]) for i, other in enumerate(twins)]
                place, own = place_of(model, rig, pose, tissue)
                known = Known(chords, [count[number] + case for case in on_path], partial(Chord.of, condensed, own))
                own_paths.append(LoadPath(number, on_path, place, known, [imposed[number][case] for case in on_path], warm))
        own_paths.sort(key=lambda path: -len(path.cases))  # the longest first, so that none is left to go on alone
        lost = Event()
        found = side_by_side(partial(along, tissue=tissue, chording=chording, lost=lost), own_paths, model.solver.workers)
        for path, ends in zip(own_paths, found, strict=True):
            for case, ended in zip(path.cases, ends, strict=False):
                cases[path.rig][case] = ended
        if lost.is_set():
            break
        for number, case in echoes:
            cases[number][case] = _heard(cases, first[number][case])
    return _strained(model, values, cases, quantity)


def numbered(rigs: Sequence[Rig]) -> list[int]:
    """The number of the first case of each rig, counted through all of them."""
    return [0, *accumulate(len(rig.pose) for rig in rigs)]


def _heard(cases: list[list[Ended]], first: tuple[int, int]) -> Ended:
    """How a case ended that is another one's, for which nothing more was done."""
    rig, case = first
    return cases[rig][case]._replace(iterations=0, factorisations=0, newton=0, tangent=False)


def _moved(ended: Ended, by: np.ndarray | None) -> Ended:
    if ended.rest is None or by is None:
        return ended
    u, length = ended.rest.displacement, float(np.linalg.norm(by))
    share = 1.0 if length == 0.0 else min(1.0, FARTHEST * float(np.linalg.norm(u)) / length)
    return ended._replace(rest=ended.rest._replace(displacement=u + share * by))


def _strained(model: Model, values: Values, cases: list[list[Ended]], quantity: str) -> Strained:
    found = tuple(tuple(rig) for rig in cases)
    return Strained(_prediction(model, values, found, quantity), found)


def paths(rig: Rig, variant: int) -> Iterator[tuple[int, list[int]]]:
    """Poses of a rig, and the cases of each that a variant of the material has, in the order of what is imposed."""
    load, own, poses = np.asarray(rig.imposed), np.asarray(rig.variant) == variant, np.asarray(rig.pose)
    for pose in np.unique(poses[own]):
        cases = np.flatnonzero(own & (poses == pose))
        yield int(pose), cases[np.argsort(load[cases])].tolist()


def impositions(added: Added, rig: Rig, values: Values) -> list[Imposed]:
    """What is imposed in each case, with effects on the push.

    **Raises** `ValueError` for an effect that changes what skin is in the way.
    """
    push = _all_pushed(added, rig, {name: jnp.asarray(value, float) for name, value in values.items()})
    if not np.array_equal(push.overlap, np.asarray(rig.interface.overlap)[np.asarray(rig.pose)]):
        raise ValueError("an effect that changes what skin is in the way is not computed together with nonlinear tissue")
    each = zip(np.asarray(push.imposed).tolist(), np.asarray(push.series).tolist(), strict=True)
    return [Imposed(None, value, series) if rig.forced else Imposed(value, None, series) for value, series in each]


@eqx.filter_jit
def _all_pushed(added: Added, rig: Rig, values: dict[str, Array]) -> Push:
    """The pushes of all cases, stacked."""
    return jax.vmap(lambda pose, imposed: pushed(added, rig, pose, imposed, values))(rig.pose, rig.imposed)


def pushed(added: Added, rig: Rig, pose: Array, imposed: Array, values: Values) -> Push:
    """One push of a rig with the effects on it."""
    overlap, area = rig.interface.overlap[pose], rig.interface.area[pose]
    return added.push(Push(imposed, overlap, area, jnp.zeros(()), rig.forced, rig.context.measurement), values)


def twin(rig: Rig, case: int, variant: int) -> int | None:
    """The case of another variant under the same travel in the same pose; None where there is none, or a force is imposed."""
    same = (np.asarray(rig.variant) == variant) & (np.asarray(rig.pose) == int(rig.pose[case]))
    found = np.flatnonzero(same & (np.asarray(rig.imposed) == float(rig.imposed[case])))
    return int(found[0]) if len(found) and not rig.forced else None


def _rest(ended: Ended) -> Ended:
    """Where a case ended, as a start that asks for no stiffness of its own."""
    return ended._replace(tangent=False)


def place_of(model: Model, rig: Rig, pose: int, tissue: Tissue) -> tuple[Place, np.ndarray]:
    """Where a rig presses on a tissue in one pose, and which of the model's columns are pressed.

    What is finer than the mesh under the tip of a line gives way as its tissue does where it is hardly strained.
    """
    own = np.asarray(rig.columns[pose])
    columns = Columns(model.columns.node[own], model.columns.weight[own], model.columns.nodes)
    sharp = float(sharp_compliance(jnp.asarray(tissue.lame), rig.layer))
    return Place(columns, jax.tree.map(lambda leaf: leaf[pose], rig.interface), sharp), own


def _once(make: Callable[[], AbstractCondensed]) -> Callable[[], AbstractCondensed]:
    """Made when it is first asked for, by whichever path: those that begin warm with their own tangents need no linear body."""
    known, one_at_a_time = lru_cache(maxsize=1)(make), Lock()

    def made() -> AbstractCondensed:
        with one_at_a_time:
            return known()

    return made


def _prediction(model: Model, values: Values, cases: tuple[tuple[Ended, ...], ...], quantity: str) -> Prediction:
    every = [ended for rig in cases for ended in rig]
    errors = [ended.rest.error for ended in every if ended.rest is not None]
    health = Health(
        jnp.asarray(all(ended.rest is not None for ended in every)),
        jnp.asarray(max(ended.iterations + ended.newton for ended in every)),
        jnp.asarray(max(errors) if len(errors) == len(every) else jnp.nan),
    )
    matrix = model.columns.matrix()
    found = [rig_readings(matrix, rig, ended) for rig, ended in zip(model.instruments.rigs, cases, strict=True)]
    return _told(model.instruments, found, {name: jnp.asarray(value, float) for name, value in values.items()}, health, quantity)


def rig_readings(matrix: sp.csc_matrix, rig: Rig, cases: tuple[Ended, ...]) -> tuple[Contact, Float[Array, "cases m"]]:
    """The contacts of a rig's cases, and what every column reads under them; NaN where no equilibrium was found."""
    unknown = _unknown(rig)
    contacts = [unknown if ended.rest is None else ended.rest.contact for ended in cases]
    nothing = np.full(matrix.shape[0], np.nan)
    u = np.stack([nothing if ended.rest is None else ended.rest.displacement for ended in cases])
    read = np.full((len(u), matrix.shape[1]), np.nan)
    sound = np.isfinite(u[:, 0])
    read[sound] = (matrix.T @ u[sound].T).T
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *contacts), jnp.asarray(read)


def _unknown(rig: Rig) -> Contact:
    """The contact of which nothing is known."""
    (p, k), nan, no = rig.interface.load.shape[1:], jnp.asarray(jnp.nan), jnp.asarray(False)
    hats, none = jnp.full(k, jnp.nan), jnp.zeros(k, bool)
    return Contact(hats, jnp.full(p, jnp.nan), nan, nan, nan, nan, none, hats, jnp.asarray(0), no, no)


@eqx.filter_jit
def _told(
    instruments: Instruments, found: list[tuple[Contact, Array]], values: dict[str, Array], health: Health, quantity: str
) -> Prediction:
    return instruments.told(found, values, health, quantity)
