"""Options of stage 1: compilation, CUDA graphs, the generator's warm-up, gradient clipping."""

from __future__ import annotations

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

from small_runs import Run, contents, make_run, tasks

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]


@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++"))), reason="no compiler")
def test_compiled_stages_train_what_eager_ones_do(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torch._dynamo.utils import counters

    from torchrl_bmrl.pipeline import stage1, stage2
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    for kept in ("data", "bcq/reach", "logs/bcq_reach"):
        shutil.copytree(finished / kept, tmp_path / kept)
    for stage in (stage1, stage2):
        counters.clear()
        run(tmp_path, stage, "compile=true")
        assert counters["stats"]["unique_graphs"] > 0
    assert "not accelerated" not in capsys.readouterr().err
    for path, kind in (
        ("bcq/lift/checkpoint.safetensors", "bcq"),
        ("distill/checkpoint.safetensors", "student"),
    ):
        compiled, eager = (
            load_checkpoint(folder / path, kind=kind)[0]["module"]
            for folder in (tmp_path, finished)
        )
        for name, value in eager.items():
            torch.testing.assert_close(compiled[name], value, rtol=0, atol=1e-4)


def test_without_a_gpu_captured_stages_say_so_and_train_the_same(
    run: Run, finished: Path, collected_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage1
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    run(collected_run, stage1, "cudagraphs=true", tasks("lift"))
    assert "device=cpu has no CUDA graphs" in capsys.readouterr().err
    for name in ("best", "checkpoint.1", "checkpoint"):
        captured, eager = (
            load_bcq_loss(folder / "bcq" / "lift" / f"{name}.safetensors")[0].state_dict()
            for folder in (collected_run, finished)
        )
        torch.testing.assert_close(captured, eager, rtol=0, atol=0)
    expected = contents(finished, "bcq/lift/*.csv")
    assert contents(collected_run, "bcq/lift/*.csv") == expected


def trained(
    finished: Path, folder: Path, *overrides: str
) -> tuple[dict[str, Any], float, set[str]]:
    """Trains lift in stage 1.

    Returns:
        the state of its checkpoint, the largest change of a critic's parameter since its start, and
        the names of the metrics that were logged.
    """
    from torchrl_bmrl.pipeline.agents import make_bcq_loss
    from torchrl_bmrl.pipeline.stage1 import train_job
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    shutil.copytree(finished / "data", folder / "data")
    made = make_run(folder, *overrides)
    train_job((made, {"lift": "lift"}), lambda count: None)
    path = folder / "bcq" / "lift" / "checkpoint.safetensors"
    state, metadata = load_checkpoint(path, kind="bcq")
    torch.manual_seed(made.seed("bcq", "lift"))
    start = make_bcq_loss(**metadata["loss"]).state_dict()
    change = max(
        float((state["module"][key] - start[key]).abs().max())
        for key in start
        if key.startswith("qvalue_network_params") and key in state["module"]
    )
    return state, change, {path.stem for path in (folder / "logs").rglob("bcq_lift/**/*.csv")}


def test_critics_wait_while_the_generator_warms_up(finished: Path, tmp_path: Path) -> None:
    for warmup, waits in ((12, True), (11, False)):
        folder = tmp_path / str(warmup)
        _, change, logged = trained(finished, folder, f"bcq.generator_warmup={warmup}")
        assert (change == 0) == waits
        assert "loss_generator" in logged
        assert ("loss_qvalue" in logged) != waits


def test_the_critics_gradient_is_clipped_and_no_other(finished: Path, tmp_path: Path) -> None:
    # Adam divides by the gradient's size plus 1e-8, so only a tiny norm changes its steps.
    state, change, _ = trained(finished, tmp_path / "clipped", "bcq.critic_grad_clip=1e-12")
    whole, whole_change, _ = trained(finished, tmp_path / "whole")
    assert change < 1e-4 < whole_change
    generator = [key for key in state["module"] if key.startswith("generator_params")]
    assert all(torch.equal(state["module"][key], whole["module"][key]) for key in generator)
