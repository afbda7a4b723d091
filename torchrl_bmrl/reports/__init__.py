"""Tables, figures and the HTML page of a run; needs the ``[reports]`` extra."""

from __future__ import annotations

from torchrl_bmrl.reports.embedding import Embeddings, measure_goal_distance, measure_stages
from torchrl_bmrl.reports.explorer import Explorer
from torchrl_bmrl.reports.figures import (
    TASK_COLORS,
    embedding_scatter,
    embedding_stages,
    embedding_tsne,
    reach_trajectories,
    stage1_curves,
    success_curves,
)
from torchrl_bmrl.reports.page import Picture, Section, write_page
from torchrl_bmrl.reports.report import read_stage1_curves, write_report
from torchrl_bmrl.reports.results_page import check_results_page, write_results_page
from torchrl_bmrl.reports.studies import read_studies, write_study
from torchrl_bmrl.reports.tables import (
    Table,
    goal_distance_table,
    results_table,
    stages_table,
    table_1,
    table_2,
    task_name,
)

__all__ = [
    "TASK_COLORS",
    "Embeddings",
    "Explorer",
    "Picture",
    "Section",
    "Table",
    "check_results_page",
    "embedding_scatter",
    "embedding_stages",
    "embedding_tsne",
    "goal_distance_table",
    "measure_goal_distance",
    "measure_stages",
    "reach_trajectories",
    "read_stage1_curves",
    "read_studies",
    "results_table",
    "stage1_curves",
    "stages_table",
    "success_curves",
    "table_1",
    "table_2",
    "task_name",
    "write_page",
    "write_report",
    "write_results_page",
    "write_study",
]
