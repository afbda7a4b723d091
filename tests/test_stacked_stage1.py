"""Agents that stage 1 trains in one program: each has its own files and its own faults."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import Interruption, Run, contents, exit_code, make_run, times

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]

STACKED = ("bcq.stacked=true", "bcq.seeds=2")
AGENTS = {"reach": "reach", "lift": "lift", "reach-1": "reach", "lift-1": "lift"}
"""Names of the agents and their tasks."""


@pytest.fixture(scope="module")
def stacked(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of stage 1, two tasks and two seeds in one program, that was never stopped."""
    from torchrl_bmrl.pipeline import stage1

    folder = tmp_path_factory.mktemp("stacked")
    shutil.copytree(finished / "data", folder / "data")
    return run(folder, stage1, *STACKED)


def test_every_member_of_a_stack_has_a_checkpoint_and_curves_of_its_own(stacked: Path) -> None:
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    weights = set()
    for name, task in AGENTS.items():
        loss, metadata = load_bcq_loss(stacked / "bcq" / name / "checkpoint.safetensors")
        assert (metadata["task"], metadata["updates"]) == (task, 12)
        weights.add(float(next(loss.generator_params.parameters()).sum()))
        with (stacked / "bcq" / name / "evaluations.csv").open() as file:
            assert [row["update"] for row in csv.DictReader(file)] == ["6", "12"]
        curve = stacked / "logs" / f"bcq_{name}" / "scalars" / "loss_qvalue.csv"
        assert [line.split(",")[0] for line in curve.read_text().splitlines()] == ["4", "8", "12"]
    assert len(weights) == len(AGENTS)


@pytest.mark.parametrize(("update", "kept"), [(3, None), (7, 4), (12, 12)])
def test_a_stack_resumed_equals_one_never_stopped(
    stacked: Path, collected_run: Path, update: int, kept: int | None
) -> None:
    from torchrl_bmrl.pipeline.agents import load_bcq_loss
    from torchrl_bmrl.pipeline.stage1 import train_job

    made = make_run(collected_run, *STACKED)
    with pytest.raises(KeyboardInterrupt):
        train_job((made, AGENTS), Interruption(update * len(AGENTS), KeyboardInterrupt))
    member = collected_run / "bcq" / "lift" / "checkpoint.safetensors"
    assert member.exists() == (kept is not None)
    if kept is not None:
        assert load_bcq_loss(member)[1]["updates"] == kept
    counted: list[int] = []
    train_job((made, AGENTS), counted.append)
    assert sum(counted) == 12 * len(AGENTS)
    expected = contents(stacked, "bcq/**/*")
    assert len(expected) == 2 + 4 * len(AGENTS)
    assert contents(collected_run, "bcq/**/*") == expected


def test_a_members_checkpoint_that_a_kill_left_out_is_written_when_the_run_goes_on(
    run: Run, stacked: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import stage1

    folder = shutil.copytree(stacked, tmp_path / "run")
    (folder / "bcq" / "lift" / "checkpoint.safetensors").unlink()
    before = times(folder)
    run(folder, stage1, *STACKED)
    assert contents(folder, "bcq/**/*") == contents(stacked, "bcq/**/*")
    assert before.items() <= times(folder).items()  # no other file is written


def test_a_member_that_diverges_is_named_and_frozen_and_the_others_go_on(
    run: Run,
    stacked: Path,
    collected_run: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchrl_bmrl.pipeline import learners, stage1
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    step, calls = learners.gradient_step, []
    factors = torch.tensor([1.0, float("nan"), 1.0, 1.0])

    def breaking(optimizer: Any, loss: Any, max_norm: Any) -> None:
        calls.append(loss)  # the generators' and the critics' in turn
        step(optimizer, loss * factors if len(calls) == 2 * 6 else loss, max_norm)

    monkeypatch.setattr(learners, "gradient_step", breaking)
    for _ in range(2):  # repeating the command repeats the message and trains nothing
        assert exit_code(run, collected_run, stage1, *STACKED) == 1
        assert "error: bcq lift, update 8: loss_qvalue is nan" in capsys.readouterr().err
    assert len(calls) == 2 * 12
    updates = {
        name: load_bcq_loss(collected_run / "bcq" / name / "checkpoint.safetensors")[1]["updates"]
        for name in AGENTS
    }
    assert updates == {"reach": 12, "lift": 4, "reach-1": 12, "lift-1": 12}
    others = [f"bcq/{name}/*" for name in AGENTS if name != "lift"]
    assert contents(collected_run, *others) == contents(stacked, *others)
