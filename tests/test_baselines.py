"""The baselines: what an update moves, what the policies see, runs that go on, rows."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
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

from omegaconf import OmegaConf
from small_runs import HORIZON, RECIPES, configured
from tensordict import TensorDict

from torchrl_bmrl import names
from torchrl_bmrl.evaluation import ResultRow, read_results, rollout, write_results
from torchrl_bmrl.pipeline.agents import ACTION_DIM, OBSERVATION_DIM
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = pytest.mark.robosuite

ALGORITHMS = ["bc", "td3_bc", "iql", "cql", "bcq_one_hot"]
TASKS = ["reach", "lift"]
SMALL = [
    "preset=smoke",
    "workers=1",
    f"tasks=[{','.join(TASKS)}]",
    "collect.train_episodes.reach=1",
    "collect.train_episodes.lift=1",
    "bcq.epochs=2",
    "bcq.updates_per_epoch=6",
    "bcq.batch_size=8",
    "bcq.num_cells=[16,16]",
    "evaluate.episodes=2",
    "evaluate.num_candidates=5",
    "log_interval=4",
    "checkpoint_interval=4",
]


@pytest.fixture(scope="module")
def baselines() -> Iterator[Any]:
    """The recipe's module, with episodes of ten steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(RECIPES))
        patch.setattr(names, "HORIZON", HORIZON)
        patch.setitem(rollout.evaluate_policy.__kwdefaults__, "max_steps", HORIZON)
        import baselines

        yield baselines


def settings(folder: Path, *overrides: str) -> Any:
    return configured(*SMALL, f"run_dir={folder}", *overrides)


def make_learner(baselines: Any, folder: Path, algorithm: str, *overrides: str) -> Any:
    config = OmegaConf.to_object(settings(folder, *overrides))
    return baselines.Learner(config, algorithm, "all" if "one_hot" in algorithm else "lift")


ACTION = torch.linspace(-0.6, 0.6, ACTION_DIM)


def one_action(rows: int, algorithm: str, seed: int = 0) -> TensorDict:
    """A demonstrator that always does the same, but for noise, and is rewarded for it."""
    size = OBSERVATION_DIM + (len(TASKS) if "one_hot" in algorithm else 0)
    generator = torch.Generator().manual_seed(seed)
    now, after = (torch.randn(rows, size, generator=generator) for _ in range(2))
    action = ACTION + 0.4 * torch.randn(rows, ACTION_DIM, generator=generator)
    action = action.clamp(-1.0, 1.0)
    never = torch.zeros(rows, 1, dtype=torch.bool)
    reward = 1 - (action - ACTION).square().sum(-1, keepdim=True)
    flags = {"done": never, "terminated": never.clone()}
    data = {"observation": now, "action": action}
    data |= {"next": {"observation": after, "reward": reward, **flags}}
    return TensorDict(data, [rows])


def networks(learner: Any) -> dict[str, torch.Tensor]:
    """Every network's parameters in one vector, by name."""
    return {
        name.removesuffix("_params"): torch.cat([x.flatten() for x in part.values(True, True)])
        .detach()
        .clone()
        for name, part in learner.loss.named_children()
        if name.endswith("_params")
    }


# -- what an update moves --------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_update_moves_every_network_and_every_target(
    baselines: Any, tmp_path: Path, algorithm: str
) -> None:
    learner = make_learner(baselines, tmp_path, algorithm)
    before, choose = networks(learner), learner.choose_updates(100)
    for number in (99, 100):
        choose(number)(one_action(8, algorithm))
    after = networks(learner)
    assert {name for name in before if torch.equal(before[name], after[name])} == set()
    expected = {
        "bc": {"actor_network"},
        "td3_bc": {"actor_network", "qvalue_network"},
        "iql": {"actor_network", "qvalue_network", "value_network"},
        "cql": {"actor_network", "qvalue_network"},
        "bcq_one_hot": {"generator", "qvalue_network"},
    }[algorithm]
    assert {name for name in after if not name.startswith("target_")} == expected
    assert {name for name in after if name.startswith("target_")} == {
        "bc": set(),
        "td3_bc": {"target_actor_network", "target_qvalue_network"},
    }.get(algorithm, {"target_qvalue_network"})
    if algorithm == "cql":
        assert learner.loss.log_alpha.item() != 0


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_policy_comes_to_do_what_the_demonstrator_does(
    baselines: Any, tmp_path: Path, algorithm: str
) -> None:
    learner = make_learner(baselines, tmp_path, algorithm, "bcq.lr=0.003", "bcq.gamma=0")
    total = {"td3_bc": 600}.get(algorithm, 200)
    choose, states = learner.choose_updates(total), one_action(64, algorithm).select("observation")

    def error() -> float:
        with baselines.set_exploration_type(baselines.ExplorationType.DETERMINISTIC):
            action = learner.make_policy()(states.copy())["action"]
        return (action - ACTION).square().mean().item()

    before = error()
    assert error() == pytest.approx(before, rel=0.2)  # without noise, but for BCQ's proposals
    for number in range(1, total + 1):
        choose(number)(one_action(128, algorithm, seed=number))
    assert error() < 0.25 * before


