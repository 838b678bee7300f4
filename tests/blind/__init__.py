"""Simulated laboratories made by a second finite-element program.

Nothing here imports fingerjax, and nothing in fingerjax imports this: the two programs share a file
contract and no code, no element, no solver and no contact method.  What the product says of data made here
is therefore a statement about its model, not about its own arithmetic.  The program is in four parts:
`bricks` (elements, mesh, stiffness, factor), `shapes` (fingers and blocks), `touch` (indenters and
contact), `laboratory` and `generate` (cases, noise and files).
"""
