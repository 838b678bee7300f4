"""Mechanics: elements, the stiffness operator, solvers, and the condensed compliance that contact works with.

Read in this order: `element` (shape functions, quadrature), `body` (a finger made ready for the solvers), `operator`
(what the stiffness does to a displacement), `solver` (two ways to undo it), `compliance` (what instruments need of it).
"""
