"""Training that diverges ends within one logging interval; the last good checkpoint stays."""

from __future__ import annotations

import re
import shutil
import sys
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

from small_runs import Run, exit_code, tasks

from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]


def break_agent(loss: Any, how: str) -> None:
    """Overwrites parameters of an agent's networks so that its training has diverged."""
    decoder = loss.generator_params["decoder", "module", "network"]
    critic = loss.qvalue_network_params["module"]
    with torch.no_grad():
        if how == "nan":
            critic["0", "weight"].fill_(float("nan"))
        elif how == "exploding":
            critic["4", "bias"].fill_(5e3)
        elif how == "dead":
            for key in ("0", "2", "4"):
                decoder[key, "weight"].zero_()
        else:
            decoder["4", "bias"].fill_(50.0)


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("nan", r"loss_qvalue is nan"),
        ("exploding", r"pred_value is .*, above .*; the training has diverged"),
        ("dead", r"all candidates of a state are equal"),
        ("saturated", r"100% of the proposed action components lie at a bound"),
    ],
)
@pytest.mark.parametrize("stacked", [False, True])
def test_what_goes_wrong_is_named_within_one_logging_interval_and_the_good_checkpoint_kept(
    run: Run,
    collected_run: Path,
    what: str,
    says: str,
    stacked: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import learners, stage1

    step, calls = learners.gradient_step, []
    agents: list[Any] = []
    make = learners.Agents

    class Watched(make):  # type: ignore[misc, valid-type]
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            agents.append(self)

    def breaking(optimizer: Any, loss: Any, max_norm: Any) -> None:
        step(optimizer, loss, max_norm)
        calls.append(loss)  # the generator's and the critics' in turn
        if len(calls) == 2 * 5:  # the update after the fourth, which is checked and saved
            break_agent(agents[-1].loss, what)

    monkeypatch.setattr(sys.modules[stage1.__module__], "Agents", Watched)
    monkeypatch.setattr(learners, "gradient_step", breaking)
    overrides = ["bcq.stacked=true"] if stacked else [tasks("lift")]
    assert exit_code(run, collected_run, stage1, *overrides) == 1
    said = capsys.readouterr().err
    assert re.search(rf"error: bcq (reach|lift), update 8: {says}", said), said
    assert "checkpoint stays" in said
    path = collected_run / "bcq" / "lift" / "checkpoint.safetensors"
    state, metadata = load_checkpoint(path, kind="bcq")
    assert metadata["updates"] == 4
    assert all(value.isfinite().all() for value in state["module"].values())


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("nan", r"loss_\w+ is nan"),
        ("dead", r"all candidates of a state are equal"),
        ("saturated", r"100% of the proposed action components lie at a bound"),
    ],
)
def test_a_student_that_goes_wrong_is_named_within_one_logging_interval(
    run: Run,
    finished: Path,
    collected_run: Path,
    what: str,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import stage2, training

    module: Any = sys.modules[stage2.__module__]  # the package's function hides its name
    shutil.copytree(finished / "bcq", collected_run / "bcq")
    step, calls, students = training.gradient_step, [], []
    make = module.Student

    def watched(**options: Any) -> Any:
        students.append(make(**options))
        return students[-1]

    def breaking(optimizer: Any, loss: Any) -> None:
        step(optimizer, loss)
        calls.append(loss)
        if len(calls) == 5:
            layers = students[0].generator.module.network
            with torch.no_grad():
                if what == "nan":
                    layers[0].weight.fill_(float("nan"))
                elif what == "dead":
                    for layer in (layers[0], layers[2], layers[4]):
                        layer.weight.zero_()
                else:
                    layers[4].bias.fill_(50.0)

    monkeypatch.setattr(module, "Student", watched)
    monkeypatch.setattr(training, "gradient_step", breaking)
    assert exit_code(run, collected_run, stage2) == 1
    said = capsys.readouterr().err
    assert re.search(rf"error: distillation, update 8: {says}", said), said
    path = collected_run / "distill" / "checkpoint.safetensors"
    assert load_checkpoint(path, kind="student")[1]["updates"] == 4


def test_looking_at_the_numbers_changes_none_of_them(
    run: Run, finished: Path, collected_run: Path
) -> None:
    from torchrl_bmrl.pipeline import stage1

    # Other intervals are other settings, but not other agents.
    run(collected_run, stage1, "log_interval=1")
    for task in ("reach", "lift"):
        states = [
            load_checkpoint(folder / "bcq" / task / "checkpoint.safetensors", kind="bcq")[0]
            for folder in (finished, collected_run)
        ]
        for key, value in states[0]["module"].items():
            assert torch.equal(value, states[1]["module"][key]), key
