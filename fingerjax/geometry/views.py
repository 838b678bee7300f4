"""What stands beside the photographs of a replica: which files, turned by how much, at what scale.

A replica of the fingertip is turned about a rod and photographed from the side (Dandekar, Raju & Srinivasan
2003, section 2). The YAML file that `images:` names lies beside the pictures:

    pixel_mm: 0.025            # size of a pixel on the finger
    length_mm: 25.0            # from the tip back to the proximal cut, which becomes z = 0
    nail_deg: 0.0              # angle of the view in which the nail faces the camera
    tip: up                    # where the tip points in the pictures: up, down, left or right
    turn: counterclockwise     # how the replica turns while the angle grows, seen from its tip
    views:
      - {file: view_000.png, angle_deg: 0.0}
      - {file: view_001.png, angle_deg: 3.6}
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fingerjax.errors import InputError
from fingerjax.strict import Number, Positive, Strict, checked
from fingerjax.yamlfile import read_yaml

FEWEST = 24  # views: with fewer, a section of four or five harmonics is no longer seen
NAME = "views.yaml"  # looked for where a folder is named


class ViewKeys(Strict):
    """One photograph."""

    file: str
    angle_deg: Number


class ViewsKeys(Strict):
    """The file beside the photographs."""

    pixel_mm: Positive
    length_mm: Positive
    nail_deg: Number = 0.0
    tip: Literal["up", "down", "left", "right"] = "up"
    turn: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    synthetic: bool = False
    views: list[ViewKeys]


@dataclass(frozen=True, eq=False)
class Views:
    """Photographs of a turned replica.

    - `file`: the YAML file. `pictures`: one path for each view.
    - `angle`: `(k,)` rad, increasing, by which the replica had been turned.
    - `pixel`, `length`: mm. `nail`: rad.
    - `tip`, `turn`: as in the YAML file.
    """

    file: Path
    pictures: tuple[Path, ...]
    angle: np.ndarray
    pixel: float
    length: float
    nail: float
    tip: str
    turn: str

    @property
    def direction(self) -> np.ndarray:
        """`(k,)` rad: theta of the side of the finger that is seen at the right border, tip upwards.

        With the nail (+y) towards the camera and the tip (+z) upwards, -x is on the right.
        """
        turned = self.angle - self.nail
        return np.pi - turned if self.turn == "counterclockwise" else np.pi + turned


def read_views(path: str | os.PathLike[str]) -> Views:
    """Read the YAML file beside the photographs, or `views.yaml` in the folder named.

    **Raises** `InputError`: an unknown or absent key, a file that is not there, too few views, angles missing
    or out of order.
    """
    file = Path(path) / NAME if Path(path).is_dir() else Path(path)
    document = read_yaml(file)
    keys = checked(ViewsKeys, document.content, document.origin())
    pictures = tuple(file.parent / view.file for view in keys.views)
    for index, picture in enumerate(pictures):
        if not picture.is_file():
            raise InputError(
                "no such picture", file=file, place=f"views.{index}", seen=keys.views[index].file, remedy="paths are relative to this file"
            )
    degrees = np.array([view.angle_deg for view in keys.views], float)
    _check_angles(degrees, file)
    return Views(
        file, pictures, np.radians(degrees), keys.pixel_mm, keys.length_mm, float(np.radians(keys.nail_deg)), keys.tip, keys.turn
    )


def _check_angles(degrees: np.ndarray, file: Path) -> None:
    if len(degrees) < FEWEST:
        remedy = f"give {FEWEST} or more, about 100 once round"
        raise InputError("too few views", file=file, place="views", seen=len(degrees), remedy=remedy)
    back = np.flatnonzero(np.diff(degrees) <= 0)
    if len(back):
        at = int(back[0]) + 1
        remedy = "list the views in the order of growing angle, each once"
        raise InputError("angles are out of order", file=file, place=f"views.{at}, angle_deg", seen=float(degrees[at]), remedy=remedy)
    gaps = np.diff(np.r_[degrees, degrees[0] + 360.0])
    if gaps[-1] <= 1e-6:
        remedy = "stop short of a whole turn: 360 deg is 0 deg again"
        raise InputError("more than one turn", file=file, place="views", seen=float(degrees[-1] - degrees[0]), remedy=remedy)
    widest = int(np.argmax(gaps))
    if gaps[widest] > 2.5 * np.median(gaps) + 1e-9:
        seen = f"none for {gaps[widest]:g} deg after {degrees[widest]:g} deg"
        raise InputError("angles are missing", file=file, place="views", seen=seen, remedy="take views evenly, once all the way round")
