"""Gymnasium's environments as a task's: actions, episodes that end one by one, success."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

import gymnasium
import numpy as np
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_bmrl.envs.gym import action_bounds, make_gym_env, max_episode_steps
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.tasks import DemonstrationFiles, Task

LOW, HIGH = np.array([-2.0, 0.0]), np.array([6.0, 0.5])


class Counter(gymnasium.Env):
    """Episodes of as many steps as the seed says; the reward is the number of the step."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, succeeds_at: int = 2, actions: str = "box") -> None:
        spaces = {
            "box": gymnasium.spaces.Box(LOW, HIGH, dtype=np.float64),
            "unbounded": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64),
            "discrete": gymnasium.spaces.Discrete(4),
        }
        self.action_space = spaces[actions]
        self.succeeds_at = succeeds_at

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.length, self.steps = seed or 1, 0
        return np.zeros(3), {"solved": False}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        info = {"solved": self.steps == self.succeeds_at}
        observation = np.array([*np.asarray(action, float).reshape(-1)[:2], self.steps])
        return observation, float(self.steps), self.steps >= self.length, False, info


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("Counter-v0", entry_point=Counter)
    gymnasium.register("Short-v0", entry_point=Counter, max_episode_steps=5)
    yield
    for name in ("Counter-v0", "Short-v0"):
        del gymnasium.registry[name]


def still(action: float) -> TensorDictModule:
    """Acts always alike."""
    return TensorDictModule(
        lambda x: torch.full((*x.shape[:-1], 2), action, dtype=x.dtype),
        in_keys=["observation"],
        out_keys=["action"],
    )


@pytest.mark.parametrize("num_envs", [None, 1, 3])
@pytest.mark.parametrize(("action", "share"), [(-1.0, 0.0), (0.0, 0.5), (1.0, 1.0)])
def test_actions_between_minus_one_and_one_span_the_environments_bounds(
    num_envs: int | None, action: float, share: float
) -> None:
    env = make_gym_env(env="Counter-v0", num_envs=num_envs)
    batch = [] if num_envs is None else [num_envs]
    assert env.batch_size == torch.Size(batch)
    space = env.action_spec.space
    assert space.low.unique().tolist() == [-1.0]
    assert space.high.unique().tolist() == [1.0]
    start = env.reset().set("action", torch.full((*batch, 2), action, dtype=torch.float64))
    seen = env.step(start)["next", "observation"][..., :2]
    expected = torch.as_tensor(LOW + share * (HIGH - LOW)).float().expand(*batch, 2)
    torch.testing.assert_close(seen, expected)
    env.close()


def test_the_bounds_are_those_of_the_environment() -> None:
    low, high = action_bounds("Counter-v0")
    assert (low, high) == (tuple(LOW), tuple(HIGH))


@pytest.mark.parametrize(
    ("env", "options", "steps"),
    [
        ("Counter-v0", None, None),
        ("Short-v0", None, 5),
        ("Short-v0", {"max_episode_steps": 3}, 3),
    ],
)
def test_an_episode_has_the_length_that_gymnasium_gives_it(
    env: str, options: dict[str, Any] | None, steps: int | None
) -> None:
    assert max_episode_steps(env, options) == steps
    if steps is not None:
        made = make_gym_env(env=env, env_options=options)
        data = made.rollout(20, still(0.0), tensordict=made.reset(seed=20), auto_reset=False)
        assert len(data) == steps
        assert data["next", "truncated"][-1]


@pytest.mark.parametrize("num_envs", [1, 3])
def test_returns_and_success_count_up_to_an_episodes_end_only(num_envs: int) -> None:
    """The seeds are the lengths: 1 step, 4 steps, more than the horizon."""
    task = Task(
        name="counter",
        files=DemonstrationFiles(path="nothing.hdf5"),
        make_env=make_gym_env,
        options={"env": "Counter-v0", "success": "solved"},
        success="success",
    )
    lengths = [1, 4, 50]
    env = make_env(task, num_envs=num_envs)
    reported: list[int] = []
    outcomes = evaluate_policy(env, still(0.0), lengths, max_steps=6, report=reported.append)
    assert [outcome.episode_return for outcome in outcomes] == [1.0, 10.0, 21.0]
    assert [outcome.success for outcome in outcomes] == [False, True, True]
    # Success is that of any step, and no step after the end counts.
    again = evaluate_policy(env, still(0.0), lengths[::-1], max_steps=6)
    assert [outcome.episode_return for outcome in again] == [21.0, 10.0, 1.0]
    env.close()


