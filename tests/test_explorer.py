"""The explorer's page contains every transition once, and nothing that a browser would load."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from explorers import EVIL, STEPS, make_explorer, page_of

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.reports import Section, write_page


def content_of(html: str) -> dict[str, Any]:
    """The page's data, which its script reads."""
    match = re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def test_every_transition_is_in_the_data_once() -> None:
    explorer = make_explorer()
    episodes = content_of(explorer.html())["episodes"]
    assert len(episodes) == 12
    rows = [
        (e["task"], e["number"], s, x, y, d, ok)
        for e in episodes
        for s, x, y, d, ok in zip(
            e["step"], e["x"], e["y"], e["distance"], e["success"], strict=True
        )
    ]
    expected = zip(
        explorer.task,
        explorer.episode + 1,
        explorer.step,
        *explorer.task_latent.T,
        explorer.distance.round(5),
        explorer.success,
        strict=True,
    )
    assert rows == [tuple(row) for row in expected]
    assert [len(e["frames"]) for e in episodes] == [3, 0] * 6


def test_the_order_of_transitions_does_not_matter() -> None:
    explorer = make_explorer()
    order = np.random.default_rng(0).permutation(len(explorer.task))
    columns = ("task_latent", "task", "episode", "step", "distance", "success")
    shuffled: dict[str, Any] = {name: getattr(explorer, name)[order] for name in columns}
    shuffled["phase"] = [explorer.phase[i] for i in order]
    assert replace(explorer, **shuffled).html() == explorer.html()


def test_what_is_unknown_is_null_in_the_data() -> None:
    rows = 12 * STEPS
    explorer = make_explorer(
        distance=np.full(rows, np.nan), success=np.full(rows, None), periods={1: 0.02}
    )
    content = content_of(explorer.html())
    assert {d for e in content["episodes"] for d in e["distance"] + e["success"]} == {None}
    assert [task["period"] for task in content["tasks"]] == [None, 0.02, None, None, None, None]


def test_names_from_data_cannot_leave_the_data() -> None:
    explorer = make_explorer(phase=[EVIL] * (12 * STEPS), note=EVIL)
    html = explorer.html()
    assert html.count("<script") == html.count("</script>") == 2
    content = content_of(html)
    assert (content["phases"][0]["name"], content["note"]) == (EVIL, EVIL)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_embeddings_of_other_sizes_are_shown_in_a_plane_and_the_page_says_so(dim: int) -> None:
    latent = np.random.default_rng(0).normal(size=(12 * STEPS, dim))
    explorer = make_explorer(task_latent=latent)
    content, text = content_of(explorer.html()), " ".join(explorer.paragraphs())
    assert all(len(e["x"]) == len(e["y"]) == STEPS for e in content["episodes"])
    axis = "principal component 1 (no unit)" if dim == 3 else "m 1 (no unit)"
    assert content["axes"][0] == axis
    assert ("is 3-D; drawn are its first two principal components" in text) == (dim == 3)
    assert ("1-D, drawn on a line" in text) == (dim == 1)


def test_where_no_picture_can_be_made_the_page_says_why(tmp_path: Path) -> None:
    explorer = make_explorer(frames={}, note="no pictures can be rendered here (egl: none).")
    assert "There are no films: no pictures can be rendered here (egl: none)." in " ".join(
        explorer.paragraphs()
    )
    assert "egl: none" in page_of(explorer, tmp_path).read_text(encoding="utf-8")


def test_what_does_not_fit_is_refused_by_name() -> None:
    rows = 12 * STEPS
    for name, value in (
        ("task_latent", np.zeros(rows)),
        ("task_latent", np.zeros((0, 2))),
        ("task_latent", np.full((rows, 2), np.inf)),
        ("task", np.full(rows, 6)),
        ("episode", np.zeros(rows - 1, dtype=int)),
        ("step", np.zeros(rows, dtype=int)),
        ("distance", np.full(rows, np.inf)),
        ("phase", ["far"]),
        ("success", np.zeros((rows, 1), dtype=bool)),
        ("frames", {(0, 0, STEPS): b""}),
    ):
        with pytest.raises(BMRLError, match=f"^{name} must"):
            make_explorer(**{name: value})


def test_a_page_without_explorer_holds_no_script(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", title="T", facts={}, sections=[Section(heading="H")])
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script" not in text
    assert "explorer" not in text


def test_the_page_names_no_address(tmp_path: Path) -> None:
    text = page_of(make_explorer(), tmp_path).read_text(encoding="utf-8")
    assert not re.search(r"https?:|url\(|@import|<link", text)
    assert "default-src 'none'" in text  # the page forbids the browser to load anything
