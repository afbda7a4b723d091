"""Runs d3rlpy's BCQ for bcq_speed.py, with a Python that has d3rlpy.

d3rlpy needs another version of gymnasium than this library, and so a separate environment:

    python -m venv /tmp/d3 && /tmp/d3/bin/pip install torch==2.13.0 d3rlpy==2.8.1
    python tests/benchmarks/bcq_speed.py --d3rlpy /tmp/d3/bin/python

Reads a number of updates per line, runs them and prints the seconds that they took.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import logging
import sys
from itertools import cycle
from time import perf_counter

import d3rlpy
import numpy as np
import structlog
import torch

OBSERVATION_DIM, ACTION_DIM = 33, 7


def main(rows: int, num_candidates: int) -> None:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    torch.set_num_threads(1)
    random = np.random.default_rng(0)
    dataset = d3rlpy.dataset.MDPDataset(
        observations=random.normal(size=(2000, OBSERVATION_DIM)).astype(np.float32),
        actions=np.tanh(random.normal(size=(2000, ACTION_DIM))).astype(np.float32),
        rewards=random.normal(size=2000).astype(np.float32),
        terminals=np.arange(1, 2001) % 200 == 0,
    )
    algorithm = d3rlpy.algos.BCQConfig(
        batch_size=rows, n_action_samples=num_candidates, update_actor_interval=1
    ).create(device="cpu:0")
    algorithm.build_with_dataset(dataset)
    batches = cycle([dataset.sample_transition_batch(rows) for _ in range(4)])
    for line in sys.stdin:
        start = perf_counter()
        for _ in range(int(line)):
            algorithm.update(next(batches))
        print(perf_counter() - start, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
