"""Files of Minari's and D4RL's layouts, mutated in hundreds of ways: refused, or read to the step.

Whatever is read is compared with what a few lines of h5py here find in the file, and what is left
out is accounted for: steps, reward and successes read and left out are those of the file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("minari")

import h5py
from test_mutations import BYTES, LINK, as_pairs, as_text, outcomes_of, try_all

from torchrl_bmrl.data import d4rl, minari
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import RawEpisode, complete
from torchrl_bmrl.errors import DataError

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")

Outcome = dict[str, Any]
Random = np.random.Generator
Edit = Callable[[Any, Random], object]
LENGTHS = (5, 6, 7, 4)
SEEDS = 4
"""Times that each structural mutation is tried, at other places."""


def rewrite(file: Any, key: str, change: Callable[[np.ndarray], Any]) -> None:
    value = change(file[key][()])
    del file[key]
    file[key] = value


def rewrite_all(file: Any, keys: Sequence[str], change: Callable[[np.ndarray], Any]) -> None:
    for key in keys:
        rewrite(file, key, change)


def rename(file: Any, key: str) -> None:
    file.move(key, f"{key}_")


def shift(file: Any) -> None:
    """Makes next observations of the rows that follow, whosever they are."""
    for before, after in zip(FLAT[:2], AFTER, strict=True):
        shifted = np.roll(file[before][()], -1, axis=0)
        del file[after]
        file[after] = shifted


def set_item(array: np.ndarray, index: Any, value: Any) -> np.ndarray:
    array[index] = value
    return array


def as_group(file: Any, key: str) -> None:
    del file[key]
    file.create_group(key)["x"] = 1.0


def as_link(file: Any, key: str, link: Any = LINK) -> None:
    del file[key]
    file[key] = link


WRECKS: dict[str, Callable[[Any, str, Random], object]] = {
    # What is done to an array that has to be there, in whatever layout.
    "a group": lambda file, key, rng: as_group(file, key),
    "dangling link": lambda file, key, rng: as_link(file, key),
    "link to another file": lambda file, key, rng: as_link(
        file, key, h5py.ExternalLink("missing.hdf5", key)
    ),
    "a scalar": lambda file, key, rng: rewrite(file, key, lambda x: x.flat[0]),
    "rows less": lambda file, key, rng: rewrite(file, key, lambda x: x[: -rng.integers(1, 4)]),
    "rows more": lambda file, key, rng: rewrite(
        file, key, lambda x: np.concatenate([x, x[: rng.integers(1, 4)]])
    ),
    "no rows": lambda file, key, rng: rewrite(file, key, lambda x: x[:0]),
    "rows of rows": lambda file, key, rng: rewrite(file, key, lambda x: np.stack([x, x], axis=-1)),
    "text": lambda file, key, rng: rewrite(file, key, as_text),
    "pairs": lambda file, key, rng: rewrite(file, key, as_pairs),
    "complex": lambda file, key, rng: rewrite(file, key, lambda x: x.astype(complex)),
}


def sparse(length: int, rng: Random) -> np.ndarray:
    return (np.arange(length) == length - 1) * float(rng.integers(1, 5))


# -- Minari ----------------------------------------------------------------------------------------


def make_episode(number: int, steps: int) -> Episode:
    rng = np.random.default_rng(number)
    arm, touch = rng.standard_normal((steps + 1, 3)), rng.integers(0, 9, (steps + 1, 2))
    last = np.arange(steps) == steps - 1
    return Episode(
        observations={"arm": arm[:-1], "touch": touch[:-1]},
        next_observations={"arm": arm[1:], "touch": touch[1:]},
        actions=rng.uniform(-1, 1, (steps, 2)).astype(np.float32),
        rewards=rng.random(steps),
        terminated=last & (number == 1),
        extras={"successes": last & (number < 2), "states": rng.standard_normal((steps, 4))},
        attributes={"seed": number},
    )


def episode_key(file: Any, rng: Random, *keys: str) -> str:
    return f"episode_{rng.integers(len(LENGTHS))}/{rng.choice(keys)}"


PARTS = ("observations/arm", "observations/touch")
NEEDED = (*PARTS, "actions", "terminations", "truncations")


def wreck_episode(change: Callable[[Any, str, Random], object]) -> Edit:
    return lambda file, rng: change(file, episode_key(file, rng, "rewards", *NEEDED), rng)


def shorten_episode(file: Any, rng: Random) -> None:
    """Another episode, whole, as its attributes do not know."""
    name, steps = f"episode_{rng.integers(len(LENGTHS))}", int(rng.integers(1, 4))
    keys: list[str] = []
    file[name].visit(keys.append)
    for key in keys:
        if isinstance(file[f"{name}/{key}"], h5py.Dataset):
            more = int(key.startswith(("observations", "infos")))
            shorter = file[f"{name}/{key}"][: steps + more]
            del file[f"{name}/{key}"]
            file[f"{name}/{key}"] = shorter


def add_beside(*keys: str) -> Edit:
    values = {"group/x": 1.0, "text": b"a", "numbers": np.zeros(3), "number": 3.0, "link": LINK}

    def edit(file: Any, rng: Random) -> None:
        name = str(rng.choice(list(values)))
        where = keys[int(rng.integers(len(keys)))].format(rng.integers(len(LENGTHS)))
        file[f"{where}/spare_{name}"] = values[name]

    return edit


def change_metadata(**changes: Callable[[Any, Random], Any]) -> Edit:
    def edit(file: Any, rng: Random) -> None:
        path = Path(file.filename).with_name("metadata.json")
        metadata = json.loads(path.read_text())
        metadata |= {key: change(metadata[key], rng) for key, change in changes.items()}
        path.write_text(json.dumps(metadata))

    return edit


def change_attribute(key: str, *values: Any) -> Edit:
    def edit(file: Any, rng: Random) -> None:
        name = f"episode_{rng.integers(len(LENGTHS))}"
        file[name].attrs[key] = values[int(rng.integers(len(values)))]

    return edit


def edit_episode(key: str, change: Callable[[np.ndarray, Random], Any]) -> Edit:
    return lambda file, rng: rewrite(
        file, episode_key(file, rng, key), lambda array: change(array, rng)
    )


MINARI: dict[str, tuple[Edit, str | None]] = {
    # What is done; what is said of it where it loads, or None where it is refused.
    **{kind: (wreck_episode(change), None) for kind, change in WRECKS.items()},
    "deleted": (lambda file, rng: file.pop(episode_key(file, rng, "rewards", *NEEDED)), None),
    "another name": (
        lambda file, rng: rename(file, episode_key(file, rng, *NEEDED)),
        None,
    ),
    "a group is gone": (lambda file, rng: file.pop(episode_key(file, rng, "observations")), None),
    "rows of other sizes": (
        lambda file, rng: rewrite(
            file, episode_key(file, rng, *PARTS, "actions"), lambda x: x[:, :-1]
        ),
        None,
    ),
    "actions of integers": (edit_episode("actions", lambda x, rng: x.astype(int)), None),
    "a part of floats": (edit_episode("observations/touch", lambda x, rng: x + 0.5), None),
    "an early end": (
        edit_episode("truncations", lambda x, rng: set_item(x, rng.integers(len(x) - 1), True)),
        None,
    ),
    "half an end": (edit_episode("terminations", lambda x, rng: x + 0.25), None),
    "success of other rows": (
        edit_episode("infos/success", lambda x, rng: x[: rng.integers(0, len(x) - 1)]),
        None,
    ),
    "no episodes": (lambda file, rng: file.clear(), None),
    "an episode is an array": (
        lambda file, rng: (file.pop("episode_2"), file.update({"episode_2": np.zeros(5)})),
        None,
    ),
    "a space of texts": (
        change_metadata(observation_space=lambda told, rng: '{"type": "Text"}'),
        None,
    ),
    "another space": (
        change_metadata(action_space=lambda told, rng: told.replace("[2]", "[3]")),
        None,
    ),
    "sparse rewards": (edit_episode("rewards", lambda x, rng: sparse(len(x), rng)), ""),
    "no reward": (edit_episode("rewards", lambda x, rng: 0 * x), ""),
    "a constant dimension": (edit_episode("observations/arm", lambda x, rng: 0 * x + x[:1]), ""),
    "no success": (edit_episode("infos/success", lambda x, rng: np.zeros_like(x)), ""),
    "success at every step": (edit_episode("infos/success", lambda x, rng: np.ones_like(x)), ""),
    "no infos": (lambda file, rng: file.pop(episode_key(file, rng, "infos")), ""),
    "another length": (shorten_episode, "total_steps contradicts"),
    "an episode less": (lambda file, rng: file.pop(episode_key(file, rng, "")[:-1]), "total_"),
    "an episode more": (
        lambda file, rng: file.copy(f"episode_{rng.integers(4)}", "episode_4"),
        "total_episodes is 4 in metadata.json, the arrays have 5",
    ),
    "beside the episodes": (add_beside(""), "beside the episodes, not read: 'spare_"),
    "beside the arrays": (add_beside("episode_{}", "episode_{}/infos"), "spare_"),
    "beside the parts": (add_beside("episode_{}/observations"), "observations/spare_"),
    "an id": (change_attribute("id", 9, -1, "x", 2.5, [1, 2]), "id contradicts"),
    "total_steps": (change_attribute("total_steps", 9, 0, "x", 5.5), "total_steps contradicts"),
    "another attribute": (change_attribute("new", 3.5, "x", [1, 2], b"\xff"), ""),
    "a wrong total": (
        change_metadata(total_steps=lambda told, rng: told + int(rng.integers(1, 9))),
        "total_steps is",
    ),
    "a wrong count": (
        change_metadata(total_episodes=lambda told, rng: [None, 0, "x", 9][rng.integers(4)]),
        "total_episodes is",
    ),
}


class Minari:
    """A data set of Minari's layout, and what a few lines of h5py find in it."""

    module: ModuleType = minari
    structural = MINARI
    texts = ("metadata.json",)

    def __init__(self, folder: Path) -> None:
        self.source = folder / "sawyer" / "lift-v0"
        minari.write_episodes(self.source, [make_episode(*item) for item in enumerate(LENGTHS)])
        self.file = self.source / "data" / "main_data.hdf5"

    def look(self, file: Any) -> dict[str, dict[str, Any]]:
        """Arrays of each episode."""
        told = {}
        for name in sorted(name for name in file if name[8:].isdigit()):
            group = file[name]
            steps = len(group["actions"])
            success = group.get("infos/success", np.zeros(steps))[()][-steps:]
            told[name] = {
                "obs": {key[-3:]: group[key][()][:-1] for key in PARTS},
                "next": {key[-3:]: group[key][()][1:] for key in PARTS},
                "actions": group["actions"][()],
                "rewards": group["rewards"][()],
                "terminated": group["terminations"][()],
                "success": success.any(),
            }
        return told


