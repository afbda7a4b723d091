"""Draws the documentation's pictures into docs/images.

    python docs/make_pictures.py

They are the data flow, the six tasks, and the embedding of the policy in this repository. Needs the
extras robosuite and reports, and EGL or OSMesa. results/publish.py draws the curves of stage 1.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image
from tensordict import TensorDict

from torchrl_bmrl.envs.rendering import render_states
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.reports import embedding_scatter, task_colors, task_name
from torchrl_bmrl.tasks import get_task
from torchrl_bmrl.training.checkpoint import load_checkpoint

DOCS = Path(__file__).parent
POLICY = DOCS.parent / "recipes" / "policies" / "sawyer.safetensors"
SIX_TASKS = ("reach", "lift", "push_right", "push_left", "push_up", "push_down")
SIZE = 256  # pixels of a picture of a task


def data_flow() -> bytes:
    """From demonstrations to one policy."""
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.set_xlim(0, 19)
    axes.set_ylim(0, 8.4)
    axes.set_axis_off()

    def box(x: float, y: float, width: float, text: str, color: str, height: float = 1.5) -> None:
        style = {"boxstyle": "round,pad=0.02,rounding_size=0.18", "linewidth": 1.2}
        axes.add_patch(
            FancyBboxPatch((x, y), width, height, facecolor=color + "22", edgecolor=color, **style)
        )
        axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=8.5)

    def arrow(start: tuple[float, float], end: tuple[float, float], text: str = "") -> None:
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "#555555"})
        if text:
            middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2 + 0.25
            axes.text(*middle, text, ha="center", fontsize=7.5, color="#555555")

    grey, blue, green = "#555555", *task_colors(3)[::2]
    for row, name in enumerate(("reach", "lift", "four pushes")):
        y = 5.4 - 2.4 * row
        box(0.1, y, 3.4, f"demonstrations\n{name}", grey)
        box(5.1, y, 3.9, "BCQ: generator G,\ncritics Q", blue)
        arrow((3.6, y + 0.75), (5.0, y + 0.75), "s, a, r, s'")
        arrow((9.1, y + 0.75), (11.0, 3.75))
    axes.text(9.2, 6.5, "G(s, z), Q(s, a)", fontsize=7.5, color="#555555")
    box(11.1, 2.3, 4.0, "student: Ĝ(s, z, m),\nQ̂(s, a, m)", green, 2.9)
    box(11.1, 6.1, 4.0, "encoder M:\ntransition to m", green)
    box(16.2, 6.1, 2.7, "classifier P:\nwhich task?", green)
    arrow((13.1, 6.0), (13.1, 5.3), "")
    axes.text(13.3, 5.55, "m", fontsize=9)
    arrow((15.2, 6.85), (16.1, 6.85))
    box(16.2, 2.3, 2.7, "policy: the best\nof 100 actions", green, 2.9)
    arrow((15.2, 3.75), (16.1, 3.75))
    axes.text(2.0, 8.0, "any source", ha="center", fontsize=10, weight="bold")
    axes.text(7.05, 8.0, "stage 1: one agent per task", ha="center", fontsize=10, weight="bold")
    axes.text(15.0, 8.0, "stage 2: one policy", ha="center", fontsize=10, weight="bold")
    axes.text(
        13.1, 1.7, "acting: m is a task's point, the last\ntransition's, or a demonstration's",
        ha="center", va="top", fontsize=8, color="#555555",
    )  # fmt: skip
    return png(figure)


def tasks() -> bytes:
    """An expert's episode of each task, half a second after it succeeded."""
    scenes = []
    for task in SIX_TASKS:
        episode = get_task(task).record(3, noise=0.2, **get_task(task).options)
        step = min(int(episode.extras["successes"].argmax()) + 10, len(episode) - 1)
        scenes.append((episode.attributes["model_file"], episode.extras["states"][step : step + 1]))
    pictures = [frames[0] for frames in render_states(scenes, size=SIZE)]
    figure = Figure(figsize=(9, 6.4), layout="constrained")
    for axes, task, picture in zip(figure.subplots(2, 3).flat, SIX_TASKS, pictures, strict=True):
        axes.imshow(picture)
        axes.set_title(task_name(task), fontsize=10)
        axes.set_axis_off()
    return png(figure)


def embedding() -> bytes:
    """One held-out demonstration of each task, as the policy of the repository sees it."""
    student, metadata = load_student(POLICY)
    state, _ = load_checkpoint(POLICY, kind="student")
    points, labels = [], []
    for index, task in enumerate(metadata["tasks"]):
        episode = TensorDict(state["demonstrations"][task]).auto_batch_size_(1)
        points.append(student.embed(episode))
        labels += [index] * len(points[-1])
    titles = list(map(task_name, metadata["tasks"]))
    return embedding_scatter(torch.cat(points).numpy(), np.array(labels), titles)


def png(figure: Figure) -> bytes:
    """With few colours, so that it is small."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, metadata={"Software": None})
    image = Image.open(buffer).convert("RGB").quantize(128)
    image.save(buffer := io.BytesIO(), "png", optimize=True)
    return buffer.getvalue()


def main() -> None:
    """Writes the pictures and says how large they are."""
    for name, draw in {"data_flow": data_flow, "tasks": tasks, "embedding": embedding}.items():
        path = DOCS / "images" / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(draw())
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
