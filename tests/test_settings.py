"""What settings may be: each kind of limit, and the settings of a run and its presets."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("h5py")
pytest.importorskip("gymnasium")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.pipeline import BCQSettings, CollectSettings, EvaluateSettings, Run, Settings
from torchrl_bmrl.run.settings import check_settings, setting


@dataclass
class Inner:
    rate: float = setting(0.5, above=0, at_most=1)


@dataclass
class Outer:
    above: float = setting(1.0, above=0)
    least: int = setting(1, at_least=0)
    both: float = setting(0.5, at_least=0, at_most=1)
    choice: str = setting("a", choices=("a", "b"))
    choices: list[str] = setting(["a"], choices=("a", "b"), unique=True)
    maybe: float | None = setting(None, above=0)
    sizes: list[int] = setting([8, 8], above=0)
    counts: dict[str, int] = setting({"reach": 1}, above=0)
    free: Any = None
    flag: bool = False
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("above", 0, "above is 0; valid: above 0"),
        ("above", -1.5, "above is -1.5; valid: above 0"),
        ("above", float("nan"), "above is nan; valid: above 0"),
        ("above", float("inf"), "above is inf; valid: above 0"),
        ("least", -1, "least is -1; valid: at least 0"),
        ("both", 1.5, "both is 1.5; valid: at least 0 and at most 1"),
        ("both", -0.1, "both is -0.1; valid: at least 0 and at most 1"),
        ("both", float("nan"), "both is nan; valid: at least 0 and at most 1"),
        ("maybe", 0.0, "maybe is 0.0; valid: above 0"),
        ("sizes", [8, 0], "sizes is 0; valid: above 0"),
        ("sizes", (8, -2), "sizes is -2; valid: above 0"),
        ("counts", {"reach": 1, "lift": 0}, "counts.lift is 0; valid: above 0"),
        ("choices", [], "choices is []; valid: at least one value, each once"),
        ("choices", ["a", "a"], "choices is ['a', 'a']; valid: at least one value, each once"),
        ("choices", [["a"], ["a"]], "valid: at least one value, each once"),
        ("inner", Inner(rate=0.0), "inner.rate is 0.0; valid: above 0 and at most 1"),
    ],
)
def test_a_value_beyond_a_limit_is_refused_by_name_value_and_what_is_valid(
    name: str, value: Any, message: str
) -> None:
    settings = Outer()
    setattr(settings, name, value)
    with pytest.raises(ConfigError, match=re.escape(message)):
        check_settings(settings)


@pytest.mark.parametrize(("name", "value"), [("choice", "c"), ("choices", ["a", "c"])])
def test_a_value_that_is_none_of_the_choices_is_refused_with_the_choices(
    name: str, value: Any
) -> None:
    settings = Outer()
    setattr(settings, name, value)
    with pytest.raises(UnknownNameError, match=f"{name} 'c'; .*: a, b") as caught:
        check_settings(settings)
    assert caught.value.valid == ("a", "b")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("above", 1e-9),
        ("least", 0),
        ("both", 0),
        ("both", 1),
        ("maybe", None),
        ("maybe", 3.0),
        ("sizes", []),
        ("counts", {}),
        ("choices", ["b", "a"]),
        ("free", object()),
        ("inner", Inner(rate=1.0)),
    ],
)
def test_values_within_the_limits_and_none_are_taken(name: str, value: Any) -> None:
    settings = Outer()
    setattr(settings, name, value)
    check_settings(settings)


def test_names_in_messages_have_the_section_they_are_in() -> None:
    with pytest.raises(ConfigError, match=r"^study\.inner\.rate is 2\.0"):
        check_settings(Outer(inner=Inner(rate=2.0)), "study.")


def test_lists_and_dicts_of_two_objects_are_not_the_same_ones() -> None:
    Outer().sizes.append(0)
    Outer().counts["lift"] = 0
    check_settings(Outer())


# -- settings of a run -----------------------------------------------------------------------------


def leaves(settings: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Every field: its dotted name, the object that it belongs to, and the field."""
    found: list[tuple[str, Any, Any]] = []
    for each in fields(settings):
        value = getattr(settings, each.name)
        if is_dataclass(value):
            found += leaves(value, f"{prefix}{each.name}.")
        else:
            found.append((f"{prefix}{each.name}", settings, each))
    return found


