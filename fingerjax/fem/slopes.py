"""How readings change with the material, under the forces that contacts ended with.

    C = B' K^-1 B        dC f = - B' K^-1 dK u,   u = K^-1 B f

One product with the stiffness and one more answer for each indentation and each way in which the material can move, however many columns
there are. Where all constants move in proportion the answer is known, K u being the load itself, and materials in proportion share theirs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .body import Body
from .condensed import PROPORTIONAL, AbstractCondensed, Fields
from .operator import Lame, internal_force


@eqx.filter_jit
def _products(body: Body, directions: Float[Array, "d 2 layers"], u: Fields) -> Float[Array, "d k nodes 3"]:
    return jax.lax.map(lambda lame: jax.lax.map(lambda each: internal_force(body, lame, each), u), directions)


def slopes(
    condensed: AbstractCondensed, body: Body, forces: Float[Array, "k m"], directions: Float[Array, "d 2 layers"]
) -> Float[np.ndarray, "k d m"]:
    """How readings, mm, change with the material under given column forces, N, per MPa along each direction of the Lame parameters."""
    k, d = len(forces), len(directions)
    if k * d == 0:
        return np.zeros((k, d, forces.shape[1]))
    turn, times = _towards_all(body, condensed.held.lame, directions)
    turned, known = jnp.tensordot(jnp.asarray(turn), directions, 1), 0 if times is None else 1
    found = np.zeros((d, k, forces.shape[1]))
    if times is not None:
        found[0] = -np.asarray(forces @ condensed.held.matrix) / times
    if d > known:
        moved = _products(body, turned[known:], condensed.displacement(forces))
        found[known:] = -np.asarray(condensed.readings(moved.reshape(-1, *moved.shape[2:]))).reshape(d - known, k, -1)
    return np.einsum("ij,ikm->kjm", turn, found)


def _towards_all(body: Body, lame: Lame, directions: Float[Array, "d 2 layers"]) -> tuple[Float[np.ndarray, "d d"], float | None]:
    """A rotation (d, d) of the directions, and how many times the first of the turned ones all Lame parameters together are; None for that
    where these are no combination of the directions.

    Springs that do not follow the moduli hold the body too: then the load is not all due to these.
    """
    d, layers = len(directions), np.unique(np.asarray(body.layer))
    ways, whole = np.asarray(directions)[:, :, layers].reshape(d, -1), np.asarray(lame)[:, layers].ravel()
    share = np.linalg.lstsq(ways.T, whole, rcond=None)[0]
    held = body.springs is not None and body.springs.stay
    if held or np.linalg.norm(share @ ways - whole) > PROPORTIONAL * np.linalg.norm(whole):
        return np.eye(d), None
    turn = np.linalg.qr(np.column_stack([share, np.eye(d)]))[0].T
    return turn, float(turn[0] @ share)


def slopes_of_all(
    bodies: Sequence[AbstractCondensed], body: Body, forces: Sequence[Float[Array, "_ m"]], directions: Float[Array, "variants d 2 layers"]
) -> list[Float[np.ndarray, "_ d m"]]:
    """`slopes` of several materials, each under its own forces: what bodies in proportion have in common is solved once."""
    found: list[np.ndarray] = [np.zeros(0)] * len(bodies)
    for members in _in_proportion(bodies, np.asarray(directions)):
        each = [np.asarray(forces[variant]) / times for variant, times, _ in members]
        pushed, which = distinct(np.concatenate(each))
        leader = members[0][0]
        moved = slopes(bodies[leader].unscaled[0], body, jnp.asarray(pushed), directions[leader])[which]
        ends = np.cumsum([len(one) for one in each])[:-1]
        for (variant, times, turn), part in zip(members, np.split(moved, ends), strict=True):
            found[variant] = np.einsum("ij,kjm->kim", turn, part) / times
    return found


Member = tuple[int, float, Float[np.ndarray, "d d"]]


def _in_proportion(bodies: Sequence[AbstractCondensed], directions: Float[np.ndarray, "variants d 2 layers"]) -> Iterator[list[Member]]:
    """Groups of materials: how many times each is as stiff as one body, and its directions in those of the group's first."""
    flat, left = directions.reshape(*directions.shape[:2], math.prod(directions.shape[2:])), list(range(len(bodies)))
    while left:
        leader, group = left[0], []
        for variant in left:
            (like, times), turn = bodies[variant].unscaled, flat[variant] @ flat[leader].T
            if like is bodies[leader].unscaled[0] and np.allclose(turn @ flat[leader], flat[variant], rtol=0.0, atol=PROPORTIONAL):
                group.append((variant, times, turn))
        left = [variant for variant in left if variant not in {member for member, _, _ in group}]
        yield group


def distinct(rows: Float[np.ndarray, "k m"]) -> tuple[Float[np.ndarray, "u m"], Int[np.ndarray, " k"]]:
    """Forces without repeats, and which of these each row is: one indentation is often read by several measurements."""
    kept: list[int] = []
    which = np.zeros(len(rows), int)
    for number, row in enumerate(rows):
        size = np.linalg.norm(row)
        same = [place for place, other in enumerate(kept) if np.linalg.norm(rows[other] - row) <= PROPORTIONAL * size]
        which[number] = same[0] if same else len(kept)
        kept += [] if same else [number]
    return rows[kept], which
