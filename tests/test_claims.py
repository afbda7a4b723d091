"""A small file that claims to hold much is refused before the memory is taken."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("PIL")
pytest.importorskip("pyarrow")

import h5py
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from torchrl_bmrl.data import d4rl
from torchrl_bmrl.data.hdf5 import (
    open_file,
    read_array,
    read_attribute,
    read_attributes,
    read_names,
    read_strings,
)
from torchrl_bmrl.data.lerobot_meta import _read_table, open_parquet
from torchrl_bmrl.data.minari_spaces import Space, read_rows
from torchrl_bmrl.errors import DataError

GZIP: dict[str, Any] = {"compression": "gzip", "chunks": True}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.hdf5"


def refused(path: Path, read: Callable[..., Any], key: str, says: str, *more: Any) -> None:
    with open_file(path) as file, pytest.raises(DataError, match=says) as caught:
        read(path, file, key, *more)
    assert caught.value.path == path


# -- HDF5 ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, GZIP])
def test_rows_that_were_never_written_are_not_made_up(path: Path, options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("few", (100, 7), **options)
        file.create_dataset("many", (40_000, 7), **options)
    refused(path, read_array, "many", "claims 1120000 bytes, more than the file can hold")
    with open_file(path) as file:
        assert read_array(path, file, "few").shape == (100, 7)


def test_an_array_of_many_names_counts_as_many(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("a", data=np.zeros((1000, 100)), **GZIP)
        for i in range(300):
            file[f"b{i}"] = file["a"]
    refused(path, read_array, "b7", "claims 800000 bytes under 301 names")


@pytest.mark.parametrize("key", ["out", "out/x", "round/x", "a/round/x"])
@pytest.mark.parametrize("read", [read_array, read_strings, read_names, read_attributes])
def test_a_link_to_another_file_is_refused_before_that_is_opened(
    path: Path, read: Any, key: str
) -> None:
    path.with_name("other").write_text("not HDF5, as HDF5 would find on opening it")
    with h5py.File(path, "w") as file:
        file["out"] = h5py.ExternalLink("other", "/x")
        file["round"] = h5py.SoftLink("/out")
        file.create_group("a")["round"] = h5py.SoftLink("/round")
    refused(path, read, key, "lies in other; valid: in this file")


def test_a_link_within_the_file_is_followed_unless_it_leads_to_itself(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["a/x"] = np.arange(3)
        file["a/near"] = h5py.SoftLink("x")
        file["far"] = h5py.SoftLink("/a")
        file["one"], file["other"] = h5py.SoftLink("other"), h5py.SoftLink("one")
    with open_file(path) as file:
        assert read_array(path, file, "far/near").tolist() == [0, 1, 2]
    refused(path, read_array, "one", "a link to itself")


def test_texts_that_all_are_the_same_long_one_are_not_all_read(path: Path) -> None:
    with h5py.File(path, "w") as file:
        texts = ["x" * 5000, *[""] * 499]
        node = file.create_dataset("mask/train", data=texts, dtype=h5py.string_dtype())
        place = node.id.get_offset()
    with path.open("r+b") as content:
        content.seek(place)
        pointer = content.read(16)
        content.seek(place)
        content.write(pointer * 500)
    refused(path, read_strings, "mask/train", "its texts are longer than the file")


def test_a_mask_of_more_texts_than_the_file_can_name_is_refused(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("mask/train", data=np.full(50_000, b"demo_0"), **GZIP)
    refused(path, read_strings, "mask/train", "claims 50000 texts")


def test_attributes_of_many_texts_of_any_length_are_refused_in_large_files(path: Path) -> None:
    texts = np.full(100, "a", h5py.string_dtype())
    with h5py.File(path, "w") as file:
        file.attrs["names"] = texts
    with open_file(path) as file:
        assert read_attributes(path, file, "/") == {"names": ["a"] * 100}
    with h5py.File(path, "r+") as file:
        file["large"] = np.zeros(10**5)
    refused(path, read_attribute, "/", "attribute names has 100 texts", "names")


def test_steps_that_take_no_byte_each_are_not_made_episodes(path: Path) -> None:
    steps = 10**5
    with h5py.File(path, "w") as file:
        for key in ("observations", "actions", "rewards", "terminals", "timeouts"):
            file.create_dataset(key, data=np.ones(steps, np.uint8), **GZIP)
    with pytest.raises(DataError, match=f"claims {steps} steps"), d4rl.open_data(path):
        pass


# -- images ----------------------------------------------------------------------------------------


def image(kind: str) -> np.ndarray:
    data = io.BytesIO()
    Image.new("RGB", (64, 64)).save(data, kind)
    return np.frombuffer(data.getvalue(), np.uint8)


SPACE = Space.of({"type": "Box", "shape": [64, 64, 3], "dtype": "uint8", "low": 0, "high": 255})


def test_images_larger_together_than_the_file_can_hold_are_not_decoded(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("images", data=np.tile(image("JPEG"), (2000, 1)), **GZIP)
    refused(path, read_rows, "images", "claims 24576000 bytes of images", SPACE)


@pytest.mark.parametrize("kind", ["PNG", "GIF", "TIFF"])
def test_only_jpeg_is_decoded_whatever_a_row_says_it_is(path: Path, kind: str) -> None:
    with h5py.File(path, "w") as file:
        rows = file.create_dataset("images", 3, h5py.vlen_dtype(np.uint8))
        for i, name in enumerate(("JPEG", "JPEG", kind)):
            rows[i] = image(name)
    refused(path, read_rows, "images", "no JPEG in row 2", SPACE)


# -- parquet ---------------------------------------------------------------------------------------


def test_equal_rows_of_parquet_are_not_more_than_its_bytes(tmp_path: Path) -> None:
    file = tmp_path / "a.parquet"
    pq.write_table(pa.table({"index": np.zeros(10**5, np.int64)}), file)
    with pytest.raises(DataError, match="claims 100000 rows"), open_parquet(file):
        pass


def test_a_text_that_is_stored_once_is_not_read_for_all_rows(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    table = pa.table({"episode_index": range(3000), "tasks": ["x" * 5000] * 3000})
    pq.write_table(table, tmp_path / "meta" / "episodes.parquet")
    with pytest.raises(DataError, match="longer than the file can hold"):
        _read_table(tmp_path, "meta")
