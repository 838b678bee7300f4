"""The bone lies nearer to the nail, or to the pad, than was said."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..finger import Finger
from ..geometry.solid import AbstractSolid
from ..layers import BONE
from .effect import Amount, Effect, Size

SKIN = 2  # dermis and epidermis stay where they are


class BoneOffset(Effect):
    """The bone moves as one piece; tissue between it and the dermis follows in proportion."""

    name = "bone_offset"
    acts_on = "finger"
    leaves = "Deep and flat indentations feel the bone too late or too early; shallow and sharp ones do not notice."
    confused_with = "the moduli of adipose tissue and fibrous matrix, strain_stiffening."
    parameters = (Size("dorsal", "mm", 0.4, -1.0, 1.0),)

    def lacking(self, finger: Finger) -> str | None:
        return None if finger.bone.any() else "the body has no bone"

    def shape(self, finger: Finger, solid: AbstractSolid, amount: Amount) -> Finger:
        dorsal = float(amount["dorsal"])
        if dorsal == 0.0:
            return finger
        centre, radii = solid.rays(finger.nodes)
        radius, outer, inner = np.linalg.norm(finger.nodes[:, :2] - centre, axis=1), radii[SKIN], radii[BONE]
        share = np.clip((outer - radius) / np.maximum(outer - inner, 1e-9), 0.0, 1.0)
        share = np.where(finger.bone, 1.0, share)
        nodes = finger.nodes.copy()
        nodes[:, 1] += dorsal * share
        return dataclasses.replace(finger, nodes=nodes, key="")
