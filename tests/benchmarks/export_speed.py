"""Times exported policies' choice among 100 candidates in one state.

    python tests/benchmarks/export_speed.py [--rounds 40] [--inductor]

The variants are the policy itself, a torch.export program, the program compiled by AOTInductor, and
an ONNX file in ONNX Runtime. All include drawing the latents, for the ONNX file with numpy. They
run in turn on one core, ten calls each after a first call, which is reported separately.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import argparse
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
import onnxruntime
import torch
from bcq_speed import OBSERVATION_DIM, make_pair
from tensordict import TensorDict

from torchrl_bmrl.export import export_policy
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.student import Student
from torchrl_bmrl.training import keep_freed_memory

CANDIDATES = 100


def policies() -> dict[str, BCQPolicy]:
    """Returns an agent, one with a perturbation network, and a student of six tasks."""
    torch.manual_seed(0)
    student = Student(num_tasks=6)
    return {
        "agent": BCQPolicy.frozen(make_pair()[1], num_candidates=CANDIDATES),
        "with perturbation": BCQPolicy.frozen(
            make_pair(perturbation=True)[1], num_candidates=CANDIDATES
        ),
        "student": student.policy(num_candidates=CANDIDATES, latent_clip=0.5),
    }


def session_of(path: Path) -> onnxruntime.InferenceSession:
    """Returns a session of an ONNX file on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def acting(policy: BCQPolicy, folder: Path, *, inductor: bool) -> dict[str, Callable[[], Any]]:
    """Returns a function for each variant that computes the action in one state."""
    sizes = {"observation": OBSERVATION_DIM, "task_latent": 2}
    state = {key: torch.randn(1, sizes[key]) for key in policy.in_keys}
    program = torch.export.export(policy, args=(), kwargs=state)
    module = program.module()
    ways = {
        "BCQPolicy": lambda: policy(TensorDict(state, [1]))["action"],
        "torch.export": lambda: module(**state),
    }
    if inductor:
        path = str(folder / "policy.pt2")
        torch._inductor.aoti_compile_and_package(program, package_path=path)
        compiled = torch._inductor.aoti_load_package(path)
        ways["AOTInductor"] = lambda: compiled(**state)
    export_policy(policy, folder / "policy.onnx", TensorDict(state, [1]))
    session = session_of(folder / "policy.onnx")
    fixed = {key: value.numpy() for key, value in state.items()}
    random = np.random.default_rng(0)
    shape = (1, CANDIDATES, policy.latent_dim)

    def draw() -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32).clip(-0.5, 0.5)

    ways["ONNX Runtime"] = lambda: session.run(None, {**fixed, "action_latent": draw()})
    return ways


def measure(ways: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Returns milliseconds of a call and ratio to the first variant, also for the first calls."""
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for number in range(rounds + 3):
        for name, act in ways.items():
            times = [perf_counter()]
            for _ in range(11):
                act()
                times.append(perf_counter())
            if number >= 3:
                # The first call finds the caches as the other ways left them.
                seconds[name].append(((times[-1] - times[1]) / 10, times[1] - times[0]))
    base = next(iter(seconds.values()))
    result: dict[str, list[float]] = {}
    for name, rows in seconds.items():
        result[name] = []
        for own, first in zip(zip(*rows, strict=True), zip(*base, strict=True), strict=True):
            ratios = [one / other for one, other in zip(own, first, strict=True)]
            result[name] += [1000 * median(own), median(ratios)]
    return result


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    text = "AOTInductor, too: needs a C++ compiler and some minutes"
    parser.add_argument("--inductor", action="store_true", help=text)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    print("| Policy | Way | ms | Ratio | First call, ms | Ratio |\n|---|---|---:|---:|---:|---:|")
    for policy_name, policy in policies().items():
        with TemporaryDirectory() as folder:
            ways = acting(policy, Path(folder), inductor=args.inductor)
            for name, values in measure(ways, args.rounds).items():
                cells = [policy_name, name, *(f"{value:.2f}" for value in values)]
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
