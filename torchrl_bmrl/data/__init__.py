"""Demonstrations: files, checks, replay buffers."""

from torchrl_bmrl.data.replay import (
    make_multi_task_replay_buffer,
    make_replay_buffer,
    stack_episodes,
    with_previous,
)

__all__ = [
    "make_multi_task_replay_buffer",
    "make_replay_buffer",
    "stack_episodes",
    "with_previous",
]
