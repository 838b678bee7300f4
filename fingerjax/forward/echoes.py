"""The same indentation in several measurements: a force and a rate of one ramp, or the windows of one rate, need one equilibrium."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import jax
import numpy as np

from ..contact.chord import Imposed
from .model import Model

Case = tuple[int, int]  # a rig's number, and one of its cases


def firsts(model: Model, imposed: Sequence[Sequence[Imposed]]) -> list[list[Case]]:
    """Of each case of each rig the first that presses the same shape at the same place of the same tissue as far, or as hard; itself where
    none did before.

    **Arguments:** `imposed`: of each rig what is imposed in each case, effects included.
    """
    seen: dict[tuple[bytes, int, Imposed], Case] = {}
    found = []
    for number, (rig, loads) in enumerate(zip(model.instruments.rigs, imposed, strict=True)):
        poses, variants = np.asarray(rig.pose).tolist(), np.asarray(rig.variant).tolist()
        places = [_place(model, number, pose) for pose in range(len(rig.columns))]
        own = [(places[pose], variant, load) for pose, variant, load in zip(poses, variants, loads, strict=True)]
        found.append([seen.setdefault(each, (number, case)) for case, each in enumerate(own)])
    return found


def _place(model: Model, number: int, pose: int) -> bytes:
    """What tells a shape at a place: the columns that it presses on, and how."""
    rig = model.instruments.rigs[number]
    own = np.asarray(rig.columns[pose])
    parts = np.asarray(model.columns.node)[own], np.asarray(model.columns.weight)[own], *jax.tree.leaves(rig.interface)
    digest = hashlib.blake2b()
    for part in (*parts[:2], *(np.asarray(leaf[pose]) for leaf in parts[2:])):
        digest.update(f"{part.shape}{part.dtype}".encode() + np.ascontiguousarray(part).tobytes())
    return digest.digest()