# -- D4RL ------------------------------------------------------------------------------------------


FLAT = ("observations/arm", "observations/touch", "actions", "rewards", "terminals", "timeouts")
AFTER = ("next_observations/arm", "next_observations/touch")


def flat_key(rng: Random, *keys: str) -> str:
    return str(rng.choice(keys))


def wreck_flat(change: Callable[[Any, str, Random], object]) -> Edit:
    return lambda file, rng: change(file, flat_key(rng, *FLAT, *AFTER), rng)


def edit_flat(key: str, change: Callable[[np.ndarray, Random], Any]) -> Edit:
    return lambda file, rng: rewrite(file, key, lambda array: change(array, rng))


def without(*keys: str) -> Edit:
    return lambda file, rng: [file.pop(key) for key in keys]


def cut_file(file: Any, rng: Random) -> None:
    """The first rows of a file, as a download that was cut by a tool."""
    rows = int(rng.integers(8, sum(LENGTHS) - 5))
    keys: list[str] = []
    file.visit(keys.append)
    for key in keys:
        if isinstance(file[key], h5py.Dataset):
            rewrite(file, key, lambda x: x[:rows])


def shift_without_timeouts(file: Any, rng: Random) -> None:
    shift(file)
    del file["timeouts"]


def end_somewhere(array: np.ndarray, rng: Random) -> np.ndarray:
    return set_item(array, rng.choice(len(array), 3, replace=False), True)


