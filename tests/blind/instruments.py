"""What cameras, load cells and nerves make of what a finger does.

Each effect has a form of its own, not that of the program that is tested: power laws in time for relaxation and adaptation, two lags in a
row, a hysteresis with memory of its own, an exponential saturation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .bricks import Array
from .laboratory import Profiles
from .protocol import FINE, Elastic, Record, Sweep, Trace

Cell = Callable[[Array, Array, Array], Array]
"""(time s, travel mm, force N), all (n,) in even steps, to the force that is recorded."""

Camera = Callable[[Callable[[Array], Array], Array], Array]
"""(deflection mm of the skin at a distance mm, distances that are written down) to the deflections that are written down."""

Nerve = Callable[[Array, Array], Array]
"""(rates Hz (..., times), times s) to rates."""


@dataclass(frozen=True)
class Instruments:
    """`cells` and `cameras` act in turn; `sites` are the receptors that an afferent listens to with their weights; `nerves` act in turn on
    scale (Hz/MPa) x max(energy - threshold (MPa), 0)."""

    cells: tuple[Cell, ...] = ()
    cameras: tuple[Camera, ...] = ()
    sites: tuple[tuple[int, float], ...] = ((0, 1.0),)
    scale: float = 133300.0
    threshold: float = 1.5e-5
    nerves: tuple[Nerve, ...] = ()


def readings(found: Elastic, instruments: Instruments, records: tuple[Record, ...]) -> dict[str, Array]:
    """Readings without noise: profiles (depths, distances), traces (times,), sweeps (stimuli, positions, times)."""
    return {record.name: _reading(found, instruments, record) for record in records}


def _reading(found: Elastic, instruments: Instruments, record: Record) -> Array:
    if isinstance(record, Profiles):
        lines = found.lines[record.name]
        return np.stack([_seen(found.z, line, np.array(record.distances), instruments.cameras) for line in lines])
    if isinstance(record, Trace):
        return _recorded(record, found, instruments.cells)
    return _fired(found.energy[record.name], instruments, record)


def _seen(z: Array, line: Array, distances: Array, cameras: tuple[Camera, ...]) -> Array:
    def deflection(at: Array) -> Array:
        return along(z, line, at)

    view: Callable[[Array], Array] = deflection
    for camera in cameras:
        view = _through(camera, view)
    return view(distances)


def _through(camera: Camera, view: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda at: camera(view, at)


def along(z: Array, values: Array, at: Array) -> Array:
    """Values at `at` between nodes at z (w,): the element's own quadratic through three successive nodes."""
    start = 2 * np.clip(np.searchsorted(z[::2], at) - 1, 0, (len(z) - 3) // 2)
    places, heights = (np.stack([v[start + n] for n in range(3)]) for v in (z, values))
    total = np.zeros(len(at))
    for n in range(3):
        others = [m for m in range(3) if m != n]
        total += heights[n] * np.prod([(at - places[m]) / (places[n] - places[m]) for m in others], axis=0)
    return total


def _recorded(record: Trace, found: Elastic, cells: tuple[Cell, ...]) -> Array:
    if not cells:
        return found.force(record.name, record.travel(np.array(record.times)))
    time = record.fine
    travel = record.travel(time)
    force = found.force(record.name, travel)
    for cell in cells:
        force = cell(time, travel, force)
    return np.interp(record.times, time, force)


def _fired(energy: Array, instruments: Instruments, record: Sweep) -> Array:
    sites, weights = zip(*instruments.sites, strict=True)
    drive = energy[..., list(sites)] @ np.array(weights)
    rate = instruments.scale * np.maximum(drive - instruments.threshold, 0.0)
    times = np.array(record.times)
    rates = np.repeat(rate[..., None], len(times), axis=-1)
    for nerve in instruments.nerves:
        rates = nerve(rates, times)
    return rates


def relaxing(share: float, time_scale: float, power: float = 0.6) -> Cell:
    """Force relaxes to 1 - share of itself as (1 + t / time_scale)^-power, by superposition over the history (Fung 1972)."""

    def cell(time: Array, travel: Array, force: Array) -> Array:
        lost = share * (1.0 - (1.0 + time / time_scale) ** -power)
        steps = np.diff(force, prepend=0.0)
        return force - np.convolve(steps, lost)[: len(time)]

    return cell


def lossy(share: float, memory: float = 0.12) -> Cell:
    """On the way back the force is less by a share; the change comes within `memory` mm of travel."""

    def cell(time: Array, travel: Array, force: Array) -> Array:
        side, out = 1.0, np.empty_like(force)
        for n, step in enumerate(np.diff(travel, prepend=travel[0])):
            side += (np.sign(step) - side) * (1.0 - np.exp(-abs(step) / memory))
            out[n] = force[n] * (1.0 - share * 0.5 * (1.0 - side))
        return out

    return cell


def lagging(delay: float) -> Cell:
    """Two equal filters in a row that together are late by `delay` s."""

    def cell(time: Array, travel: Array, force: Array) -> Array:
        keep = np.exp(-FINE / (0.5 * delay))
        for _ in range(2):
            out, last = np.empty_like(force), force[0]
            for n, value in enumerate(force):
                last = keep * last + (1.0 - keep) * value
                out[n] = last
            force = out
        return force

    return cell


def offset(newtons: float) -> Cell:
    """The zero of the load cell is off."""
    return lambda time, travel, force: force + newtons


def drifting(rate: float, time_scale: float = 12.0) -> Cell:
    """The zero moves off at `rate` N/s at first, then ever more slowly."""
    return lambda time, travel, force: force + rate * time_scale * (1.0 - np.exp(-time / time_scale))


def swinging(size: float, period: float) -> Cell:
    """The zero swings by `size` N."""
    return lambda time, travel, force: force + size * np.sin(2 * np.pi * time / period)


def gaining(factor: float) -> Cell:
    """The load cell reads `factor` times the force."""
    return lambda time, travel, force: factor * force


def enlarging(share: float) -> Camera:
    """Lengths in the picture, along and across the skin, are larger than stated by a share."""
    return lambda skin, at: (1.0 + share) * skin(at / (1.0 + share))


def turned(degrees: float) -> Camera:
    """The picture is turned: points further along the finger read as lifted, and lifted points as further along."""
    slope = np.tan(np.radians(degrees))
    return lambda skin, at: skin(at + slope * skin(at)) + slope * at


def barrel(share: float, radius: float) -> Camera:
    """Lengths shrink towards the rim of the picture: by `share` at `radius` mm from the middle, as the square of the distance."""

    def camera(skin: Callable[[Array], Array], at: Array) -> Array:
        real = at * (1.0 + share * (at / radius) ** 2)
        return skin(real) * (1.0 - share * (real / radius) ** 2)

    return camera


def saturating(most: float) -> Nerve:
    """rate = most (1 - exp(-rate / most))."""
    return lambda rates, times: most * (1.0 - np.exp(-rates / most))


def bending(power: float, pivot: float = 40.0) -> Nerve:
    """rate = pivot (rate / pivot)^power, straight below a twentieth of the pivot."""

    def nerve(rates: Array, times: Array) -> Array:
        low = pivot / 20.0
        return np.where(rates > low, pivot * (np.maximum(rates, low) / pivot) ** power, rates * (low / pivot) ** (power - 1.0))

    return nerve


def humming(background: float) -> Nerve:
    """A background discharge that fades as the afferent is driven: rate + background exp(-rate / (5 background))."""
    return lambda rates, times: rates + background * np.exp(-rates / (5.0 * background))


def tiring(power: float, start: float = 0.3) -> Nerve:
    """rate x (t / start)^-power."""
    return lambda rates, times: rates * (times / start) ** -power
