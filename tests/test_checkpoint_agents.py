"""A loss or a student is built from its checkpoint alone, or the checkpoint is refused by name."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from checkpoint_files import checkpoint_path, same
from helpers import NO_UPDATER
from tensordict import TensorDict
from torch import nn

pytest.importorskip("safetensors")

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.agents import GENERATORS, load_bcq_loss, make_bcq_loss
from torchrl_bmrl.pipeline.student import TASK_ENCODERS, Student, load_student
from torchrl_bmrl.training.checkpoint import save_checkpoint
from torchrl_bmrl.training.networks import build

SMALL = {"num_cells": [8], "observation_dim": 3, "action_dim": 2}
STUDENT = {**SMALL, "num_tasks": 3, "latent_dim": 4}
METADATA = {
    "kind": "student",
    "student": STUDENT,
    "tasks": ["reach", "lift", "push_up"],
    "latent_clip": 0.5,
    "accuracy": 0.9,
    "statistics": {"loc": [0.0, 1.0, 2.0], "scale": [1.0, 1.0, 0.5]},
}
"""The metadata that a student's checkpoint must contain."""

path = pytest.fixture(checkpoint_path)


# -- round trips -----------------------------------------------------------------------------------


@pytest.mark.filterwarnings(NO_UPDATER)
@pytest.mark.parametrize("perturbation", [False, True])
def test_a_trained_loss_comes_back_from_its_file_alone(path: Path, perturbation: bool) -> None:
    options = {**SMALL, "perturbation": perturbation, "num_candidates": 5, "latent_clip": None}
    loss = make_bcq_loss(**options)
    save_checkpoint(path, {"module": loss.state_dict()}, {"kind": "bcq", "loss": options})
    again, metadata = load_bcq_loss(path)
    assert metadata["loss"] == options
    assert again.num_candidates == 5
    assert again.latent_clip is None
    assert same(dict(loss.state_dict()), dict(again.state_dict()))
    assert not any(parameter.requires_grad for parameter in again.parameters())
    actions = []
    for module in (loss, again):
        policy = BCQPolicy.frozen(module)
        torch.manual_seed(0)
        actions.append(policy(TensorDict({"observation": torch.zeros(4, 3)}, [4]))["action"])
    assert torch.equal(*actions)


def test_a_student_comes_back_with_its_prototypes(path: Path) -> None:
    student = Student(**STUDENT)
    student.prototypes.normal_()
    save_checkpoint(path, {"module": student.state_dict()}, METADATA)
    again, _ = load_student(path)
    assert same(dict(student.state_dict()), dict(again.state_dict()))


# -- refusals --------------------------------------------------------------------------------------


def test_a_student_without_an_encoder_is_refused_by_the_missing_key(path: Path) -> None:
    state = Student(**STUDENT).state_dict()
    rest = {key: value for key, value in state.items() if not key.startswith("task_encoder")}
    save_checkpoint(path, {"module": rest}, METADATA)
    with pytest.raises(CheckpointError, match="task_encoder"):
        load_student(path)


def test_networks_of_another_size_are_refused_by_name(path: Path) -> None:
    loss = make_bcq_loss(**SMALL)
    options = {**SMALL, "num_cells": [7]}
    save_checkpoint(path, {"module": loss.state_dict()}, {"kind": "bcq", "loss": options})
    with pytest.raises(CheckpointError, match="has shape"):
        load_bcq_loss(path)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_parameters_that_are_not_finite_are_not_acted_with(path: Path, number: float) -> None:
    state = make_bcq_loss(**SMALL).state_dict()
    key = next(key for key in state if key.endswith("0.weight"))
    state[key][1, 2] = number
    save_checkpoint(path, {"module": state}, {"kind": "bcq", "loss": SMALL})
    with pytest.raises(CheckpointError, match=f"'{key}' contains numbers that are not finite"):
        load_bcq_loss(path)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (None, "contains no networks"),
        ({**SMALL, "num_cells": [10**9]}, "num_cells is .*no tensor in the file is that large"),
        ({**SMALL, "num_cells": [8] * 999}, "num_cells is .*no tensor in the file is that large"),
        ({**SMALL, "num_qvalue_nets": 10**9}, "num_qvalue_nets is .*that large"),
        ({**SMALL, "num_cells": "eight"}, "its options build no networks"),
        ({**SMALL, "num_cells": [-1]}, "its options build no networks"),
        ({**SMALL, "hidden": 8}, "its options build no networks"),
        ({**SMALL, "latent_clip": -1.0}, "its options build no networks"),
    ],
)
def test_settings_of_no_networks_are_refused_before_any_are_made(
    path: Path, options: Any, match: str
) -> None:
    state = {"module": make_bcq_loss(**SMALL).state_dict()}
    save_checkpoint(path, state, {"kind": "bcq", "loss": options})
    with pytest.raises(CheckpointError, match=match) as info:
        load_bcq_loss(path)
    assert info.value.path == path


