"""The nearest model of the catalogue where none explains the data: effects are added one at a time, for as long as each is worth it.

Nothing of it is named. It says how far the catalogue goes, how well it foretells what was held out, and what is left then:

    start   the explanation that helps and removes most
    add     what its residual asks for, refitted; kept where it helps and removes a tenth of what was left

An effect that runs to the end of what is plausible is not named, but the model with as much of it as is plausible may come nearest.
"""

from __future__ import annotations

from collections.abc import Sequence

from .explanations import Explanation
from .inquiry import Inquiry

WORTH = 0.1  # share of the misfit that another effect must remove


def nearest(inquiry: Inquiry, found: Sequence[Explanation]) -> Explanation | None:
    """The nearest model, from the explanations by one and by two effects; None where no effect helps."""
    best = max((one for one in found if one.helps), key=lambda one: one.delta, default=None)
    most = inquiry.reach.together
    while best is not None and len(best.families) < most:
        inquiry.tell(len(best.families) / most, f"{best.name} with one effect more")
        worth = WORTH * best.best.rss
        tried = [one for one in inquiry.enlarged(best, worth) if one.helps and best.best.rss - one.best.rss > worth]
        if not tried:
            break
        best = max(tried, key=lambda one: one.delta)
    return best
