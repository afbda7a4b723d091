"""Times BCQPolicy's choice among 100 candidates, compared with plain PyTorch.

    python tests/benchmarks/acting_speed.py [--rounds 40] [--device cuda]

One state is one episode, several states are parallel episodes. The variants run in turn.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

from collections.abc import Callable
from statistics import median
from time import perf_counter

import torch
from bcq_speed import OBSERVATION_DIM, make_pair, read_options, wait
from plain_bcq import PlainBCQ
from tensordict import TensorDict
from torch import Tensor

from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.training import keep_freed_memory

STATES = (1, 6, 20, 100)
CANDIDATES = 100


@torch.no_grad()
def plain_action(plain: PlainBCQ, observation: Tensor) -> Tensor:
    """The published method, which repeats every state for each of its candidates."""
    repeated = observation.repeat_interleave(CANDIDATES, 0)
    shape = (repeated.shape[0], plain.vae.latent_dim)
    latent = torch.randn(shape, device=observation.device).clamp(-0.5, 0.5)
    proposals = plain.vae.decode(repeated, latent)
    best = plain.critic_1(repeated, proposals).view(-1, CANDIDATES).argmax(1)
    rows = torch.arange(len(observation), device=observation.device)
    return proposals.view(-1, CANDIDATES, proposals.shape[-1])[rows, best]


def acting(states: int, device: str = "cpu") -> dict[str, Callable[[], Tensor]]:
    """Returns the variants with the same networks and states."""
    plain, loss = make_pair(device=device)
    policy = BCQPolicy.frozen(loss, num_candidates=CANDIDATES)
    observation = torch.randn(states, OBSERVATION_DIM, device=device)
    return {
        "plain PyTorch": lambda: plain_action(plain, observation),
        "BCQPolicy": lambda: policy(TensorDict({"observation": observation}, [states]))["action"],
    }


def measure(states: int, *, rounds: int, device: str) -> dict[str, float]:
    """Returns the median milliseconds of a call."""
    ways = acting(states, device)
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds + 3):
        for name, act in ways.items():
            wait(device)
            start = perf_counter()
            for _ in range(5):
                act()
            wait(device)
            if number >= 3:
                seconds[name].append((perf_counter() - start) / 5)
    return {name: 1000 * median(values) for name, values in seconds.items()}


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    args = read_options(__doc__, arguments)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    print("| States | Way | ms a call | ms a state |\n|---:|---|---:|---:|")
    for states in STATES:
        for name, value in measure(states, rounds=args.rounds, device=args.device).items():
            print(f"| {states} | {name} | {value:.2f} | {value / states:.2f} |", flush=True)


if __name__ == "__main__":
    main()
