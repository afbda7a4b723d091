"""The baselines: what an update moves, what the policies see, runs that go on, rows."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")
pytest.importorskip("robosuite", exc_type=ImportError)

from small_runs import TASKS, Interruption, contents, study_run
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.envs.transforms import Compose

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.pipeline import (
    Run,
    Settings,
    collect,
)
from torchrl_bmrl.pipeline import run as run_module
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies.baselines import (
    ALL_TASKS,
    BASELINES,
    BaselineSettings,
    Learner,
    baselines,
    make_buffer,
    make_table,
    one_hot_task,
    train_job,
)
from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = pytest.mark.robosuite

OBSERVATION_DIM, ACTION_DIM = 33, 7


def make_run(folder: Path, **bcq: Any) -> Run:
    return study_run(folder, bcq, log_interval=4, checkpoint_interval=4)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with demonstrations and nothing else."""
    folder = tmp_path_factory.mktemp("collected")
    with make_run(folder) as run:
        collect(run)
    return folder


def make_learner(folder: Path, algorithm: str, **bcq: Any) -> Learner:
    task = ALL_TASKS if algorithm == "bcq_one_hot" else "lift"
    return Learner(make_run(folder, **bcq), algorithm, task, {})


ACTION = torch.linspace(-0.6, 0.6, ACTION_DIM)


def one_action(rows: int, algorithm: str, seed: int = 0) -> TensorDict:
    """A demonstrator that always does the same, but for noise, and is rewarded for it."""
    size = OBSERVATION_DIM + (len(TASKS) if algorithm == "bcq_one_hot" else 0)
    generator = torch.Generator().manual_seed(seed)
    now, after = (torch.randn(rows, size, generator=generator) for _ in range(2))
    action = ACTION + 0.4 * torch.randn(rows, ACTION_DIM, generator=generator)
    action = action.clamp(-1.0, 1.0)
    never = torch.zeros(rows, 1, dtype=torch.bool)
    reward = 1 - (action - ACTION).square().sum(-1, keepdim=True)
    flags = {"done": never, "terminated": never.clone()}
    data = {"observation": now, "action": action}
    data |= {"next": {"observation": after, "action": action.clone(), "reward": reward, **flags}}
    return TensorDict(data, [rows])


def networks(learner: Learner) -> dict[str, torch.Tensor]:
    """Every network's parameters in one vector, by name."""
    return {
        name.removesuffix("_params"): torch.cat([x.flatten() for x in part.values(True, True)])
        .detach()
        .clone()
        for name, part in learner.loss.named_children()
        if name.endswith("_params")
    }


# -- what an update moves --------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", BASELINES)
def test_an_update_moves_every_network_and_every_target(collected: Path, algorithm: str) -> None:
    learner = make_learner(collected, algorithm)
    before, step = networks(learner), learner.make_step(100)
    for update in (99, 100):
        step(update, one_action(8, algorithm))
    after = networks(learner)
    assert {name for name in before if torch.equal(before[name], after[name])} == set()
    expected = {
        "bc": {"actor_network"},
        "bc_best": {"actor_network"},
        "td3_bc": {"actor_network", "qvalue_network"},
        "rebrac": {"actor_network", "qvalue_network"},
        "iql": {"actor_network", "qvalue_network", "value_network"},
        "cql": {"actor_network", "qvalue_network"},
        "bcq_one_hot": {"generator", "qvalue_network"},
    }[algorithm]
    assert {name for name in after if not name.startswith("target_")} == expected
    assert {name for name in after if name.startswith("target_")} == {
        "bc": set(),
        "bc_best": set(),
        "td3_bc": {"target_actor_network", "target_qvalue_network"},
        "rebrac": {"target_actor_network", "target_qvalue_network"},
    }.get(algorithm, {"target_qvalue_network"})
    if algorithm == "cql":
        assert learner.loss.log_alpha.item() != 0


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", BASELINES)
def test_a_policy_comes_to_do_what_the_demonstrator_does(collected: Path, algorithm: str) -> None:
    learner = make_learner(collected, algorithm, lr=0.003, gamma=0.0, cosine=False)
    total = {"td3_bc": 600, "rebrac": 600}.get(algorithm, 200)
    step, states = learner.make_step(total), one_action(64, algorithm).select("observation")

    def error() -> float:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = learner.make_policy()(states.copy())["action"]
        return (action - ACTION).square().mean().item()

    before = error()
    assert error() == pytest.approx(before, rel=0.2)  # without noise, but for BCQ's proposals
    for update in range(1, total + 1):
        step(update, one_action(128, algorithm, seed=update))
    assert error() < 0.25 * before