@pytest.mark.parametrize("held", [torch.zeros(0, 3000), torch.zeros(1, 3000)])
def test_no_memory_is_taken_for_networks_that_the_file_s_tensors_do_not_fill(
    path: Path, held: torch.Tensor
) -> None:
    made = []

    def make(**options: int) -> nn.Module:
        made.append(nn.Linear(options["width"], options["width"]))
        return made[-1]

    with pytest.raises(CheckpointError, match=r"no tensor in the file|has shape|is missing"):
        build(make, {"width": 3000}, {"module": {"weight": held}}, path)
    assert all(module.weight.is_meta for module in made)


def test_networks_of_more_parts_than_can_be_built_in_time_are_refused(path: Path) -> None:
    state = {"module": {str(i): torch.zeros(1) for i in range(2000)}}
    options = {"observation_dim": 1, "action_dim": 1, "num_cells": [1] * 2000}
    save_checkpoint(path, state, {"kind": "bcq", "loss": options})
    with pytest.raises(CheckpointError, match="more than 2000 weights and biases"):
        load_bcq_loss(path)


@pytest.mark.parametrize(
    "make",
    [
        *(partial(make_bcq_loss, generator=name, perturbation=True) for name in GENERATORS),
        *(partial(Student, num_tasks=3, task_encoder=name, infers=True) for name in TASK_ENCODERS),
    ],
)
def test_networks_have_the_same_shapes_on_the_meta_device_where_they_are_checked(make: Any) -> None:
    options = {**SMALL, "num_cells": [8]}
    with torch.device("meta"):
        meant = make(**options).state_dict()
    real = make(**options).state_dict()
    assert list(meant) == list(real)
    for key, tensor in real.items():
        if isinstance(tensor, torch.Tensor):
            assert meant[key].shape == tensor.shape
            assert meant[key].is_meta


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tasks", ["reach", "lift"]),
        ("tasks", ["reach", "lift", "../../etc/passwd"]),
        ("tasks", ["reach", "lift", "lift"]),
        ("tasks", "abc"),
        ("tasks", [["reach"], "lift", "push_up"]),
        ("latent_clip", -1),
        ("latent_clip", "0.5"),
        ("latent_clip", float("nan")),
        ("accuracy", 2),
        ("accuracy", "1"),
        ("statistics", {"loc": [0.0], "scale": [1.0, 2.0]}),
        ("statistics", {"loc": [0.0], "scale": [0.0]}),
        ("statistics", {"loc": ["0"], "scale": [1.0]}),
        ("statistics", {"loc": [float("inf")], "scale": [1.0]}),
        ("statistics", {"loc": 1.0, "scale": 1.0}),
        ("statistics", []),
    ],
)
def test_what_a_student_must_say_is_checked_when_it_is_loaded(
    path: Path, key: str, value: Any
) -> None:
    state = {"module": Student(**STUDENT).state_dict()}
    save_checkpoint(path, state, {**METADATA, key: value})
    with pytest.raises(CheckpointError, match=f"{key} is .*; valid: "):
        load_student(path)
