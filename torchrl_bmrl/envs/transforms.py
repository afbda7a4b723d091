"""Transforms from named parts to ``observation``, for environments and stored data alike."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DoubleToFloat,
    ObservationNorm,
    RewardSum,
    Transform,
)

from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.tasks import Task, get_task


class SinCosTransform(Transform):
    """Replaces angles by their sines and cosines, so that 0 and 2π are the same point.

    Args:
        in_key: angles [rad], ``(*B, n)``; removed.
        sin_key: their sines.
        cos_key: their cosines.

    Example:
        >>> from tensordict import TensorDict
        >>> transform = SinCosTransform("q", "sin_q", "cos_q")
        >>> sorted(transform(TensorDict({"q": torch.zeros(4, 7)}, [4])).keys())
        ['cos_q', 'sin_q']
    """

    def __init__(self, in_key: str, sin_key: str, cos_key: str) -> None:
        super().__init__(in_keys=[in_key], out_keys=[sin_key, cos_key])

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        angle = next_tensordict.pop(self.in_keys[0])
        next_tensordict.set(self.out_keys[0], angle.sin())
        return next_tensordict.set(self.out_keys[1], angle.cos())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the angles of a batch."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replaces the angles' entry by two entries."""
        spec = observation_spec[self.in_keys[0]]
        del observation_spec[self.in_keys[0]]
        for key in self.out_keys:
            observation_spec[key] = Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
        return observation_spec


class StageReward(Transform):
    """Rewards each completed stage of a composition with +1, and nothing else.

    Reads ``stage (*B,)`` before and after a step. Writes ``("next", "reward") (*B, 1)`` and
    ``progress (*B, 1)``, the share of completed stages, for the agent's observation.

    Args:
        num_stages: number of the composition's tasks.

    Raises:
        BMRLError: for ``num_stages`` below one.

    Example:
        >>> from tensordict import TensorDict
        >>> transform = StageReward(2)
        >>> now, after = (TensorDict({"stage": torch.tensor(i)}) for i in (0, 1))
        >>> after = transform._step(now, after)
        >>> after["reward"], after["progress"]
        (tensor([1.]), tensor([0.5000]))
    """

    def __init__(self, num_stages: int) -> None:
        if num_stages < 1:
            raise BMRLError(f"num_stages is {num_stages}; valid: at least 1")
        super().__init__(in_keys=["stage"], out_keys=["progress"])
        self.num_stages = num_stages

    def _apply_transform(self, stage: Tensor) -> Tensor:
        return stage.unsqueeze(-1).float() / self.num_stages

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        gained = next_tensordict.get("stage") - tensordict.get("stage")
        return self._call(next_tensordict).set("reward", gained.unsqueeze(-1).float())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Rewards are numbers of stages."""
        reward_spec["reward"] = Bounded(0, self.num_stages, (*reward_spec.shape, 1))
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds ``progress``."""
        observation_spec["progress"] = Bounded(0, 1, (*observation_spec.shape, 1))
        return observation_spec


