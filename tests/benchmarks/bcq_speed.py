"""Updates per second of BCQ in this library, plain PyTorch and d3rlpy, and of its matrix products.

    python tests/benchmarks/bcq_speed.py [--rounds 40] [--batch-sizes 100 256] [--members 6]
    python tests/benchmarks/bcq_speed.py --device cuda --members 1 2 4 6 8 16 32 64

An update is one training step without sampling its batch: VAE step, critic step, soft update of the
targets. An update of a stack counts once per member. The variants run in turn in one process. Each
round gives a ratio to plain PyTorch and one to the limit; the table contains medians, so that other
load on the machine has little influence.

The limit is the time of the update's matrix products alone, into allocated memory: forward,
gradients, and next actions with the states' part computed once.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import argparse
import subprocess
import warnings
from collections.abc import Callable
from itertools import cycle, pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import torch
from plain_bcq import PlainBCQ
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_bmrl.modules import ActionVAE, make_perturbation_network, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.training import accelerate, gradient_step, keep_freed_memory, make_adam

OBSERVATION_DIM, ACTION_DIM = 33, 7
WIDTH = 256
BATCH_SIZES = (100, 256)
NETWORKS = ("generator", "qvalue_network", "perturbation_network")  # in update order
LIMIT, PLAIN = "matrix products alone", "plain PyTorch"
TAU, LR = 0.005, 1e-3
WARM_UP = 5
Update = Callable[[TensorDict], tuple[Tensor, ...]]


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


def make_pair(
    seed: int = 0, *, device: str = "cpu", perturbation: bool = False, **options: Any
) -> tuple[PlainBCQ, BCQLoss]:
    """Returns both variants with the same weights, including the targets."""
    torch.manual_seed(seed)
    generator = ActionVAE(OBSERVATION_DIM, ACTION_DIM)
    critics = [make_qvalue_network(OBSERVATION_DIM, ACTION_DIM) for _ in range(2)]
    plain = PlainBCQ(OBSERVATION_DIM, ACTION_DIM, tau=TAU, lr=LR, device=device)
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
    network = make_perturbation_network(OBSERVATION_DIM, ACTION_DIM) if perturbation else None
    return plain, BCQLoss(generator, critics, network, bounds=(-1.0, 1.0), **options).to(device)


def plain_arguments(batch: TensorDict) -> tuple[Tensor, ...]:
    after = batch["next"]
    return (
        batch["observation"],
        batch["action"],
        after["reward"],
        after["observation"],
        after["terminated"],
    )


def make_plain_update(device: str = "cpu", compiled: bool = False) -> Update:
    plain = make_pair(device=device)[0]
    # As accelerate() compiles: with eager random numbers, which on CPU are faster.
    options = {"fallback_random": device == "cpu"}
    step = torch.compile(plain.update, options=options) if compiled else plain.update
    return lambda batch: step(*plain_arguments(batch))


def make_library_update(loss: LossModule, **options: Any) -> Update:
    """Returns the update of ``recipes/train_bcq.py``; ``options`` are those of ``accelerate``."""
    targets = SoftUpdate(loss, tau=TAU)
    names = [name for name in NETWORKS if getattr(loss, f"{name}_params", None) is not None]
    optimizers = {
        f"{name.removesuffix('_network')}_loss": make_adam(
            getattr(loss, f"{name}_params").parameters(), lr=LR
        )
        for name in names
    }

    def update(batch: TensorDict) -> dict[str, Tensor]:
        values = {}
        for name, optimizer in optimizers.items():
            values[name], _ = getattr(loss, name)(batch)
            gradient_step(optimizer, values[name])
        targets.step()
        return {name: value.detach() for name, value in values.items()}

    fast = accelerate(update, **options)
    return lambda batch: tuple(fast(batch).values())


def make_alone(device: str = "cpu", accelerated: str = "", **options: Any) -> Update:
    loss = make_pair(device=device, **options)[1]
    return make_library_update(loss, device=device, **dict.fromkeys(accelerated.split(), True))


def make_stack(members: int, device: str = "cpu", accelerated: str = "") -> Update:
    """Returns an update of every member, all on the same batch."""
    stack = StackedLoss([make_pair(seed)[1] for seed in range(members)]).to(device)
    options = dict.fromkeys(accelerated.split(), True)
    update = make_library_update(stack, device=device, **options)
    return lambda batch: update(batch.expand(members, *batch.batch_size))


def make_products(rows: int, device: str = "cpu", num_candidates: int = 10) -> Update:
    """Returns the matrix products of one update."""
    state, action, latent = OBSERVATION_DIM, ACTION_DIM, 2 * ACTION_DIM
    shapes = []  # rows of the left matrix, columns of it, columns of the right one

    def forward(sizes: tuple[int, ...], height: int) -> None:
        shapes.extend((height, i, o) for i, o in pairwise(sizes))

    def train(inputs: int, outputs: int, *, into_input: int = 0) -> None:
        sizes = (inputs, WIDTH, WIDTH, outputs)
        forward(sizes, rows)
        shapes.extend((i, rows, o) for i, o in pairwise(sizes))  # gradients of the weights
        backwards = [(rows, o, i) for i, o in pairwise(sizes)][1:]  # and of what they multiply
        shapes.extend([*backwards, *([(rows, WIDTH, into_input)] if into_input else [])])

    train(state + action, 2 * latent)
    train(state + latent, action, into_input=latent)
    for inputs, outputs in ((latent, action), (action, 1), (action, 1)):  # decoder, two critics
        shapes.append((rows, state, WIDTH))
        forward((inputs, WIDTH, WIDTH, outputs), rows * num_candidates)
    for _ in range(2):
        train(state + action, 1)
    matrices = [
        [torch.randn(size, device=device) for size in ((n, i), (i, o), (n, o))]
        for n, i, o in shapes
    ]

    def update(batch: TensorDict) -> tuple[Tensor]:
        for left, right, out in matrices:
            torch.mm(left, right, out=out)
        return (out,)

    return update


class Outside:
    """d3rlpy's updates, timed in another process; see ``d3rlpy_bcq.py``."""

    def __init__(self, python: str, rows: int) -> None:
        script = Path(__file__).with_name("d3rlpy_bcq.py")
        self.process = subprocess.Popen(
            [python, str(script), str(rows), "10"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def seconds(self, updates: int) -> float:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{updates}\n")
        self.process.stdin.flush()
        for line in self.process.stdout:  # what it says of itself comes first
            if line[0].isdigit():
                return float(line)
        raise RuntimeError("d3rlpy_bcq.py ended; run it by itself to see why")


def variants(rows: int, device: str, members: list[int]) -> dict[str, tuple[Update, int]]:
    """Returns updates by name, each with its number of members."""
    made: dict[str, tuple[Update, int]] = {
        LIMIT: (make_products(rows, device), 1),
        PLAIN: (make_plain_update(device), 1),
        "plain PyTorch, compiled": (make_plain_update(device, compiled=True), 1),
        "BCQLoss": (make_alone(device), 1),
        "BCQLoss, compiled": (make_alone(device, "compiled"), 1),
        "BCQLoss with perturbation": (make_alone(device, perturbation=True), 1),
        "BCQLoss with perturbation, compiled": (
            make_alone(device, "compiled", perturbation=True),
            1,
        ),
    }
    captured = ("captured", "compiled captured") if device == "cuda" else ("compiled",)
    for count in members:
        for accelerated in ("", *captured):
            name = ", ".join([f"StackedLoss of {count}", *accelerated.split()])
            made[name] = (make_stack(count, device, accelerated), count)
    return made


def warmed_up(update: Update, batches: list[TensorDict]) -> Update:
    """Returns the update after its compilation and the optimizers' first steps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the compiler says about tensordict's internals
        for _, batch in zip(range(max(WARM_UP, len(batches))), cycle(batches), strict=False):
            update(batch)
    return update


def measure(
    rows: int, *, rounds: int, updates: int, device: str, members: list[int], d3rlpy: str | None
) -> dict[str, tuple[float, float, float]]:
    """Returns medians over the rounds: updates per second, ratio to plain, share of the limit."""
    batches = [make_batch(rows, seed).to(device) for seed in range(4)]
    torch.compiler.reset()
    made = variants(rows, device, members)
    for update, _ in made.values():
        warmed_up(update, batches)
    outside = None if d3rlpy is None else Outside(d3rlpy, rows)
    speeds: list[dict[str, float]] = []
    for number in range(rounds + 1):
        speed = {}
        for name in list(made) if number % 2 == 0 else reversed(made):
            update, count = made[name]
            source = cycle(batches)
            wait(device)
            start = perf_counter()
            for _ in range(updates):
                update(next(source))
            wait(device)
            speed[name] = updates * count / (perf_counter() - start)
        if outside is not None:
            speed["d3rlpy's BCQ, with perturbation"] = updates / outside.seconds(updates)
        speeds.append(speed)
    names = list(speeds.pop(0))  # the first round warms up what is outside
    return {
        name: (
            median(speed[name] for speed in speeds),
            median(speed[name] / speed[PLAIN] for speed in speeds),
            median(speed[name] / speed[LIMIT] for speed in speeds),
        )
        for name in names
    }


def wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def product_speed(device: str) -> float:
    """Returns the best GFLOP/s of a layer over 1000 candidates."""
    left = torch.randn(1000, WIDTH, device=device)
    right = torch.randn(WIDTH, WIDTH, device=device)
    seconds = []
    for _ in range(20):
        wait(device)
        start = perf_counter()
        for _ in range(10):
            nn.functional.linear(left, right)
        wait(device)
        seconds.append((perf_counter() - start) / 10)
    return 2 * 1000 * WIDTH**2 / min(seconds) / 1e9


def read_options(
    summary: str | None,
    arguments: list[str] | None,
    options: dict[str, dict[str, Any]] | None = None,
) -> argparse.Namespace:
    """Parses the options of a script and those that all scripts have."""
    parser = argparse.ArgumentParser(description=(summary or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    for name, option in (options or {}).items():
        parser.add_argument(name, **option)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    options: dict[str, dict[str, Any]] = {
        "--updates": {"type": int, "default": 5, "help": "updates per variant and round"},
        "--batch-sizes": {"type": int, "nargs": "+", "default": list(BATCH_SIZES)},
        "--members": {"type": int, "nargs": "*", "default": [6], "help": "sizes of stacks"},
        "--d3rlpy": {"metavar": "PYTHON", "help": "an interpreter that has d3rlpy"},
    }
    args = read_options(__doc__, arguments, options)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    speed = product_speed(args.device)
    where = torch.cuda.get_device_name() if args.device == "cuda" else "one CPU core"
    print(f"{where}; a layer over 1000 candidates: {speed:.0f} GFLOP/s", end="\n\n")
    print("| Batch | Variant | Updates/s | Ratio to plain | Share of the limit |")
    print("|---:|---|---:|---:|---:|", flush=True)
    for rows in args.batch_sizes:
        table = measure(
            rows,
            rounds=args.rounds,
            updates=args.updates,
            device=args.device,
            members=args.members,
            d3rlpy=args.d3rlpy,
        )
        for name, (speed, ratio, share) in table.items():
            print(f"| {rows} | {name} | {speed:.1f} | {ratio:.2f} | {share:.2f} |", flush=True)


if __name__ == "__main__":
    main()
