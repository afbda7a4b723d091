"""What tuning the baselines needs: their coefficients, their data, and starts of their own."""

from __future__ import annotations

import re
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

from small_runs import TASKS, command_line, contents, started, study_run
from small_runs import make_run as small_run
from tensordict import TensorDict
from torchrl.envs import ExplorationType, exploration_type

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.pipeline import Run
from torchrl_bmrl.studies import algorithms
from torchrl_bmrl.studies.algorithms import (
    ALGORITHMS,
    OBJECTIVES,
    check_coefficients,
    make_loss,
    published,
)
from torchrl_bmrl.studies.baselines import (
    BaselineSettings,
    Learner,
    baselines,
    evaluate_job,
    has_agents,
    make_buffer,
    train_job,
)

SIZES = {"observation_dim": 3, "action_dim": 2}
COEFFICIENTS = {
    "td3_bc": {"alpha": 1.0},
    "rebrac": {"actor_penalty": 0.01, "critic_penalty": 0.02},
    "iql": {"temperature": 10.0, "expectile": 0.9},
    "cql": {"min_q_weight": 1.0},
}


def make_run(folder: Path, **bcq: Any) -> Run:
    return study_run(folder, bcq, log_interval=4, checkpoint_interval=4)


def batch(rows: int = 16, steps: int | None = None) -> TensorDict:
    torch.manual_seed(0)
    never = torch.zeros(rows, 1, dtype=torch.bool)
    after = {"observation": torch.randn(rows, 3), "action": torch.rand(rows, 2) * 2 - 1}
    after |= {"reward": torch.randn(rows, 1), "done": never, "terminated": never.clone()}
    data = {"observation": torch.randn(rows, 3), "action": torch.rand(rows, 2) * 2 - 1}
    if steps is not None:
        data["steps_to_next_obs"] = after["steps_to_next_obs"] = torch.full((rows, 1), steps)
    return TensorDict(data | {"next": after}, [rows])


def losses(algorithm: str, data: TensorDict, coefficients: Any = None) -> list[float]:
    """What each network of a new loss minimises."""
    torch.manual_seed(0)
    loss, _ = make_loss(algorithm, SIZES, (8,), coefficients or {}, gamma=0.9)
    torch.manual_seed(1)
    return [objective(loss, data.copy()).item() for objective in OBJECTIVES[algorithm].values()]


# -- coefficients ----------------------------------------------------------------------------------


def test_the_coefficients_of_an_algorithm_are_the_published_ones_by_default() -> None:
    assert {name: published(name) for name in ALGORITHMS} == {
        "bc": {},
        "bc_best": {"share": 0.1},
        "td3_bc": {"alpha": 2.5},
        "rebrac": {"actor_penalty": 0.1, "critic_penalty": 0.1},
        "iql": {"temperature": 3.0, "expectile": 0.7},
        "cql": {"min_q_weight": 5.0},
    }


@pytest.mark.parametrize(
    ("algorithm", "name"), [(key, name) for key, x in COEFFICIENTS.items() for name in x]
)
def test_every_coefficient_changes_the_loss(algorithm: str, name: str) -> None:
    given = {name: COEFFICIENTS[algorithm][name]}
    default = {name: published(algorithm)[name]}
    assert losses(algorithm, batch()) == losses(algorithm, batch(), default)
    assert losses(algorithm, batch()) != losses(algorithm, batch(), given)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"ddpg": {}}, "unknown algorithm of c 'ddpg'; valid .*: bc, bc_best, td3_bc, rebrac"),
        ({"bcq_one_hot": {"lmbda": 0.5}}, "unknown algorithm of c 'bcq_one_hot'"),
        ({"td3_bc": {"beta": 1.0}}, "c.td3_bc has 'beta'; valid: alpha"),
        ({"bc": {"alpha": 1.0}}, "c.bc has 'alpha'; valid: none"),
        ({"td3_bc": {"layer_norm": True}}, "c.td3_bc has 'layer_norm'; valid: alpha"),
        ({"td3_bc": {"alpha": "1"}}, "c.td3_bc.alpha is '1'; valid: at least 0"),
        ({"td3_bc": {"alpha": True}}, "c.td3_bc.alpha is True; valid: at least 0"),
        ({"td3_bc": {"alpha": -1}}, "c.td3_bc.alpha is -1; valid: at least 0"),
        ({"td3_bc": {"alpha": float("inf")}}, "c.td3_bc.alpha is inf; valid: at least 0"),
        ({"iql": {"expectile": 1.5}}, "c.iql.expectile is 1.5; valid: between 0 and 1"),
        ({"bc_best": {"share": 10}}, "c.bc_best.share is 10; valid: between 0 and 1"),
    ],
)
def test_coefficients_that_are_none_are_refused(given: Any, says: str) -> None:
    check_coefficients(COEFFICIENTS | {"bc_best": {"share": 1}}, "c")
    with pytest.raises(BMRLError, match=says):
        check_coefficients(given, "c")


