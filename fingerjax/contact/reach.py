"""The part of the skin that an indentation can reach: small pads, cut from the whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError
from .footprint import FAR, first_contact
from .pad import Pad, SkinMesh, border, of_facets, pad, renumbered
from .shape import AbstractIndenter
from .triangle import SAMPLED

NOTHING_THERE = ("weight", "full", "rim")  # what is 0 of a facet that only fills up a window
SPARE = 1.25  # soft skin bulges: it is reached this much earlier than the travel says
LEAST = 32  # hats and facets that a window is made for, at least


@dataclass(frozen=True)
class Indentation:
    """One thing that will be pressed: an indenter, its origin (x0, z0), and the largest travel, in mm."""

    indenter: AbstractIndenter
    origin: tuple[float, float]
    travel: float


def pad_for(finger: SkinMesh, indentations: Sequence[Indentation]) -> Pad:
    """The skin that any of `indentations` can reach, with a rim of facets to spare.

    **Raises:** `InputError` for an indentation that no skin is under.
    """
    whole = pad(finger)
    reached = [_reached(whole, one) for one in indentations]
    for one, facets in zip(indentations, reached, strict=True):
        if not facets.any():
            x0, x1, z0, z1 = (round(float(value), 3) for value in whole.box)
            remedy = f"bring its origin over the pad, x {x0} to {x1} and z {z0} to {z1} mm"
            shape = type(one.indenter).__name__
            raise InputError(f"the indenter ({shape}) never touches the skin", place="origin", seen=one.origin, remedy=remedy)
    chosen = np.any(reached, axis=0)
    edge = np.zeros(len(finger.nodes), bool)
    edge[np.asarray(whole.nodes)] = np.asarray(whole.edge)
    return of_facets(np.asarray(finger.nodes, float), np.asarray(whole.nodes)[np.asarray(whole.facets)[chosen]], edge)


def windows(whole: Pad, indentations: Sequence[Indentation | Sequence[Indentation]]) -> Pad:
    """One small pad for each indentation, cut from `whole` and stacked along a leading axis, for `jax.vmap`; one for several where they
    come as a list.

    `columns` says which of the whole pad's nodes each window has. Short windows are filled up with facets of
    no area, and all of them to a length with `room`.
    """
    together = [[each] if isinstance(each, Indentation) else each for each in indentations]
    cuts = [_cut(whole, np.flatnonzero(np.any([_reached(whole, one) for one in each], axis=0))) for each in together]
    arrays = [_stacked([cut[name] for cut in cuts], name in NOTHING_THERE) for name in cuts[0]]
    return jax.tree.unflatten(jax.tree.structure(whole), arrays)


def _reached(whole: Pad, one: Indentation) -> np.ndarray:
    """Facets that the indenter comes near to within its travel, and their neighbours."""
    facets, points = np.asarray(whole.facets), np.asarray(whole.points)
    at = np.einsum("sa,fai->fsi", SAMPLED, points[facets])
    margin, gap, lowest = map(np.asarray, _clearance(whole, one.indenter, jnp.asarray(np.asarray(one.origin, float)), jnp.asarray(at)))
    if not lowest < 0.5 * FAR:
        return np.zeros(len(facets), bool)
    size = np.ptp(at[..., 0], axis=1) + np.ptp(at[..., 2], axis=1)
    touched = np.any((margin > -size[:, None]) & (gap < SPARE * one.travel), axis=1)
    return np.any(np.isin(facets, facets[touched]), axis=1)


@eqx.filter_jit
def _clearance(
    whole: Pad, indenter: AbstractIndenter, origin: Float[Array, "2"], at: Float[Array, "f s 3"]
) -> tuple[Float[Array, "f s"], Float[Array, "f s"], Float[Array, ""]]:
    """The margin over each place, and the travel from first contact at which the undeformed skin there is met."""
    lowest = first_contact(whole, indenter, (origin[0], origin[1]))
    x, z = at[..., 0] - origin[0], at[..., 2] - origin[1]
    return jnp.broadcast_to(indenter.margin(x, z), x.shape), at[..., 1] - indenter.surface(x, z) - lowest, lowest


def _cut(whole: Pad, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of the pad of some facets of a pad, in the order of its fields."""
    facets, hats = np.asarray(whole.facets)[chosen], np.asarray(whole.hats)[chosen]
    columns, facets = renumbered(facets)
    kept, hats = renumbered(hats)
    open_ended = np.isin(facets[:, :3], border(facets)) & ~np.asarray(whole.edge)[columns][facets[:, :3]]
    return {
        "points": np.asarray(whole.points)[columns],
        "nodes": np.asarray(whole.nodes)[columns],
        "columns": np.asarray(whole.columns)[columns],
        "facets": facets,
        "hats": hats,
        "position": np.asarray(whole.position)[chosen],
        "weight": np.asarray(whole.weight)[chosen],
        "full": np.asarray(whole.full)[kept],
        "rim": np.isin(np.arange(len(kept)), hats[open_ended]),
        "edge": np.asarray(whole.edge)[columns],
        "box": np.asarray(whole.box),
    }


def room(count: int) -> int:
    """`count` rounded up to `LEAST` or one of four lengths between powers of two: code is compiled for each length that there is, which
    takes longer than to solve, and a pad has a few facets more or less whenever an indenter or a mesh changes a little.
    """
    count = max(count, LEAST)
    step = 2 ** max(int(count).bit_length() - 3, 0)
    return -(-count // step) * step


def filled(part: np.ndarray, length: int, value: float | None = 0) -> np.ndarray:
    """An array made longer by entries of `value`, or by its first entry where that is None."""
    more = np.broadcast_to(part[:1] if value is None else np.asarray(value, part.dtype), (length - len(part), *part.shape[1:]))
    return np.concatenate([part, more])


def _stacked(parts: list[np.ndarray], empty: bool) -> Array:
    """Arrays of different lengths along a new axis: short ones repeat their first entry, or are filled with 0 where that says `empty`."""
    longest = room(max(map(len, parts)))
    return jax.device_put(np.stack([filled(one, longest, 0 if empty else None) for one in parts]))  # asarray would compile for each shape
