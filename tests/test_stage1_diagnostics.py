"""Stage 1 diagnoses its agents after every epoch, and trains as it would without."""

from __future__ import annotations

import logging
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import numpy as np
import torch
from episode_files import write_file
from helpers import NO_UPDATER

from torchrl_bmrl.pipeline import BCQSettings, EvaluateSettings, Run, Settings, collect, stage1
from torchrl_bmrl.pipeline.learners import Agents
from torchrl_bmrl.pipeline.stage1 import train_job
from torchrl_bmrl.training.diagnostics import Diagnostics, diagnose, read_diagnostics

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
TASKS = ("door", "drawer")
PARTS = {"arm": ((3,), np.float64)}
MODULE: Any = sys.modules[train_job.__module__]  # the function stage1 hides it
METRICS = (
    "candidate_spread",
    "spread_ratio",
    "qvalue_gap",
    "qvalue_std",
    "outside_share",
    "active_latents",
    "largest_latent_kl",
)


def make(folder: Path, source: Path, **bcq: Any) -> Run:
    """A small run of two tasks without environments, with demonstrations from a folder."""
    files = {name: {"demonstrations": str(source / f"{name}.hdf5")} for name in TASKS}
    stage = {"epochs": 2, "updates_per_epoch": 3, "batch_size": 4, "num_cells": [8]} | bcq
    return Run(
        Settings(
            run_dir=str(folder),
            workers=1,
            tasks=files,
            bcq=BCQSettings(**stage),
            evaluate=EvaluateSettings(num_candidates=3),
            log_interval=2,
            checkpoint_interval=2,
        )
    )


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with demonstrations."""
    folder = tmp_path_factory.mktemp("collected")
    for index, name in enumerate(TASKS):
        write_file(folder / f"{name}.hdf5", [n + index for n in (5, 6, 7, 8)], parts=PARTS)
    with make(folder, folder) as run:
        collect(run)
    return folder


def trained(collected: Path, folder: Path, **bcq: Any) -> Path:
    """The folder of a run that was trained on the same demonstrations."""
    shutil.copytree(collected / "data", folder / "data")
    with make(folder, collected, **bcq) as run:
        stage1(run)
    return folder


def files(folder: Path, pattern: str) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.glob(pattern)}


def found(ratio: float, share: float = 0.0) -> Diagnostics:
    return Diagnostics(
        candidate_spread=0.1,
        spread_ratio=ratio,
        qvalue_gap=0.0,
        qvalue_std=1.0,
        outside_share=share,
        latent_kl=None,
    )


@pytest.mark.parametrize(
    ("bcq", "agents"),
    [({}, TASKS), ({"stacked": True, "seeds": 2}, (*TASKS, "door-1", "drawer-1"))],
)
def test_every_agent_has_a_row_per_epoch_in_its_folder_and_its_logs(
    collected: Path, tmp_path: Path, bcq: dict[str, Any], agents: tuple[str, ...]
) -> None:
    trained(collected, tmp_path, **bcq)
    ratios = set()
    for name in agents:
        rows = read_diagnostics(tmp_path / "bcq" / name / "diagnostics.csv")
        assert list(rows) == [3, 6]
        for metric in METRICS:
            logged = (tmp_path / "logs" / f"bcq_{name}" / "scalars" / f"{metric}.csv").read_text()
            values = [line.split(",") for line in logged.splitlines()]
            assert [(int(step), float(x)) for step, x in values] == [
                (update, row.metrics()[metric]) for update, row in rows.items()
            ]
        ratios.add(rows[6].spread_ratio)
    assert len(ratios) == len(agents)


def test_diagnostics_change_no_byte_of_the_training(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(collected, tmp_path / "with")
    monkeypatch.setattr(MODULE, "diagnose", lambda *_, **__: found(1.0))
    without = trained(collected, tmp_path / "without")
    # Checkpoints contain the parameters, the optimizers and the random states.
    checkpoints = files(whole, "bcq/*/checkpoint.safetensors")
    assert len(checkpoints) == 2
    assert checkpoints == files(without, "bcq/*/checkpoint.safetensors")
    losses = files(whole, "logs/*/scalars/loss_*.csv")
    assert losses
    assert losses == files(without, "logs/*/scalars/loss_*.csv")


def test_an_agent_is_diagnosed_on_its_own_demonstrations_as_it_will_act(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []

    def spy(loss: Any, data: Any, **options: Any) -> Diagnostics:
        calls.append((data, options))
        return diagnose(loss, data, **options)

    monkeypatch.setattr(MODULE, "diagnose", spy)
    monkeypatch.setattr(MODULE, "DIAGNOSED", 12)
    run = make(trained(collected, tmp_path), collected)
    assert len(calls) == 4
    for index, (data, options) in enumerate(calls):
        own = run.transitions(TASKS[index // 2], "train")
        assert options == {"num_candidates": 3}
        assert len(data) == 12
        rows = {tuple(row.tolist()) for row in torch.cat([own["observation"], own["action"]], -1)}
        seen = torch.cat([data["observation"], data["action"]], -1)
        assert {tuple(row.tolist()) for row in seen} <= rows
        assert len(seen.unique(dim=0)) == 12  # without replacement
    assert torch.equal(calls[0][0]["action"], calls[1][0]["action"])  # comparable between epochs


def test_each_agent_of_a_stack_is_diagnosed_itself_on_demonstrations_of_its_own_task(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []

    def spy(loss: Any, data: Any, **options: Any) -> Diagnostics:
        calls.append((loss.generator_params.to_tensordict(), data))
        return diagnose(loss, data, **options)

    monkeypatch.setattr(MODULE, "diagnose", spy)
    monkeypatch.setattr(MODULE, "DIAGNOSED", 12)
    folder = trained(collected, tmp_path, stacked=True, seeds=2, epochs=1)
    run, agents = make(folder, collected), [*TASKS, "door-1", "drawer-1"]
    for name, (params, data) in zip(agents, calls, strict=True):
        task = name.removesuffix("-1")
        own = run.transitions(task, "train")
        actions = {tuple(x.tolist()) for x in own["action"]}
        assert {tuple(x.tolist()) for x in data["action"]} <= actions
        assert (params == run.teacher(name).generator_params.to_tensordict()).all()
        untrained = Agents(run, {name: task}, [own]).loss.generator_params
        # Three updates change the parameters little; another agent's are quite different.
        assert ((params - untrained.to_tensordict()).abs() < 0.01).all()
    # Agents of one task differ in their sample.
    assert not torch.equal(calls[0][1]["action"], calls[2][1]["action"])


def test_a_run_that_was_stopped_has_the_diagnostics_of_one_that_was_not(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MODULE, "DIAGNOSED", 12)  # fewer than there are: it matters which

    class Stop(KeyboardInterrupt):
        pass

    def stop(count: int) -> None:
        done.append(count)
        if len(done) == 3:  # after the first epoch, which is after the first checkpoint
            raise Stop

    done: list[int] = []
    whole = trained(collected, tmp_path / "whole")
    shutil.copytree(collected / "data", tmp_path / "stopped" / "data")
    run = make(tmp_path / "stopped", collected)
    with pytest.raises(Stop):
        train_job((run, {"door": "door"}), stop)
    train_job((run, {"door": "door"}), lambda count: None)
    for pattern in ("bcq/door/diagnostics.csv", "logs/bcq_door/scalars/*.csv"):
        expected = files(whole, pattern)
        assert expected
        assert files(tmp_path / "stopped", pattern) == expected


@pytest.mark.parametrize(
    ("ratio", "share", "level", "text"),
    [
        (0.1, 0.0, logging.INFO, "stage 1: the candidates of door, drawer vary less than"),
        (1.0, 0.6, logging.WARNING, "stage 1: door, drawer: most chosen actions are unlike"),
    ],
)
def test_a_finding_is_logged_once_for_all_agents(
    collected: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    ratio: float,
    share: float,
    level: int,
    text: str,
) -> None:
    monkeypatch.setattr(MODULE, "diagnose", lambda *_, **__: found(ratio, share))
    with caplog.at_level(logging.INFO, "torchrl_bmrl"):
        trained(collected, tmp_path)
    records = [r for r in caplog.records if r.getMessage().startswith("stage 1: ")]
    assert [record.levelno for record in records] == [level]
    assert records[0].getMessage().startswith(text)


def test_only_the_last_epoch_counts_and_healthy_agents_are_not_named(
    collected: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    ratios = iter([0.1, 0.1, 0.1, 1.0])  # two epochs of each
    monkeypatch.setattr(MODULE, "diagnose", lambda *_, **__: found(next(ratios)))
    with caplog.at_level(logging.INFO, "torchrl_bmrl"):
        trained(collected, tmp_path)
    (line,) = [r.getMessage() for r in caplog.records if r.getMessage().startswith("stage 1: ")]
    assert "candidates of door vary" in line
