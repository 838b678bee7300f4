"""Compiled programs are forgotten before the process has more pieces of memory than the system allows."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from fingerjax.forward import programs
from fingerjax.side_by_side import side_by_side


def pieces() -> int:
    return len(programs.MAPS.read_bytes().splitlines())


def compiled(sizes: range) -> None:
    def program(x: jax.Array) -> jax.Array:
        return jnp.linalg.solve(jnp.eye(x.size) + jnp.outer(x, x), jnp.sin(x))

    again = jax.jit(program)
    for size in sizes:
        again(jnp.ones(size)).block_until_ready()


@pytest.mark.skipif(not programs.MAPS.exists(), reason="the system does not tell what a process maps")
def test_what_compiled_programs_map_is_given_back_where_little_is_left(tmp_path: Path) -> None:
    limit = tmp_path / "max_map_count"
    compiled(range(3, 5))  # what one program needs once is not counted
    jax.clear_caches()
    before = pieces()
    compiled(range(5, 30))
    grown = pieces() - before
    assert grown > 60
    limit.write_text(str(int(10 * pieces() / programs.ROOM)))
    assert not programs.forget_when_many(limit=limit)
    assert pieces() - before >= grown
    limit.write_text(str(int(0.9 * pieces() / programs.ROOM)))
    assert programs.forget_when_many(limit=limit)
    assert pieces() - before < 0.5 * grown
    compiled(range(5, 7))  # and compiles again


@pytest.mark.parametrize("said", [None, "", "many"])
def test_nothing_is_forgotten_where_the_system_does_not_tell(tmp_path: Path, said: str | None) -> None:
    limit = tmp_path / "max_map_count"
    if said is not None:
        limit.write_text(said)
    assert not programs.forget_when_many(limit=limit)
    assert not programs.forget_when_many(maps=tmp_path / "maps", limit=programs.LIMIT)


@pytest.mark.skipif(not programs.MAPS.exists(), reason="the system does not tell what a process maps")
def test_nothing_is_forgotten_beside_other_work(tmp_path: Path) -> None:
    limit = tmp_path / "max_map_count"
    limit.write_text("1")
    assert side_by_side(lambda _: programs.forget_when_many(limit=limit), [0, 1], workers=2) == [False, False]
    assert programs.forget_when_many(limit=limit)
