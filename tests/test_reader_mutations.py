"""Mutated files of Minari's and D4RL's layouts are refused, or read to the step.

What is read is compared with what a few lines of h5py find in the file. Steps, reward and
successes that are read or left out add up to those of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("minari")

import h5py
from d4rl_mutations import D4rl
from episode_files import assert_identical
from minari_mutations import Minari
from mutations import BYTES, Outcome, outcomes_of, try_all

from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import RawEpisode, complete
from torchrl_bmrl.errors import DataError

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")
SEEDS = 4
"""Times that each structural mutation is tried, at other places."""


def compare(raws: Mapping[str, RawEpisode], found: Mapping[str, dict[str, Any]]) -> None:
    """The episodes that were read have the file's numbers to the bit."""
    assert sorted(raws) == sorted(found)
    for name, raw in raws.items():
        theirs = found[name]
        steps = len(theirs["actions"])
        after = raw.next_observations
        if after is None and any(len(part) == steps + 1 for part in raw.observations.values()):
            after = {key: part[1:] for key, part in raw.observations.items()}
        assert (after is None) == (theirs["next"] is None)
        for ours, parts in ((raw.observations, theirs["obs"]), (after, theirs["next"])):
            assert set(ours or {}) == set(parts or {})
            for key, part in (ours or {}).items():
                assert_identical(part[:steps], parts[key])
        for key in ("actions", "rewards", "terminated"):
            assert_identical(getattr(raw, key), theirs[key])


def account(raws: Mapping[str, RawEpisode], found: Mapping[str, dict[str, Any]]) -> None:
    """Steps, reward and successes that are read or left out add up to those of the file."""
    steps = reward = successes = 0
    for name, raw in raws.items():
        # Leaving out the last step of an episode of one step is refused.
        options = ReadOptions(last_step="truncate" if len(raw.actions) == 1 else None)
        episode = complete("file", name, raw, options)
        steps += len(episode) + episode.left_out.steps
        reward += episode.rewards.sum() + episode.left_out.reward
        successes += bool(episode.succeeded) + episode.left_out.success
    assert steps == sum(len(x["actions"]) for x in found.values())
    assert reward == pytest.approx(sum(x["rewards"].sum() for x in found.values()))
    assert successes == sum(x["success"] for x in found.values())


class Mutator:
    """Mutates one good data set and checks how it is read.

    Args:
        layout: Layout of the data set.
    """

    def __init__(self, layout: Any) -> None:
        self.layout = layout
        files = [layout.file, *(layout.file.with_name(name) for name in layout.texts)]
        self.good = {file: file.read_bytes() for file in files}
        with h5py.File(layout.file) as file:
            self.found = layout.look(file)

    def load(self) -> tuple[dict[str, RawEpisode], list[str]] | None:
        """Episodes and oddities; ``None`` where the data set is refused by its name."""
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
        """A mutation of bytes: what loads equals the original."""
        self.restore()
        rng = np.random.default_rng(seed)
        texts = self.layout.texts if seed % 4 == 0 else ()
        path = self.layout.file.with_name(texts[0]) if texts else self.layout.file
        content = bytearray(self.good[path])
        while len(content) < 5000:  # so that blocks of all sizes fit
            content += b" "
        BYTES[kind][0](content, rng)
        path.write_bytes(content)
        loaded = self.load()
        if loaded is None:
            return {"outcome": "refused"}
        raws = loaded[0]
        # A part that metadata.json no longer names is left alone, and this is reported.
        beside = {name for name, raw in raws.items() if raw.left_alone}
        assert texts or not beside
        for name in beside:
            assert all(x.startswith("observations/") for x in raws[name].left_alone)
        whole = {name: raw for name, raw in raws.items() if name not in beside}
        compare(whole, {name: x for name, x in self.found.items() if name not in beside})
        return {"outcome": "loaded"}

    def structural(self, kind: str, seed: int) -> Outcome:
        """Another valid file: refused, or read as it is and its oddities reported."""
        self.restore()
        edit, reported = self.layout.structural[kind]
        with h5py.File(self.layout.file, "r+") as file:
            edit(file, np.random.default_rng(seed))
        loaded = self.load()
        assert (loaded is None) == (reported is None), "refused" if loaded is None else "loaded"
        if loaded is None:
            return {"outcome": "refused"}
        raws, oddities = loaded
        with h5py.File(self.layout.file) as file:
            found = self.layout.look(file)
        compare(raws, found)
        account(raws, found)
        mentioned = [*oddities, *(name for raw in raws.values() for name in raw.left_alone)]
        assert not reported or any(reported in text for text in mentioned), mentioned
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
