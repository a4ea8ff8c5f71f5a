"""Masks by their content, in memory and in a folder, and files that are damaged."""

import os
import tempfile
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.viewer import _masks
from splatseg.viewer._masks import MaskStore
from splatseg.viewer.commands import Mask


def values(*given: int) -> np.ndarray:
    return np.array(given, np.uint8)


@given(st.lists(st.integers(0, 255), min_size=1, max_size=40))
def test_a_store_gives_back_what_was_put(tmp_path_factory, given) -> None:
    folder = tmp_path_factory.mktemp("masks")
    given = values(*given)
    for store in (MaskStore(len(given)), MaskStore(len(given), folder)):
        mask = store.put(given)
        assert mask.count == sum(value >= 128 for value in given.tolist())
        store.persist([mask])
        assert mask in store
        assert np.array_equal(store.get(mask), given)
    assert np.array_equal(MaskStore(len(given), folder).get(mask), given)


def test_equal_masks_are_one_and_others_have_other_names() -> None:
    store = MaskStore(3)
    assert store.put(values(1, 2, 200)) == store.put(values(1, 2, 200))
    assert store.put(values(1, 2, 200)).id != store.put(values(1, 2, 201)).id
    assert len(store.put(values(0, 0, 0)).id) == 32


def test_a_mask_is_no_window_into_what_was_put() -> None:
    store, given = MaskStore(3), values(1, 2, 200)
    mask = store.put(given)
    given[0] = 99
    assert store.get(mask).tolist() == [1, 2, 200]
    with pytest.raises(ValueError, match="read-only"):
        store.get(mask)[0] = 5


def test_what_is_no_mask_of_the_scene_is_refused() -> None:
    store = MaskStore(3)
    assert store.gaussians == 3
    with pytest.raises(ShapeError, match="expected 3 values"):
        store.put(values(1, 2))
    with pytest.raises(InputError, match="expected bytes"):
        store.put(np.zeros(3))


def test_a_file_is_written_when_it_is_asked_for_and_once(tmp_path) -> None:
    folder = tmp_path / "deep" / "masks"
    store = MaskStore(3, folder)
    kept, other = store.put(values(0, 0, 255)), store.put(values(0, 255, 0))
    assert not folder.exists()
    store.persist([kept])
    assert [path.name for path in folder.iterdir()] == [f"{kept.id}.z"]
    before = (folder / f"{kept.id}.z").stat().st_ino
    store.persist([kept])
    assert store.put(values(0, 0, 255)) == kept
    store.persist([kept])
    assert (folder / f"{kept.id}.z").stat().st_ino == before
    fresh = MaskStore(3, folder)
    assert kept in fresh
    assert other not in fresh
    with pytest.raises(InputError, match="mask: expected one that was stored"):
        fresh.get(other)


def test_names_that_are_no_digests_lead_to_no_file(tmp_path) -> None:
    (tmp_path / "masks").mkdir()
    (tmp_path / "secret.z").write_bytes(zlib.compress(bytes(3)))
    store = MaskStore(3, tmp_path / "masks")
    for id in ("../secret", "", "x" * 32, "A" * 32, "/" * 32):
        assert Mask(id=id, count=0) not in store
        with pytest.raises(InputError, match="mask: expected one that was stored"):
            store.get(Mask(id=id, count=0))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no zlib",
        zlib.compress(bytes([0, 0, 254])),
        zlib.compress(bytes([0, 0, 255, 0])),
        zlib.compress(bytes([0, 0])),
        zlib.compress(bytes(1 << 24)),
        zlib.compress(bytes([0, 0, 255]))[:-7],
    ],
)
def test_a_damaged_file_is_said(tmp_path, content) -> None:
    store = MaskStore(3, tmp_path)
    mask = store.put(values(0, 0, 255))
    store.persist([mask])
    (tmp_path / f"{mask.id}.z").write_bytes(content)
    with pytest.raises(FileFormatError, match=rf"{mask.id}\.z: expected .*damaged"):
        MaskStore(3, tmp_path).get(mask)


def test_few_masks_are_kept_as_arrays(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(_masks, "_KEPT_BYTES", 6)
    store = MaskStore(3, tmp_path)
    made = [store.put(values(i, 0, 255)) for i in range(5)]
    store.persist(made[:3])
    assert len(store._arrays) == 2
    assert [int(store.get(mask)[0]) for mask in made] == [0, 1, 2, 3, 4]
    assert len(store._arrays) == 2
    first = store.get(made[3])
    store.get(made[0])
    assert store.get(made[3]) is first, "the one that was used last stays"


def test_many_masks_without_a_folder_go_to_a_temporary_one(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(_masks, "_PACKED_BYTES", 40)
    monkeypatch.setattr(_masks, "_KEPT_BYTES", 3)
    store = MaskStore(3)
    made = [store.put(values(i, 0, 255)) for i in range(9)]
    (folder,) = tmp_path.iterdir()
    written = {path.name for path in folder.iterdir()}
    assert 0 < len(written) < 9
    assert {f"{mask.id}.z" for mask in made} - written == {f"{id}.z" for id in store._packed}
    assert sum(map(len, store._packed.values())) == store._packed_bytes <= 40
    assert all(mask in store for mask in made)
    assert [int(store.get(mask)[0]) for mask in made] == list(range(9))
    assert store.put(values(0, 0, 255)) == made[0]
    assert made[0].id not in store._packed, "it is in the folder already"
    store.close()
    assert not folder.exists()
    assert made[0] not in store


def test_what_went_to_the_temporary_folder_is_written_when_it_is_asked_for(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(_masks, "_PACKED_BYTES", 0)
    store = MaskStore(3, tmp_path / "masks")
    mask, other = store.put(values(0, 0, 255)), store.put(values(0, 255, 0))
    assert not (tmp_path / "masks").exists()
    store.persist([mask])
    store.close()
    fresh = MaskStore(3, tmp_path / "masks")
    assert fresh.get(mask).tolist() == [0, 0, 255]
    assert other not in fresh


def test_what_a_killed_process_left_is_cleared(tmp_path) -> None:
    left = tmp_path / ".splatseg-999999999-abc"
    left.mkdir()
    (left / "half").write_bytes(b"x")
    os.utime(left, (1, 1))
    MaskStore(3, tmp_path)
    assert not left.exists()
