"""A number that may be fitted: its name is its path in the model, its link keeps it inside its limits.

Choose a link: `log` for what is positive and known to a factor (moduli, scales, thresholds), `logit` for
what lies strictly between two limits (Poisson's ratio), `identity` for the rest (offsets, angles).
"""

from __future__ import annotations

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from .errors import InputError
from .spelling import choose_from

LINKS = ("log", "identity", "logit")
# A value this close to a limit, as a share of the distance between the limits (in log for a log link), is at
# it.
NEAR_LIMIT = 1e-3
_NAME = re.compile(r"[A-Za-z_][\w-]*(\.[A-Za-z_][\w-]*)*(\[[^\[\]]+\])?")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number that may be fitted.

    **Arguments:**

    - `name`: path in the model, `epidermis.modulus`; of one group, `epidermis.modulus[subject 1]`.
    - `value`: start, in `unit`.
    - `unit`: internal unit as text: `MPa`, `mm`, `Hz/MPa`, `1`.
    - `link`: `log`, `identity` or `logit`; the fitter moves `raw()`, physics sees `natural(raw)`.
    - `lower`, `upper`: limits in `unit`; may be infinite, except for `logit`.

    **Raises** `InputError` where the name is no path, the link unknown, the limits are crossed or outside
    what the link can reach, or the value is outside them.
    """

    name: str
    value: float
    unit: str = "1"
    link: str = "log"
    lower: float = 0.0
    upper: float = math.inf

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(
                "a parameter's name is no path", seen=self.name, remedy="write it as epidermis.modulus"
            )
        if self.link not in LINKS:
            raise InputError(
                f"{self.name}: unknown link", seen=self.link, remedy=choose_from(self.link, LINKS)
            )
        self._check_limits()
        self._check_value(self.value)

    def _check_limits(self) -> None:
        if not self.lower < self.upper:
            seen = (self.lower, self.upper)
            raise InputError(
                f"{self.name}: the lower limit is not below the upper one", seen=seen, remedy="swap them"
            )
        if self.link == "log" and self.lower < 0:
            raise InputError(
                f"{self.name}: a log link needs limits that are not negative",
                seen=self.lower,
                remedy="use the identity link, or a lower limit of 0 or more",
            )
        if self.link == "logit" and not (math.isfinite(self.lower) and math.isfinite(self.upper)):
            seen = (self.lower, self.upper)
            raise InputError(
                f"{self.name}: a logit link needs two finite limits", seen=seen, remedy="give both limits"
            )

    def _check_value(self, value: float) -> None:
        inside = self.lower <= value <= self.upper and math.isfinite(value)
        if self.link == "logit":
            inside = self.lower < value < self.upper
        if self.link == "log":
            inside = inside and value > 0
        if not inside:
            span = f"between {self.lower:g} and {self.upper:g} {self.unit}"
            strictly = {"logit": ", limits excluded", "log": ", above 0"}.get(self.link, "")
            raise InputError(
                f"{self.name}: the value is outside its limits",
                seen=value,
                remedy=f"choose it {span}{strictly}",
            )

    @property
    def path(self) -> str:
        """The name without its group: `epidermis.modulus[1]` -> `epidermis.modulus`."""
        return self.name.partition("[")[0]

    @property
    def group(self) -> str | None:
        """The group that this value belongs to, `epidermis.modulus[1]` -> `1`; None where it holds for
        all.
        """
        return self.name.partition("[")[2].rstrip("]") or None

    def of_group(self, group: object) -> Parameter:
        """The same parameter for one value of a `per` column."""
        return dataclasses.replace(self, name=f"{self.path}[{group}]")

    def raw(self, value: float | None = None) -> float:
        """The number that a fitter moves, for `value` in `unit` (the start where None).

        **Raises** `InputError` where the value is outside the limits.
        """
        value = self.value if value is None else float(value)
        self._check_value(value)
        if self.link == "log":
            return math.log(value)
        if self.link == "logit":
            return math.log((value - self.lower) / (self.upper - value))
        return value

    def natural(self, raw: ArrayLike) -> jax.Array:
        """The value in `unit` at a raw number; traceable, the inverse of `raw`."""
        raw = jnp.asarray(raw)
        if self.link == "log":
            return jnp.exp(raw)
        if self.link == "logit":
            return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(raw)
        return raw

    def slope(self, raw: ArrayLike) -> jax.Array:
        """d natural / d raw at a raw number, in `unit`; traceable."""
        raw = jnp.asarray(raw)
        if self.link == "log":
            return jnp.exp(raw)
        if self.link == "logit":
            return (self.upper - self.lower) * jax.nn.sigmoid(raw) * jax.nn.sigmoid(-raw)
        return jnp.ones_like(raw)

    def raw_limits(self) -> tuple[float, float]:
        """The limits as raw numbers; -inf or inf where the link alone keeps the value inside."""
        if self.link == "log":
            return (
                math.log(self.lower) if self.lower > 0 else -math.inf,
                math.log(self.upper) if self.upper < math.inf else math.inf,
            )
        if self.link == "logit":
            return (-math.inf, math.inf)
        return (self.lower, self.upper)

    def at_limit(self, value: float) -> str | None:
        """`lower` or `upper` where a value (in `unit`) lies at a limit or beyond it, to `NEAR_LIMIT`; None
        elsewhere.
        """
        low, here, high = (self._ruler(number) for number in (self.lower, value, self.upper))
        span = high - low
        near = NEAR_LIMIT * span if math.isfinite(span) else 0.0
        if here <= low + near:
            return "lower"
        return "upper" if here >= high - near else None

    def _ruler(self, value: float) -> float:
        if self.link != "log":
            return value
        if value <= 0:
            return -math.inf
        return math.log(value) if value < math.inf else math.inf