@pytest.mark.parametrize("algorithm", ["td3_bc", "rebrac"])
def test_the_actor_and_targets_of_td3_move_at_every_other_update(
    collected: Path, algorithm: str
) -> None:
    learner = make_learner(collected, algorithm)
    step, moved = learner.make_step(100), []
    for update in (1, 2, 3):
        before = networks(learner)
        step(update, one_action(8, algorithm))
        after = networks(learner)
        moved.append({name for name in before if not torch.equal(before[name], after[name])})
    assert moved[0] == moved[2] == {"qvalue_network"}
    assert moved[1] == {*moved[0], "actor_network", "target_actor_network", "target_qvalue_network"}


def test_cql_imitates_in_the_first_twenty_fifth_of_its_updates(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = make_learner(collected, "cql")
    imitation, calls = learner.loss.actor_bc_loss, []
    monkeypatch.setattr(
        learner.loss, "actor_bc_loss", lambda data: calls.append(data) or imitation(data)
    )
    step, counts = learner.make_step(100), []
    for update in (1, 4, 5, 100):
        step(update, one_action(8, "cql"))
        counts.append(len(calls))
    assert counts == [1, 2, 2, 2]


def test_cqls_candidates_differ_within_a_state(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A TorchRL loss turns sampling off in its methods; CQL would compare ten times the same action.
    learner = make_learner(collected, "cql")
    draw, drawn = learner.loss._get_policy_actions, []

    def recorded(*args: Any, **kwargs: Any) -> Any:
        drawn.append(draw(*args, **kwargs))
        return drawn[-1]

    monkeypatch.setattr(learner.loss, "_get_policy_actions", recorded)
    learner.make_step(100)(100, one_action(8, "cql"))
    assert len(drawn) == 2  # at the states and at the next ones
    for data, _ in drawn:
        actions = data["action"].reshape(8, 10, ACTION_DIM)
        assert (actions.std(1) > 0.01).all()
        observations = data["observation"].reshape(8, 10, OBSERVATION_DIM)
        assert (observations == observations[:, :1]).all()


@pytest.mark.parametrize("algorithm", ["td3_bc", "rebrac", "iql", "cql", "bcq_one_hot"])
def test_the_discount_is_that_of_stage_1(collected: Path, algorithm: str) -> None:
    learner = make_learner(collected, algorithm, gamma=0.5)
    assert learner.loss.value_estimator.gamma.item() == 0.5


@pytest.mark.parametrize("cosine", [True, False])
@pytest.mark.parametrize("algorithm", BASELINES)
def test_the_learning_rate_of_every_network_decays_if_that_of_stage_1_does(
    collected: Path, algorithm: str, cosine: bool
) -> None:
    learner = make_learner(collected, algorithm, lr=0.01, cosine=cosine)
    learner.make_step(4)(3, one_action(8, algorithm))
    rates = [optimizer.param_groups[0]["lr"].item() for optimizer in learner.optimizers.values()]
    assert rates == pytest.approx([0.005 if cosine else 0.01] * len(rates))


# -- the task's index ------------------------------------------------------------------------------


def test_one_hot_bcq_acts_differently_in_the_same_state_for_another_task(collected: Path) -> None:
    policy = make_learner(collected, "bcq_one_hot").make_policy()
    seen, done = [], []
    for index in range(2):
        data = TensorDict({"observation": torch.ones(5, OBSERVATION_DIM)}, [5])
        seen.append(Compose(*one_hot_task(index, 2))(data))
        torch.manual_seed(0)  # the same latents
        done.append(policy(seen[-1].copy())["action"])
    assert [data["observation"][0, -2:].tolist() for data in seen] == [[1, 0], [0, 1]]
    assert all(list(data.keys()) == ["observation"] for data in seen)
    assert (done[0] - done[1]).abs().amax(-1).min() > 1e-4


# -- whole runs ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_hot_bcq_learns_from_every_task_with_its_index(collected: Path) -> None:
    batch = make_buffer(make_run(collected), "bcq_one_hot", ALL_TASKS, {}).sample()
    assert batch.batch_size == (2, 8)
    for data in (batch, batch["next"]):
        index = data["observation"][..., OBSERVATION_DIM:]
        assert torch.equal(index, torch.eye(2).unsqueeze(1).expand(2, 8, 2))
    assert torch.equal(batch["task"], torch.tensor([[0], [1]]).expand(2, 8))


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", BASELINES)
@pytest.mark.parametrize(
    ("error", "update", "kept"),
    [(KeyboardInterrupt, 3, 0), (KeyboardInterrupt, 7, 4), (StoppedError, 7, 7)],
)
def test_training_resumed_equals_never_stopped(
    collected: Path,
    tmp_path: Path,
    algorithm: str,
    error: type[BaseException],
    update: int,
    kept: int,
) -> None:
    task = ALL_TASKS if algorithm == "bcq_one_hot" else "lift"
    jobs = []
    for name in ("whole", "stopped"):
        shutil.copytree(collected / "data", tmp_path / name / "data")
        jobs.append((make_run(tmp_path / name), (algorithm, task, 12, {})))
    train_job(jobs[0], lambda _: None)
    with pytest.raises(error):
        train_job(jobs[1], Interruption(update, error))
    newest = f"baselines/{algorithm}-{task}/checkpoint.safetensors"
    assert (tmp_path / "stopped" / newest).exists() == bool(kept)
    if kept:
        assert load_checkpoint(tmp_path / "stopped" / newest, kind="baseline")[1]["updates"] == kept
    counted: list[int] = []
    train_job(jobs[1], counted.append)
    assert counted == ([kept] if kept else []) + [1] * (12 - kept)
    assert contents(tmp_path / "stopped", newest) == contents(tmp_path / "whole", newest)


@pytest.mark.slow
def test_every_baseline_plays_the_evaluations_starts_and_a_repeated_call_redoes_nothing(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(collected, tmp_path / "run"))
    stage_1 = ResultRow(
        task="lift", policy="bcq", seed=0, episode=0, episode_return=7.5, success=True
    )
    write_results(folder / "results.csv", [stage_1])
    before = (folder / "results.csv").read_bytes()
    played: list[tuple[int, list[int]]] = []
    evaluate_policy = run_module.evaluate_policy

    def recorded(env: Any, policy: Any, seeds: list[int], **options: Any) -> Any:
        played.append((env.observation_spec["observation"].shape[-1], seeds))
        return evaluate_policy(env, policy, seeds, **options)

    monkeypatch.setattr(run_module, "evaluate_policy", recorded)
    with make_run(folder) as run:
        baselines(run, BaselineSettings(algorithms=["bc", "iql"]))
        text = baselines(run, BaselineSettings())  # others join
        starts = [[run.seed("evaluate", task, i) for i in range(2)] for task in TASKS]
    assert [seeds for _, seeds in played] == starts * len(BASELINES)
    assert [size - OBSERVATION_DIM for size, _ in played] == [0] * 12 + [2, 2]

    rows = read_results(folder / "baselines.csv")
    assert [(row.policy, row.task, row.episode) for row in rows] == [
        (name, task, i) for name in BASELINES for task in TASKS for i in range(2)
    ]
    assert len({row.episode_return for row in rows if row.task == "lift"}) > 4  # other policies
    assert read_results(folder / "evaluation" / "lift-cql.csv") == [
        row for row in rows if (row.policy, row.task) == ("cql", "lift")
    ]
    lines = (folder / "tables" / "baselines.csv").read_text().splitlines()
    assert lines[0] == 'Policy,Reach,Lift,"Success, all",95% interval,Episodes'
    assert lines[1].startswith("Expert,")
    assert lines[2] == 'BCQ,–,"7.5, 100%",100%,"[100%, 100%]",1'
    names = ["BC", '"BC, best episodes"', "TD3+BC", "ReBRAC", "IQL", "CQL", '"BCQ, one-hot task"']
    assert all(line.startswith(f"{n},") for line, n in zip(lines[3:], names, strict=True))
    assert (folder / "studies" / "baselines.json").exists()
    paired = (folder / "tables" / "baselines_paired.csv").read_text().splitlines()
    assert paired[0] == "Policy,Reference,Mean over tasks,Reach,Lift"
    assert {line.rpartition("%")[0] != "" for line in paired[3:]} == {True}
    assert (folder / "studies" / "baselines_paired.json").exists()
    assert "12 updates each" in text
    assert (folder / "results.csv").read_bytes() == before

    kept = "baselines.csv", "tables/*", "studies/*", "evaluation/*", "baselines/**/*"
    written = contents(folder, *kept)
    checkpoints = list(folder.glob("baselines/*/*.safetensors"))
    times = [path.stat().st_mtime_ns for path in checkpoints]
    (folder / "evaluation" / "lift-bc.csv").unlink()  # as a kill would leave it
    with make_run(folder) as run:
        baselines(run, BaselineSettings())
        assert contents(folder, *kept) == written
        assert [path.stat().st_mtime_ns for path in checkpoints] == times
        assert len(played) == 2 * len(BASELINES) + 1
        # The baselines are held to their own settings, the run is not.
        with pytest.raises(BMRLError, match="updates is 8 here and 12 in the folder's run"):
            baselines(run, BaselineSettings(updates=8))


def test_without_demonstrations_the_error_names_the_recipe_that_writes_them(tmp_path: Path) -> None:
    with make_run(tmp_path) as run:
        with pytest.raises(BMRLError, match=r"statistics.json: no such file; recipes/collect.py"):
            baselines(run, BaselineSettings())
        assert not (tmp_path / "baselines").exists()


def test_a_task_without_an_environment_is_refused_before_training(tmp_path: Path) -> None:
    tasks = {"door": {"demonstrations": "door.hdf5"}}
    with (
        Run(Settings(run_dir=str(tmp_path), tasks=tasks)) as run,
        pytest.raises(BMRLError, match="door of tasks have no environment"),
    ):
        baselines(run, BaselineSettings())


def test_the_table_shows_returns_alone_for_a_task_without_success() -> None:
    rows = [
        ResultRow(task=task, policy="bc", seed=0, episode=0, episode_return=2.0, success=success)
        for task, success in (("b", True), ("a", None))
    ]
    table = make_table(rows, 5, {"a": "Ant", "b": "Ball"})
    assert table.header[1:3] == ("Ant", "Ball")
    assert table.rows == [("BC", "2.0", "2.0, 100%", "–", "–", "2")]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (
            {"algorithms": ["ddpg"]},
            "unknown baselines.algorithms 'ddpg'; .*iql, cql, bcq_one_hot",
        ),
        ({"algorithms": ["bc", "bc"]}, r"baselines.algorithms is .*; valid: .*each once"),
        ({"updates": 0}, "baselines.updates is 0; valid: above 0"),
    ],
)
def test_settings_that_are_not_valid_are_refused(values: dict[str, Any], says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        check_settings(BaselineSettings(**values), "baselines.")
