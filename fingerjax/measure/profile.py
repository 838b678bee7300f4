"""What a camera reads: how far points of the skin have moved along +y."""

from __future__ import annotations

from jaxtyping import Array, Float


def deflection(compliance_op: Float[Array, "m p"], nodal_forces: Float[Array, " p"]) -> Float[Array, " m"]:
    """Displacement in mm along +y of m observed surface points under forces in N on the p pad nodes.

    `compliance_op` in mm/N holds the rows of the compliance that belong to the observed points.
    """
    return compliance_op @ nodal_forces
