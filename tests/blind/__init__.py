"""Simulated laboratories made by a second finite-element program.

Nothing here imports fingerjax, and nothing in fingerjax imports this: the two programs share a file
contract and no code, no element, no solver and no contact method.  What the product says of data made here
is therefore a statement about its model, not about its own arithmetic.  `bricks` has elements, mesh,
stiffness and factor, `shapes` fingers and blocks, `touch` indenters and contact.

Two sets of laboratories are made with it.  `laboratory` and `generate` make those that are shipped, without
an effect.  `scenarios` hides effects in forms of its own: in tissue (`flesh`, `stiffening`), where skin is
touched (`pressing`, `friction`), in rig and routine (`protocol`) and in cameras, load cells and nerves
(`instruments`); `truths` computes and keeps what they come to, `folders` adds noise and writes files, and
`score` says how well diagnoses of them did.
"""
