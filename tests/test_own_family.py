"""The page about a user's own family, executed as it is written, with fewer updates."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")
pytest.importorskip("sklearn")

import tiny_family
from helpers import shown_files
from small_runs import RECIPES, recipe

from torchrl_bmrl.data.importing import read_scaled_episode
from torchrl_bmrl.data.robomimic import read_kept_episode
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.pipeline import Run, collect, two_stage
from torchrl_bmrl.rows import read_rows
from torchrl_bmrl.studies import families
from torchrl_bmrl.studies.families import generalise
from torchrl_bmrl.tasks import FAMILIES

PAGE = RECIPES.parent / "docs" / "own_family.md"
FILES = shown_files(PAGE)
BLOCKS = re.findall(
    r"```python\n(.*?)```", PAGE.read_text().partition("## A new file")[2], re.DOTALL
)
FEW = [
    "preset=family",
    "tasks=[turns:turn]",
    "run_dir=run",
    "workers=2",
    "bcq.updates_per_epoch=5",
    "distill.updates=5",
    "distill.inference_updates=5",
    "distill.reward_updates=5",
    "evaluate.num_candidates=3",
]
STUDY = [
    "run_dir=run",
    "workers=2",
    "families.episodes=2",
    "families.mbml.updates=4",
    "families.mbml.reward_updates=2",
    "families.methods=[told,demonstration,behaviour,one_shot,mbml]",
]
READS_NONE = {"context": "set", "inference_updates": 0, "reward_updates": 0}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the page's module, and the demonstrations that its script writes."""
    forget_module()
    for name, text in FILES.items():
        (tmp_path / name).write_text(text.replace("range(0, 360, 30)", "range(0, 360, 120)"))
    path = os.pathsep.join([str(tmp_path), str(RECIPES.parent)])
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.syspath_prepend(str(tmp_path))
    subprocess.run([sys.executable, "record_turns.py"], cwd=tmp_path, check=True)
    yield tmp_path
    forget_module()


def forget_module() -> None:
    """The page's module is imported anew; its files lie in a test's own folder."""
    sys.modules.pop("turns", None)
    FAMILIES.pop("turn", None)


def change(folder: Path, angle: int, edit: Any) -> None:
    import h5py

    with h5py.File(folder / "turns" / f"{angle}.hdf5", "a") as file:
        edit(file)


def settings(folder: Path, distill: dict[str, Any] | None = None) -> Any:
    return tiny_family.settings(folder / "run", distill, tasks=["turns:turn"])


def returns(folder: Path) -> dict[tuple[str, str], list[str]]:
    """Returns of the demonstrations that each method is given of each member."""
    columns = dict.fromkeys(("method", "member", "data_return"), str)
    found: dict[tuple[str, str], list[str]] = {}
    for row in read_rows(folder / "run" / "families" / "results.csv", columns):
        found.setdefault((row["method"], row["member"]), []).append(row["data_return"])
    return found


@pytest.mark.slow
def test_the_page_leads_from_files_to_members_that_nobody_trained_on(folder: Path) -> None:
    for name, options in {"two_stage": FEW, "families": STUDY}.items():
        done = recipe(name, *options, cwd=folder)
        assert done.returncode == 0, done.stderr
    assert "m of one episode of another behaviour" in done.stdout
    given = returns(folder)
    assert len(given) == 5 * 3
    assert all(0.1 < float(value) <= 2.0 for values in given.values() for value in values)
    for way, context in {"demonstration": False, "behaviour": True}.items():
        path = folder / "run" / "families" / "contexts" / f"turn_45-{way}-1.npz"
        in_file = read_scaled_episode(
            folder / "turns" / "45.hdf5", 1, bounds=(-0.1, 0.1), context=context
        )
        assert np.allclose(read_kept_episode(path).actions, in_file.actions, atol=1e-6)
        assert np.abs(in_file.actions).max() == pytest.approx(1)  # in the file they end at 0.1

    space: dict[str, Any] = {}
    exec(BLOCKS[0], space)
    made = __import__("turns").make_turn(45)
    assert space["play"](folder / "run", made, steps=20).shape == (20,)


def test_files_without_other_behaviour_do_without_the_second_encoder(folder: Path) -> None:
    for path in (folder / "turns").glob("*.hdf5"):
        change(folder, int(path.stem), lambda file: file.pop("mask"))
    refused = replace(settings(folder), run_dir=str(folder / "refused"))
    with (
        Run(refused) as run,
        pytest.raises(DataError, match=r"mask/context: names no .*distill.context=set"),
    ):
        collect(run)
    with Run(settings(folder, READS_NONE)) as run:
        two_stage(run)
        (folder / "turns" / "0.hdf5").unlink()  # of a trained member, whose data the run has
        with pytest.raises(ConfigError, match="behaviour and the run has no episodes of another"):
            generalise(run, tiny_family.study())
        alone = replace(FAMILIES["turn"].tasks("inside")[0], make_env=None)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(families, "held_out_members", lambda run: [("inside", alone)])
            with pytest.raises(ConfigError, match="turn_45 of tasks have no environment"):
                generalise(run, tiny_family.study(methods=["demonstration"]))
        methods = ["demonstration", "one_shot", "focal", "mbml"]
        assert "FOCAL, given one" in generalise(run, tiny_family.study(methods=methods))


def test_a_held_out_file_that_is_short_or_missing_is_named_before_anything_is_trained(
    folder: Path,
) -> None:
    def one_is_left(file: Any) -> None:
        for name in set(file["data"]) - {"demo_3"}:
            del file["data"][name]
        del file["mask"]

    def one_context_is_left(file: Any) -> None:
        only = file["mask/context"][:1]
        del file["mask/context"]
        file["mask/context"] = only

    with Run(settings(folder)) as run:
        two_stage(run)
        change(folder, 45, one_context_is_left)
        short = r"turns/45.hdf5: 1 episodes in mask/context; valid: at least 2"
        with pytest.raises(DataError, match=short):
            generalise(run, tiny_family.study(methods=["behaviour"]))
        assert not (folder / "run" / "families").exists()
        change(folder, 165, one_is_left)
        short = r"turns/165.hdf5: 1 episodes outside mask/context; valid: at least 2"
        with pytest.raises(DataError, match=short):
            generalise(run, tiny_family.study(methods=["demonstration"]))
        (folder / "turns" / "285.hdf5").unlink()
        one = tiny_family.study(methods=["demonstration"], episodes=1)
        with pytest.raises(DataError, match=r"turns/285.hdf5"):
            generalise(run, one)
        assert not (folder / "run" / "families").exists()
        # Without a method that is given a demonstration, only its return is missing.
        generalise(run, replace(one, methods=["one_shot"]))
    given = returns(folder)
    assert given["one_shot", "turn_285"] == [""]
    assert float(given["one_shot", "turn_165"][0]) > 1
