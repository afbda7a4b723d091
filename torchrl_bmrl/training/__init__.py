"""Training: updates that can be compiled or captured as a CUDA graph, and their optimizer."""

from torchrl_bmrl.training.update import (
    Metrics,
    Update,
    accelerate,
    get_rng_state,
    gradient_step,
    keep_freed_memory,
    load_adam,
    make_adam,
    set_rng_state,
)

__all__ = [
    "Metrics",
    "Update",
    "accelerate",
    "get_rng_state",
    "gradient_step",
    "keep_freed_memory",
    "load_adam",
    "make_adam",
    "set_rng_state",
]
