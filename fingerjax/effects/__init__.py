"""Effects that a layered linear fingertip under ideal instruments lacks: one file each, found by themselves. `effect` says what one is."""

from .catalogue import catalogue, chosen
from .effect import Amount, Effect, Size
from .records import Context, Felt, Push, Reading

__all__ = ["Amount", "Context", "Effect", "Felt", "Push", "Reading", "Size", "catalogue", "chosen"]
