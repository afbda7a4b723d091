#!/usr/bin/env bash
# torchrl 0.14.1: VecNormV2, the running normalisation of observations, where their mean is not zero.
#
# Guess: after some hundred steps normalised observations have a mean of 0 and a deviation of 1, as with
#        VecNorm, which it replaces. The page calls it "an almost drop-in replacement".
# Seen:  with the default decay of 0.9999, observations of mean 10 and deviation 1 come out with a
#        deviation of 0.10 after 1,000 steps and of 0.16 after 10,000: scale says 9.6 and 6.1, not 1. The
#        variance is the running mean of squares less the square of the running mean, and both begin at
#        zero. Their start is corrected for after the subtraction, not before it, so that most of the
#        squared mean stays in the variance until about 1 / (1 - decay) steps have passed several times
#        over. to_observation_norm() and denorm() have the same scale. No warning. With a mean of 0, or
#        with decay=1.0, it is right. (_norm and _get_loc_scale in envs/transforms/vecnorm.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv, VecNorm, VecNormV2


class Sensor(EnvBase):
    """Each observation is a draw of a normal distribution with a deviation of 1."""

    def __init__(self, mean):
        super().__init__()
        self.mean = mean
        self.observation_spec = Composite(observation=Unbounded(1))
        self.action_spec = Unbounded(1)
        self.reward_spec = Unbounded(1)

    def draw(self):
        return TensorDict({"observation": self.mean + torch.randn(1)}, [])

    def _reset(self, tensordict=None):
        return self.draw()

    def _step(self, tensordict):
        rest = {"reward": torch.zeros(1), "done": torch.zeros(1, dtype=torch.bool)}
        return self.draw().update(rest)

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def deviations(mean, transform):
    """The deviation of the last 500 normalised observations, after 1,000 steps and after 10,000."""
    env = TransformedEnv(Sensor(mean), transform)
    env.set_seed(0)
    found = []
    for steps in (1_000, 9_000):
        rows = env.rollout(steps, break_when_any_done=False)
        found.append(rows["normal"][-500:].std().item())
    return found


keys = {"in_keys": ["observation"], "out_keys": ["normal"]}
print(f"torchrl {version('torchrl')}: deviation of normalised observations, 1 before", end=" ")
print("normalisation too, after 1,000 and 10,000 steps")
for mean in (0.0, 3.0, 10.0):
    transform = VecNormV2(**keys)
    assert transform.decay == 0.9999
    new = deviations(mean, transform)
    scale = transform.scale["observation"].item()
    old = deviations(mean, VecNorm(**keys, decay=0.9999, new_api=False))
    whole = deviations(mean, VecNormV2(**keys, decay=1.0))
    print(f"  mean {mean:.0f}: VecNormV2 {new[0]:.2f} and {new[1]:.2f} (scale {scale:.2f}),", end=" ")
    print(f"VecNorm {old[0]:.2f} and {old[1]:.2f},", end=" ")
    print(f"VecNormV2 with decay 1 {whole[0]:.2f} and {whole[1]:.2f}")
    assert all(abs(x - 1) < 0.1 for x in old + whole)
    if mean == 0:
        assert all(abs(x - 1) < 0.1 for x in new)
    else:
        assert new[0] < 1.2 / mean and new[1] < 2 / mean, "the variance of VecNormV2 has changed"
PY