def test_a_command_gives_coefficients_as_a_mapping(recipes: Any, tmp_path: Path) -> None:
    given = (
        "+baselines.coefficients.td3_bc.alpha=1.0",
        "+baselines.coefficients={iql: {temperature: 10}}",
    )
    code, (_, study) = started(recipes, "baselines", f"run_dir={tmp_path}", *given)
    assert code == 0
    assert study.coefficients == {"td3_bc": {"alpha": 1.0}, "iql": {"temperature": 10}}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("baselines.coefficients=5", "coefficients"),
        ("+baselines.coefficients={td3_bc: 5}", "coefficients"),
        ("baselines.starts=dev", "unknown baselines.starts 'dev'; .*evaluation, development"),
    ],
)
def test_a_command_with_another_kind_of_setting_is_refused(
    recipes: Any, tmp_path: Path, given: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command_line("baselines", f"run_dir={tmp_path}", given) != 0
    assert re.search(says, capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


# -- critics ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", [name for name in OBJECTIVES if name[:2] != "bc"])
def test_the_critics_have_layer_norm_if_stage_1_has_and_rebracs_always(algorithm: str) -> None:
    def norms(layer_norm: bool) -> int:
        loss, _ = make_loss(algorithm, SIZES, (8, 8), {}, gamma=0.9, layer_norm=layer_norm)
        networks = [loss.qvalue_network, *([loss.value_network] if algorithm == "iql" else [])]
        numbers = {
            sum(isinstance(part, torch.nn.LayerNorm) for part in network.modules())
            for network in networks
        }
        return numbers.pop() if len(numbers) == 1 else -1

    assert norms(True) == 2
    assert norms(False) == (2 if algorithm == "rebrac" else 0)


@pytest.mark.parametrize("algorithm", [name for name in OBJECTIVES if name[:2] != "bc"])
def test_the_critics_targets_discount_by_the_steps_of_a_row(algorithm: str) -> None:
    once = losses(algorithm, batch())
    assert losses(algorithm, batch(steps=1)) == pytest.approx(once, rel=1e-6)
    assert losses(algorithm, batch(steps=3)) != pytest.approx(once, rel=1e-4)


# -- data ------------------------------------------------------------------------------------------


def fake_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **bcq: Any) -> Run:
    """A run whose two episodes of each task have three steps, and the second is better."""
    rows, run = 6, make_run(tmp_path, **bcq)
    step = torch.arange(rows)
    done = (step % 3 == 2).unsqueeze(-1)
    after = {"observation": torch.zeros(rows, 3), "reward": step.float().unsqueeze(-1)}
    after |= {"done": done, "terminated": torch.zeros_like(done), "truncated": done}
    action = step.float().unsqueeze(-1) / 10
    data = {"observation": torch.zeros(rows, 3), "action": action, "episode": step // 3}
    monkeypatch.setattr(
        Run, "transitions", lambda *_: TensorDict(data | {"next": after}, [rows]).clone()
    )
    return run


def rows_of(run: Run, algorithm: str, **coefficients: float) -> list[tuple[float, ...]]:
    """Action, next action and reward of the rows that a baseline learns from, in tenths."""
    sample = make_buffer(run, algorithm, "lift", coefficients).sample()
    keys = [key for key in ("action", ("next", "action")) if sample.get(key, None) is not None]
    columns = [(10 * sample[key]).round().flatten().tolist() for key in keys]
    columns.append(sample["next", "reward"].flatten().tolist())
    return sorted(set(zip(*columns, strict=True)))


def test_filtered_cloning_learns_from_the_best_episodes_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=256)
    assert [action for action, _ in rows_of(run, "bc")] == [0, 1, 2, 3, 4, 5]
    assert [action for action, _ in rows_of(run, "bc_best")] == [3, 4, 5]
    assert [action for action, _ in rows_of(run, "bc_best", share=1.0)] == [0, 1, 2, 3, 4, 5]


def test_rebrac_learns_from_pairs_of_actions_of_one_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=256)
    assert [row[:2] for row in rows_of(run, "rebrac")] == [(0, 1), (1, 2), (3, 4), (4, 5)]


