"""Hundreds of odd files in robomimic's layout: each is accounted for to the step, or refused.

What a file holds is drawn at random and known to the test; what is read of it is worked out here
once more, from the documentation alone.
"""

from __future__ import annotations

import io
import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py

from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.errors import DataError

FILES = 240
OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"last_step": "drop"},
    {"last_step": "truncate"},
    {"last_step": "terminate"},
    {"dones_terminate": True},
    {"reward": "success"},
    {"reward": "last", "last_step": "truncate"},
    {"successful": True},
    {"successful": True, "last_step": "drop", "reward": "success"},
)


@dataclass
class Known:
    """What the test knows of a file: rewards and successes by episode, and what is wrong."""

    rewards: list[np.ndarray] = field(default_factory=list)
    successes: list[bool | None] = field(default_factory=list)
    solved: list[np.ndarray | None] = field(default_factory=list)
    next_obs: str = "there"
    has_rewards: bool = True
    has_dones: bool = True
    terminated: bool = False
    wrong: bool = False


def make(path: Path, rng: np.random.Generator) -> Known:
    """Writes a file as some tool or other might."""
    known = Known(
        next_obs=str(rng.choice(["there", "missing", "one more"])),
        has_rewards=bool(rng.random() < 0.85),
        has_dones=bool(rng.random() < 0.85),
        terminated=bool(rng.random() < 0.2),
    )
    kind = rng.choice(["sparse", "dense", "none", "penalty"])
    told = rng.choice(["attribute", "array", "both", "nobody"])
    parts = {f"x{i}": int(rng.integers(1, 4)) for i in range(rng.integers(1, 4))}
    dtype = rng.choice(["f4", "f8"])
    oddities = {
        name
        for name in ("datagen", "nested states", "beside", "constant", "totals", "text", "frozen")
        if rng.random() < 0.3
    }
    faulty = rng.integers(4) if rng.random() < 0.2 else None
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for i in range(rng.integers(1, 5)):
            steps = int(rng.integers(2, 12))
            demo, last = data.create_group(f"demo_{i}"), np.arange(steps) == steps - 1
            rewards = {
                "sparse": 1.0 * last,
                "dense": rng.random(steps),
                "none": np.zeros(steps),
                "penalty": -np.ones(steps),
            }[kind]
            for name, size in parts.items():
                x = rng.standard_normal((steps + 1, size)).astype(dtype)
                if "constant" in oddities:
                    x[:, 0] = 3
                if "frozen" in oddities:
                    x[:] = x[0]
                demo[f"obs/{name}"] = x if known.next_obs == "one more" else x[:-1]
                if known.next_obs == "there":
                    demo[f"next_obs/{name}"] = x[1:]
            demo["actions"] = rng.uniform(-1, 1, (steps, 2))
            if known.has_rewards:
                demo["rewards"] = rewards
            if known.has_dones:
                demo["dones"] = 1 * last
            if known.terminated:
                demo["terminated"] = last
            success = bool(rng.random() < 0.6)
            solved = (np.arange(steps) >= rng.integers(1, steps)) & success
            if told in ("attribute", "both"):
                demo.attrs["success"] = success
            if told in ("array", "both"):
                demo["successes"] = solved
            known.rewards.append(rewards)
            known.successes.append(None if told == "nobody" else success)
            known.solved.append(solved if told in ("array", "both") else None)
            if "datagen" in oddities:
                demo["obs/datagen_info/pose"] = np.zeros((steps, 4, 4))
            if "nested states" in oddities:
                demo["states/robot/joints"] = np.zeros((steps + 1, 7))
            if "text" in oddities:
                demo["obs/language"] = ["pick"] * steps
            if "totals" in oddities:
                demo.attrs["num_samples"] = steps + 3
        if "beside" in oddities:
            data["index"], file["elsewhere/x"] = np.arange(3), 1
        if faulty is not None:
            known.wrong = True
            damage(data["demo_0"], int(faulty), next(iter(parts)))
    return known


def damage(demo: Any, kind: int, part: str) -> None:
    """One fault that no option mends."""
    if kind == 0:
        actions = demo["actions"][()]
        del demo["actions"]
        demo["actions"] = np.concatenate([actions, actions[-1:], actions[-1:]])
    elif kind == 1:
        demo[f"obs/{part}"][0, 0] = np.nan
    elif kind == 2:
        demo["actions"][0, 0] = 4
    else:
        x = demo[f"obs/{part}"][()]
        del demo[f"obs/{part}"]
        demo[f"obs/{part}"] = x[:-2]