D4RL: dict[str, tuple[Edit, str | None]] = {
    **{kind: (wreck_flat(change), None) for kind, change in WRECKS.items()},
    "deleted": (
        lambda file, rng: file.pop(
            flat_key(rng, "actions", "terminals", "rewards", "observations", *AFTER)
        ),
        None,
    ),
    "another name": (
        lambda file, rng: rename(file, flat_key(rng, "actions", "terminals")),
        None,
    ),
    "ends that nothing tells": (without("timeouts", "next_observations"), None),
    "shifted, without timeouts": (
        shift_without_timeouts,
        None,
    ),
    "rows of other sizes": (
        lambda file, rng: rewrite(file, flat_key(rng, *AFTER), lambda x: x[:, :-1]),
        None,
    ),
    "another dtype": (
        lambda file, rng: rewrite(file, flat_key(rng, *AFTER), lambda x: x.astype(np.float16)),
        None,
    ),
    "NaN": (
        lambda file, rng: rewrite(
            file,
            flat_key(rng, "rewards", "actions", "observations/arm", "next_observations/arm"),
            lambda x: set_item(x, rng.integers(len(x)), np.nan),
        ),
        None,
    ),
    "half an end": (
        lambda file, rng: rewrite(file, flat_key(rng, "terminals", "timeouts"), lambda x: x * 0.5),
        None,
    ),
    "success of other rows": (edit_flat("infos/success", lambda x, rng: x[1:]), None),
    "success of 3": (edit_flat("infos/success", lambda x, rng: x * 3), None),
    "sparse rewards": (edit_flat("rewards", lambda x, rng: sparse(len(x), rng)), ""),
    "no reward": (edit_flat("rewards", lambda x, rng: 0 * x), ""),
    "columns": (
        lambda file, rng: rewrite_all(file, FLAT[3:], lambda x: x[:, None]),
        "",
    ),
    "a constant dimension": (
        lambda file, rng: rewrite_all(file, (FLAT[1], AFTER[1]), np.ones_like),
        "",
    ),
    "no success": (edit_flat("infos/success", lambda x, rng: np.zeros_like(x)), ""),
    "no infos": (without("infos"), ""),
    "no timeouts": (without("timeouts"), "no timeouts: an episode ends at a terminal and where"),
    "no next observations": (without("next_observations"), ""),
    "other terminals": (edit_flat("terminals", end_somewhere), ""),
    "other timeouts": (edit_flat("timeouts", end_somewhere), ""),
    "ends of both kinds": (
        lambda file, rng: rewrite_all(file, FLAT[4:], np.ones_like),
        "22 rows are terminal and timeout at once",
    ),
    "no end": (
        lambda file, rng: rewrite_all(file, FLAT[4:], np.zeros_like),
        "rows 0 to 21 end in neither",
    ),
    "the first rows": (cut_file, ""),
    "shifted": (
        lambda file, rng: shift(file),
        "next_observations is the next episode's first observation",
    ),
    "beside": (add_beside("", "infos"), "spare_"),
    "beside the metadata": (
        lambda file, rng: file.update({"metadata/net/weight": np.zeros((2, 2))}),
        "1 arrays below metadata are not read, such as metadata/net/weight",
    ),
}


