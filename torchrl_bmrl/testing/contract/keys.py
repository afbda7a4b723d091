"""Checks of the keys that a loss reads and writes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.measures import as_keywords, assert_same, refused, run
from torchrl_bmrl.testing.wrappers import Renamed, renamed


def new_names(loss: LossModule) -> dict[str, Any]:
    """A nested name for every key of ``set_keys``, and for those that the networks read."""
    read = {key: ("agent", key) for key in loss.in_keys if isinstance(key, str)}
    accepted = {key: ("my", name) for name, key in asdict(loss.default_keys()).items()}
    # A keyword call nests its inputs with another batch size, which the priority does not have.
    return read | accepted | {loss.tensor_keys.priority: ("buffer", "priority")}


class KeyChecks:
    """Checks of keys, for every loss."""

    def test_renamed_and_nested_keys_give_the_same_losses(self, case: Case) -> None:
        """This fails for a key that is a plain string in the loss's code."""
        loss = case.make()
        names = new_names(loss)

        def edit(name: str, network: TensorDictModuleBase) -> TensorDictModuleBase:
            return Renamed(network, names)

        other = case.make(edit=edit)
        keys = asdict(loss.default_keys())
        other.set_keys(**{name: renamed(key, names) for name, key in keys.items()})
        expected_keys = [renamed(key, names) for key in loss.in_keys]
        assert other.in_keys == expected_keys, "in_keys do not follow set_keys and the networks"
        data = case.batch()
        weight = torch.linspace(0.1, 1.0, data.numel(), dtype=torch.float64)
        data[loss.tensor_keys.priority_weight] = weight.view(data.shape)
        renamed_data = TensorDict({}, data.batch_size)
        for key, value in data.items(True, True):
            renamed_data.set(renamed(key, names), value)
        keywords = as_keywords(renamed_data, other.in_keys)
        assert_same(run(other, renamed_data), run(loss, data), "under other names")
        priorities = data[loss.tensor_keys.priority], renamed_data[other.tensor_keys.priority]
        assert torch.equal(*priorities)
        expected = run(loss, data.exclude(loss.tensor_keys.priority_weight))
        torch.manual_seed(0)
        for key, value in zip(other.out_keys, other(**keywords), strict=True):
            assert torch.equal(value, expected[key]), f"a keyword call gives another {key}"

    def test_a_key_set_to_none_has_its_default_again(self, case: Case) -> None:
        """As in TorchRL's losses; ``in_keys`` follow."""
        loss, fresh = case.make(), case.make()
        for name, default in asdict(loss.default_keys()).items():
            loss.set_keys(**{name: ("my", name)})
            assert getattr(loss.tensor_keys, name) == ("my", name)
            for key in fresh.in_keys:  # a network's key keeps its name
                assert {key, renamed(key, {default: ("my", name)})} & set(loss.in_keys)
            loss.set_keys(**{name: None})
            assert loss.tensor_keys == fresh.tensor_keys
            assert loss.in_keys == fresh.in_keys

    def test_an_unknown_key_is_refused_with_the_accepted_ones(self, case: Case) -> None:
        """``set_keys`` accepts the fields of the loss's ``_AcceptedKeys``."""
        with pytest.raises(ValueError, match=r"goal is not an accepted tensordict key.*priority"):
            case.make().set_keys(goal="g")

    def test_in_keys_are_stable_and_can_be_set(self, case: Case) -> None:
        """``read_keys`` must not depend on the order of a set."""
        loss = case.make()
        assert loss.in_keys == loss.in_keys == case.make().in_keys
        assert len(set(loss.in_keys)) == len(loss.in_keys)
        loss.in_keys = ["observation", "action"]
        assert loss.in_keys == ["observation", "action"]

    def test_only_the_in_keys_are_read_and_all_of_them_are_needed(self, case: Case) -> None:
        """First fails if ``read_keys`` lacks a key, later if it has too many."""
        loss, data = case.make(), case.batch()
        rest = run(loss, data.select(*loss.in_keys))
        assert_same(rest, run(loss, data.clone()), "with the in_keys alone")
        for key in loss.in_keys:
            refused(loss, data.exclude(key), f"no {key!r}")

    def test_tensordict_and_keywords_give_the_out_keys_in_order(self, case: Case) -> None:
        """``written_keys`` has the order of the output of ``forward``."""
        loss, data = case.make(), case.batch()
        expected = run(loss, data)
        assert list(expected.keys()) == loss.out_keys, "forward returns others than out_keys"
        assert loss.out_keys == case.make().out_keys
        torch.manual_seed(0)
        result = loss(**as_keywords(data, loss.in_keys))
        for key, value in zip(loss.out_keys, result, strict=True):
            assert torch.equal(value, expected[key]), f"a keyword call gives another {key}"

    def test_selected_out_keys_are_all_that_is_returned(self, case: Case) -> None:
        """``forward`` needs TorchRL's ``dispatch`` decorator."""
        loss = case.make()
        key = f"loss_{next(iter(case.trains))}"
        loss.select_out_keys(key)
        assert list(loss(case.batch()).keys()) == [key]
        assert isinstance(loss(**as_keywords(case.batch(), loss.in_keys)), Tensor)
