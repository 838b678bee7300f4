"""Load cases on several devices: the answers of one, in a process that makes believe it has two."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
from fingerjax.fem.body import body, material
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.solver import Shared, solver_for
from fingerjax.fem.stiffness import Elastic
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block
import scipy.sparse as sp

assert len(jax.devices()) == 2
one = body(block((2.0, 1.0, 2.0), (3, 2, 3)), bone="held")
stiffness = Elastic(one, material(dict.fromkeys(SOFT_LAYERS, 0.1), 0.48).lame())
skin = np.flatnonzero(np.asarray(one.nodes)[:, 1] < 1e-9)[:3]
columns = columns_from_matrix(sp.csc_matrix((np.ones(3), (3 * skin + 1, np.arange(3))), shape=(3 * len(one.free), 3)))
solver = solver_for(one, "multigrid")
assert isinstance(solver, Shared)
dealt, alone = (each.held(stiffness, columns.loads()) for each in (solver, solver.one))
assert len(dealt.displacement.sharding.device_set) == 2
assert dealt.converged.all() and dealt.displacement.shape == alone.displacement.shape
assert jnp.allclose(dealt.displacement, alone.displacement, rtol=0, atol=1e-7 * jnp.abs(alone.displacement).max())
print("dealt out")
"""


def test_cases_are_dealt_out_among_devices() -> None:
    options = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": options, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "dealt out" in done.stdout