class D4rl:
    """A file of D4RL's layout, and what a few lines of h5py find in it."""

    module: ModuleType = d4rl
    structural = D4RL
    texts = ()

    def __init__(self, folder: Path) -> None:
        self.source = self.file = folder / "hopper.hdf5"
        made = [make_episode(*item) for item in enumerate(LENGTHS)]
        last = np.cumsum(LENGTHS) - 1
        rows = np.arange(sum(LENGTHS))
        terminals = np.concatenate([episode.terminated for episode in made])
        arrays: dict[str, Any] = {
            **{f"observations/{k}": [e.observations[k] for e in made] for k in ("arm", "touch")},
            **{f"{k}": [e.next_observations[k[18:]] for e in made] for k in AFTER},
            "actions": [episode.actions for episode in made],
            "rewards": [episode.rewards for episode in made],
            "infos/success": [episode.extras["successes"] for episode in made],
            "infos/states": [episode.extras["states"] for episode in made],
            "terminals": [terminals],
            "timeouts": [np.isin(rows, last) & ~terminals],
        }
        with h5py.File(self.file, "w", libver=("v110", "v110")) as file:
            for key, parts in arrays.items():
                file.create_dataset(
                    key, data=np.concatenate(parts), compression="gzip", fletcher32=True
                )

    def look(self, file: Any) -> dict[str, dict[str, Any]]:
        """Arrays of each episode."""
        whole = {
            key: file[key][()]
            for key in (*FLAT, *AFTER, "infos/success", "infos/states")
            if key in file
        }
        steps = len(whole["actions"])
        whole |= {
            key: whole[key].reshape(steps)
            for key in ("rewards", "terminals", "timeouts")
            if key in whole
        }
        if "timeouts" in whole:
            cut = whole["timeouts"]
        else:
            cut = np.zeros(steps, bool)
            for before, after in zip(FLAT[:2], AFTER, strict=True):
                cut[:-1] |= (whole[before][1:] != whole[after][:-1]).any(axis=1)
        ends = [int(row) for row in np.flatnonzero(whole["terminals"] | cut)]
        told, start = {}, 0
        for end in sorted({*ends, steps - 1}):
            rows = slice(start, end + 1)
            told[f"rows_{start}_to_{end}"] = {
                "obs": {key[-3:]: whole[key][rows] for key in FLAT[:2]},
                "next": {key[-3:]: whole[key][rows] for key in AFTER}
                if AFTER[0] in whole
                else None,
                "actions": whole["actions"][rows],
                "rewards": whole["rewards"][rows],
                "terminated": whole["terminals"][rows],
                "success": whole.get("infos/success", np.zeros(steps))[rows].any(),
            }
            start = end + 1
        return told


