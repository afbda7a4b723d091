"""Updates per second of BCQLoss beside plain PyTorch.

    python tests/benchmarks/bcq_speed.py [--rounds 40] [--updates 5] [--batch-sizes 100 256]

An update is what one step of training does, without the sampling of its batch: VAE step, critic
step, soft update of the targets. The variants take turns in one process; each round gives one ratio
to plain PyTorch, the table their medians, so that what else the machine does matters little.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import argparse
import warnings
from collections.abc import Callable
from itertools import cycle
from statistics import median
from time import perf_counter
from typing import Any

import torch
import torch._inductor.config
from plain_bcq import PlainBCQ
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss

OBSERVATION_DIM, ACTION_DIM = 33, 7
BATCH_SIZES = (100, 256)
TAU, LR = 0.005, 1e-3
WARM_UP = 5
Update = Callable[[TensorDict], tuple[Tensor, Tensor]]


def make_batch(rows: int, seed: int = 0) -> TensorDict:
    """Random transitions, every eighth one terminated."""
    generator = torch.Generator().manual_seed(seed)

    def randn(size: int) -> Tensor:
        return torch.randn(rows, size, generator=generator)

    terminated = (torch.arange(rows) % 8 == 0).unsqueeze(-1)
    after = {"observation": randn(OBSERVATION_DIM), "reward": randn(1)}
    after |= {"done": terminated, "terminated": terminated.clone()}
    data = {"observation": randn(OBSERVATION_DIM), "action": randn(ACTION_DIM).tanh()}
    return TensorDict(data | {"next": after}, batch_size=[rows])


def copy_weights(source: nn.Module, destination: nn.Module) -> None:
    for given, taken in zip(source.parameters(), destination.parameters(), strict=True):
        taken.data.copy_(given.data)


def make_pair(seed: int = 0) -> tuple[PlainBCQ, BCQLoss]:
    """Both with the same weights, targets included."""
    torch.manual_seed(seed)
    generator = ActionVAE(OBSERVATION_DIM, ACTION_DIM)
    critics = [make_qvalue_network(OBSERVATION_DIM, ACTION_DIM) for _ in range(2)]
    plain = PlainBCQ(OBSERVATION_DIM, ACTION_DIM, tau=TAU, lr=LR)
    copy_weights(generator.encoder, plain.vae.encoder)
    copy_weights(generator.decoder, plain.vae.decoder)
    for critic, trained, target in zip(
        critics,
        (plain.critic_1, plain.critic_2),
        (plain.target_1, plain.target_2),
        strict=True,
    ):
        copy_weights(critic, trained)
        copy_weights(critic, target)
    return plain, BCQLoss(generator, critics, bounds=(-1.0, 1.0))


def plain_arguments(batch: TensorDict) -> tuple[Tensor, ...]:
    after = batch["next"]
    return (
        batch["observation"],
        batch["action"],
        after["reward"],
        after["observation"],
        after["terminated"],
    )


def make_plain_update(plain: PlainBCQ, compiled: str | None = None) -> Update:
    """``compiled``: ``None``, ``"losses"`` or the whole ``"update"``."""
    if compiled == "losses":
        plain.vae_loss = torch.compile(plain.vae_loss, fullgraph=True)
        plain.critic_loss = torch.compile(plain.critic_loss, fullgraph=True)
    step = torch.compile(plain.update) if compiled == "update" else plain.update

    def update(batch: TensorDict) -> tuple[Tensor, Tensor]:
        return step(*plain_arguments(batch))

    return update


def make_library_update(loss: BCQLoss, compiled: str | None = None) -> Update:
    """One update as ``recipes/train_bcq.py`` does it; ``compiled`` as above."""
    targets = SoftUpdate(loss, tau=TAU)
    generator_loss, qvalue_loss = loss.generator_loss, loss.qvalue_loss
    if compiled == "losses":
        generator_loss = torch.compile(generator_loss, fullgraph=True)
        qvalue_loss = torch.compile(qvalue_loss, fullgraph=True)
    generator_optimizer = torch.optim.Adam(loss.generator_params.parameters(), lr=LR)
    qvalue_optimizer = torch.optim.Adam(loss.qvalue_network_params.parameters(), lr=LR)
    parts = ((generator_loss, generator_optimizer), (qvalue_loss, qvalue_optimizer))

    def update(batch: TensorDict) -> tuple[Tensor, Tensor]:
        values = []
        for part, optimizer in parts:
            value, _ = part(batch)
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            optimizer.step()
            values.append(value.detach())
        targets.step()
        return values[0], values[1]

    return torch.compile(update) if compiled == "update" else update


VARIANTS: dict[str, Callable[[], Update]] = {
    "plain": lambda: make_plain_update(make_pair()[0]),
    "BCQLoss": lambda: make_library_update(make_pair()[1]),
    "BCQLoss, losses compiled": lambda: make_library_update(make_pair()[1], "losses"),
    "BCQLoss, update compiled": lambda: make_library_update(make_pair()[1], "update"),
    "plain, losses compiled": lambda: make_plain_update(make_pair()[0], "losses"),
    "plain, update compiled": lambda: make_plain_update(make_pair()[0], "update"),
}


def warmed_up(update: Update, batches: list[TensorDict]) -> Update:
    """The update after its compilation and the optimizers' first steps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the compiler says about tensordict's internals
        for _, batch in zip(range(max(WARM_UP, len(batches))), cycle(batches), strict=False):
            update(batch)
    return update


def measure(rows: int, *, rounds: int, updates: int) -> dict[str, tuple[float, float]]:
    """Medians over the rounds: updates per second, and the ratio to plain of the same round."""
    batches = [make_batch(rows, seed) for seed in range(4)]
    torch.compiler.reset()
    variants = {name: warmed_up(make(), batches) for name, make in VARIANTS.items()}
    speeds: list[dict[str, float]] = []
    for number in range(rounds):
        order = list(variants) if number % 2 == 0 else list(reversed(variants))
        speed = {}
        for name in order:
            update, source = variants[name], cycle(batches)
            start = perf_counter()
            for _ in range(updates):
                update(next(source))
            speed[name] = updates / (perf_counter() - start)
        speeds.append(speed)
    return {
        name: (
            median(speed[name] for speed in speeds),
            median(speed[name] / speed["plain"] for speed in speeds),
        )
        for name in variants
    }


def main(arguments: list[str] | None = None) -> None:
    summary = "Updates per second of BCQLoss beside plain PyTorch, one thread."
    parser = argparse.ArgumentParser(description=summary)
    options: dict[str, dict[str, Any]] = {
        "--rounds": {"type": int, "default": 40},
        "--updates": {"type": int, "default": 5, "help": "updates per variant and round"},
        "--batch-sizes": {"type": int, "nargs": "+", "default": list(BATCH_SIZES)},
    }
    for name, option in options.items():
        parser.add_argument(name, **option)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    # The compiler's own random numbers are slow on CPU; with eager's a compiled loss also draws
    # what the eager one draws.
    torch._inductor.config.fallback_random = True

    results = {
        rows: measure(rows, rounds=args.rounds, updates=args.updates) for rows in args.batch_sizes
    }
    print("| Batch | Variant | Updates/s | Ratio to plain |")
    print("|---:|---|---:|---:|")
    for rows, table in results.items():
        for name, (speed, ratio) in table.items():
            print(f"| {rows} | {name} | {speed:.1f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
