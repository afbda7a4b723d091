"""A saved buffer is loaded as it was, and a damaged or foreign dump is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from replay_buffers import Make, draw, every_buffer, mixed, multi_task, numbered, single
from tensordict import TensorDict

from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.errors import BMRLError, DataError


def copy_state(way: str, saved: Any, loaded: Any, path: Path) -> None:
    if way == "dumps":
        saved.dumps(path / "buffer")
        loaded.loads(path / "buffer")
    else:
        loaded.load_state_dict(saved.state_dict())


@every_buffer
@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_a_buffer_that_was_loaded_samples_what_the_saved_one_does(
    make: Make, way: str, tmp_path: Path
) -> None:
    saved, loaded = make(), make()
    loaded.storage.set(slice(0, len(loaded)), loaded[:].apply(torch.zeros_like))
    assert not draw(loaded, 0).any()
    copy_state(way, saved, loaded, tmp_path)
    assert torch.equal(draw(loaded, 0), draw(saved, 0))
    assert (loaded[:] == saved[:]).all()


@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_weights_are_loaded(way: str, tmp_path: Path) -> None:
    saved, loaded = mixed(weights=[0, 1, 0]), mixed(weights=[1, 0, 0])
    copy_state(way, saved, loaded, tmp_path)
    assert loaded.sample()["task"].unique().item() == 1


@pytest.mark.parametrize("way", ["dumps", "state_dict"])
@pytest.mark.parametrize("sizes", [(5, 30, 12), (30, 5), (30, 5, 13)])
def test_data_sets_of_other_sizes_are_not_loaded(
    sizes: tuple[int, ...], way: str, tmp_path: Path
) -> None:
    other = make_multi_task_replay_buffer([numbered(7, rows) for rows in sizes], batch_size=2)
    before = other[:].clone()
    with pytest.raises(BMRLError, match=r"of \[30, 5, 12\] transitions; valid: "):
        copy_state(way, multi_task(), other, tmp_path)
    assert (other[:] == before).all()


@every_buffer
@pytest.mark.parametrize("prefetch", [(0, 2), (2, 0), (1, 1)])
@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_samples_prepared_ahead_are_no_part_of_a_state(
    make: Make, way: str, prefetch: tuple[int, int], tmp_path: Path
) -> None:
    saved, loaded = (make(prefetch=number) for number in prefetch)
    loaded.storage.set(slice(0, len(loaded)), loaded[:].apply(torch.zeros_like))
    for buffer in (saved, loaded):
        buffer.sample()
    copy_state(way, saved, loaded, tmp_path)
    sample = loaded.sample()  # not one that was prefetched before
    assert torch.equal(sample["number"], saved[:]["number"][sample["index"]])
    assert not [file for file in tmp_path.rglob("*") if file.suffix in (".pkl", ".pt", ".t")]


def test_a_dump_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: not a dump of these data"):
        single().loads(tmp_path / "nowhere")


@every_buffer
def test_a_dump_that_was_cut_short_is_refused_by_name_and_size_and_changes_nothing(
    make: Make, tmp_path: Path
) -> None:
    make().dumps(tmp_path)
    file = max(tmp_path.rglob("*.memmap"), key=lambda file: file.stat().st_size)
    content = file.read_bytes()
    loaded = make()
    before = loaded[:].clone()
    for size in (len(content) - 1, 0, len(content) + 1):
        file.write_bytes((content + b"x")[:size])
        with pytest.raises(DataError, match=f"{size} bytes; valid: {len(content)}, ") as caught:
            loaded.loads(tmp_path)
        assert caught.value.path == file
        assert file.stat().st_size == size
    file.unlink()
    with pytest.raises(DataError, match=f"0 bytes; valid: {len(content)}, "):
        loaded.loads(tmp_path)
    assert (loaded[:] == before).all()


class Executed:
    """Creates a file when its pickle is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("part", ["storage", "rng_state"])
@every_buffer
def test_a_pickle_in_a_dump_is_refused_and_not_executed(
    make: Make, part: str, tmp_path: Path
) -> None:
    saved = make()
    saved.set_rng(torch.Generator().manual_seed(0))
    saved.dumps(tmp_path / "buffer")
    before = saved[:].clone()
    folder = tmp_path / "buffer" / part
    data = TensorDict.load_memmap(folder).clone()
    hidden = TensorDict({}, data.batch_size).set_non_tensor("x", Executed(tmp_path / "executed"))
    hidden.memmap(tmp_path / "hidden")
    shutil.copytree(tmp_path / "hidden" / "x", folder / "x")
    meta = json.loads((folder / "meta.json").read_text())
    meta["x"] = json.loads((tmp_path / "hidden" / "meta.json").read_text())["x"]
    (folder / "meta.json").write_text(json.dumps(meta))
    loaded = make()
    loaded.set_rng(torch.Generator().manual_seed(0))
    with pytest.raises(DataError, match="pickle"):
        loaded.loads(tmp_path / "buffer")
    assert not (tmp_path / "executed").exists()
    assert (loaded[:] == before).all()
    with pytest.warns(FutureWarning, match="pickle"):  # tensordict's reader executes it
        TensorDict.load_memmap(folder)
    assert (tmp_path / "executed").exists()