# -- what a mutated file gives ---------------------------------------------------------------------


def assert_same(ours: Any, theirs: Any) -> None:
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs, strict=True)


def compare(raws: Mapping[str, RawEpisode], told: Mapping[str, dict[str, Any]]) -> None:
    """What was read is what the file has, to the bit."""
    assert sorted(raws) == sorted(told)
    for name, raw in raws.items():
        theirs = told[name]
        steps = len(theirs["actions"])
        after = raw.next_observations
        if after is None and any(len(part) == steps + 1 for part in raw.observations.values()):
            after = {key: part[1:] for key, part in raw.observations.items()}
        assert (after is None) == (theirs["next"] is None)
        for ours, parts in ((raw.observations, theirs["obs"]), (after, theirs["next"])):
            for key, part in (ours or {}).items():
                assert_same(part[:steps], parts[key[-3:]])
        for key in ("actions", "rewards", "terminated"):
            assert_same(getattr(raw, key), theirs[key])


def account(raws: Mapping[str, RawEpisode], told: Mapping[str, dict[str, Any]]) -> None:
    """Steps, reward and successes that are read and left out are those of the file."""
    steps = reward = successes = 0
    for name, raw in raws.items():
        # A single step that is left out leaves nothing: that is refused.
        options = ReadOptions(last_step="truncate" if len(raw.actions) == 1 else None)
        episode = complete("file", name, raw, options)
        steps += len(episode) + episode.left_out.steps
        reward += episode.rewards.sum() + episode.left_out.reward
        successes += bool(episode.succeeded) + episode.left_out.success
    assert steps == sum(len(x["actions"]) for x in told.values())
    assert reward == pytest.approx(sum(x["rewards"].sum() for x in told.values()))
    assert successes == sum(x["success"] for x in told.values())


