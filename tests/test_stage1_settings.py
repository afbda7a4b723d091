"""What the settings of stage 1's critics and generator do to a small run of files."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import numpy as np
import torch
from episode_files import read_file
from file_edits import edit, put
from file_runs import TASKS, UPDATES, file_run, write_demonstrations
from tensordict import TensorDict

from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.modules import ActionFlow, ActionMixture, ActionVAE, BCQPolicy, ChunkPolicy
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.pipeline import (
    BCQSettings,
    Run,
    Settings,
    collect,
    stage1,
    stage2,
)
from torchrl_bmrl.pipeline.learners import Agents
from torchrl_bmrl.pipeline.settings import OF_THE_AUTOENCODER
from torchrl_bmrl.pipeline.stage1 import make_policy
from torchrl_bmrl.pipeline.training_data import reward_statistics, training_data
from torchrl_bmrl.pipeline.two_stage import two_stage
from torchrl_bmrl.studies import fqe, people
from torchrl_bmrl.training.checkpoint import load_checkpoint


def trained(folder: Path, **bcq: Any) -> Run:
    """A run with demonstrations and stage 1."""
    folder.mkdir(parents=True, exist_ok=True)
    write_demonstrations(folder)
    run = file_run(folder, bcq=bcq)
    with run:
        collect(run)
        stage1(run)
    return run


# -- generators and critics ------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "latent"), [("flow", 0), ("gaussian", 1), ("mixture", 1)])
def test_both_stages_run_with_another_generator(tmp_path: Path, name: str, latent: int) -> None:
    run = trained(tmp_path, generator=name)
    with run:
        stage2(run)
    loss, (student, metadata) = run.teacher("door"), run.student()
    kinds = {"flow": ActionFlow, "gaussian": ActionMixture, "mixture": ActionMixture}
    assert isinstance(loss.generator, kinds[name])
    if name != "flow":
        components = loss.generator.decoder.module.num_components
        assert (components == 1) == (name == "gaussian")
    action_dim = run.transitions("door", "train")["action"].shape[-1]
    assert student.latent_dim == action_dim + latent
    assert metadata["latent_clip"] is None


def test_a_stack_trains_agents_with_any_generator(tmp_path: Path) -> None:
    run = trained(tmp_path, generator="flow", stacked=True, acting_rule="mean", layer_norm=True)
    assert isinstance(run.teacher("drawer").generator, ActionFlow)


def test_an_option_that_the_generator_does_not_take_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"kl_weight is 0.1, and generator ActionFlow"):
        trained(tmp_path, generator="flow", kl_weight=0.1)


def test_agents_have_the_critics_of_the_settings_also_when_loaded(tmp_path: Path) -> None:
    options = {"num_qvalue_nets": 3, "layer_norm": True, "acting_rule": "min"}
    loss = trained(tmp_path, **options).teacher("door")
    assert loss.num_qvalue_nets == 3
    assert loss.acting_rule == "min"
    assert any(isinstance(part, torch.nn.LayerNorm) for part in loss.qvalue_network.modules())


@pytest.mark.parametrize("cosine", [True, False])
def test_the_learning_rate_of_stage_1_decays_as_a_cosine_or_stays(
    tmp_path: Path, cosine: bool
) -> None:
    run = trained(tmp_path, cosine=cosine, lr=0.01, updates_per_epoch=4)
    state, _ = load_checkpoint(run.agent_path("door"), kind="bcq")
    share = 3 / 4 if cosine else 0.0
    for optimizer in state["optimizers"].values():
        (group,) = optimizer["param_groups"]
        assert float(group["lr"]) == pytest.approx(0.01 * (1 + math.cos(math.pi * share)) / 2)


def test_large_rewards_are_no_divergence(tmp_path: Path) -> None:
    write_demonstrations(tmp_path)
    for name in TASKS:
        path = tmp_path / f"{name}.hdf5"
        for demo, episode in read_file(path).items():
            edit(path, put(f"data/{demo}/rewards", np.full(len(episode), 1e4)))
    with file_run(tmp_path) as run:
        collect(run)
        stage1(run)
    _, metadata = load_checkpoint(run.agent_path("door"), kind="bcq")
    assert metadata["updates"] == UPDATES


def test_values_are_bounded_by_rewards_that_a_batch_may_lack(tmp_path: Path) -> None:
    write_demonstrations(tmp_path)
    with file_run(tmp_path) as run:
        collect(run)
        data = run.transitions("door", "train")
        sparse = data.copy()
        sparse["next", "reward"] = torch.zeros_like(data["next", "reward"])
        sparse["next", "reward"][0] = 100.0
        agents = Agents(run, {"door": "door"}, [sparse])
        metrics = {"pred_value": torch.tensor(9e3)}  # of at most 1e4
        assert agents.check(metrics, sparse[1:5], 1)
        with pytest.raises(BMRLError, match=r"pred_value is 9e\+04, above 5e\+04"):
            agents.check({"pred_value": torch.tensor(9e4)}, sparse[1:5], 1)


# -- the critics' data -----------------------------------------------------------------------------


def data(rewards: list[float], *, terminated: bool = False) -> TensorDict:
    number = len(rewards)
    last = (torch.arange(number) == number - 1).unsqueeze(-1)
    after = {"reward": torch.tensor(rewards).unsqueeze(-1), "done": last}
    after |= {"terminated": last & terminated, "observation": torch.arange(number).unsqueeze(-1)}
    return TensorDict({"action": torch.zeros(number, 2), "next": after}, [number])


def test_standard_rewards_have_mean_zero_and_deviation_one() -> None:
    before = data([1.0, 2.0, 6.0])
    (part,) = training_data([before], BCQSettings(standard_reward=True))
    assert part["next", "reward"].mean().item() == pytest.approx(0.0, abs=1e-6)
    assert part["next", "reward"].std().item() == pytest.approx(1.0)
    assert before["next", "reward"].flatten().tolist() == [1.0, 2.0, 6.0]


def test_rewards_of_episodes_that_terminate_are_scaled_but_not_shifted() -> None:
    """A shift would pay for an early or a late end."""
    (part,) = training_data(
        [data([0.0, 0.0, 6.0], terminated=True)], BCQSettings(standard_reward=True)
    )
    reward = part["next", "reward"].flatten()
    assert reward[0] == reward[1] == 0
    assert reward.std().item() == pytest.approx(1.0)


def test_equal_rewards_are_shifted_to_zero_and_not_divided_by_zero() -> None:
    (part,) = training_data([data([2.0, 2.0])], BCQSettings(standard_reward=True))
    assert part["next", "reward"].flatten().tolist() == [0.0, 0.0]
    assert reward_statistics(data([2.0, 2.0]))[1] == 1


def test_the_first_part_of_the_data_decides_the_scale_of_all() -> None:
    first, second = training_data(
        [data([1.0, 2.0, 6.0]), data([5.0, 9.0])], BCQSettings(standard_reward=True)
    )
    deviation = torch.tensor([1.0, 2.0, 6.0]).std()
    for part, rewards in ((first, [1.0, 2.0, 6.0]), (second, [5.0, 9.0])):
        expected = (torch.tensor(rewards) - 3.0) / deviation
        torch.testing.assert_close(part["next", "reward"].flatten(), expected)


def test_the_outcome_of_a_row_is_that_of_its_steps_or_of_its_chunk() -> None:
    (steps,) = training_data([data([1.0] * 4)], BCQSettings(n_steps=3, gamma=0.5))
    assert steps["next", "reward"].flatten().tolist() == [1.75, 1.75, 1.5, 1.0]
    (chunks,) = training_data([data([1.0] * 4)], BCQSettings(action_chunk=3, gamma=0.5))
    assert chunks["action"].shape == (2, 6)
    assert chunks["next", "reward"].flatten().tolist() == [1.75, 1.75]


def test_with_the_defaults_the_data_are_those_that_were_given() -> None:
    before = data([1.0, 2.0])
    assert training_data([before], BCQSettings())[0] is before


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[TensorDict]:
    """Batches that the critics of BCQ are trained on from now on."""
    seen: list[TensorDict] = []
    run_loss = BCQLoss.qvalue_loss

    def spy(self: BCQLoss, batch: TensorDict) -> Any:
        seen.append(batch)
        return run_loss(self, batch)

    monkeypatch.setattr(BCQLoss, "qvalue_loss", spy)
    return seen


def most_steps(batches: list[TensorDict]) -> int:
    return max(int(batch["steps_to_next_obs"].max()) for batch in batches)


@pytest.mark.parametrize("option", ["n_steps", "action_chunk"])
def test_the_critics_discount_by_the_steps_of_each_row(
    tmp_path: Path, option: str, batches: list[TensorDict]
) -> None:
    trained(tmp_path, **{option: 3})
    assert most_steps(batches) == 3


def test_studies_train_on_the_data_of_stage_1(tmp_path: Path, batches: list[TensorDict]) -> None:
    run = trained(tmp_path / "runs", n_steps=3)
    batches.clear()
    with run:
        fqe.train_job((run, ("door", [2])), lambda updates: None)
    assert most_steps(batches) == 3
    batches.clear()
    run.tasks = run.tasks[:1]  # a study of people has one task
    shutil.copy(run.demonstrations("door"), tmp_path / "demonstrations.hdf5")
    with run:
        people.train_job((run, (0.5, 0)), lambda updates: None)
    assert most_steps(batches) == 3


# -- chunks ----------------------------------------------------------------------------------------


def test_agents_of_chunks_play_them_action_by_action(tmp_path: Path) -> None:
    run = trained(tmp_path, action_chunk=3)
    policy = make_policy(run.teacher("door"), run.settings)
    assert isinstance(policy, ChunkPolicy)
    transitions = run.transitions("door", "train")
    action = policy(transitions[:1].select("observation"))["action"]
    assert action.shape == transitions[:1]["action"].shape
    assert isinstance(make_policy(run.teacher("door"), Settings()), BCQPolicy)


@pytest.mark.parametrize("stage", [stage2, two_stage], ids=["stage2", "two_stage"])
def test_the_distillation_refuses_chunks_before_it_begins(tmp_path: Path, stage: Any) -> None:
    run = file_run(tmp_path, bcq={"action_chunk": 3})
    with run, pytest.raises(ConfigError, match=r"bcq.action_chunk is 3; valid for the distill"):
        stage(run)
    assert not (tmp_path / "data").exists()


def test_steps_and_chunks_together_are_refused() -> None:
    settings = Settings(bcq=BCQSettings(n_steps=2, action_chunk=3))
    with pytest.raises(ConfigError, match=r"bcq.n_steps is 2 and bcq.action_chunk 3; valid: one"):
        settings.check()


@pytest.mark.parametrize("generator", ["flow", "mixture", "gaussian"])
@pytest.mark.parametrize(
    "option", [{"kl_weight": 0.1}, {"kl_reduction": "sum"}, {"latent_clip": None}], ids=list
)
def test_settings_that_the_generator_does_not_read_are_refused_before_anything_is_recorded(
    generator: str, option: dict[str, Any]
) -> None:
    ((name, value),) = option.items()
    Settings(bcq=BCQSettings(**option)).check()
    with pytest.raises(ConfigError, match=f"bcq.{name} is {value}, and bcq.generator={generator} "):
        Settings(bcq=BCQSettings(generator=generator, **option)).check()


@pytest.mark.parametrize("other", [ActionFlow, ActionMixture])
def test_the_settings_of_the_autoencoder_are_the_options_that_no_other_generator_takes(
    other: type[ActionFlow | ActionMixture],
) -> None:
    assert set(OF_THE_AUTOENCODER) == set(ActionVAE(1, 1).options) - set(other(1, 1).options)
