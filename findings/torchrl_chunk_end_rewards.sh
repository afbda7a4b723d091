#!/usr/bin/env bash
# torchrl 0.14.1: MultiAction and an episode that ends inside a chunk of actions.
#
# Guess: a chunk of four actions whose second one ends the episode with a reward of 1 returns that
#        reward, alone or in a vectorised environment. Transforms between environment and
#        MultiAction count the steps that were done.
# Seen:  stack_rewards=False, which returns the last reward, returns 0: the skipped rest of the chunk
#        counts as the last step. An episode with its only reward at its end has none, unless its
#        length is a multiple of the chunk's. On a SerialEnv whose other environment goes on,
#        stack_rewards=True repeats the reward for each skipped step, [0, 1, 1, 1], where a single
#        environment gives [0, 1, 0]. RewardSum and StepCounter below MultiAction count the skipped
#        steps, too: 3 and 8 instead of 1 and 6. No warning.
#
# Here: modules.ChunkPolicy plays chunks step by step in the plain environment.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import (
    Compose, EnvBase, MultiAction, RewardSum, SerialEnv, StepCounter, TransformedEnv,
)


class Episode(EnvBase):
    """Terminates after a number of steps, with a reward of 1."""

    def __init__(self, steps=6):
        super().__init__()
        self.steps = steps
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            {key: Binary(1, (1,), dtype=torch.bool) for key in ("done", "terminated")}
        )

    def _reset(self, tensordict):
        return TensorDict({"observation": torch.zeros(1)})

    def _step(self, tensordict):
        step = tensordict["observation"] + 1
        end = step >= self.steps
        after = {"observation": step, "reward": end.float(), "done": end}
        return TensorDict({**after, "terminated": end.clone()})

    def _set_seed(self, seed):
        pass


def second_chunk(env, **options):
    """What the chunk returns in which the episode ends."""
    env = TransformedEnv(env, Compose(RewardSum(), StepCounter(), MultiAction(**options)))
    batch = env.batch_size
    data = env.reset()
    for _ in range(2):
        data["action"] = torch.zeros(*batch, 4, 1)
        out, data = env.step_and_maybe_reset(data)
    out = out["next"][0] if batch else out["next"]
    assert out["terminated"].all() and (out["observation"] == 6).all()
    found = [out[key].flatten().tolist() for key in ("reward", "episode_reward", "step_count")]
    print(f"  {type(env.base_env).__name__}, {options}: reward {found[0]},", end=" ")
    print(f"episode_reward {found[1]}, step_count {found[2]}")
    return found


print(f"torchrl {version('torchrl')}, the second chunk of four, where step 6 ends the episode:")
two = [Episode, lambda: Episode(100)]  # the second one goes on
alone_last = second_chunk(Episode(), stack_rewards=False)
alone = second_chunk(Episode(), stack_rewards=True)
batch_last = second_chunk(SerialEnv(2, two), stack_rewards=False)
batch = second_chunk(SerialEnv(2, two), stack_rewards=True)
assert alone == [[0, 1, 0], [1], [6]], "a single environment's stack has changed"
assert alone_last == [[0], [1], [6]], "a single environment's last reward has changed"
assert batch_last == [[0], [1], [8]], "the last reward of a batch has changed"
assert batch == [[0, 1, 1, 1], [3], [8]], "the stack of a batch has changed"
PY