class Mutator:
    """Mutates one good data set and looks at what comes of it.

    Args:
        layout: of the data set.
    """

    def __init__(self, layout: Any) -> None:
        self.layout = layout
        files = [layout.file, *(layout.file.with_name(name) for name in layout.texts)]
        self.good = {file: file.read_bytes() for file in files}
        with h5py.File(layout.file) as file:
            self.told = layout.look(file)

    def load(self) -> tuple[dict[str, RawEpisode], list[str]] | None:
        """Episodes and oddities; ``None`` where the data set is refused, with its name."""
        try:
            return self.read()
        except DataError as error:
            text = str(error)
        assert text.startswith(str(self.layout.source)), text
        return None

    def read(self) -> tuple[dict[str, RawEpisode], list[str]]:
        module, source = self.layout.module, self.layout.source
        with module.open_data(source) as opened:
            raws = dict(opened.episodes)
        for name, raw in raws.items():
            if raw.rewards is None:
                complete(self.layout.file, name, raw, ReadOptions())
        return raws, list(opened.oddities)

    def bytes(self, kind: str, seed: int) -> Outcome:
        """A mutation of bytes: whatever loads is the original."""
        self.restore()
        rng = np.random.default_rng(seed)
        texts = self.layout.texts if seed % 4 == 0 else ()
        path = self.layout.file.with_name(texts[0]) if texts else self.layout.file
        content = bytearray(self.good[path])
        while len(content) < 5000:  # for blocks of any size
            content += b" "
        BYTES[kind][0](content, rng)
        path.write_bytes(content)
        loaded = self.load()
        if loaded is None:
            return {"outcome": "refused"}
        raws = loaded[0]
        # A part that metadata.json no longer names is left alone, and is said to be.
        beside = {name for name, raw in raws.items() if raw.left_alone}
        assert texts or not beside
        for name in beside:
            assert all(x.startswith("observations/") for x in raws[name].left_alone)
        whole = {name: raw for name, raw in raws.items() if name not in beside}
        compare(whole, {name: x for name, x in self.told.items() if name not in beside})
        return {"outcome": "loaded"}

    def structural(self, kind: str, seed: int) -> Outcome:
        """Another valid file: refused, or read as it is, with what is odd about it."""
        self.restore()
        edit, said = self.layout.structural[kind]
        with h5py.File(self.layout.file, "r+") as file:
            edit(file, np.random.default_rng(seed))
        loaded = self.load()
        assert (loaded is None) == (said is None), "refused" if loaded is None else "loaded"
        if loaded is None:
            return {"outcome": "refused"}
        raws, oddities = loaded
        with h5py.File(self.layout.file) as file:
            told = self.layout.look(file)
        compare(raws, told)
        account(raws, told)
        mentioned = [*oddities, *(name for raw in raws.values() for name in raw.left_alone)]
        assert not said or any(said in text for text in mentioned), mentioned
        return {"outcome": "loaded"}

    def restore(self) -> None:
        for path, content in self.good.items():
            path.write_bytes(content)


def mutations(layout: Any) -> list[tuple[str, str, int]]:
    return [
        *(("bytes", kind, seed) for kind, (_, count) in BYTES.items() for seed in range(count)),
        *(("structural", kind, seed) for kind in layout.structural for seed in range(SEEDS)),
    ]


def run(folder: str, name: str) -> None:
    mutator = Mutator(LAYOUTS[name](Path(folder)))
    try_all(mutator, mutations(mutator.layout), Path(folder))


LAYOUTS: dict[str, Any] = {"minari": Minari, "d4rl": D4rl}


@pytest.fixture(scope="module", params=LAYOUTS)
def outcomes(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[Any, Outcome]]:
    return outcomes_of(run, tmp_path_factory.mktemp(request.param), request.param)


def test_every_mutated_file_is_refused_or_read_to_the_step(
    outcomes: list[tuple[Any, Outcome]],
) -> None:
    assert len(outcomes) >= 200
    wrong = [(mutation, outcome["outcome"]) for mutation, outcome in outcomes if "wrong" in outcome]
    assert wrong == []


def test_mutations_of_bytes_are_found(outcomes: list[tuple[Any, Outcome]]) -> None:
    found = [kind for (_, kind, _), outcome in outcomes if outcome["outcome"] == "refused"]
    assert found.count("truncated") > BYTES["truncated"][1] / 2
    assert found.count("flipped bit in use") > BYTES["flipped bit in use"][1] / 3
