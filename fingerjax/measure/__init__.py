"""Instruments: what a laboratory reads off an indented fingertip, as small pure functions."""
