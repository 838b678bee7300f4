"""What a layered solid holds, told before it is meshed: volumes, and how thick its layers are."""

from __future__ import annotations

from typing import Any

import numpy as np

from fingerjax.geometry.solid import AbstractSolid
from fingerjax.layers import LAYERS, SOFT_LAYERS


def account(solid: AbstractSolid) -> dict[str, Any]:
    """Volume of every layer (mm^3), thickness of the soft ones (mm) at the centre of the pad, and their range over the shaft.

    Thickness is counted along the section's radius, where the next layer inwards has not ended.
    """
    pad = _radii(solid, np.array([solid.pad_centre]), np.array([1.5 * np.pi]))[:, 0]
    z = np.linspace(0.0, 0.9 * solid.length, 60)
    theta = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    radii = _radii(solid, np.repeat(z, len(theta)), np.tile(theta, len(z)))
    ranges = {}
    for layer, name in enumerate(SOFT_LAYERS):
        thick = (radii[layer] - radii[layer + 1])[radii[layer + 1] > 0]
        ranges[name] = (float(thick.min()), float(thick.max())) if thick.size else (float(pad[layer] - pad[layer + 1]),) * 2
    return {
        "volume": {name: solid.volume(layer) for layer, name in enumerate(LAYERS)},
        "pad": {name: float(pad[layer] - pad[layer + 1]) for layer, name in enumerate(SOFT_LAYERS)},
        "range": ranges,
    }


def _radii(solid: AbstractSolid, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
    return solid.rays(solid.surface(z, theta))[1]


def told(solid: AbstractSolid) -> list[str]:
    """The account as lines of text, then the solid's notes."""
    known = account(solid)
    lines = [f"{solid.name}: {solid.extent}"]
    for name in LAYERS:
        line = f"  {name:10s} {known['volume'][name]:9.1f} mm3"
        if name in known["pad"]:
            low, high = known["range"][name]
            line += f", {known['pad'][name]:.3f} mm at the centre of the pad, {low:.3f} to {high:.3f} mm all over"
        lines.append(line)
    return [*lines, *(f"  note: {note}" for note in solid.notes)]
