"""Tables, figures and the HTML page of a run; needs the ``[reports]`` extra."""

from __future__ import annotations

from torchrl_bmrl.reports.drawing import task_colors
from torchrl_bmrl.reports.embedding import Embeddings, measure_goal_distance, measure_stages
from torchrl_bmrl.reports.embedding_figures import (
    embedding_paths,
    embedding_scatter,
    embedding_stages,
    embedding_trajectories,
    embedding_tsne,
)
from torchrl_bmrl.reports.explorer import Explorer
from torchrl_bmrl.reports.figures import behaviour_trajectories, stage1_curves, success_curves
from torchrl_bmrl.reports.page import Picture, Section, write_page
from torchrl_bmrl.reports.paper import table_1, table_2
from torchrl_bmrl.reports.report import write_report
from torchrl_bmrl.reports.stage1 import read_stage1_curves
from torchrl_bmrl.reports.studies import read_studies, write_study
from torchrl_bmrl.reports.tables import (
    Table,
    goal_distance_table,
    results_table,
    stages_table,
    task_name,
    task_titles,
)

__all__ = [
    "Embeddings",
    "Explorer",
    "Picture",
    "Section",
    "Table",
    "behaviour_trajectories",
    "embedding_paths",
    "embedding_scatter",
    "embedding_stages",
    "embedding_trajectories",
    "embedding_tsne",
    "goal_distance_table",
    "measure_goal_distance",
    "measure_stages",
    "read_stage1_curves",
    "read_studies",
    "results_table",
    "stage1_curves",
    "stages_table",
    "success_curves",
    "table_1",
    "table_2",
    "task_colors",
    "task_name",
    "task_titles",
    "write_page",
    "write_report",
    "write_study",
]
