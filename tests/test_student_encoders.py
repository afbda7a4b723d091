"""A student with each encoder of m: what it embeds, stores, tells and refuses."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import DIMS, transitions
from tensordict import TensorDict

pytest.importorskip("yaml")
pytest.importorskip("safetensors")
pytest.importorskip("h5py")

from torchrl_bmrl.errors import BMRLError, CheckpointError, ConfigError, UnknownNameError
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.modules import (
    BCQPolicy,
    ContextTaskLatent,
    DemonstrationTaskLatent,
    OnlineTaskLatent,
    PrototypeTaskLatent,
    embed_context,
)
from torchrl_bmrl.pipeline import DistillSettings, Run, Settings
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.pipeline.stage2 import make_sampler, proposals
from torchrl_bmrl.pipeline.student import (
    OF_SETS,
    TASK_ENCODERS,
    Student,
    load_student,
    make_distillation_loss,
)
from torchrl_bmrl.training.checkpoint import save_checkpoint

TASKS, ROWS = 3, 8
OPTIONS: dict[str, Any] = {
    "num_tasks": TASKS,
    "observation_dim": DIMS[0],
    "action_dim": DIMS[1],
    "task_latent_dim": 4,
    "num_cells": (16,),
}
CODES = [[0.0, 1.0], [1.0, 0.0], [-1.0, 0.5]]
every_encoder = pytest.mark.parametrize("name", TASK_ENCODERS)
of_sets = pytest.mark.parametrize("name", OF_SETS)


def make_student(name: str, **options: Any) -> Student:
    torch.manual_seed(0)
    told = {"code_dim": 2} if name == "told" else {}
    student = Student(**OPTIONS, task_encoder=name, **told, **options)
    if name == "told":
        student.set_codes(CODES)
    return student


def datasets(rows: int = ROWS) -> list[TensorDict]:
    """Transitions of each task."""
    parts = [transitions(rows, dtype=torch.float32, seed=i) for i in range(TASKS)]
    for i, part in enumerate(parts):
        part["task"] = torch.full((rows,), i)
        part["next", "reward"] += 3 * i
    return parts


# -- m ---------------------------------------------------------------------------------------------


@every_encoder
def test_prototypes_are_of_each_task_s_data(name: str) -> None:
    student, data = make_student(name), datasets()
    student.set_prototypes(data, "mean")
    if name in OF_SETS:
        expected = torch.stack([student.embed_context(part) for part in data])
    elif name == "told":
        expected = torch.tensor(CODES)
    elif name == "one_hot":
        expected = torch.eye(TASKS)
    elif name == "nothing":
        expected = torch.zeros(TASKS, 1)
    else:
        expected = torch.stack([student.embed(part).mean(0) for part in data])
    torch.testing.assert_close(student.prototypes, expected)


@every_encoder
def test_all_of_a_student_goes_through_a_checkpoint(name: str, tmp_path: Path) -> None:
    student, path = make_student(name), tmp_path / "student.safetensors"
    student.set_scales(*datasets())
    student.set_prototypes(datasets(), "mean")
    write(path, student, name)
    loaded, metadata = load_student(path)
    assert metadata["tasks"] == ["a", "b", "c"]
    state = loaded.state_dict()
    assert all(torch.equal(state[key], value) for key, value in student.state_dict().items())
    policy = loaded.policy(num_candidates=4, latent_clip=0.5)
    data = TensorDict(
        {"observation": torch.randn(5, 3), "task_latent": loaded.prototypes[:1].expand(5, -1)}, [5]
    )
    assert policy(data)["action"].shape == (5, 2)


STATISTICS = {"loc": [0.0] * 3, "scale": [1.0] * 3}


def write(path: Path, module: Student, name: str, **changes: Any) -> None:
    options = {**OPTIONS, "num_cells": [16], "task_encoder": name}
    options |= {"code_dim": 2} if name == "told" else {}
    options |= {"infers": True} if module.context_encoder is not None else {}
    metadata = {
        "kind": "student",
        "student": options,
        "tasks": ["a", "b", "c"],
        "latent_clip": 0.5,
        "accuracy": 0.5,
        "statistics": STATISTICS,
    }
    save_checkpoint(path, {"module": module.state_dict()}, metadata | changes)


def test_checkpoints_of_earlier_versions_are_read(tmp_path: Path) -> None:
    options = {key: OPTIONS[key] for key in ("num_tasks", "observation_dim", "action_dim")}
    path = tmp_path / "student.safetensors"
    student = Student(**options)
    write(path, student, "transition", student=options)
    assert load_student(path)[0].context_encoder is None


@pytest.mark.parametrize(
    ("accuracy", "valid"), [(None, True), (0, True), (1.5, False), ("", False)]
)
def test_an_accuracy_is_a_share_or_that_of_no_classifier(
    accuracy: Any, valid: bool, tmp_path: Path
) -> None:
    path = tmp_path / "student.safetensors"
    write(path, make_student("set_mean"), "set_mean", accuracy=accuracy)
    if valid:
        assert load_student(path)[1]["accuracy"] == accuracy
        return
    with pytest.raises(CheckpointError, match=r"accuracy is .*valid: .*null without a classifier"):
        load_student(path)


@of_sets
def test_a_set_has_an_embedding_and_a_transition_has_none(name: str) -> None:
    student, data = make_student(name), datasets()[0]
    assert student.embed_context(data).shape == (4,)
    assert student.embed_context(torch.stack([data, data])).shape == (2, 4)
    with pytest.raises(BMRLError, match="reads sets of transitions; valid: embed_context"):
        student.embed(data)
    with pytest.raises(ConfigError, match="what I do needs m of single transitions"):
        student.check_embeds("what I do")


@pytest.mark.parametrize("name", ["told", "nothing", "one_hot"])
def test_a_context_says_nothing_to_an_encoder_that_reads_the_task(name: str) -> None:
    with pytest.raises(BMRLError, match=r"reads .'task'.*valid: single transitions"):
        make_student(name).embed_context(datasets()[0])


def test_the_average_over_a_context_is_m_of_an_encoder_of_transitions() -> None:
    student, data = make_student("transition"), datasets()[0]
    torch.testing.assert_close(student.embed_context(data), student.embed(data).mean(0))


@of_sets
def test_a_second_encoder_infers_the_task(name: str) -> None:
    one, two, data = make_student(name), make_student(name, infers=True), datasets()[0]
    assert torch.equal(one.infer(data), one.embed_context(data))
    assert torch.equal(two.infer(data), embed_context(two.context_encoder, data))
    assert not torch.equal(two.infer(data), two.embed_context(data))


@of_sets
def test_accuracy_is_over_tasks(name: str) -> None:
    student, data = make_student(name), datasets()
    with torch.no_grad():
        student.task_classifier.module.weight.zero_()
        student.task_classifier.module.bias.copy_(torch.tensor([0.0, 1.0, 0.0]))
    assert student.accuracy(torch.cat(data)) == pytest.approx(1 / 3)
    assert student.accuracy(data[1]) == 1
    assert student.accuracy(torch.cat([data[0], data[1][:2]])) == 0.5


@pytest.mark.parametrize("codes", [CODES[:2], [[1.0]] * 3, [[1.0] * 3] * 3])
def test_codes_of_another_shape_are_refused(codes: Any) -> None:
    with pytest.raises(BMRLError, match=r"codes are of shape .*valid: \(3, 2\)"):
        make_student("told").set_codes(codes)


def test_another_encoder_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"'sets'; valid.*set_mean"):
        make_student("sets")


# -- sources of m ----------------------------------------------------------------------------------


def test_sources_follow_the_encoder() -> None:
    demonstration = datasets()[0]
    kinds = {"transition": (OnlineTaskLatent, DemonstrationTaskLatent)}
    kinds |= dict.fromkeys(OF_SETS, (ContextTaskLatent, PrototypeTaskLatent))
    for name, (online, one_shot) in kinds.items():
        student = make_student(name)
        assert type(student.task_latent_source("online", 1)) is online
        source = student.task_latent_source("demonstration", 1, demonstration)
        assert type(source) is one_shot
    torch.testing.assert_close(source.task_latent, student.embed_context(demonstration))


@every_encoder
def test_every_student_has_prototypes_as_a_source(name: str) -> None:
    student = make_student(name)
    student.set_prototypes(datasets(), "mean")
    source = student.task_latent_source("prototype", 2)
    assert torch.equal(source.task_latent, student.prototypes[2])


@pytest.mark.parametrize("name", ["told", "nothing", "one_hot"])
@pytest.mark.parametrize("source", ["online", "demonstration"])
def test_an_encoder_that_reads_no_transitions_has_no_other_source(name: str, source: str) -> None:
    with pytest.raises(BMRLError, match="valid: single transitions"):
        make_student(name).task_latent_source(source, 0, datasets()[0])


@every_encoder
def test_a_demonstration_is_needed_where_one_is_read(name: str) -> None:
    with pytest.raises(BMRLError, match="demonstration has none; valid"):
        make_student(name).task_latent_source("demonstration", 0)
    with pytest.raises(UnknownNameError, match="'dream'; valid"):
        make_student(name).task_latent_source("dream", 0, datasets()[0])


# -- training --------------------------------------------------------------------------------------


@every_encoder
@pytest.mark.parametrize("classifies", [True, False])
def test_only_what_has_a_term_is_trained(name: str, classifies: bool) -> None:
    student = make_student(name)
    sizes = {"observation_dim": DIMS[0], "action_dim": DIMS[1], "num_cells": (16,)}
    teachers = [BCQPolicy.frozen(make_bcq_loss(**sizes)) for _ in range(TASKS)]
    options: dict[str, Any] = {"context": "set" if name in OF_SETS else "current"}
    if name in OF_SETS:
        options |= {"context_fraction": 1.0, "context_size": 4}
    weight = 1.0 if classifies else None
    loss = make_distillation_loss(student, teachers, classification_weight=weight, **options)
    losses = loss(torch.stack(datasets()))
    sum(x for key, x in losses.items() if key.startswith("loss_")).backward()
    trained = {key.split(".")[0] for key, p in student.named_parameters() if p.grad is not None}
    expected = {"generator", "qvalue_network"} | ({"task_classifier"} if classifies else set())
    expected |= set() if name in ("told", "nothing", "one_hot") else {"task_encoder"}
    assert trained == expected
    assert ("accuracy" in losses.keys()) == classifies  # noqa: SIM118 (a TensorDict)


@every_encoder
def test_proposals_for_the_health_check_take_every_encoder(name: str) -> None:
    state = torch.random.get_rng_state()
    student, batch = make_student(name), torch.stack(datasets())
    torch.random.set_rng_state(state)
    assert proposals(student, batch, 0.5, "cpu").shape == (TASKS, ROWS, 10, 2)
    assert torch.equal(torch.random.get_rng_state(), state)


class Data:
    """As much of a run as the sampler reads: rows name their behaviour in the reward."""

    settings = Settings(device="cpu")
    names = ("a", "b", "c")

    def transitions(self, name: str, split: str) -> TensorDict:
        data = datasets(20)[self.names.index(name)]
        data["next", "reward"].fill_(self.names.index(name) + {"train": 0, "context": 100}[split])
        return data


def test_given_contexts_are_of_the_row_s_task_and_of_both_behaviours() -> None:
    run: Any = Data()
    train = [run.transitions(name, "train") for name in run.names]
    settings = DistillSettings(context="given", batch_size=200)
    torch.manual_seed(0)
    sample = make_sampler(run, settings, train)
    shares = []
    for _ in range(100):
        batch = sample()
        reward = batch["context", "next", "reward"].squeeze(-1)
        assert batch.shape == reward.shape == (TASKS, 200)
        assert (batch["next", "reward"].squeeze(-1) < 100).all()
        assert (reward % 100 == torch.arange(TASKS).unsqueeze(-1)).all()
        shares.append((reward >= 100).float().mean(1))
    share = torch.stack(shares).flatten()
    assert 0.4 < share.mean() < 0.6
    assert share.min() < 0.1
    assert share.max() > 0.9
    assert ((share > 0.3) & (share < 0.7)).any()


def test_other_contexts_add_nothing_to_a_batch() -> None:
    run: Any = Data()
    train = [run.transitions(name, "train") for name in run.names]
    assert "context" not in make_sampler(run, DistillSettings(batch_size=4), train)()


# -- settings --------------------------------------------------------------------------------------

SETS = {"task_encoder": "set_mean", "context_fraction": 1.0, "isometry_weight": 0.0}


@pytest.mark.parametrize(
    "changes",
    [
        SETS,
        SETS | {"task_encoder": "set_attention", "context": "given"},
        SETS | {"batch_size": 16, "context_size": 8},
        SETS | {"inference_updates": 5},
        {"task_encoder": "told", "isometry_weight": 0.0},
        {"task_encoder": "nothing", "isometry_weight": 0.0, "classification_weight": None},
    ],
)
def test_settings_that_fit_are_taken(changes: dict[str, Any]) -> None:
    DistillSettings(**changes).check(["prototype"])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (SETS | {"context": "current"}, "context is current; valid .*set_mean: set or given"),
        (SETS | {"context": "random"}, "context is random; valid .*set_mean: set or given"),
        (SETS | {"context_fraction": 0.5}, "context_fraction is 0.5; valid .*: 1"),
        (SETS | {"isometry_weight": 1.0}, "isometry_weight is 1.0; valid .*: 0"),
        (SETS | {"prototype": "medoid"}, "prototype is medoid; valid .*: mean"),
        (SETS | {"batch_size": 15}, "batch_size is 15; valid .*: at least 16, two contexts"),
        ({"context": "given"}, r"\w+ is (given|transition); valid .*=transition: .*set"),
        ({"inference_updates": 5}, r"\w+ is (5|transition); valid .*=transition: "),
        ({"task_encoder": "told"}, "isometry_weight is 1.0; valid .*told: 0"),
    ],
)
def test_settings_that_do_not_fit_the_encoder_are_refused(
    changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape("distill.") + says):
        DistillSettings(**changes).check(["prototype"])


@pytest.mark.parametrize("name", ["told", "nothing", "one_hot"])
def test_sources_that_an_encoder_cannot_have_are_refused(name: str) -> None:
    settings = DistillSettings(task_encoder=name, isometry_weight=0.0)
    with pytest.raises(ConfigError, match=rf"{name}, which does not read .*valid: \[prototype\]"):
        settings.check(["prototype", "online"])


@pytest.mark.parametrize("changes", [{"context": "given"}, {"inference_updates": 5}])
def test_contexts_of_another_behaviour_must_be_collected(changes: dict[str, Any]) -> None:
    settings = Settings(distill=DistillSettings(**(SETS | changes)))
    with pytest.raises(ConfigError, match=r"collect.context_episodes 0; valid: at least 1"):
        Run(settings)
    Run(dataclasses.replace(settings, tasks={"mine": {"demonstrations": "mine.hdf5"}}))
    settings.collect = dataclasses.replace(settings.collect, context_episodes=1)
    Run(settings)


def test_tasks_of_no_family_cannot_be_told(tmp_path: Path) -> None:
    distill = DistillSettings(task_encoder="told", isometry_weight=0.0)
    with pytest.raises(ConfigError, match=r"tasks is .*valid: the trained members of one family"):
        Run(Settings(run_dir=str(tmp_path), tasks=["reach", "lift"], distill=distill))


# -- studies of single transitions -----------------------------------------------------------------


@of_sets
def test_studies_that_embed_transitions_refuse_and_leave_nothing(name: str, tmp_path: Path) -> None:
    for extra in ("hydra", "gymnasium", "matplotlib", "scipy", "sklearn", "tqdm"):
        pytest.importorskip(extra)
    from torchrl_bmrl.studies.imitation import ImitateSettings, imitate
    from torchrl_bmrl.studies.interpolation import InterpolationSettings, interpolate
    from torchrl_bmrl.studies.latent_sac import LatentSACSettings, latent_sac

    settings = Settings(run_dir=str(tmp_path), tasks=["reach", "lift", "push_up"], workers=1)
    with Run(settings) as run:
        run.student_path.parent.mkdir()
        write(run.student_path, make_student(name), name, tasks=list(run.names))
        write_atomic(run.data_dir / "statistics.json", json.dumps(STATISTICS))
        before = sorted(tmp_path.rglob("*"))
        for study, options in (
            (imitate, ImitateSettings(composition="reach-lift")),
            (interpolate, InterpolationSettings(task="lift")),
            (latent_sac, LatentSACSettings(composition="reach-lift")),
        ):
            with pytest.raises(BMRLError, match="single transitions"):
                study(run, options)
            assert sorted(tmp_path.rglob("*")) == before, study.__name__
