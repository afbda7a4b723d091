"""Demonstrations: episodes, files, n-step and next-action data, chunks, replay buffers."""

from torchrl.data.datasets import register_dataset

from torchrl_bmrl.data.chunks import ActionChunks
from torchrl_bmrl.data.episodes import Episode, stack_episodes
from torchrl_bmrl.data.n_step import NStep
from torchrl_bmrl.data.replay import (
    make_mixed_replay_buffer,
    make_multi_task_replay_buffer,
    make_replay_buffer,
    with_previous,
)
from torchrl_bmrl.data.transitions import best_episodes, with_next_action

# By name: the class is imported when it is asked for, since it needs h5py.
register_dataset("robomimic", "torchrl_bmrl.data.datasets:RobomimicExperienceReplay", replace=True)

__all__ = [
    "ActionChunks",
    "Episode",
    "NStep",
    "best_episodes",
    "make_mixed_replay_buffer",
    "make_multi_task_replay_buffer",
    "make_replay_buffer",
    "stack_episodes",
    "with_next_action",
    "with_previous",
]