@pytest.mark.parametrize("kind", [bool, np.bool_, float, np.float32, np.array])
@pytest.mark.parametrize("key", ["solved", "success"])
def test_success_is_the_key_of_info_that_the_task_names(
    key: str, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Counter.step

    def renamed(self: Any, action: Any) -> Any:
        *rest, info = step(self, action)
        return *rest, {key: kind(info["solved"])}

    monkeypatch.setattr(Counter, "step", renamed)
    env = make_gym_env(env="Counter-v0", success=key, num_envs=2)
    data = env.rollout(3, still(0.0), tensordict=reset(env, 9), auto_reset=False)
    assert data["next", "success"].reshape(2, 3).tolist() == [[False, True, False]] * 2
    assert key == "success" or key not in data["next"]


def test_a_step_without_the_key_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    step = Counter.step

    def sparse(self: Any, action: Any) -> Any:
        *rest, info = step(self, action)
        return *rest, info if info["solved"] else {}

    monkeypatch.setattr(Counter, "step", sparse)
    env = make_gym_env(env="Counter-v0", success="solved")
    data = env.rollout(3, still(0.0), tensordict=env.reset(seed=9), auto_reset=False)
    assert data["next", "success"].flatten().tolist() == [False, True, False]


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_key_of_success_that_info_never_has_is_logged_at_an_episodes_end(
    num_envs: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    env = make_gym_env(env="Short-v0", success="solvd", num_envs=num_envs)
    start = env.reset(seed=9) if num_envs is None else reset(env, 9)
    started = env.rollout(4, still(0.0), tensordict=start.clone(), auto_reset=False)
    assert not started["next", "success"].any()
    assert not caplog.messages  # the key may come at the last step alone
    start = env.reset(seed=9) if num_envs is None else reset(env, 9)
    env.rollout(5, still(0.0), tensordict=start, auto_reset=False)
    env.rollout(5, still(0.0), tensordict=start, auto_reset=False)
    assert len(caplog.messages) == (num_envs or 1)  # once for each environment
    assert caplog.messages[0].startswith("success is 'solvd', which info did not contain")
    assert caplog.messages[0].endswith("keys of info: solved")


def test_failed_episodes_may_lack_the_key_once_it_was_seen() -> None:
    env = make_gym_env(env="Short-v0", success="solved")
    (reader,) = env.base_env.info_dict_reader
    last = TensorDict({"done": torch.tensor(True)})
    assert reader({"solved": True}, last)["success"]
    assert not reader({}, last)["success"]


def reset(env: Any, seed: int) -> TensorDict:
    return env.reset(list_of_kwargs=[{"seed": seed}] * env.numel())


def test_without_a_key_there_is_no_success() -> None:
    env = make_gym_env(env="Counter-v0", num_envs=2)
    data = env.rollout(3, still(0.0), tensordict=reset(env, 9), auto_reset=False)
    assert "success" not in data["next"]
    (outcome, _) = evaluate_policy(env, still(0.0), [2, 2], max_steps=3)
    assert outcome.success is None


@pytest.mark.parametrize("num_envs", [None, 2])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"env": "NoSuch-v0"}, "env is NoSuch-v0: gymnasium cannot make it"),
        ({"env": "no_such_module:NoSuch-v0"}, "no_such_module:NoSuch-v0: gymnasium cannot make it"),
        ({"env": "Counter-v0", "env_options": {"colour": 1}}, "Counter-v0: gymnasium cannot make"),
        ({"env": "Counter-v0", "env_options": {"actions": "unbounded"}}, "numbers between bounds"),
        ({"env": "Counter-v0", "env_options": {"actions": "discrete"}}, "numbers between bounds"),
    ],
)
def test_what_is_no_environment_with_bounded_actions_is_refused(
    options: dict[str, Any], says: str, num_envs: int | None
) -> None:
    with pytest.raises(ConfigError, match=says):
        make_gym_env(num_envs=num_envs, **options)


def test_an_id_may_name_the_module_that_registers_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_envs.py").write_text(
        "import gymnasium\nfrom test_gym_env import Counter\n"
        'gymnasium.register("Mine-v0", entry_point=Counter, max_episode_steps=7)\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    assert max_episode_steps("my_envs:Mine-v0") == 7
    assert action_bounds("my_envs:Mine-v0")[0] == tuple(LOW)
    gymnasium.registry.pop("Mine-v0")
    sys.modules.pop("my_envs")