def test_td3_bc_moves_its_actor_and_targets_at_every_other_update(
    baselines: Any, tmp_path: Path
) -> None:
    learner = make_learner(baselines, tmp_path, "td3_bc")
    choose, moved = learner.choose_updates(100), []
    for number in (1, 2, 3):
        before = networks(learner)
        choose(number)(one_action(8, "td3_bc"))
        after = networks(learner)
        moved.append({name for name in before if not torch.equal(before[name], after[name])})
    assert moved[0] == moved[2] == {"qvalue_network"}
    assert moved[1] == {*moved[0], "actor_network", "target_actor_network", "target_qvalue_network"}


def test_cql_imitates_in_the_first_twenty_fifth_of_its_updates(
    baselines: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = make_learner(baselines, tmp_path, "cql")
    imitation, calls = learner.loss.actor_bc_loss, []
    monkeypatch.setattr(
        learner.loss, "actor_bc_loss", lambda data: calls.append(data) or imitation(data)
    )
    choose, counts = learner.choose_updates(100), []
    for number in (1, 4, 5, 100):
        choose(number)(one_action(8, "cql"))
        counts.append(len(calls))
    assert counts == [1, 2, 2, 2]


def test_cqls_candidates_differ_within_a_state(
    baselines: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A TorchRL loss turns sampling off in its methods; CQL would compare ten times the same action.
    learner = make_learner(baselines, tmp_path, "cql")
    draw, drawn = learner.loss._get_policy_actions, []

    def recorded(*args: Any, **kwargs: Any) -> Any:
        drawn.append(draw(*args, **kwargs))
        return drawn[-1]

    monkeypatch.setattr(learner.loss, "_get_policy_actions", recorded)
    learner.choose_updates(100)(100)(one_action(8, "cql"))
    assert len(drawn) == 2  # at the states and at the next ones
    for data, _ in drawn:
        actions = data["action"].reshape(8, 10, ACTION_DIM)
        assert (actions.std(1) > 0.01).all()
        observations = data["observation"].reshape(8, 10, OBSERVATION_DIM)
        assert (observations == observations[:, :1]).all()


@pytest.mark.parametrize("algorithm", ["td3_bc", "iql", "cql", "bcq_one_hot"])
def test_the_discount_is_that_of_stage_1(baselines: Any, tmp_path: Path, algorithm: str) -> None:
    learner = make_learner(baselines, tmp_path, algorithm, "bcq.gamma=0.5")
    assert learner.loss.value_estimator.gamma.item() == 0.5


# -- the task's index ------------------------------------------------------------------------------


def test_one_hot_bcq_acts_differently_in_the_same_state_for_another_task(
    baselines: Any, tmp_path: Path
) -> None:
    policy = make_learner(baselines, tmp_path, "bcq_one_hot").make_policy()
    seen, done = [], []
    for index in range(2):
        data = TensorDict({"observation": torch.ones(5, OBSERVATION_DIM)}, [5])
        seen.append(baselines.Compose(*baselines.one_hot_task(index, 2))(data))
        torch.manual_seed(0)  # the same latents
        done.append(policy(seen[-1].copy())["action"])
    assert [data["observation"][0, -2:].tolist() for data in seen] == [[1, 0], [0, 1]]
    assert all(list(data.keys()) == ["observation"] for data in seen)
    assert (done[0] - done[1]).abs().amax(-1).min() > 1e-4


# -- whole runs ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def collected(baselines: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with demonstrations and nothing else."""
    import collect

    folder = tmp_path_factory.mktemp("collected")
    collect.collect(OmegaConf.to_object(settings(folder)))
    return folder


def run(baselines: Any, folder: Path, *overrides: str) -> None:
    baselines.run_recipe(settings(folder, *overrides), baselines.baselines)


def contents(folder: Path, *patterns: str) -> dict[str, bytes]:
    paths = [path for pattern in patterns for path in folder.glob(pattern) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.slow
def test_one_hot_bcq_learns_from_every_task_with_its_index(baselines: Any, collected: Path) -> None:
    buffer = baselines.make_buffer(OmegaConf.to_object(settings(collected)), "bcq_one_hot", "all")
    batch = buffer.sample()
    assert batch.batch_size == (2, 8)
    for data in (batch, batch["next"]):
        index = data["observation"][..., OBSERVATION_DIM:]
        assert torch.equal(index, torch.eye(2).unsqueeze(1).expand(2, 8, 2))
    assert torch.equal(batch["task"], torch.tensor([[0], [1]]).expand(2, 8))


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(("update", "kept"), [(3, None), (7, 4), (11, 8), (12, 12)])
def test_training_resumed_equals_never_stopped(
    baselines: Any, collected: Path, tmp_path: Path, algorithm: str, update: int, kept: int | None
) -> None:
    task = "all" if algorithm == "bcq_one_hot" else "lift"
    jobs = []
    for name in ("whole", "stopped"):
        shutil.copytree(collected / "data", tmp_path / name / "data")
        jobs.append((OmegaConf.to_object(settings(tmp_path / name)), algorithm, task))
    done = 0

    def stop(count: int) -> None:
        nonlocal done
        done += count
        if done == update:
            raise KeyboardInterrupt

    baselines.train_job(jobs[0], lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        baselines.train_job(jobs[1], stop)
    checkpoint = (
        tmp_path / "stopped" / "baselines" / f"{algorithm}-{task}" / "checkpoint.safetensors"
    )
    assert checkpoint.exists() == (kept is not None)
    if kept is not None:
        assert load_checkpoint(checkpoint, kind="baseline")[1]["updates"] == kept
    counted: list[int] = []
    baselines.train_job(jobs[1], counted.append)
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    expected = contents(tmp_path / "whole", "baselines/**/*")
    assert len(expected) == 2  # the newest, and the one before
    assert contents(tmp_path / "stopped", "baselines/**/*") == expected


@pytest.mark.slow
def test_every_baseline_plays_the_evaluations_starts_and_a_repeated_command_redoes_nothing(
    baselines: Any,
    collected: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import evaluate

    folder = Path(shutil.copytree(collected, tmp_path / "run"))
    stage_1 = ResultRow(
        task="lift", policy="bcq", seed=0, episode=0, episode_return=7.5, success=True
    )
    write_results(folder / "results.csv", [stage_1])
    before = (folder / "results.csv").read_bytes()
    played: list[tuple[Any, list[int]]] = []
    plain: Callable[..., Any] = evaluate.evaluate_policy

    def recorded(env: Any, policy: Any, seeds: list[int], **options: Any) -> Any:
        played.append((env.observation_spec["observation"].shape, seeds))
        return plain(env, policy, seeds, **options)

    monkeypatch.setattr(evaluate, "evaluate_policy", recorded)
    run(baselines, folder, "baselines.algorithms=[bc,iql]")
    run(baselines, folder)  # others join
    starts = {task: [derive_seed(0, "evaluate", task, i) for i in range(2)] for task in TASKS}
    assert [seeds for _, seeds in played] == list(starts.values()) * len(ALGORITHMS)
    sizes = [shape[-1] - OBSERVATION_DIM for shape, _ in played]
    assert sizes == [0] * 8 + [2, 2]

    rows = read_results(folder / "baselines.csv")
    assert [(row.policy, row.task, row.episode) for row in rows] == [
        (name, task, i) for name in ALGORITHMS for task in TASKS for i in range(2)
    ]
    assert len({row.episode_return for row in rows if row.task == "lift"}) > 4  # other policies
    assert read_results(folder / "evaluation" / "lift-cql.csv") == [
        row for row in rows if (row.policy, row.task) == ("cql", "lift")
    ]
    lines = (folder / "tables" / "baselines.csv").read_text().splitlines()
    assert lines[0] == 'Policy,Reach,Lift,"Success, all",95% interval,Episodes'
    assert lines[1] == 'BCQ,–,"7.5, 100%",100%,"[100%, 100%]",1'
    assert [line.split(",")[0] for line in lines[2:6]] == ["BC", "TD3+BC", "IQL", "CQL"]
    assert (folder / "studies" / "baselines.json").exists()
    assert "12 updates each" in capsys.readouterr().out
    assert (folder / "results.csv").read_bytes() == before

    kept = "baselines.csv", "tables/*", "studies/*", "evaluation/*", "baselines/**/*"
    written = contents(folder, *kept)
    checkpoints = list(folder.glob("baselines/*/*.safetensors"))
    times = [path.stat().st_mtime_ns for path in checkpoints]
    (folder / "evaluation" / "lift-bc.csv").unlink()  # as a kill would leave it
    run(baselines, folder)
    assert contents(folder, *kept) == written
    assert [path.stat().st_mtime_ns for path in checkpoints] == times
    assert len(played) == 2 * len(ALGORITHMS) + 1

    # The baselines are held to their own settings, the run stays free of them.
    with pytest.raises(SystemExit):
        run(baselines, folder, "baselines.updates=8")
    assert "updates is 8 here and 12 in the folder's run" in capsys.readouterr().err


def test_without_demonstrations_the_recipe_says_who_writes_them(
    baselines: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run(baselines, tmp_path)
    assert "statistics.json: no such file; recipes/collect.py writes it" in capsys.readouterr().err
    assert not (tmp_path / "baselines").exists()