@dataclass(frozen=True)
class ObservationStatistics:
    """Mean and scale of ``observation (n,)`` over the training demonstrations.

    Attributes:
        loc: mean.
        scale: standard deviation, at least 1e-3; 1 where the observation is constant.
        parts: names of the parts that are concatenated to the observation; ``None`` for a task
            with transforms of its own.

    Example:
        >>> ObservationStatistics(loc=torch.zeros(33), scale=torch.ones(33)).scale.shape
        torch.Size([33])
    """

    loc: Tensor
    scale: Tensor
    parts: tuple[str, ...] | None = None

    @classmethod
    def from_lists(cls, lists: Mapping[str, Any]) -> ObservationStatistics:
        """Statistics from the lists of :meth:`to_lists`.

        Args:
            lists: ``loc`` and ``scale`` with the same length and, optionally, ``parts``.

        Raises:
            BMRLError: for other lists, and for a scale that is not above 0 in float32.

        Example:
            >>> ObservationStatistics.from_lists({"loc": [1.0], "scale": [2.0]}).scale
            tensor([2.])
        """
        try:
            loc, scale = (torch.tensor(lists[name], dtype=torch.float) for name in ("loc", "scale"))
            parts = lists.get("parts")
        except (AttributeError, KeyError, OverflowError, RuntimeError, TypeError, ValueError):
            raise BMRLError(f"{reprlib.repr(lists)}; valid: lists loc and scale") from None
        fits = loc.shape == scale.shape and loc.ndim == 1
        if not (fits and loc.isfinite().all() and scale.isfinite().all() and (scale > 0).all()):
            raise BMRLError("scale: valid: as many positive numbers as in loc, all finite")
        named = isinstance(parts, list | None) and all(isinstance(x, str) for x in parts or ())
        if not named:
            raise BMRLError(f"parts is {reprlib.repr(parts)}; valid: names")
        return cls(loc, scale, None if parts is None else tuple(parts))

    def to_lists(self) -> dict[str, Any]:
        """The statistics as JSON-compatible lists."""
        lists = {"loc": self.loc.tolist(), "scale": self.scale.tolist()}
        return lists if self.parts is None else lists | {"parts": list(self.parts)}

    def close_to(self, other: ObservationStatistics) -> bool:
        """Whether networks that were trained with one read the same from the other.

        Machines compute the last digits of the same statistics differently.

        Args:
            other: statistics, which may be of another size.

        Example:
            >>> one = ObservationStatistics(loc=torch.zeros(2), scale=torch.ones(2))
            >>> one.close_to(ObservationStatistics(loc=torch.ones(2), scale=torch.ones(2)))
            False
        """
        if self.loc.shape != other.loc.shape:
            return False
        apart = torch.cat([(self.loc - other.loc) / self.scale, 1 - other.scale / self.scale])
        return bool((apart.abs() < 1e-3).all())

    @classmethod
    def of(cls, datasets: Sequence[TensorDictBase], tasks: Sequence[Task]) -> ObservationStatistics:
        """Statistics over all tasks together; every task has the same weight.

        Args:
            datasets: one batch ``[N_i]`` per task, with the named parts.
            tasks: the tasks.
        """
        parts = observation_parts(tasks[0], datasets[0])
        observations = [
            make_observation_transform(task, parts=parts)(data.copy()).get("observation").double()
            for task, data in zip(tasks, datasets, strict=True)
        ]
        loc = torch.stack([x.mean(0) for x in observations]).mean(0)
        second = torch.stack([(x - loc).square().mean(0) for x in observations]).mean(0)
        largest = torch.stack([x.abs().amax(0) for x in observations]).amax(0)
        scale = nonzero_scale(second.sqrt(), largest, torch.float32)  # as they were before double()
        return cls(loc.float(), scale.clamp_min(1e-3).float(), parts)


def observation_parts(task: Task, data: TensorDictBase) -> tuple[str, ...] | None:
    """Returns the names of the concatenated parts; ``None`` for a task with its own transforms.

    Args:
        task: the task.
        data: transitions with the parts, now and under ``"next"``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.tasks import DemonstrationFiles, Task
        >>> task = Task(name="door", files=DemonstrationFiles(path="door.hdf5"))
        >>> parts = {"arm": torch.zeros(4, 7)}
        >>> observation_parts(task, TensorDict({**parts, "next": parts}, [4]))
        ('arm',)
    """
    if task.observation is not None:
        return None
    following = data.get("next").keys()
    return task.parts or tuple(key for key in data.keys() if key in following)  # noqa: SIM118


def make_observation_transform(
    task: Task,
    statistics: ObservationStatistics | None = None,
    *,
    parts: Sequence[str] | None = None,
    cast: bool = True,
) -> Compose:
    """Returns the transform from the named parts to ``observation (n,)`` float32.

    Append it to an environment, or call it on stored data.

    Args:
        task: the task.
        statistics: statistics of the normalisation; ``None`` for no normalisation.
        parts: names to concatenate, for a task without its own transforms; by default those of the
            statistics or of the task.
        cast: whether to cast float64 to float32; TorchRL cannot cast a float32 environment.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.tasks import DemonstrationFiles, Task
        >>> task = Task(name="door", files=DemonstrationFiles(path="door.hdf5"))
        >>> transform = make_observation_transform(task, parts=["arm", "door"])
        >>> parts = {"arm": torch.zeros(4, 7), "door": torch.zeros(4, 1)}
        >>> transform(TensorDict(parts, [4]))["observation"].shape
        torch.Size([4, 8])
    """
    names = parts or (statistics and statistics.parts) or task.parts or ("observation",)
    transforms: list[Transform] = (
        [CatTensors(list(names), "observation", dim=-1, sort=False, del_keys=True)]
        if task.observation is None
        else task.observation()
    )
    if cast:
        transforms.append(DoubleToFloat(in_keys=["observation"]))
    if statistics is not None:
        transforms.append(
            ObservationNorm(
                loc=statistics.loc,
                scale=statistics.scale,
                in_keys=["observation"],
                standard_normal=True,
            )
        )
    return Compose(*transforms)


