"""A valid file, mutated in hundreds of ways, is refused by name or loads correctly."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
import torch
from episode_files import write_file
from file_edits import as_group, rewrite
from mutations import BYTES, LINK, Outcome, as_pairs, as_text, outcomes_of, try_all

from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.robomimic import open_episodes, read_metadata
from torchrl_bmrl.data.summary import summarise
from torchrl_bmrl.errors import DataError

LENGTHS = (5, 6, 7)
NAMES = [f"demo_{i}" for i in range(len(LENGTHS))]
ARRAYS = ("actions", "rewards", "terminated", "successes", "phases", "states")
PARTS = tuple(f"{group}/{part}" for group in ("obs", "next_obs") for part in ("object", "image"))
FLOATS = ("actions", "rewards", "states", "obs/object", "next_obs/object")


# -- structure: another valid HDF5 file, which is refused with the key at fault --------------------


def with_value(index: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array.reshape(len(array), -1)[index % len(array), 0] = value
        return array

    return change


Edit = Callable[[Any, str], object]
CHECKED = (*ARRAYS, *PARTS)
STRUCTURAL: dict[str, tuple[Edit, tuple[str, ...]]] = {
    # name: the edit of an array of an episode, and the arrays that it is applied to
    # Without `terminated` an episode counts as truncated, as in robomimic's own files.
    "deleted": (
        lambda demo, key: demo.pop(key),
        tuple(key for key in CHECKED if key != "terminated"),
    ),
    "a group": (as_group, CHECKED),
    "another name": (
        lambda demo, key: demo.move(key, f"{key}_"),
        tuple(key for key in CHECKED if key != "terminated"),
    ),
    "dangling link": (lambda demo, key: (demo.pop(key), demo.update({key: LINK})), CHECKED),
    "transposed": (lambda demo, key: rewrite(demo, key, lambda x: x.T), ("actions", *PARTS)),
    "a column": (lambda demo, key: rewrite(demo, key, lambda x: x[:, None]), CHECKED),
    "flat": (lambda demo, key: rewrite(demo, key, np.ravel), ("actions", "states", *PARTS)),
    "a scalar": (lambda demo, key: rewrite(demo, key, lambda x: x.flat[0]), CHECKED),
    "one row less": (lambda demo, key: rewrite(demo, key, lambda x: x[:-1]), CHECKED),
    "one row more": (
        lambda demo, key: rewrite(demo, key, lambda x: np.concatenate([x, x[-1:]])),
        CHECKED,
    ),
    "no rows": (lambda demo, key: rewrite(demo, key, lambda x: x[:0]), CHECKED),
    "one dimension less": (
        lambda demo, key: rewrite(demo, key, lambda x: x[..., :-1]),
        ("actions", "states", *PARTS),
    ),
    "text": (lambda demo, key: rewrite(demo, key, as_text), CHECKED),
    "bytes": (lambda demo, key: rewrite(demo, key, lambda x: x.astype("S8")), CHECKED),
    "complex": (lambda demo, key: rewrite(demo, key, lambda x: x.astype(complex)), CHECKED),
    "pairs": (lambda demo, key: rewrite(demo, key, as_pairs), CHECKED),
    "another dtype": (lambda demo, key: rewrite(demo, key, lambda x: x.astype("f2")), PARTS),
    "NaN": (lambda demo, key: rewrite(demo, key, with_value(2, np.nan)), FLOATS),
    "inf": (lambda demo, key: rewrite(demo, key, with_value(3, -np.inf)), FLOATS),
    "three times as large": (lambda demo, key: rewrite(demo, key, lambda x: 3 * x), ("actions",)),
    "neither 0 nor 1": (
        lambda demo, key: rewrite(demo, key, lambda x: x + np.float32(0.5)),
        ("terminated", "successes"),
    ),
    "terminated at once": (lambda demo, key: rewrite(demo, key, np.ones_like), ("terminated",)),
}
UNREAD = ("phases", "states")
"""A replay buffer does not read these arrays and accepts any values in them."""
ONE_NUMBER = ("rewards", "terminated", "successes")
"""These arrays may also have the shape (T, 1), as in TorchRL."""


def damage_group(file: Any, rng: np.random.Generator) -> str:
    """Damages a group or the arrays of an episode as a whole; returns the key."""
    key = demo = f"data/{rng.choice(NAMES[1:])}"
    other = "data/demo_0"
    choice = rng.integers(7)
    if choice == 0:
        key = f"{demo}/obs"
        del file[key]
    elif choice == 1:
        del file[demo]
        file[demo] = np.zeros((5, 7))
    elif choice == 2:  # of another length
        file.move(f"{demo}/actions", f"{demo}/spare")
        file[f"{demo}/actions"] = file[f"{other}/actions"]
        del file[f"{demo}/spare"]
    elif choice == 3:
        key = f"{demo}/next_obs"
        del file[key]
        file[key] = file[f"{other}/next_obs"]
    elif choice == 4:
        key = f"{demo}/obs"
        del file[key]
        file.create_group(key)
    elif choice == 5:
        del file[demo]
        file[demo] = h5py.ExternalLink("missing.hdf5", "/data")
    else:
        key = "data"
        file.move("data", "Data")
    return key


def damage_mask(file: Any, rng: np.random.Generator) -> str:
    """Damages the mask ``train``."""
    key = "mask/train"
    names = file[key][()]
    values = {
        "unknown": [*names[:-1], b"demo_9"],
        "twice": [*names, names[0]],
        "none": np.array([], dtype="S6"),
        "numbers": np.arange(len(names)),
        "table": np.zeros((2, 2)),
        "text": np.array(["demo_0", "demo 1"], dtype=h5py.string_dtype()),
        "group": LINK,
    }
    del file[key]
    file[key] = values[rng.choice(list(values))]
    return key


def damage_attribute(file: Any, rng: np.random.Generator) -> str:
    """Gives an attribute, which no array depends on, a value of another type."""
    values = (3.5, b"\xff\xfe", "{", h5py.Empty("f8"), np.zeros((2, 2)), ["a"], 1j, file.ref)
    group = file[rng.choice(["data", "data/demo_1"])]
    name = str(rng.choice([*group.attrs, "new"]))
    group.attrs[name] = values[rng.integers(len(values))]
    return str(group.name)


# -- what a mutated file gives ---------------------------------------------------------------------


def load(path: Path, root: Path, split: str | None) -> tuple[str | None, str | None, Any]:
    """Key and text of the refusal, or the data; asserts that no unfinished folder remains."""
    before = path.read_bytes()
    key = text = data = None
    try:
        replay = RobomimicExperienceReplay(path, root=root, split=split)
        data = (replay[:].to_tensordict(), replay.metadata)
    except DataError as error:
        key, text = error.key, str(error)
    left = sorted(os.listdir(root)) if root.exists() else []
    assert len(left) == (data is not None), f"left behind: {left}"
    assert not any(name.startswith(".") for name in left), f"left behind: {left}"
    assert path.read_bytes() == before, "the source has been modified"
    return key, text, data


def check(path: Path) -> tuple[list[tuple[str | None, str]], Any]:
    """The problems that the check finds, and the episodes if it finds none."""
    try:
        metadata = read_metadata(path)
        with open_episodes(path) as episodes:
            problems = summarise(episodes, prefix="data/").problems
            return problems, None if problems else (dict(episodes), metadata)
    except DataError as error:
        return [(error.key, error.message)], None


def assert_equal(ours: Any, theirs: Any, where: str = "") -> None:
    """Asserts that nested dictionaries are equal to the bit."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), where
        for key in theirs:
            assert_equal(ours[key], theirs[key], f"{where}/{key}")
    elif isinstance(theirs, torch.Tensor):
        assert ours.dtype == theirs.dtype, where
        assert torch.equal(ours, theirs), where
    elif isinstance(theirs, np.ndarray):
        assert ours.dtype == theirs.dtype, where
        assert ours.shape == theirs.shape, where
        assert ours.tobytes() == theirs.tobytes(), where
    else:
        assert ours == theirs, where