def test_n_steps_end_in_the_action_after_the_last_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=256, n_steps=2, gamma=0.5)
    assert rows_of(run, "rebrac") == [(0, 2, 0.5), (1, 2, 1), (3, 5, 5), (4, 5, 4)]
    assert [reward for _, reward in rows_of(run, "iql")] == [0.5, 2, 2, 5, 6.5, 5]


def test_rewards_are_standardised_if_those_of_stage_1_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=256, standard_reward=True)
    standard = (torch.arange(6.0) - 2.5) / torch.arange(6.0).std()
    assert [reward for _, reward in rows_of(run, "iql")] == pytest.approx(standard.tolist())


def trained_batch(
    run: Run, monkeypatch: pytest.MonkeyPatch, algorithm: str, **coefficients: float
) -> TensorDict:
    """The batch that a training of one update gets."""
    batches: list[TensorDict] = []

    def record(update: int, batch: TensorDict) -> dict[str, torch.Tensor]:
        batches.append(batch)
        return {}

    monkeypatch.setattr(Learner, "make_step", lambda *_: record)
    train_job((run, (algorithm, "lift", 1, coefficients)), lambda _: None)
    (batch,) = batches
    return batch


@pytest.mark.parametrize("algorithm", [name for name in OBJECTIVES if name[:2] != "bc"])
def test_batches_contain_the_steps_of_their_rows_also_where_iql_reads_them(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=64, n_steps=2)
    batch = trained_batch(run, monkeypatch, algorithm)
    assert set(batch["steps_to_next_obs"].flatten().tolist()) == {1, 2}
    assert torch.equal(batch["next", "steps_to_next_obs"], batch["steps_to_next_obs"])


def test_filtered_cloning_trains_on_the_given_share_of_the_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, batch_size=256)
    batch = trained_batch(run, monkeypatch, "bc_best", share=1.0)
    assert len(batch["action"].unique()) == 6


