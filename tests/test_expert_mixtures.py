"""Experts of different quality demonstrate in turn, and the files say which one did."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import h5py
from episode_files import ENV_ARGS, PARTS, make_episode

from torchrl_bmrl.data.robomimic import open_episodes, read_metadata, write_episodes
from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.experts.settings import experts_of
from torchrl_bmrl.pipeline import CollectSettings, Run, Settings
from torchrl_bmrl.pipeline.evaluate import (
    evaluate,
    evaluate_job,
    expert_outcomes,
    reference_outcomes,
)
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.studies import imitation
from torchrl_bmrl.tasks import Task, register_task

MIXTURE = [{}, {"speed_limit": 0.3, "contact_speed_limit": 0.25}, {"noise": 0.5}]
PLAYED = [(0.2, 1.0, 0.7), (0.2, 0.3, 0.25), (0.5, 1.0, 0.7)]
"""Noise and speed limits of the experts of MIXTURE."""


def record(
    seed: int, *, noise: float, gains: ExpertGains | None, after: Any = (), **options: Any
) -> Any:
    """An episode whose rewards are the noise and the speed limits that it was recorded with."""
    gains = gains or ExpertGains()
    rewards = [noise, gains.speed_limit, gains.contact_speed_limit]
    episode = make_episode(seed, 3, parts=PARTS)
    extras = {
        **episode.extras,
        "successes": np.array([False, False, noise < 0.4]),
        "stages": np.zeros(3, dtype=np.int8),
    }
    attributes = {"seed": seed, "env_args": ENV_ARGS}
    return replace(episode, rewards=np.array(rewards), extras=extras, attributes=attributes)


TASKS = [Task(name=name, record=record, success="success") for name in ("waving", "nodding")]


@pytest.fixture(autouse=True)
def registered() -> None:
    for task in TASKS:
        register_task(task)


def run(folder: Path, **options: Any) -> dict[str, Path]:
    return collect_demonstrations(
        folder,
        TASKS,
        {"waving": 4, "nodding": 2},
        valid_episodes=2,
        noise=0.2,
        seed=3,
        workers=1,
        **options,
    )


def played(path: Path) -> list[tuple[float, ...]]:
    """Noise and speed limits of each episode of a file."""
    with open_episodes(path) as episodes:
        return [tuple(each.rewards) for each in episodes.values()]


def expected(*experts: int) -> list[Any]:
    return [pytest.approx(PLAYED[i]) for i in experts]


@pytest.mark.parametrize("options", [{}, {"experts": None}, {"experts": {}}])
def test_without_the_setting_no_byte_of_the_files_changes(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    file = run(tmp_path / "collected", **options)["waving"]
    seeds = [derive_seed(3, "collect", "waving", i) for i in range(6)]
    episodes = [record(seed, noise=0.2, gains=None) for seed in seeds]
    write_episodes(
        tmp_path / "by_hand.hdf5",
        [
            replace(each, attributes={"seed": seed})
            for each, seed in zip(episodes, seeds, strict=True)
        ],
        env_args=ENV_ARGS,
        attributes={"task": "waving", "action_noise": 0.2, "seed": 3},
        masks={"train": range(4), "valid": range(4, 6)},
    )
    assert file.read_bytes() == (tmp_path / "by_hand.hdf5").read_bytes()


def test_the_episodes_use_the_experts_in_turn_and_so_do_the_held_out_ones(tmp_path: Path) -> None:
    files = run(tmp_path, experts={"default": MIXTURE})
    assert played(files["waving"]) == expected(0, 1, 2, 0, 1, 2)
    assert played(files["nodding"]) == expected(0, 1, 2, 0)


def test_an_entry_for_a_task_replaces_the_default_and_changes_no_other_task(
    tmp_path: Path,
) -> None:
    files = run(tmp_path / "both", experts={"default": MIXTURE, "nodding": [MIXTURE[2]]})
    assert played(files["waving"]) == expected(0, 1, 2, 0, 1, 2)
    assert played(files["nodding"]) == expected(2, 2, 2, 2)
    alone, plain = run(tmp_path / "one", experts={"nodding": MIXTURE}), run(tmp_path / "plain")
    assert alone["waving"].read_bytes() == plain["waving"].read_bytes()


def test_the_changes_apply_to_the_noise_and_the_gains_of_the_settings() -> None:
    collect = CollectSettings(
        noise=0.1, gains=ExpertGains(position=3.0), experts={"default": MIXTURE}
    )
    experts = collect.experts_of("lift")
    assert [expert.noise for expert in experts] == [0.1, 0.1, 0.5]
    assert [expert.gains for expert in experts] == [
        ExpertGains(position=3.0),
        ExpertGains(position=3.0, speed_limit=0.3, contact_speed_limit=0.25),
        ExpertGains(position=3.0),
    ]
    assert collect.gains == ExpertGains(position=3.0)


def test_a_file_of_several_experts_names_the_one_of_each_episode(tmp_path: Path) -> None:
    file = run(tmp_path, experts={"waving": MIXTURE})["waving"]
    metadata = read_metadata(file)
    assert json.loads(metadata["experts"]) == MIXTURE
    with open_episodes(file) as episodes:
        assert [each.attributes["expert"] for each in episodes.values()] == [0, 1, 2, 0, 1, 2]
    assert metadata["masks"] == {
        "train": ["demo_0", "demo_1", "demo_2", "demo_3"],
        "valid": ["demo_4", "demo_5"],
        "expert_0": ["demo_0", "demo_3"],
        "expert_0_train": ["demo_0", "demo_3"],
        "expert_1": ["demo_1", "demo_4"],
        "expert_1_train": ["demo_1"],
        "expert_1_valid": ["demo_4"],
        "expert_2": ["demo_2", "demo_5"],
        "expert_2_train": ["demo_2"],
        "expert_2_valid": ["demo_5"],
    }


def test_a_file_of_one_weak_expert_says_its_noise_and_has_no_further_masks(tmp_path: Path) -> None:
    file = run(tmp_path, experts={"default": [MIXTURE[2]]})["waving"]
    metadata = read_metadata(file)
    assert metadata["action_noise"] == 0.5
    assert json.loads(metadata["experts"]) == [MIXTURE[2]]
    assert set(metadata["masks"]) == {"train", "valid"}
    with h5py.File(file) as opened:
        assert "expert" not in opened["data/demo_0"].attrs


def settings(folder: Path, **experts: Any) -> Settings:
    chosen = Settings(run_dir=str(folder), tasks=["waving"])
    chosen.collect.experts = experts
    chosen.evaluate.expert_rollouts = True
    return chosen


def test_the_experts_rows_play_the_mixture(tmp_path: Path) -> None:
    outcomes = expert_outcomes(Run(settings(tmp_path, default=MIXTURE)), "waving", [7, 8, 9, 10])
    returns = [pytest.approx(sum(PLAYED[i])) for i in (0, 1, 2, 0)]
    assert [each.episode_return for each in outcomes] == returns
    assert [each.success for each in outcomes] == [True, True, False, True]


def test_the_reference_is_the_scripted_expert_without_noise_and_with_default_gains(
    tmp_path: Path,
) -> None:
    chosen = settings(tmp_path, default=MIXTURE)
    chosen.collect.gains = ExpertGains(speed_limit=0.1)
    outcomes = reference_outcomes(Run(chosen), "waving", [7, 8])
    assert [each.episode_return for each in outcomes] == [pytest.approx(0.0 + 1.0 + 0.7)] * 2


def test_an_expert_that_tells_no_success_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(settings(tmp_path, default=MIXTURE))
    (task,) = run.tasks

    def record(*args: Any, **options: Any) -> Any:
        return replace(task.record(*args, **options), extras={})

    monkeypatch.setattr(run, "tasks", (replace(task, record=record),))
    (outcome,) = reference_outcomes(run, "waving", [7])
    assert outcome.success is None


def test_the_reference_is_played_once_on_the_starts_of_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def counting(seed: int, **options: Any) -> Any:
        seeds.append(seed)
        return record(seed, **options)

    register_task(replace(TASKS[0], record=counting, horizon=3))
    chosen = settings(tmp_path, default=MIXTURE)
    chosen.evaluate.episodes = 4
    started = Run(chosen)
    steps: list[int] = []
    rows = evaluate_job((started, ("waving", "reference", "")), steps.append)
    assert seeds == [started.seed("evaluate", "waving", i) for i in range(4)]
    assert evaluate_job((started, ("waving", "reference", "")), steps.append) == rows
    assert len(seeds) == 4
    assert steps == [12, 12]
    assert {row.policy for row in rows} == {"reference"}
    expert = evaluate_job((started, ("waving", "expert", "")), steps.append)
    assert expert[0].episode_return != rows[0].episode_return


@pytest.mark.parametrize("reference", [True, False])
def test_only_scripted_experts_have_a_reference_and_only_if_the_setting_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: bool
) -> None:
    played: list[tuple[str, ...]] = []

    class StopError(Exception): ...

    def jobs(self: Run, function: Any, jobs: Any, **options: Any) -> Any:
        played.extend(jobs)
        raise StopError

    monkeypatch.setattr(Run, "jobs", jobs)
    monkeypatch.setattr(Run, "horizon", lambda *_: 3)
    monkeypatch.setattr(Run, "playable", True)
    chosen = settings(tmp_path)
    chosen.tasks = {"waving": {"task": "waving"}, "door": {"demonstrations": "door.hdf5"}}
    chosen.evaluate.reference = reference
    with Run(chosen) as started, pytest.raises(StopError):
        evaluate(started)
    found = [job for job in played if job[1] == "reference"]
    assert found == [("waving", "reference", "")] * reference
    assert ("door", "expert", "") in played


def test_the_reference_may_join_a_finished_run(tmp_path: Path) -> None:
    with Run(settings(tmp_path)):
        pass
    config = tmp_path / "config.yaml"
    config.write_text(config.read_text().replace("  reference: false\n", ""))
    chosen = settings(tmp_path)
    chosen.evaluate.reference = True
    with Run(chosen):
        pass


def test_the_demonstrations_to_imitate_use_the_experts_in_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imitation, "transform_data", lambda data, *_: data)

    def once(name: str, read: Any, make: Any) -> Any:
        make(tmp_path / Path(name).name)
        return read(tmp_path / Path(name).name)

    chosen = settings(tmp_path, waving=MIXTURE[:2])
    fake = SimpleNamespace(settings=chosen, once=once, seed=lambda *_: 0, statistics=None)
    rewards = [
        imitation.demonstrate(fake, TASKS[0], number)["next", "reward"].flatten().tolist()  # type: ignore[arg-type]
        for number in range(3)
    ]
    assert rewards == expected(0, 1, 0)


@pytest.mark.parametrize(
    ("experts", "message"),
    [
        ({"default": []}, "collect.experts.default is []; valid: at least one entry"),
        ({"lift": [{}, {"speed": 0.1}]}, "collect.experts.lift[1] changes 'speed'; valid: noise, "),
        ({"lift": [{"noise": -0.1}]}, "collect.experts.lift[0].noise is -0.1; valid: at least 0"),
        ({"lift": [{"noise": None}]}, "collect.experts.lift[0].noise is None; valid: a number"),
        ({"lift": [{"noise": "much"}]}, "collect.experts.lift[0].noise is 'much'; valid: a number"),
        ({"lift": [{"position": float("nan")}]}, "lift[0].position is nan; valid: a number"),
        (
            {"lift": [{"speed_limit": 1.5}]},
            "collect.experts.lift[0].speed_limit is 1.5; valid: above 0 and at most 1",
        ),
        ({"lift": [{"contact_speed_limit": 0}]}, "lift[0].contact_speed_limit is 0; valid: above"),
        ({"lift": 1}, "collect.experts.lift is 1; valid: a list"),
        ({"lift": [1]}, "collect.experts.lift is 1; valid: a mapping"),
    ],
)
def test_an_invalid_entry_is_refused_by_name_and_value_with_what_is_valid(
    experts: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        Settings(collect=CollectSettings(experts=experts)).check()


def test_an_invalid_entry_is_refused_before_anything_is_recorded(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="changes 'speed'"):
        run(tmp_path, experts={"nodding": [{"speed": 0.1}]})
    assert not list(tmp_path.iterdir())


def test_an_entry_for_an_unknown_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown task 'wavign'; .*reach"):
        Run(settings(tmp_path, wavign=MIXTURE))


def test_an_entry_for_a_task_of_files_is_refused_and_the_default_does_not_apply_to_it(
    tmp_path: Path,
) -> None:
    chosen = settings(tmp_path, default=MIXTURE)
    chosen.tasks = {"door": {"demonstrations": "door.hdf5"}}
    Run(chosen)
    chosen.collect.experts = {"door": MIXTURE}
    with pytest.raises(ConfigError, match=r"collect\.experts has door, whose .* are files; valid:"):
        Run(chosen)


def test_a_run_is_not_continued_with_other_experts(tmp_path: Path) -> None:
    chosen = settings(tmp_path / "run", waving=MIXTURE)
    with Run(chosen):
        pass
    with Run(chosen):
        pass
    for other in ({}, {"waving": MIXTURE[:2]}, {"default": MIXTURE}):
        with (
            pytest.raises(BMRLError, match=r"collect\.experts\."),
            Run(settings(tmp_path / "run", **other)),
        ):
            pass


def test_a_run_from_before_the_setting_is_continued(tmp_path: Path) -> None:
    with Run(settings(tmp_path)):
        pass
    config = tmp_path / "config.yaml"
    text = config.read_text()
    assert "  experts: {}\n" in text
    config.write_text(text.replace("  experts: {}\n", ""))
    with Run(settings(tmp_path)):
        pass


def test_weak_presets_have_the_speed_limits_and_the_noise_that_the_docs_explain(
    recipes: Any, tmp_path: Path
) -> None:
    pytest.importorskip("hydra")
    from small_runs import settings_of

    for preset, numbers in (("weak", [100] * 6), ("weak_paper", [500, 500, *[100] * 4])):
        chosen = settings_of(f"preset={preset}", f"run_dir={tmp_path}")
        collect = Run(chosen).settings.collect
        assert list(collect.train_episodes.values()) == numbers
        assert chosen.evaluate.expert_rollouts
        assert chosen.evaluate.reference
        (reach,), (lift,) = collect.experts_of("reach"), collect.experts_of("lift")
        assert (reach.noise, reach.gains.speed_limit) == (0.4, 0.03)
        assert (lift.noise, lift.gains.speed_limit) == (0.4, 0.35)
        assert lift.gains.contact_speed_limit == 0.3
    mixed = settings_of("preset=mixed", f"run_dir={tmp_path}").collect
    for task in ("reach", "push_up"):
        assert [each.noise for each in mixed.experts_of(task)] == [0.2, 0.2, 0.5]
        limits = [each.gains.speed_limit for each in mixed.experts_of(task)]
        assert limits == [1.0, 0.35, 1.0]


def test_a_command_line_gives_the_experts_of_a_task(recipes: Any, tmp_path: Path) -> None:
    pytest.importorskip("hydra")
    from small_runs import settings_of

    line = "+collect.experts={lift: [{}, {noise: 0.5, grasp_steps: 12}], default: [{noise: 0.1}]}"
    collect = settings_of(line, f"run_dir={tmp_path}").collect
    assert [each.noise for each in collect.experts_of("lift")] == [0.2, 0.5]
    assert [each.noise for each in collect.experts_of("reach")] == [0.1]
    assert experts_of("lift", collect.experts, noise=0.2)[1].gains == ExpertGains(grasp_steps=12)
