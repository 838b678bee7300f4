"""Meshes: tetrahedra that follow the layers of a solid, refined where an indenter needs it."""
