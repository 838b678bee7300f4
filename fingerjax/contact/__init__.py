"""Touching: rigid, frictionless shapes pressed into the pad, solved exactly on the condensed body."""