def transform_data(
    data: TensorDictBase, task: Task, statistics: ObservationStatistics
) -> TensorDictBase:
    """Applies :func:`make_observation_transform` to stored transitions, now and next.

    Args:
        data: batch ``[N]`` with the named parts.
        task: the task.
        statistics: statistics of the normalisation.

    Returns:
        batch ``[N]`` with ``observation (N, n)`` instead of the parts, also under ``"next"``, and
        the other keys of ``data``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.tasks import DemonstrationFiles, Task
        >>> task = Task(name="door", files=DemonstrationFiles(path="door.hdf5"))
        >>> parts = {"arm": torch.zeros(4, 7)}
        >>> statistics = ObservationStatistics(torch.zeros(7), torch.ones(7), ("arm",))
        >>> data = transform_data(TensorDict({**parts, "next": parts}, [4]), task, statistics)
        >>> data["next", "observation"].shape
        torch.Size([4, 7])
    """
    transform = make_observation_transform(task, statistics)
    after = transform(data.get("next").copy())
    return transform(data.exclude("next")).set("next", after)


def make_env(
    task: Task | str,
    statistics: ObservationStatistics | None = None,
    *transforms: Transform,
    num_envs: int | None = None,
    **options: Any,
) -> TransformedEnv:
    """Returns a task's TorchRL environment with ``observation (n,)``.

    Args:
        task: a task, or the name of a registered task or a composition.
        statistics: statistics of the normalisation; ``None`` for no normalisation.
        *transforms: appended transforms, such as a source of ``task_latent``.
        num_envs: number of parallel episodes, batch ``[num_envs]``; ``None`` for one without a
            batch dimension.
        **options: options of the environment, which replace those of the task.

    Raises:
        UnknownNameError: for a name that is not registered.
        ConfigError: for a task without an environment.
        BMRLError: for ``num_envs`` below one.

    Example:
        >>> env = make_env("push_up", num_envs=2)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 33])
    """
    task = get_task(task) if isinstance(task, str) else task
    if task.make_env is None:
        raise ConfigError(f"task {task.name} has no environment; valid: a task with make_env")
    if num_envs is not None and num_envs < 1:
        raise BMRLError(f"num_envs is {num_envs}; valid: at least 1")
    env = task.make_env(num_envs=num_envs, **{**task.options, **options})
    parts = None
    if statistics is not None and statistics.parts and len(statistics.parts) == 1:
        # A single part may have another name in the demonstrations.
        parts = (
            statistics.parts if statistics.parts[0] in env.observation_keys else ("observation",)
        )
    cast = any(env.observation_spec[key].dtype == torch.float64 for key in env.observation_keys)
    observation = make_observation_transform(task, statistics, parts=parts, cast=cast)
    if statistics is not None:
        _check_observation(task, env, statistics, observation)
    made = Compose(observation, RewardSum(), *transforms)
    return TransformedEnv(env, made, auto_unwrap=True)


def _check_observation(
    task: Task, env: EnvBase, statistics: ObservationStatistics, transform: Compose
) -> None:
    """Raises an error if an environment's observation differs from that of the demonstrations."""
    spec = env.observation_spec
    try:
        size = transform(spec.zero())["observation"].shape[-1]
    except Exception as error:  # CatTensors raises Exception itself
        found = ", ".join(f"{key} {tuple(spec[key].shape)}" for key in env.observation_keys)
        raise ConfigError(
            f"the environment of task {task.name} has {found}; valid: {len(statistics.loc)} "
            f"numbers, from {statistics.parts or 'the parts of the task'} ({error})"
        ) from error
    if size != len(statistics.loc):
        raise ConfigError(
            f"the environment of task {task.name} has {size} observed numbers; valid: "
            f"{len(statistics.loc)}, as in its demonstrations"
        )
