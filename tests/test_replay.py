"""Buffers sample the data by their weights and seed, from the device that they lie on."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
from replay_buffers import (
    SIZES,
    Make,
    draw,
    every_buffer,
    mixed,
    multi_task,
    numbered,
    single,
    tasks,
    weighted,
)
from tensordict import TensorDict

from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer, replay

# -- what is sampled -------------------------------------------------------------------------------


def test_a_buffer_samples_all_of_its_rows_whole() -> None:
    buffer = make_replay_buffer(numbered(10, 20), batch_size=64)
    assert len(buffer) == 20
    torch.manual_seed(0)
    drawn = torch.cat([buffer.sample() for _ in range(5)])
    assert drawn.batch_size == (320,)
    assert sorted(drawn["number"].unique().tolist()) == list(range(10, 30))
    assert torch.equal(drawn["next", "double"], 2.0 * drawn["number"])
    assert drawn["number"].bincount()[10:].max() < 3 * 320 / 20  # about evenly


def test_a_multi_task_sample_has_a_row_per_task_from_its_own_data() -> None:
    buffer = make_multi_task_replay_buffer(tasks(), batch_size=16)
    torch.manual_seed(0)
    samples = torch.cat([buffer.sample() for _ in range(20)], -1)
    assert samples.batch_size == (3, 320)
    for i, rows in enumerate(SIZES):
        assert samples["task"][i].unique().item() == i
        numbers = samples["number"][i]
        assert sorted(numbers.unique().tolist()) == list(range(1000 * i, 1000 * i + rows))
        assert numbers.bincount()[1000 * i :].max() < 3 * 320 / rows  # about evenly
    assert torch.equal(samples["next", "double"], 2.0 * samples["number"])


def test_with_weights_each_row_is_of_one_task_drawn_by_them() -> None:
    torch.manual_seed(0)
    samples = [weighted(weights=[1, 2, 1]).sample()["task"] for _ in range(50)]
    rows = torch.cat(samples)
    assert torch.equal(rows, rows[:, :1].expand_as(rows))
    shares = rows[:, 0].bincount() / len(rows)
    torch.testing.assert_close(shares, torch.tensor([0.25, 0.5, 0.25]), atol=0.1, rtol=0)
    assert any(len(sample[:, 0].unique()) < 3 for sample in samples)  # with replacement


def test_a_mixture_has_its_weights_however_large_the_data_sets_are() -> None:
    torch.manual_seed(0)
    buffer = mixed(weights=[1, 0, 3])
    samples = torch.cat([buffer.sample() for _ in range(100)])
    assert samples.batch_size == (800,)
    shares = samples["task"].bincount(minlength=3) / 800
    torch.testing.assert_close(shares, torch.tensor([0.25, 0.0, 0.75]), atol=0.05, rtol=0)
    for i in (0, 2):  # about evenly within a data set
        counts = samples["number"][samples["task"] == i].bincount()[1000 * i :]
        assert counts.min() > 0
        assert counts.max() < 3 * counts.float().mean()


@every_buffer
def test_a_sample_has_the_keys_of_the_data_and_says_where_it_lay(make: Make) -> None:
    buffer = make()
    sample = buffer.sample()
    assert set(sample.keys(True, True)) == {"number", "task", ("next", "double"), "index"}
    assert sample["index"].shape == sample["number"].shape == sample.batch_size
    assert torch.equal(buffer[:]["number"][sample["index"]], sample["number"])


@every_buffer
@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
def test_the_batch_size_can_be_given_to_a_sample(make: Make) -> None:
    buffer = make()
    assert buffer.sample(3).batch_size == (*buffer.sample().batch_size[:-1], 3)


def test_the_sampler_has_all_that_torchrl_asks_for() -> None:
    assert not inspect.isabstract(replay.TaskSampler)
    sampler = replay.TaskSampler([2, 3], weights=[1, 2])
    sampler._empty()
    assert sampler.state_dict() == {"sizes": [2, 3], "weights": [1.0, 2.0]}


# -- rows of the data ------------------------------------------------------------------------------

INDICES = {
    "one": torch.tensor(4),
    "none": torch.zeros(0, dtype=torch.int64),
    "rows": torch.tensor([[3, 3, 0], [46, 1, 2]]),
    "narrow": torch.tensor([3, 1], dtype=torch.int32),
    "from the end": torch.tensor([-1, 0, -47]),
    "mask": torch.arange(47) > 40,
    "slice": slice(2, 5),
}


@pytest.mark.parametrize("index", INDICES.values(), ids=list(INDICES))
def test_a_buffer_is_indexed_as_its_data_are(index: Any) -> None:
    expected, got = torch.cat(tasks())[index], multi_task()[index]
    assert got.batch_size == expected.batch_size
    assert (got == expected).all()


@every_buffer
def test_what_is_added_to_all_rows_is_not_added_to_the_buffer(make: Make) -> None:
    buffer = make()
    buffer[:]["next", "other"] = torch.zeros(len(buffer))
    assert "other" not in set(buffer[:]["next"].keys())


def test_the_data_given_stay_as_they_were() -> None:
    data = tasks()
    buffer = make_multi_task_replay_buffer(data, batch_size=8)
    buffer.sample().zero_()
    data[0]["number"].zero_()
    assert (buffer[:]["number"][1:30] > 0).all()
    assert set(data[0].keys(True, True)) == {"number", "task", ("next", "double")}


@every_buffer
def test_a_buffer_is_not_written_to(make: Make) -> None:
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        make().extend(numbered(0, 3))


# -- seeds -----------------------------------------------------------------------------------------


@every_buffer
def test_the_same_seed_draws_the_same_samples(make: Make) -> None:
    drawn = draw(make(), 0)
    assert torch.equal(drawn, draw(make(), 0))
    assert not torch.equal(drawn, draw(make(), 1))
    assert not torch.equal(drawn[0], drawn[1])


@every_buffer
def test_one_prefetching_thread_draws_the_same_samples_whatever_else_is_drawn(make: Make) -> None:
    def prefetched(seed: int, others: int) -> torch.Tensor:
        torch.manual_seed(seed)
        buffer = make(prefetch=1)
        numbers = []
        for _ in range(6):
            numbers.append(buffer.sample()["number"])
            torch.randn(others)
        return torch.stack(numbers)

    drawn = prefetched(0, 1)
    assert torch.equal(drawn, prefetched(0, 1000))
    assert not torch.equal(drawn, prefetched(1, 1))


# -- memory maps and devices -----------------------------------------------------------------------


def test_data_of_a_buffer_lie_where_they_are_told_to(tmp_path: Path) -> None:
    single(scratch_dir=str(tmp_path / "map"))
    assert any(path.is_file() for path in (tmp_path / "map").rglob("*"))


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="Linux says what it was told")
def test_the_system_is_told_that_rows_are_read_at_random(tmp_path: Path) -> None:
    _buffer = make_replay_buffer(numbered(0, 50), batch_size=4, scratch_dir=str(tmp_path))
    of_file: dict[str, list[str]] = {}
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if "-" in line.split()[0]:
            mapping = line
        elif line.startswith("VmFlags:") and str(tmp_path) in mapping:
            of_file[mapping.split()[-1]] = line.split()
    assert len(of_file) == len(list(tmp_path.rglob("*.memmap"))) > 0
    assert all("rr" in flags for flags in of_file.values())  # MADV_RANDOM


@every_buffer
def test_data_that_fit_a_device_lie_there(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "fits", lambda datasets, device: True)
    buffer = make(device="meta")
    assert buffer.storage.device == buffer.sample().device == torch.device("meta")
    assert not buffer._prefetch_cap
    assert make().storage.device == torch.device("cpu")  # whatever fits


@every_buffer
def test_samples_of_data_that_do_not_fit_a_device_are_transferred(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, "fits", lambda datasets, device: False)
    buffer = make(device="meta")
    assert (buffer.storage.device, buffer._prefetch_cap) == (torch.device("cpu"), 2)
    samples = [buffer.sample() for _ in range(4)]
    assert {value.device.type for sample in samples for value in sample.values(True, True)} == {
        "meta"
    }
    assert make(device="meta", prefetch=0)._prefetch_cap == 0


def test_data_fit_into_half_of_a_gpu_s_free_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    data = [TensorDict({"x": torch.zeros(10, 2), "y": torch.zeros(10)}, [10])] * 2  # 240 bytes
    for free, expected in ((480, True), (479, False)):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=free: (free, 10**9))
        assert replay.fits(data, torch.device("cuda")) is expected
    assert not replay.fits(data, torch.device("cpu"))


@pytest.mark.gpu
@pytest.mark.parametrize("resident", [True, False])
@every_buffer
def test_a_buffer_of_a_gpu_samples_what_that_of_the_cpu_holds(
    make: Make, resident: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not resident:
        monkeypatch.setattr(replay, "fits", lambda datasets, device: False)
    expected = make()[:]["number"]
    buffer = make(device="cuda", prefetch=1)
    assert buffer.storage.device.type == ("cuda" if resident else "cpu")
    torch.manual_seed(0)
    samples = [buffer.sample() for _ in range(20)]
    torch.cuda.synchronize()
    for sample in samples:
        assert {value.device.type for value in sample.values(True, True)} == {"cuda"}
        assert torch.equal(sample["number"].cpu(), expected[sample["index"].cpu()])
        assert torch.equal(sample["next", "double"], 2.0 * sample["number"])
    resampled = [make(device="cuda").sample()["number"] for _ in map(torch.manual_seed, (0, 0))]
    assert torch.equal(*resampled)
