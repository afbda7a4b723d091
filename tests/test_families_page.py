"""The members of a family on the page: points, colours, marks, and what a click plays."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from families import film, lifted, members

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.families import SPLITS, get_family
from torchrl_bmrl.reports import Section, Table, read_studies, write_study
from torchrl_bmrl.reports.members import explore_members, read_film, write_film

TABLE = Table(title="T", caption="C", header=("a",), rows=[("1",)])


def test_every_member_is_one_point_with_its_parameter_and_its_mark() -> None:
    family, content = get_family("lift_to_height"), lifted().content
    assert [task["facts"][0] for task in content["tasks"]] == [f"{p[0]}" for p in family.all()]
    assert content["facts"] == ["height [cm]", "Member", "Return", "Success"]
    assert [e["task"] for e in content["episodes"]] == list(range(len(family.all())))
    assert all(len(set(zip(e["x"], e["y"], strict=True))) == 1 for e in content["episodes"])
    assert len({group["mark"] for group in content["groups"]}) == len(SPLITS)
    splits = [split for split in SPLITS for _ in family.members[split]]
    for task, split in zip(content["tasks"], splits, strict=True):
        assert content["groups"][task["group"]]["name"] == task["facts"][1]
        assert (task["facts"][1] == "trained") == (split == "train")
        assert ("inside" in task["facts"][1]) == (split == "inside")


def test_held_out_members_do_not_move_the_trained_ones() -> None:
    family = get_family("lift_to_height")
    some = members(family)
    far = [m if m.split == "train" else replace(m, task_latent=9 * m.task_latent) for m in some]
    noise = np.random.default_rng(0).normal(size=8)
    near, moved = (
        [e["x"][0] for e in explore_members(family, each).content["episodes"]]
        for each in (some, [replace(m, task_latent=m.task_latent + noise) for m in far])
    )
    trained = len(family.members["train"])
    assert np.allclose(near[:trained], moved[:trained], atol=1e-3)
    assert not np.allclose(near[trained:], moved[trained:], atol=1e-3)
    assert "first two principal components of the trained members' points" in lifted().caption


def test_every_number_of_the_parameter_can_colour_the_points() -> None:
    family = get_family("reach_hidden")
    content = explore_members(family, members(family)).content
    assert [parameter["name"] for parameter in content["parameters"]] == list(family.parameters)
    for i, parameter in enumerate(content["parameters"]):
        values = [numbers[i] for numbers in family.all()]
        assert list(parameter["values"]) == values
        assert (parameter["low"], parameter["high"]) == (min(values), max(values))
        assert parameter["scale"][0] != parameter["scale"][-1]
    assert "x [cm]: −14 to 16" in content["parameters"][0]["legend"]


def test_a_direction_has_the_same_colour_after_a_full_turn() -> None:
    family = get_family("push_towards")
    some = members(family)
    (direction,) = explore_members(family, [*some, replace(some[0], parameter=(360.0,))]).content[
        "parameters"
    ]
    assert (direction["low"], direction["high"]) == (0, 360)
    assert direction["values"][0] == direction["values"][-1]
    first, last = (
        np.array([int(direction["scale"][i][1 + 2 * k : 3 + 2 * k], 16) for k in range(3)])
        for i in (0, -1)
    )
    assert abs(first - last).max() <= 3
    assert len(set(direction["scale"][1:-1])) == len(direction["scale"]) - 2


@pytest.mark.parametrize("dim", [1, 2, 8])
def test_embeddings_of_any_size_are_drawn(dim: int) -> None:
    family = get_family("lift_to_height")
    explorer = explore_members(family, members(family, dim=dim))
    named = "principal component" if dim == 8 else "m"
    assert explorer.content["axes"][0] == f"{named} 1 (no unit)"
    assert ("8-D; drawn are" in explorer.caption) == (dim == 8)


def test_without_films_the_page_says_why_and_nothing_of_episodes() -> None:
    explorer = lifted(films=False, note="no <library> works.")
    assert "There are no films: no <library> works." in explorer.caption
    assert "Click" not in explorer.caption
    assert "no &lt;library&gt; works." in explorer.html()
    assert explorer.content["facts"] == ["height [cm]", "Member"]
    assert all(e["step"] == [0] and not e["frames"] for e in explorer.content["episodes"])


def test_names_from_data_cannot_leave_the_data() -> None:
    evil = "</script><script>alert(1)</script>"
    family = replace(get_family("lift_to_height"), title=evil)
    html = explore_members(family, [replace(m, title=evil) for m in members(family)]).html()
    assert html.count("<script") == html.count("</script>") == 2


def test_a_stored_explorer_is_read_as_it_was_written(tmp_path: Path) -> None:
    section = Section(heading="A study", tables=[TABLE], explorer=lifted())
    write_study(tmp_path, "families", section, {})
    write_study(tmp_path, "other", Section(heading="B", tables=[TABLE]), {})
    first, second = read_studies(tmp_path)
    assert first.explorer is not None
    assert first.explorer.html() == lifted().html()
    assert second.explorer is None


@pytest.mark.parametrize("text", ["{", "[]", '{"caption": ""}', '{"content": 1, "more": 2}'])
def test_a_damaged_explorer_is_named(tmp_path: Path, text: str) -> None:
    section = Section(heading="A study", tables=[TABLE], explorer=lifted())
    write_study(tmp_path, "families", section, {})
    (tmp_path / "figures" / "families.json").write_text(text)
    with pytest.raises(DataError, match=r"families\.json: not the results of a study"):
        read_studies(tmp_path)


def test_a_film_is_read_as_it_was_written_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "lift.json"
    write_film(path, film(success=None, period=None))
    assert read_film(path) == film(success=None, period=None)
    content = json.loads(path.read_text())
    for damaged in ({}, [], {**content, "frames": {"a": ""}}, {**content, "episode_return": "1"}):
        path.write_text(json.dumps(damaged))
        with pytest.raises(DataError, match=r"lift\.json: not a film"):
            read_film(path)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A small run of two trained members, open, with stage 2."""
    for needed in ("robosuite", "h5py", "filelock", "safetensors"):
        pytest.importorskip(needed)
    from torchrl_bmrl import pipeline
    from torchrl_bmrl.families import Family, register_family
    from torchrl_bmrl.tasks import FAMILIES

    lift = get_family("lift_to_height")
    heights = {"train": [(6,), (20,)], "inside": [(12,)], "outside": [(24,)]}
    register_family(
        Family(name="few_lifts", parameters=lift.parameters, members=heights, make=lift.make)
    )
    settings = pipeline.Settings(
        run_dir=str(tmp_path_factory.mktemp("run")),
        workers=1,
        tasks=["few_lifts"],
        collect=pipeline.CollectSettings(
            train_episodes={"default": 1}, valid_episodes=1, context_episodes=1
        ),
        bcq=pipeline.BCQSettings(epochs=1, updates_per_epoch=6, batch_size=8, num_cells=[16, 16]),
        distill=pipeline.DistillSettings(
            updates=12,
            batch_size=8,
            num_cells=[16, 16],
            task_encoder="set_mean",
            task_latent_dim=8,
            context="given",
            context_fraction=1.0,
            context_size=4,
            classification_weight=None,
            isometry_weight=0.0,
        ),
        evaluate=pipeline.EvaluateSettings(episodes=1, num_candidates=5),
    )
    with pipeline.Run(settings) as opened:
        for step in (pipeline.collect, pipeline.stage1, pipeline.stage2):
            step(opened)
        yield opened
    del FAMILIES["few_lifts"]


