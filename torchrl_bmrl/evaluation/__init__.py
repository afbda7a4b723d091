"""Rollouts of policies, their results, and statistics of these."""

from __future__ import annotations

from torchrl_bmrl.evaluation.clusters import clustered_ratio
from torchrl_bmrl.evaluation.paired import paired_difference
from torchrl_bmrl.evaluation.results import (
    POLICIES,
    RESULT_FIELDS,
    ResultRow,
    Summary,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.statistics import (
    Estimate,
    bootstrap_interval,
    probability_of_improvement,
    rank_correlation,
    relative_difference,
)

__all__ = [
    "POLICIES",
    "RESULT_FIELDS",
    "Estimate",
    "ResultRow",
    "Summary",
    "bootstrap_interval",
    "clustered_ratio",
    "paired_difference",
    "probability_of_improvement",
    "rank_correlation",
    "read_results",
    "relative_difference",
    "summarise",
    "write_results",
]
