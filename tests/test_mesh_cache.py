"""Kept meshes: built once, named by what made them, whole or not at all; and fingers on disk."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.mesh import cache
from fingerjax.mesh.bodies import block
from fingerjax.mesh.cache import Arrays, cache_dir, content_key, kept
from fingerjax.mesh.files import export_vtu, load, packed, save, unpacked


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FINGERJAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Builder:
    """Counts how often it builds; every build is another one, as pytetwild's are."""

    def __init__(self) -> None:
        self.built = 0

    def __call__(self) -> Arrays:
        self.built += 1
        return {"numbers": np.arange(5.0) + self.built}


def test_built_once_and_then_read(own_cache: Path) -> None:
    build = Builder()
    first, second = kept("a", build), kept("a", build)
    assert build.built == 1
    np.testing.assert_array_equal(first["numbers"], second["numbers"])
    assert [path.name for path in own_cache.iterdir()] == ["a.npz"]


def test_the_folder_is_named_by_the_environment_or_the_user(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_dir() == own_cache and own_cache.is_dir()
    monkeypatch.delenv("FINGERJAX_CACHE")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda name: str(tmp_path / "user" / name))
    assert cache_dir() == tmp_path / "user" / "fingerjax"


def test_keys_tell_contents_apart() -> None:
    assert content_key("a", 1.0) == content_key("a", 1.0)
    assert len({content_key("a", 1.0), content_key("a", 1.5), content_key("b", 1.0), content_key("a")}) == 4


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied", "swapped"])
def test_a_damaged_file_is_built_again(own_cache: Path, damage: str) -> None:
    build = Builder()
    kept("a", build)
    path = own_cache / "a.npz"
    data = bytearray(path.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        at = data.find(b"numbers.npy") + 40
        data[at] ^= 0xFF
    elif damage == "emptied":
        data = bytearray()
    else:
        import io

        buffer = io.BytesIO()
        np.savez(buffer, numbers=np.zeros(3), checksum=np.frombuffer(b"0" * 64, np.uint8))
        data = bytearray(buffer.getvalue())
    path.write_bytes(bytes(data))
    again = kept("a", build)
    assert build.built == 2
    np.testing.assert_array_equal(kept("a", build)["numbers"], again["numbers"])
    assert build.built == 2


def test_a_failing_build_leaves_nothing(own_cache: Path) -> None:
    def fail() -> Arrays:
        raise InputError("cannot be meshed")

    with pytest.raises(InputError):
        kept("a", fail)
    assert list(own_cache.iterdir()) == []


def test_a_failing_write_leaves_nothing(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(arrays: Arrays) -> bytes:
        raise OSError("no space left on device")

    monkeypatch.setattr(cache, "packed", no_space)
    with pytest.raises(OSError, match="no space"):
        kept("a", Builder())
    assert list(own_cache.iterdir()) == []


def _race(folder: str, start: object, value: float, results: object) -> None:
    import os

    os.environ["FINGERJAX_CACHE"] = folder

    def build() -> Arrays:
        start.wait()  # type: ignore[attr-defined]
        return {"numbers": np.full(200_000, value)}

    results.put(float(kept("race", build)["numbers"][0]))  # type: ignore[attr-defined]


def test_two_processes_end_with_one_mesh(own_cache: Path) -> None:
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(2), context.Queue()
    processes = [context.Process(target=_race, args=(str(own_cache), start, v, results)) for v in (1.0, 2.0)]
    for process in processes:
        process.start()
    seen = {results.get(timeout=60) for _ in processes}
    for process in processes:
        process.join()
    assert len(seen) == 1
    assert [path.name for path in own_cache.iterdir()] == ["race.npz"]
    assert kept("race", Builder())["numbers"][0] in seen


def _stall(folder: str, begun: object) -> None:
    import os
    import time

    os.environ["FINGERJAX_CACHE"] = folder

    def build() -> Arrays:
        begun.set()  # type: ignore[attr-defined]
        time.sleep(60.0)
        return {"numbers": np.zeros(3)}

    kept("stalled", build)


def test_a_killed_process_leaves_the_mesh_to_the_next(own_cache: Path) -> None:
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    process = context.Process(target=_stall, args=(str(own_cache), begun))
    process.start()
    assert begun.wait(60)
    process.kill()
    process.join()
    build = Builder()
    assert kept("stalled", build)["numbers"][0] == 1.0 and build.built == 1
    # Half a file beside its place, as a process killed while writing leaves it, is never read.
    (own_cache / ".other-x.tmp").write_bytes(b"half")
    assert kept("other", build)["numbers"][0] == 2.0


def test_a_finger_survives_the_disk(tmp_path: Path) -> None:
    body = block(interfaces=(0.5,))
    save(body, tmp_path / "block.npz")
    read = load(tmp_path / "block.npz")
    for name in ("nodes", "tets", "layer", "skin", "nail", "bone", "proximal"):
        np.testing.assert_array_equal(getattr(read, name), getattr(body, name))
        assert getattr(read, name).dtype == getattr(body, name).dtype
    assert (read.name, read.key, read.quality) == (body.name, body.key, body.quality)


def test_a_damaged_finger_is_refused(tmp_path: Path) -> None:
    (tmp_path / "block.npz").write_bytes(b"not a finger")
    with pytest.raises(InputError, match="damaged"):
        load(tmp_path / "block.npz")
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path / "nowhere.npz")
    assert unpacked(packed({"a": np.arange(3)})) is not None


def test_viewers_get_ten_node_elements_with_their_layers(tmp_path: Path) -> None:
    import meshio

    body = block(interfaces=(0.5,))
    export_vtu(body, tmp_path / "block.vtu", height=body.nodes[:, 1], number=np.arange(len(body.tets)))
    read = meshio.read(tmp_path / "block.vtu")
    np.testing.assert_allclose(read.points, body.nodes)
    np.testing.assert_array_equal(read.cells_dict["tetra10"], body.tets)
    np.testing.assert_array_equal(read.cell_data["layer"][0], body.layer + 1)
    np.testing.assert_array_equal(read.point_data["bone"], body.bone)
    np.testing.assert_allclose(read.point_data["height"], body.nodes[:, 1])
    with pytest.raises(InputError, match="neither per node nor per element"):
        export_vtu(body, tmp_path / "block.vtu", odd=np.zeros(3))