@pytest.mark.parametrize(
    "name", ["mixing_fraction", "metric_weight", "distance_weight", "contrastive_weight"]
)
def test_terms_that_compare_tasks_are_refused_before_anything_is_trained_for_one(name: str) -> None:
    settings = Settings()
    settings.check_distillation(["lift"])
    setattr(settings.distill, name, 0.5)
    settings.check_distillation(["lift", "reach"])
    with pytest.raises(ConfigError, match=rf"distill.{name} is 0.5, and lift the only task"):
        settings.check_distillation(["lift"])


def test_the_defaults_are_valid() -> None:
    Settings().check()


@pytest.mark.parametrize("name", [name for name, _, each in leaves(Settings()) if each.metadata])
def test_a_limit_of_each_setting_of_a_run_is_checked(name: str) -> None:
    settings = Settings()
    owner, each = {key: (owner, each) for key, owner, each in leaves(settings)}[name]
    bad: Any = float("nan")
    if each.metadata["choices"]:
        bad = "no such choice"
    elif all(each.metadata[key] is None for key in ("above", "at_least", "at_most")):
        bad = []
    value = getattr(owner, each.name)
    if isinstance(value, dict):
        bad = {"default": bad}
    elif isinstance(value, list):
        bad = [bad] if bad != [] else []
    setattr(owner, each.name, bad)
    with pytest.raises(BMRLError, match=re.escape(name)):
        settings.check()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"distill.task_encoder": "one_hot"}, "isometry_weight is 1.0; valid .*one_hot: 0"),
        (
            {
                "distill.task_encoder": "one_hot",
                "distill.isometry_weight": 0.0,
                "evaluate.latent_sources": ["online"],
            },
            "task_encoder is one_hot",
        ),
        ({"only": ["reach"], "bcq.stacked": True}, "only is .*; valid with bcq.stacked: null"),
        ({"bcq.value_bounds": (1.0, 0.0)}, "value_bounds are .*low < high"),
        ({"device": "gpu"}, "device is 'gpu'"),
        (
            {
                "distill.task_encoder": "told",
                "distill.isometry_weight": 0.0,
                "distill.context": "previous",
            },
            "context is previous; valid .*told: set, current or random",
        ),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(changes: dict[str, Any], says: str) -> None:
    settings = Settings()
    for name, value in changes.items():
        *groups, last = name.split(".")
        setattr(getattr(settings, groups[0]) if groups else settings, last, value)
    with pytest.raises(BMRLError, match=says):
        settings.check()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"only": 0}, "only is 0; valid: a list"),
        ({"bcq": BCQSettings(num_cells=4)}, "bcq.num_cells is 4; valid: a list"),
        ({"collect": CollectSettings(after=1)}, "collect.after is 1; valid: a mapping"),
        (
            {"collect": CollectSettings(after={"lift": 1})},
            "collect.after.lift is 1; valid: a list",
        ),
        (
            {"evaluate": EvaluateSettings(latent_sources=3)},
            "evaluate.latent_sources is 3; valid: a list",
        ),
    ],
)
def test_a_number_where_a_list_or_a_mapping_belongs_is_refused_by_name(
    changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        Settings(**changes).check()


def test_the_device_may_be_missing_where_nothing_is_trained() -> None:
    Settings(device="gpu").check(device=False)


def test_presets_and_ablations_fill_valid_settings(recipes: Any, tmp_path: Path) -> None:
    pytest.importorskip("hydra")
    from omegaconf import OmegaConf
    from small_runs import RECIPES, configured, filled, settings_of

    presets, ablations = (
        {path.stem: path for path in sorted((RECIPES / "config" / group).glob("*.yaml"))}
        for group in ("preset", "ablation")
    )
    assert len(presets) >= 5
    assert len(ablations) >= 15
    for preset in presets:
        unchanged = configured(f"preset={preset}", f"run_dir={tmp_path}")
        for ablation, path in ablations.items():
            # As Hydra merges it, which takes a quarter of a second each time.
            settings = filled(OmegaConf.merge(unchanged, OmegaConf.load(path)))
            if ablation == "latent_clip_none" and settings.bcq.generator != "autoencoder":
                with pytest.raises(ConfigError, match=r"bcq.latent_clip is None, and bcq.gen"):
                    settings.check()
                continue
            settings.check()
            assert len(Run(settings).names) == 6 or preset in ("family", "ml1")
        assert settings == settings_of(
            f"preset={preset}", f"ablation={ablation}", f"run_dir={tmp_path}"
        )
