"""Bodies that several benchmarks solve on: the preset monkey, and finer ones made by cutting each of its elements into eight.

Midsides are straight and the bone is held, so that other programs can be given the same problem.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from fingerjax.fem.body import Body, Material, assemble_body, material
from fingerjax.fem.element import EDGES
from fingerjax.fem.operator import Lame
from fingerjax.finger import Finger
from fingerjax.geometry.presets import preset
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh import Resolution, build_finger
from fingerjax.mesh.topology import oriented, quadratic

COARSE, FINE = Resolution(0.5, 1.5), Resolution(0.17, 1.0)  # the paper's 8,500 and 29,000 nodes
LARGE = Resolution(0.41, 1.23)  # 105,000 nodes when cut into eight
PUSHED = 0.3  # mm above the lowest point of the pad: nodes up to there are pushed
EIGHTHS = [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]


@dataclass(frozen=True)
class Problem:
    """A body, moduli, and nodal forces on its pad (n, 3), N."""

    body: Body
    lame: Lame
    load: np.ndarray

    @property
    def unknowns(self) -> int:
        return 3 * int(np.count_nonzero(np.asarray(self.body.free)))


def finger(resolution: Resolution) -> Finger:
    """The preset monkey without its bone, midsides straight."""
    soft = build_finger(preset("monkey"), resolution).without_bone()
    nodes = soft.nodes.copy()
    nodes[soft.tets[:, 4:]] = nodes[soft.tets[:, :4]][:, EDGES].mean(axis=2)
    return dataclasses.replace(soft, nodes=nodes)


def eighths(whole: Finger) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Linear tetrahedra (8e, 4) on the nodes of quadratic ones: nodes, tets, layer, held."""
    tets = oriented(whole.nodes, whole.tets[:, EIGHTHS].reshape(-1, 4))
    return whole.nodes, tets, np.repeat(whole.layer, 8), whole.nail | whole.bone


def problem(resolution: Resolution, *, order: int = 2, refined: bool = False, model: str = "m43338", ratio: float = 0.48) -> Problem:
    """A push on the pad; `refined` cuts each element into eight, and so does `order=1`, which keeps the nodes of order 2."""
    whole = finger(resolution)
    nodes, tets, layer, held = whole.nodes, whole.tets, whole.layer, whole.nail | whole.bone
    if refined or order == 1:
        nodes, tets, layer, held = eighths(whole)
    if refined and order == 2:
        nodes, tets, pairs = quadratic(nodes, tets)
        held = np.concatenate([held, held[pairs].all(axis=1)])
    return Problem(assemble_body(nodes, tets, layer, held), moduli(model, ratio).lame(), _push(nodes, ~held))


def moduli(model: str, ratio: float = 0.48) -> Material:
    """The material of one of the paper's models, m43338 and the like: powers of ten, the epidermis of m4 at 1 MPa."""
    return material({name: 10.0 ** (int(power) - 4) for name, power in zip(SOFT_LAYERS, model[1:5], strict=True)}, ratio)


def _push(nodes: np.ndarray, free: np.ndarray) -> np.ndarray:
    load = np.zeros_like(nodes)
    load[(nodes[:, 1] < nodes[:, 1].min() + PUSHED) & free, 1] = 1e-3
    return load


def bytes_per_unknown(one: Problem) -> float:
    """What the matrix-free product reads: connectivity, layers, geometry, supports."""
    body = one.body
    read = (body.tets, body.layer, body.free, body.slopes, body.inverse_along, body.weight_along)
    return sum(jnp.asarray(each).nbytes for each in read) / one.unknowns
