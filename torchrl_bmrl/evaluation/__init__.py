"""Rolling policies out and summing up what happened."""

from __future__ import annotations

from torchrl_bmrl.evaluation.results import (
    POLICIES,
    RESULT_FIELDS,
    ResultRow,
    Summary,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.statistics import bootstrap_interval

__all__ = [
    "POLICIES",
    "RESULT_FIELDS",
    "ResultRow",
    "Summary",
    "bootstrap_interval",
    "read_results",
    "summarise",
    "write_results",
]
