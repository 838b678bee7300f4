"""Effects that differ between subjects, instruments or sessions: an amount of their own for each label that rows have.

Rows of one label know nothing of the amounts of another, so that the model with amounts that differ is the model with each of them in
turn, of which every row takes its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..errors import InputError
from ..spelling import choose_from
from .subject import NONE, AbstractSubject, Column, Evaluation, Family, Proposal

Part = tuple[Bool[np.ndarray, "rows"], dict[str, float]]  # rows, and the amounts that they see


class Apart(AbstractSubject):
    """A subject of which some effects have an amount for each label: `offset` of `contact_offset` becomes `offset[1]`, `offset[2]`, ...

    `labels`: effect -> (rows,) text. Its columns enter together, as those of an effect with several numbers do. What the subject finds is
    found as often as there are different amounts.

    **Raises** `InputError` for an effect that the subject does not have.
    """

    def __init__(self, whole: AbstractSubject, labels: Mapping[str, Shaped[np.ndarray, "rows"]]):
        by_name = {family.name: family for family in whole.families}
        for name in labels:
            if name not in by_name:
                raise InputError("no such effect", seen=name, remedy=choose_from(name, by_name))
        self.whole, self.labels = whole, {name: np.asarray(each).astype(str) for name, each in labels.items()}
        self.name, self.kind, self.parameters, self.rows = whole.name, whole.kind, whole.parameters, whole.rows
        self.priors, self.refinement = whole.priors, whole.refinement
        self.families = tuple(self._parted(family) if family.name in labels else family for family in whole.families)

    def _parted(self, family: Family) -> Family:
        columns, second = (tuple(one for _, one in self._own(family.name, each)) for each in (family.columns, family.second))
        return dataclasses.replace(family, columns=columns, second=second)

    def _own(self, family: str, columns: tuple[Column, ...]) -> Iterator[tuple[str, Column]]:
        for column in columns:
            for label in dict.fromkeys(self.labels[family].tolist()):
                yield label, dataclasses.replace(column, name=f"{column.name}[{label}]")

    @cached_property
    def _meant(self) -> dict[str, tuple[str, Bool[np.ndarray, "rows"]]]:
        """Key of a column with a label -> the whole subject's key, and the rows that it is for."""
        found = {}
        for family in self.whole.families:
            for column in (*family.columns, *family.second) if family.name in self.labels else ():
                for label, own in self._own(family.name, (column,)):
                    found[own.key] = column.key, self.labels[family.name] == label
        return found

    def evaluate(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        n, meant = len(self.rows), [self._meaning(key) for key in moving]
        value, theta, slopes = np.full(n, np.nan), np.full((n, len(raw)), np.nan), np.zeros((n, len(moving)))
        for rows, amounts in self._parts(phi):
            asked = tuple(dict.fromkeys(whole for whole, own in meant if (own & rows).any()))
            found = self.whole.evaluate(raw, amounts, asked)
            if not found.usable:
                return Evaluation(np.full(n, np.nan), np.full_like(theta, np.nan), np.full_like(slopes, np.nan), converged=False)
            value[rows], theta[rows] = found.prediction[rows], found.theta_jacobian[rows]
            for number, (whole, own) in enumerate(meant):
                if whole in asked:
                    slopes[own & rows, number] = found.phi_jacobian[own & rows, asked.index(whole)]
        return Evaluation(value, theta, slopes)

    def glance(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Evaluation | None:
        value = np.full(len(self.rows), np.nan)
        converged = True
        for rows, amounts in self._parts(phi):
            found = self.whole.glance(raw, amounts)
            if found is None:
                return None
            value[rows], converged = found.prediction[rows], converged and found.converged
        return Evaluation(value, np.zeros((len(value), 0)), np.zeros((len(value), 0)), converged)

    def columns(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float] = NONE) -> Mapping[str, Float[np.ndarray, "rows"]]:
        """Those of the whole subject, beside the effects that are the same for all rows."""
        found = self.whole.columns(raw, {key: value for key, value in phi.items() if key not in self._meant})
        replaced = {whole for whole, _ in self._meant.values()}
        parted = {key: np.where(own, found[whole], 0.0) for key, (whole, own) in self._meant.items()}
        return {key: column for key, column in found.items() if key not in replaced} | parted

    def finer(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Float[np.ndarray, "rows"] | None:
        return self._by_parts(self.whole.finer, raw, phi)

    def softness(self, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> Float[np.ndarray, "rows"] | None:
        return self._by_parts(self.whole.softness, raw, phi)

    def proposals(self, raw: Float[np.ndarray, "p"]) -> tuple[Proposal, ...]:
        """Those of the whole subject; what is measured next tells of no label's own amount."""
        return tuple(dataclasses.replace(one, columns=self._untold(one)) for one in self.whole.proposals(raw))

    def _untold(self, proposal: Proposal) -> dict[str, Float[np.ndarray, "new"]]:
        return {key: np.zeros(len(proposal.sigma)) for key in self._meant} | dict(proposal.columns)

    def account(self) -> Mapping[str, object]:
        return self.whole.account()

    def _by_parts(
        self,
        read: Callable[[Float[np.ndarray, "p"], Mapping[str, float]], Float[np.ndarray, "rows"] | None],
        raw: Float[np.ndarray, "p"],
        phi: Mapping[str, float],
    ) -> Float[np.ndarray, "rows"] | None:
        value = np.full(len(self.rows), np.nan)
        for rows, amounts in self._parts(phi):
            found = read(raw, amounts)
            if found is None:
                return None
            value[rows] = found[rows]
        return value

    def _parts(self, phi: Mapping[str, float]) -> list[Part]:
        """Rows that see the same amounts, and these under the keys of the whole subject."""
        shared = {key: value for key, value in phi.items() if key not in self._meant}
        seen: list[Part] = [(np.ones(len(self.rows), bool), shared)]
        for key, value in phi.items():
            if key in self._meant:
                whole, own = self._meant[key]
                split = [part for rows, amounts in seen for part in ((rows & own, amounts | {whole: value}), (rows & ~own, amounts))]
                seen = [part for part in split if part[0].any()]
        merged: list[Part] = []
        for rows, amounts in seen:
            like = next((number for number, (_, other) in enumerate(merged) if other == amounts), None)
            if like is None:
                merged.append((rows, amounts))
            else:
                merged[like] = merged[like][0] | rows, amounts
        return merged

    def _meaning(self, key: str) -> tuple[str, Bool[np.ndarray, "rows"]]:
        """The whole subject's key, and the rows that it is for."""
        return self._meant.get(key, (key, np.ones(len(self.rows), bool)))