def studied(run: Any) -> dict[str, Any]:
    """The explorer's data after the study."""
    from torchrl_bmrl.studies.families import generalise
    from torchrl_bmrl.studies.families_methods import FamilySettings

    generalise(run, FamilySettings(episodes=1, methods=["demonstration"]))
    return json.loads((run.folder / "figures" / "families.json").read_text())["content"]


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_study_films_every_member_once_and_the_page_plays_them(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.errors import RenderError
    from torchrl_bmrl.evaluation.rollout import rollout_episodes
    from torchrl_bmrl.pipeline import evaluate
    from torchrl_bmrl.studies import families, families_films

    if note := families_films.why_no_films():
        from test_films import skip_without_renderer

        skip_without_renderer(RenderError([note]))
    played: list[int] = []

    def counted(*args: Any, **options: Any) -> Any:
        played.append(1)
        return rollout_episodes(*args, **options)

    monkeypatch.setattr(families_films, "rollout_episodes", counted)
    content = studied(run)
    assert len(played) == 4
    assert [task["name"] for task in content["tasks"]] == [
        f"Lift to height {height}" for height in (6, 20, 12, 24)
    ]
    for episode in content["episodes"]:
        assert episode["step"] == list(range(0, 100, 5))
        assert sorted(map(int, episode["frames"])) == episode["step"]
        assert len(set(episode["frames"].values())) > 5  # the arm moves
    assert {task["period"] for task in content["tasks"]} == {0.05}
    # What was played is read back; an episode whose file is missing is played again.
    (run.folder / "families" / "films" / "lift_to_height_24.json").unlink()
    assert studied(run) == content
    assert len(played) == 5

    evaluate(run)
    page = (run.folder / "report.html").read_text(encoding="utf-8")
    assert page.count('<div class="explorer">') == 1
    assert content["episodes"][3]["frames"]["95"] in page
    # Without a renderer no episode is played, and the points are the same.
    for path in (run.folder / "families" / "films").iterdir():
        path.unlink()
    monkeypatch.setattr(families, "why_no_films", lambda: "egl: none.")
    without = studied(run)
    assert len(played) == 5
    assert [e["x"][0] for e in without["episodes"]] == [e["x"][0] for e in content["episodes"]]
    assert without["note"] == "There are no films: egl: none."
