"""An environment, a demonstration and an encoder to test the sources of the task embedding with."""

from __future__ import annotations

from typing import Any

import torch
from helpers import ACTION_DIM, CELLS, DIMS, OBSERVATION_DIM, TASK_LATENT_DIM, transitions
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from torchrl_bmrl.modules import make_task_encoder

POINT = torch.tensor([0.5, -2.0])


class Walk(EnvBase):
    """Moves by the action; the third coordinate counts the steps; truncates after six."""

    def __init__(self, batch_size: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size=batch_size)
        shape = self.batch_size
        self.observation_spec = Composite(
            observation=Unbounded((*shape, OBSERVATION_DIM)), shape=shape
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*shape, ACTION_DIM))
        self.reward_spec = Unbounded((*shape, 1))
        flag = Bounded(0, 1, shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        return TensorDict(
            {"observation": torch.zeros(*self.batch_size, OBSERVATION_DIM)}, self.batch_size
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        ones = torch.ones(*self.batch_size, 1)
        observation = tensordict["observation"] + torch.cat([tensordict["action"], ones], -1)
        truncated = observation[..., -1:] >= 6
        return TensorDict(
            {
                "observation": observation,
                "reward": observation.sum(-1, keepdim=True),
                "done": truncated,
                "truncated": truncated,
                "terminated": torch.zeros_like(truncated),
            },
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_encoder() -> TensorDictModule:
    torch.manual_seed(0)
    return make_task_encoder(*DIMS, TASK_LATENT_DIM, num_cells=CELLS)


def demonstration() -> TensorDict:
    """Four transitions, step t at (10 t, 0, t)."""
    data = transitions(4, dtype=torch.float32)
    data["observation"] = torch.tensor([[10.0 * t, 0.0, float(t)] for t in range(4)])
    return data


def embedded(encoder: TensorDictModule, data: TensorDictBase) -> Tensor:
    with torch.no_grad():
        return encoder(data.select(*encoder.in_keys))["task_latent"]


def driven(transform: Transform, stages: list[int], batch_size: tuple[int, ...] = ()) -> Tensor:
    """``task_latent`` before each step of an episode that is at ``stages``."""

    def at(stage: int) -> TensorDict:
        data = transitions(1, dtype=torch.float32)[0].exclude("next").expand(*batch_size)
        return data.clone().set("stage", torch.full(batch_size, stage))

    latents = [transform._reset(None, at(stages[0]))["task_latent"]]
    for stage in stages[1:]:
        following = at(stage).set("reward", torch.zeros(*batch_size, 1))
        latents.append(transform._step(at(stage), following)["task_latent"])
    return torch.stack(latents, -2)