def expected(known: Known, options: dict[str, Any]) -> dict[str, Any] | None:
    """Steps, reward and successes in the file, read, and left out; ``None`` if it is refused."""
    if known.wrong:
        return None
    if options.get("successful") and None in known.successes:
        return None
    total = {"read": np.zeros(3), "left out": np.zeros(3)}
    rewarded = {"read": 0, "cut": 0}
    cut_successes = read_successes = 0
    chosen = 0
    for rewards, success, solved in zip(known.rewards, known.successes, known.solved, strict=True):
        steps = len(rewards)
        last = np.arange(steps) == steps - 1
        given = options.get("reward")
        if options.get("successful") and not success:
            recorded = rewards if known.has_rewards else np.zeros(steps)
            # By the rule of the episodes that are read: a sum of two sorts would be none.
            left = {None: recorded.sum(), "success": 0, "last": 1}[given]
            total["left out"] += steps, left, 0
            continue
        chosen += 1
        if given == "success" and success is None:
            return None
        if given is None and not known.has_rewards:
            return None
        if given == "last":
            rewards = 1.0 * last
        elif given == "success":
            rewards = 1.0 * (last & bool(success)) if solved is None else 1.0 * solved
        terminates = known.terminated
        if options.get("dones_terminate") and not known.terminated:
            if not known.has_dones:
                return None
            terminates = True
        keeps = terminates or options.get("last_step") in ("truncate", "terminate")
        cut = known.next_obs == "missing" and not keeps
        kept = slice(0, steps - 1 if cut else steps)
        stays = bool(success) if solved is None else bool(solved[kept].any())
        total["read"] += len(rewards[kept]), rewards[kept].sum(), stays
        read_successes += stays
        rewarded["read"] += np.count_nonzero(rewards[kept])
        if cut:
            lost = bool(success) and not stays
            total["left out"] += 1, rewards[-1], lost
            cut_successes += lost
            rewarded["cut"] += rewards[-1] != 0
    if not chosen:
        return None
    if "last_step" not in options and (
        (rewarded["cut"] and not rewarded["read"]) or (cut_successes and not read_successes)
    ):
        return None
    return {**total, "in the file": total["read"] + total["left out"]}


def flags(options: dict[str, Any]) -> list[str]:
    told = []
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        told += [flag] if value is True else [flag, value]
    return told


def printed(path: Path, options: dict[str, Any]) -> tuple[bool, dict[str, np.ndarray], str]:
    """Whether `check` accepts a file, and the sums that it prints."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(["check", str(path), *flags(options)])
        except SystemExit as end:  # a file that cannot be opened with these options
            code = end.code
    sums: dict[str, np.ndarray] = {}
    for line in out.getvalue().splitlines():
        if found := re.match(r"  (in the file|read|left out)  ", line):
            parts = re.findall(r"([\d,]+) steps, reward (\S+), (\d+) successes", line)
            rows = [[float(value.replace(",", "")) for value in part] for part in parts]
            sums[found[1]] = np.sum(rows, axis=0) if rows else np.zeros(3)
    return code == 0, sums, err.getvalue()


@pytest.mark.filterwarnings("ignore:.*last steps with a reward:UserWarning")
@pytest.mark.filterwarnings("ignore:.*left out on request:UserWarning")
@pytest.mark.filterwarnings("ignore:.*not read in the episodes:UserWarning")
def test_every_step_reward_and_success_of_an_odd_file_is_accounted_for_or_it_is_refused(
    tmp_path: Path,
) -> None:
    outcomes = {"read": 0, "refused": 0}
    for number in range(FILES):
        rng = np.random.default_rng(number)
        path = tmp_path / f"{number}.hdf5"
        known = make(path, rng)
        # A faulty episode may be among those that are left out.
        options = {} if known.wrong else OPTIONS[number % len(OPTIONS)]
        truth = expected(known, options)
        accepted, sums, err = printed(path, options)
        where = f"file {number}, {options}, {known}"
        assert accepted == (truth is not None), f"{where}: {err}"
        if truth is None:
            assert err.startswith(f"error: {path}: "), where
            with pytest.raises(DataError, match=re.escape(str(path))):
                RobomimicExperienceReplay(path, root=tmp_path / "refused", **options)
            outcomes["refused"] += 1
            continue
        for name, values in truth.items():
            np.testing.assert_allclose(sums[name], values, rtol=1e-4, err_msg=f"{where}: {name}")
        np.testing.assert_array_equal(
            (sums["read"] + sums["left out"])[[0, 2]], sums["in the file"][[0, 2]]
        )
        replay = RobomimicExperienceReplay(path, root=tmp_path / "root", **options)
        data = replay[:]
        assert len(data) == truth["read"][0], where
        assert float(data["next", "reward"].sum()) == pytest.approx(truth["read"][1], abs=1e-4)
        # Ready for use, constant dimensions among them.
        assert all(min(part["scale"]) > 0 for part in replay.metadata["statistics"].values()), where
        outcomes["read"] += 1
    assert not (tmp_path / "refused").exists() or not any((tmp_path / "refused").iterdir())
    assert min(outcomes.values()) > FILES / 5, outcomes
