"""Tables, figures and the HTML page of a run; needs the ``[reports]`` extra."""

from __future__ import annotations

from torchrl_bmrl.reports.figures import (
    TASK_COLORS,
    embedding_scatter,
    embedding_tsne,
    reach_trajectories,
    stage1_curves,
    success_curves,
)
from torchrl_bmrl.reports.page import Picture, Section, write_page
from torchrl_bmrl.reports.report import Embeddings, read_stage1_curves, write_report
from torchrl_bmrl.reports.tables import Table, results_table, table_1, table_2, task_name

__all__ = [
    "TASK_COLORS",
    "Embeddings",
    "Picture",
    "Section",
    "Table",
    "embedding_scatter",
    "embedding_tsne",
    "reach_trajectories",
    "read_stage1_curves",
    "results_table",
    "stage1_curves",
    "success_curves",
    "table_1",
    "table_2",
    "task_name",
    "write_page",
    "write_report",
]
