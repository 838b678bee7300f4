"""Nodes moved with the layers: how effects that change a finger's geometry change its mesh."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from ..finger import Finger
from ..geometry.solid import AbstractSolid
from ..layers import BONE

Radii = np.ndarray  # (5, n) mm: the outer radius of every layer on each node's ray


def on_rays(finger: Finger, solid: AbstractSolid, moved: Callable[[Radii], Radii]) -> Finger:
    """Nodes carried along their rays from the section's centre, as the interfaces on both sides of each are moved; the skin stays.

    **Raises** `ValueError` where layers would cross.
    """
    centre, before = solid.rays(finger.nodes)
    away = finger.nodes[:, :2] - centre
    radius = np.linalg.norm(away, axis=1)
    before = np.minimum.accumulate(before, axis=0)
    after = moved(before)
    if (np.diff(after, axis=0) > 1e-9).any():
        raise ValueError("layers would cross")
    thickness = before[:-1] - before[1:]
    depth = np.clip((before[:-1] - radius) / np.where(thickness > 1e-9, thickness, 1.0), 0.0, 1.0)
    shift = after - before
    change = np.zeros_like(radius)
    for layer in range(BONE):
        inside = (radius <= before[layer] + 1e-9) & (radius > before[layer + 1] + 1e-9)
        change = np.where(inside, shift[layer] + depth[layer] * (shift[layer + 1] - shift[layer]), change)
    core = radius <= before[BONE] + 1e-9
    change = np.where(core, shift[BONE] * np.where(before[BONE] > 0, radius / np.where(before[BONE] > 0, before[BONE], 1.0), 0.0), change)
    scale = np.where(radius > 1e-9, (radius + change) / np.where(radius > 1e-9, radius, 1.0), 1.0)
    nodes = finger.nodes.copy()
    nodes[:, :2] = centre + away * scale[:, None]
    still = _still(finger, change)
    nodes[still] = finger.nodes[still]
    return dataclasses.replace(finger, nodes=nodes, key="")


def _still(finger: Finger, change: Float[np.ndarray, " n"]) -> Int[np.ndarray, " _"]:
    """Vertices of the skin that stay, and the middles of edges between two of them, which lie beneath the skin where straight."""
    ends, middles = finger.skin[:, [[0, 1], [1, 2], [2, 0]]], finger.skin[:, 3:]
    stays = np.abs(change) < 1e-9 * np.ptp(finger.nodes[:, 1])
    return np.concatenate([np.unique(ends[stays[ends]]), np.unique(middles[stays[ends].all(axis=2)])])
