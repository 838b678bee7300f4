"""The five tissues of the fingertip, numbered inwards as in Dandekar, Raju & Srinivasan (2003), section 3."""

from __future__ import annotations

LAYERS = ("epidermis", "dermis", "adipose", "fibrous", "bone")
SOFT_LAYERS = LAYERS[:4]
BONE = LAYERS.index("bone")
