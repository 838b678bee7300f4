"""The meshed fingertip that the shape floor hands upwards: nodes, tetrahedra, and what each of them is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fingerjax.layers import BONE


@dataclass(frozen=True, eq=False)
class Finger:
    """A body of quadratic (10-node) tetrahedra in millimetres: z towards the tip, nail at +y, pad at -y.

    **Arguments:**

    - `name`: what the body is called in tables.
    - `nodes`: `(n, 3)` float64, mm. Vertices and midsides; midsides of curved surfaces lie on the true
        surface.
    - `tets`: `(e, 10)` int64, four vertices and then the midsides of 01, 12, 02, 03, 13, 23 (VTK's order),
        positively oriented.
    - `layer`: `(e,)` int64, index into `fingerjax.layers.LAYERS`.
    - `skin`: `(f, 6)` int64, outer quadratic triangles, three vertices and the midsides of 01, 12, 20,
        normals outwards. The proximal cut is not skin.
    - `nail`: `(n,)` bool, nodes of the nail patch.
    - `bone`: `(n,)` bool, nodes on or inside the bone's surface (the fixed face of a test body).
    - `proximal`: `(n,)` bool, nodes on z = 0.
    - `rollers`: `(n, 3)` bool, ways along x, y, z in which nodes that are not held cannot move; None where there are none.
    - `key`: hash of everything that made the mesh.
    - `quality`: figures of `fingerjax.mesh.quality`.
    """

    name: str
    nodes: np.ndarray
    tets: np.ndarray
    layer: np.ndarray
    skin: np.ndarray
    nail: np.ndarray
    bone: np.ndarray
    proximal: np.ndarray
    key: str = ""
    quality: dict[str, Any] = field(default_factory=dict)
    rollers: np.ndarray | None = None

    def __post_init__(self) -> None:
        n, e = len(self.nodes), len(self.tets)
        shapes = {
            "nodes": (self.nodes.shape, (n, 3)),
            "tets": (self.tets.shape, (e, 10)),
            "layer": (self.layer.shape, (e,)),
            "skin": (self.skin.shape, (len(self.skin), 6)),
            "nail": (self.nail.shape, (n,)),
            "bone": (self.bone.shape, (n,)),
            "proximal": (self.proximal.shape, (n,)),
            "rollers": ((n, 3) if self.rollers is None else self.rollers.shape, (n, 3)),
        }
        for argument, (seen, wanted) in shapes.items():
            if seen != wanted:
                raise ValueError(f"Finger: {argument} has shape {seen}, wanted {wanted}")
        if self.nodes.dtype != np.float64:
            raise ValueError(f"Finger: nodes are {self.nodes.dtype}; hand in float64 coordinates")

    @property
    def vertices(self) -> np.ndarray:
        """`(n,)` bool: which nodes are corners of tetrahedra, the others being midsides."""
        mask = np.zeros(len(self.nodes), bool)
        mask[self.tets[:, :4]] = True
        return mask

    def without_bone(self) -> Finger:
        """The soft tissue alone: bone elements, and nodes that nothing else uses, are dropped.

        Nodes of the bone's surface stay and are still marked in `bone`: they are where a rigid bone holds the
        tissue.
        """
        soft = self.layer != BONE
        if soft.all():
            return self
        used = np.zeros(len(self.nodes), bool)
        used[self.tets[soft]] = True
        number = np.cumsum(used) - 1
        skin = self.skin[used[self.skin].all(axis=1)]
        return dataclasses.replace(
            self,
            nodes=self.nodes[used],
            tets=number[self.tets[soft]],
            layer=self.layer[soft],
            skin=number[skin],
            nail=self.nail[used],
            bone=self.bone[used],
            proximal=self.proximal[used],
            rollers=None if self.rollers is None else self.rollers[used],
            key=f"{self.key}-without-bone" if self.key else "",
        )