def plain(data: Any) -> Any:
    """Loaded data as nested dictionaries."""
    tensors, metadata = data
    return {"data": tensors.to_dict(), "metadata": metadata}


def plain_episodes(checked: Any) -> Any:
    """Episodes as nested dictionaries."""
    episodes, metadata = checked
    return {"episodes": {k: vars(e) for k, e in episodes.items()}, "metadata": metadata}


class Mutator:
    """Mutates one valid file and checks the outcome.

    Args:
        folder: where the files are written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        good = folder / "good.hdf5"
        write_file(good, LENGTHS, train=2)
        self.good = good.read_bytes()
        self.path = folder / "lift.hdf5"
        self.path.write_bytes(self.good)
        self.data = {
            split: plain(load(self.path, folder / "good" / str(split), split)[2])
            for split in (None, "train")
        }
        self.episodes = plain_episodes(check(self.path)[1])

    def bytes(self, kind: str, seed: int) -> Outcome:
        """Mutates bytes: data that still load must be the original."""
        data = bytearray(self.good)
        BYTES[kind][0](data, np.random.default_rng(seed))
        self.path.write_bytes(data)
        split = "train" if seed % 2 else None
        _, text, loaded = load(self.path, self.root(kind, seed), split)
        if text is None:
            assert_equal(plain(loaded), self.data[split])
        else:
            assert text.startswith(f"{self.path}: "), text
        problems, checked = check(self.path)
        if not problems:
            assert_equal(plain_episodes(checked), self.episodes)
            assert text is None, f"the check found nothing, but: {text}"
        return {"outcome": "refused" if problems else "loaded", "text": text}

    def structural(self, kind: str, seed: int) -> Outcome:
        """Mutates one array: the file must be refused with its key."""
        edit, keys = STRUCTURAL[kind]
        demo, key = NAMES[seed % len(NAMES)], keys[seed]
        self.mutate(lambda file: edit(file[f"data/{demo}"], key))
        _, text, loaded = load(self.path, self.root(kind, seed), None)
        problems, _ = check(self.path)
        if key in UNREAD or (kind == "a column" and key in ONE_NUMBER):
            assert text is None, text
            assert_equal(plain(loaded), self.data[None])
            return {"outcome": "loaded"}
        assert text is not None, f"data/{demo}/{key} was loaded"
        assert text.startswith(f"{self.path}: data/demo_"), text
        assert problems, f"data/{demo}/{key} passed the check"
        # If the first episode is damaged, the check may name the others, which differ from it.
        named = key.removesuffix("_").split("/")[-1]
        assert any(named in str(where) for where, _ in problems), problems
        if kind in ("NaN", "inf", "neither 0 nor 1", "three times as large", "terminated at once"):
            assert any("in row" in message for _, message in problems), problems
        return {"outcome": "refused", "text": text}

    def other(self, kind: str, seed: int) -> Outcome:
        """Mutates a group, a mask or an attribute."""
        rng = np.random.default_rng(seed)
        edit = {"group": damage_group, "mask": damage_mask, "attribute": damage_attribute}[kind]
        keys: list[str] = []
        self.mutate(lambda file: keys.append(edit(file, rng)))
        split = "train" if kind == "mask" else None
        _, text, loaded = load(self.path, self.root(kind, seed), split)
        problems, _ = check(self.path)
        if kind == "attribute":
            if text is None:
                assert_equal(plain(loaded)["data"], self.data[None]["data"])
            return {"outcome": "loaded" if text is None else "refused", "text": text}
        assert text is not None, f"{keys[0]} was loaded"
        assert text.startswith(f"{self.path}: {keys[0]}"), text
        assert kind == "mask" or problems
        return {"outcome": "refused", "text": text}

    def mutate(self, edit: Callable[[Any], object]) -> None:
        self.path.write_bytes(self.good)
        with h5py.File(self.path, "r+") as file:
            edit(file)

    def root(self, *name: object) -> Path:
        return self.folder / "-".join(map(str, name))


def mutations() -> list[tuple[str, str, int]]:
    rng = np.random.default_rng(0)
    return [
        *(("bytes", kind, seed) for kind, (_, count) in BYTES.items() for seed in range(count)),
        *(
            ("structural", kind, int(seed))
            for kind, (_, keys) in STRUCTURAL.items()
            for seed in rng.permutation(len(keys))[:3]
        ),
        *(("other", "group", seed) for seed in range(14)),
        *(("other", "mask", seed) for seed in range(12)),
        *(("other", "attribute", seed) for seed in range(16)),
    ]


def run(folder: str) -> None:
    torch.set_num_threads(1)
    try_all(Mutator(Path(folder)), mutations(), Path(folder))


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Any, Outcome]]:
    return outcomes_of(run, tmp_path_factory.mktemp("mutations"))


def test_every_mutated_file_is_refused_by_name_or_loads_correctly(
    outcomes: list[tuple[Any, Outcome]],
) -> None:
    assert len(outcomes) >= 200
    wrong = [(mutation, outcome["outcome"]) for mutation, outcome in outcomes if "wrong" in outcome]
    assert wrong == []


def test_every_kind_of_mutation_is_tried(outcomes: list[tuple[Any, Outcome]]) -> None:
    kinds = {kind for (_, kind, _), _ in outcomes}
    assert kinds == {*BYTES, *STRUCTURAL, "group", "mask", "attribute"}


def test_damage_to_what_is_read_is_found(outcomes: list[tuple[Any, Outcome]]) -> None:
    found = Counter(kind for (_, kind, _), o in outcomes if "refused" in o["outcome"])
    assert found["truncated"] == BYTES["truncated"][1]
    assert found["bytes appended"] == 0
    assert found["flipped bit in use"] > BYTES["flipped bit in use"][1] / 2
