"""Paths of meshes: files name no machine, and a missing mesh is what the message says."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from torchrl_bmrl.envs.assets import find_assets, shorten_paths
from torchrl_bmrl.errors import BMRLError, DataError

OWN = "robosuite/models/assets/robots/sawyer/meshes/base.stl"
MODEL = '<mujoco><asset><mesh name="a" file="{}"/></asset></mujoco>'


@pytest.mark.parametrize(
    "path",
    [
        f"/home/me/venv/lib/{OWN}",
        f"/home/me/robosuite/{OWN}",
        "C:\\me\\" + OWN.replace("/", "\\"),
        OWN,
    ],
)
def test_paths_of_robosuite_lose_the_place_of_the_package(path: str) -> None:
    assert shorten_paths(MODEL.format(path)) == MODEL.format(OWN)
    assert shorten_paths(MODEL.format(path).replace('"', "'")) == MODEL.format(OWN).replace(
        '"', "'"
    )


@pytest.mark.parametrize("path", ["/home/me/robosuite/own.stl", "own.stl", "/home/me/own.stl"])
def test_other_paths_stay(path: str) -> None:
    assert shorten_paths(MODEL.format(path)) == MODEL.format(path)


def test_a_written_demonstration_has_no_path_of_its_machine(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    from torchrl_bmrl.data.episodes import Episode
    from torchrl_bmrl.data.robomimic import open_episodes, write_episodes

    x = {"x": np.zeros((2, 1))}
    episode = Episode(
        observations=x,
        next_observations=x,
        actions=np.zeros((2, 1)),
        rewards=np.zeros(2),
        terminated=np.zeros(2, bool),
        attributes={"model_file": MODEL.format(f"/home/me/{OWN}")},
    )
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert b"/home/me" not in file["data/demo_0"].attrs["model_file"]
    with open_episodes(tmp_path / "a.hdf5") as episodes:
        assert episodes["demo_0"].attributes["model_file"] == MODEL.format(OWN)


@pytest.mark.robosuite
def test_both_forms_are_found_where_robosuite_is_installed_as_robosuite_finds_them() -> None:
    from robosuite.environments.base import MujocoEnv

    spec = find_spec("robosuite")
    assert spec is not None
    assert spec.origin is not None
    assets = Path(spec.origin).parent / "models" / "assets"
    file = next(assets.rglob("*.png"))
    path = f"robosuite/models/assets/{file.relative_to(assets).as_posix()}"
    for place in ("", "/another/machine/"):
        model = MODEL.format(place + path)
        for found in (find_assets(model), MujocoEnv.edit_model_xml(None, model)):
            assert [mesh.get("file") for mesh in ET.fromstring(found).iter("mesh")] == [str(file)]


@pytest.mark.robosuite
@pytest.mark.parametrize(
    ("path", "said"),
    [
        (OWN.replace("base", "no_such_mesh"), "no_such_mesh.*no such file"),
        ("/no/such/mesh.stl", "/no/such/mesh.*not a file of robosuite"),
    ],
)
def test_a_missing_mesh_is_named_and_not_the_renderer(path: str, said: str) -> None:
    from torchrl_bmrl.envs.rendering import render_states

    with pytest.raises(DataError, match=said):
        render_states([(MODEL.format(path), np.zeros((1, 1)))])


@pytest.mark.parametrize(
    ("model", "states", "said"),
    [
        ("no model", np.zeros((1, 1)), "not XML"),
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", np.zeros((1, 1)), "does not compile"),
        ("<mujoco/>", np.zeros((1, 3)), "valid: .*1"),
    ],
)
def test_a_scene_that_cannot_be_drawn_is_named_and_not_the_renderer(
    model: str, states: np.ndarray, said: str
) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.envs.rendering import render_states

    with pytest.raises(BMRLError, match=said) as caught:
        render_states([(model, states)])
    assert "no pictures can be rendered here" not in str(caught.value)


def test_a_film_without_its_mesh_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for extra in ("scipy", "matplotlib", "jinja2", "sklearn", "mujoco", "h5py"):
        pytest.importorskip(extra)
    import test_films

    from torchrl_bmrl.pipeline.films import films_of
    from torchrl_bmrl.reports import films

    def missing(*_: object, **__: object) -> None:
        find_assets(MODEL.format("/no/such/mesh.stl"))

    monkeypatch.setattr(films, "render_states", missing)
    test_films.write_demonstrations(tmp_path)
    made = films_of(test_films.OneTask(tmp_path))
    assert not made.frames
    assert "mesh.stl: not a file of robosuite" in made.note
    assert "no pictures can be rendered here" not in made.note