@pytest.mark.parametrize("algorithm", [name for name in OBJECTIVES if name[:2] != "bc"])
def test_a_baseline_has_the_layer_norm_of_the_run_and_its_own_coefficients(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fake_run(tmp_path, monkeypatch, layer_norm=True)
    given = COEFFICIENTS[algorithm]
    data = make_buffer(run, algorithm, "lift", given).sample().reshape(-1)

    def metrics(**coefficients: float) -> list[float]:
        learner = Learner(run, algorithm, "lift", coefficients)
        modules = learner.loss.qvalue_network.modules()
        assert sum(isinstance(part, torch.nn.LayerNorm) for part in modules) == 2
        torch.manual_seed(1)
        return [value.item() for value in learner.make_step(100)(100, data.copy()).values()]

    assert metrics(**published(algorithm)) == metrics()
    assert metrics(**given) != metrics()


def test_baselines_act_without_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, seen = fake_run(tmp_path, monkeypatch), []
    monkeypatch.setattr(
        "torchrl_bmrl.studies.baselines.evaluate_once", lambda *args, **_: args[3]([0])
    )
    monkeypatch.setattr(Run, "play", lambda *_, **__: seen.append(exploration_type()) or [])
    evaluate_job((run, ("iql", "lift", {}, False)), lambda _: None)
    assert seen == [ExplorationType.DETERMINISTIC]


# -- whole runs ------------------------------------------------------------------------------------


@pytest.mark.robosuite
def test_development_starts_are_other_starts_and_other_files(
    finished_copy: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []
    play = Run.play

    def recorded(self: Run, *args: Any, **options: Any) -> Any:
        seeds.extend(options["seeds"])
        return play(self, *args, **options)

    monkeypatch.setattr(Run, "play", recorded)
    settings = ("baselines.algorithms=[bc]", "baselines.updates=4")
    kept = "results.csv", "studies/*", "evaluation/*", "report.html"
    before = contents(finished_copy, *kept)

    def go(*more: str) -> None:
        run(finished_copy, baselines, *settings, *more, section="baselines")

    import baselines as recipe  # noqa: F401 (adds the settings)

    go("baselines.starts=development")
    assert contents(finished_copy, *kept) == before
    assert not (finished_copy / "baselines.csv").exists()
    rows = read_results(finished_copy / "baselines_dev.csv")
    assert {(row.policy, row.task) for row in rows} == {
        (policy, task) for policy in ("bcq", "bc") for task in TASKS
    }
    development = set(seeds)
    seeds.clear()
    go()
    assert development.isdisjoint(seeds)
    assert len(development) == len(set(seeds)) == len(rows) / 2
    assert {row.policy for row in read_results(finished_copy / "baselines.csv")} == {"bc"}
    assert read_results(finished_copy / "baselines_dev.csv") == rows
    tables = {path.name for path in (finished_copy / "tables").glob("baselines*")}
    names = ("baselines", "baselines_paired", "baselines_dev", "baselines_dev_paired")
    assert tables == {f"{name}.{end}" for name in names for end in ("md", "csv")}
    assert {path.stem for path in (finished_copy / "studies").glob("baselines*")} == set(names[:2])


@pytest.mark.robosuite
def test_stage_1_has_agents_if_they_all_are_finished(finished_copy: Path) -> None:
    run = small_run(finished_copy)
    assert has_agents(run)
    assert not has_agents(small_run(finished_copy, "bcq.epochs=3"))
    run.agent_path("lift").unlink()
    assert not has_agents(run)


@pytest.mark.robosuite
def test_without_agents_the_baselines_play_development_starts_alone(
    collected_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[str] = []
    monkeypatch.setattr(
        "torchrl_bmrl.studies.baselines.evaluate_once",
        lambda run, task, policy, *_, **__: played.append(policy) or [],
    )
    settings = BaselineSettings(algorithms=["bc"], updates=4, starts="development")
    with make_run(collected_run) as opened:
        baselines(opened, settings)
    assert set(played) == {"bc"}


@pytest.mark.robosuite
def test_a_finished_baseline_with_other_coefficients_is_refused_before_any_training(
    collected_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "torchrl_bmrl.studies.baselines.evaluate_once", lambda *_, **__: []
    )  # trained, not played
    monkeypatch.setattr("torchrl_bmrl.studies.baselines.evaluate_stages", lambda *_: [])

    def go(names: list[str], **coefficients: Any) -> None:
        settings = BaselineSettings(algorithms=names, updates=4, coefficients=coefficients)
        with make_run(collected_run) as opened:
            baselines(opened, settings)

    go(["td3_bc"], td3_bc={"alpha": 1.0})
    for values in ({}, {"td3_bc": {"alpha": 2.0}}):
        with pytest.raises(BMRLError, match=r"coefficients.td3_bc.alpha is 2.* here and 1.0 in"):
            go(["bc", "td3_bc"], **values)
        assert not (collected_run / "baselines" / "bc-lift").exists()
    go(["bc", "td3_bc"], td3_bc={"alpha": 1})
    go(["bc_best"], bc_best={"share": 0.1})  # others join
    go(["bc_best"])  # 0.1 is the published one
    shutil.rmtree(collected_run / "baselines" / "td3_bc-lift")
    shutil.rmtree(collected_run / "baselines" / "td3_bc-reach")
    go(["td3_bc"])


def test_every_algorithm_is_listed_with_its_order_of_updates() -> None:
    assert list(algorithms.ALGORITHMS) == list(OBJECTIVES)
    assert set(algorithms.DATA) <= set(ALGORITHMS)
