"""Every way in which a run can end, each a sentence that says what to try."""

from __future__ import annotations

import enum


class RESULTS(enum.Enum):
    """How a solve, a contact, or a fit ended. The value is the sentence that a person reads."""

    successful = "The run ended well."
    not_converged = (
        "The solver stopped before its residual was small enough; allow more iterations, loosen the "
        "tolerance, or bring Poisson's ratio away from 0.5."
    )
    no_optimum = (
        "The fit found no optimum; start it elsewhere, free fewer parameters, tie some, or add a prior or a measurement that they change."
    )
    contact_did_not_settle = (
        "The set of touching points kept changing; take smaller steps of depth, or give a sharp indenter a "
        "finite edge radius."
    )
    contact_reached_edge = (
        "The contact reached the edge of the pad that was prepared for it; prepare a larger pad, press "
        "less deep, or move the site away from the end of the finger."
    )
    no_equilibrium = (
        "No equilibrium of the strained tissue was found all the way to the load asked for; allow smaller load "
        "steps, press less, or make the tissue less compressible or less stiffening."
    )
    force_not_reached = (
        "No travel within the limit gives the force asked for; check the unit of the force, raise the "
        "largest travel, or start from stiffer moduli."
    )
    at_limit = (
        "A parameter ran to its limit, or towards it on a plateau, so its value and uncertainty mean little; widen the limit, fix "
        "the parameter, or tie it to another."
    )
    not_identified = (
        "These data do not determine every free parameter; fix or tie the ones named, add a prior, or "
        "measure something that they change."
    )
    interrupted = "The run was stopped before its end; start it again and it goes on from what was finished."

    @property
    def ok(self) -> bool:
        """True only for `successful`."""
        return self is RESULTS.successful
