"""Programs that JAX compiled, forgotten in time: each maps tens of pieces of memory, and Linux allows a process some 65,000.

A process that asks for one more is not told that it has too many: compilation ends with "Cannot allocate memory" while most of the memory
is free, and the process with a segmentation fault. A diagnosis of many indenters, each with a pad of its own size, gets there.
"""

from __future__ import annotations

from pathlib import Path

import jax

from ..side_by_side import beside_others

MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
ROOM = 0.6  # share of what is allowed from which on programs are forgotten: what one evaluation compiles must find room in the rest


def forget_when_many(maps: Path = MAPS, limit: Path = LIMIT) -> bool:
    """Drop all compiled programs where the process is close to the number of mappings that the system allows; whether it was.

    What is asked again compiles again, in seconds. Where the system does not tell nothing is done, nor beside other work, which
    may be compiling.
    """
    if beside_others():
        return False
    try:
        allowed = int(limit.read_text())
        with maps.open("rb") as lines:
            many = sum(1 for _ in lines) > ROOM * allowed
    except (OSError, ValueError):
        return False
    if many:
        jax.clear_caches()
    return many
