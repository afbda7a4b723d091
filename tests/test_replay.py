"""What the buffers sample, from where, and what they refuse."""

from __future__ import annotations

import inspect
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import SliceSampler, TensorDictReplayBuffer

from torchrl_bmrl.data import (
    make_mixed_replay_buffer,
    make_multi_task_replay_buffer,
    make_replay_buffer,
    replay,
    with_previous,
)
from torchrl_bmrl.data.n_step import NStep
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError

SIZES = (30, 5, 12)


def numbered(start: int, rows: int, task: int = 0) -> TensorDict:
    return TensorDict(
        {
            "number": torch.arange(start, start + rows),
            "task": torch.full((rows,), task),
            "next": {"double": 2.0 * torch.arange(start, start + rows)},
        },
        batch_size=[rows],
    )


def tasks() -> list[TensorDict]:
    return [numbered(1000 * i, rows, task=i) for i, rows in enumerate(SIZES)]


def transitions() -> TensorDict:
    """Three episodes of 4, 1 and 3 steps."""
    step = torch.tensor([0, 1, 2, 3, 0, 0, 1, 2])
    episode = torch.tensor([0, 0, 0, 0, 1, 2, 2, 2])
    time = (100.0 * episode + step).unsqueeze(-1)
    return TensorDict(
        {
            "x": time,
            "action": time.expand(8, 7) / 1000,
            "episode": episode,
            "step": step,
            "next": {"x": time + 1, "reward": time.clone()},
        },
        batch_size=[8],
    )


def single(**options: Any) -> TensorDictReplayBuffer:
    return make_replay_buffer(numbered(0, 50), batch_size=8, **options)


def multi_task(**options: Any) -> TensorDictReplayBuffer:
    return make_multi_task_replay_buffer(tasks(), batch_size=8, **options)


def weighted(**options: Any) -> TensorDictReplayBuffer:
    return multi_task(**{"weights": [1, 2, 1], **options})


def mixed(**options: Any) -> TensorDictReplayBuffer:
    options = {"weights": [1, 0, 3], **options}
    return make_mixed_replay_buffer(tasks(), batch_size=8, **options)


BUFFERS = (single, multi_task, weighted, mixed)
Make = Callable[..., TensorDictReplayBuffer]
every_buffer = pytest.mark.parametrize("make", BUFFERS, ids=lambda make: make.__name__)
every_ensemble = pytest.mark.parametrize("make", [multi_task, mixed], ids=lambda m: m.__name__)


def copy_state(way: str, saved: Any, loaded: Any, path: Path) -> None:
    if way == "dumps":
        saved.dumps(path / "buffer")
        loaded.loads(path / "buffer")
    else:
        loaded.load_state_dict(saved.state_dict())


def draw(buffer: TensorDictReplayBuffer, seed: int) -> torch.Tensor:
    torch.manual_seed(seed)
    return torch.stack([buffer.sample()["number"] for _ in range(4)])


def test_the_previous_transition_is_of_the_same_episode() -> None:
    keys = ["x", "action", ("next", "reward"), ("next", "x"), "episode", "step"]
    data = transitions()
    before = data.clone()
    result = with_previous(data, keys)
    assert torch.equal(result["previous", "episode"], data["episode"])
    assert torch.equal(result["previous", "step"], (data["step"] - 1).clamp(min=0))
    later = data["step"] > 0
    assert torch.equal(result["previous", "next", "x"][later], data["x"][later])
    first = ~later
    for key in keys:
        assert torch.equal(result["previous"][key][first], data[key][first])
    assert set(data.keys(True)) == set(before.keys(True))  # the input stays as it was
    assert (data == before).all()


@pytest.mark.parametrize("rows", [slice(1, None), slice(2, 7), slice(None, None, 2)])
def test_a_transition_whose_previous_one_is_not_there_is_its_own(rows: slice) -> None:
    data = transitions()[rows]
    result = with_previous(data, ["x", "episode", "step"])
    own = result["previous", "step"] == data["step"]
    assert own[0]  # the last row is not before the first one
    assert torch.equal(result["previous", "episode"], data["episode"])
    assert torch.equal(result["previous", "step"][~own], data["step"][~own] - 1)


def test_the_previous_transition_of_two_files_one_after_the_other_is_of_the_same() -> None:
    # The second one begins where an episode of the first one ends, as far as its steps tell.
    first, second = transitions()[:2], transitions()[2:]
    second["episode"] = second["episode"] + 3
    result = with_previous(torch.cat([first, second]), ["episode", "step"])
    assert result["previous", "step"].tolist() == [0, 0, 2, 2, 0, 0, 0, 1]


# -- episodes of several data sets -----------------------------------------------------------------


def files() -> list[TensorDict]:
    """Files whose episodes are numbered from 0; x tells file, episode and step."""
    found = []
    for number in range(3):
        data = transitions()
        data["file"] = torch.full((8,), number)
        data["next", "done"] = data["step"].roll(-1).eq(0).unsqueeze(-1)
        data["collector", "traj_ids"] = data["episode"].clone()
        found.append(with_previous(data, ["x", "file", "episode"]))
    return found


def joined(buffer: TensorDictReplayBuffer) -> TensorDict:
    return buffer[:].to_tensordict()


@pytest.mark.parametrize("make", [make_multi_task_replay_buffer, make_mixed_replay_buffer])
def test_episodes_of_several_data_sets_have_numbers_of_their_own(make: Any) -> None:
    data = files()
    before = [part.clone() for part in data]
    stored = joined(make(data, weights=[1, 1, 1], batch_size=4))
    assert stored["episode"].tolist() == [
        3 * i + e for i in range(3) for e in [0] * 4 + [1] + [2] * 3
    ]
    assert torch.equal(stored["collector", "traj_ids"], stored["episode"])
    assert torch.equal(stored["previous", "episode"], stored["episode"])
    assert stored["episode"].dtype == torch.int64
    for part, kept in zip(data, before, strict=True):
        assert (part == kept).all()


def test_one_data_set_keeps_the_numbers_of_its_episodes() -> None:
    data = transitions()
    data["episode"] += 5
    assert torch.equal(joined(make_replay_buffer(data, batch_size=4))["episode"], data["episode"])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([[0, 1], [2, 3]], [[0, 1], [2, 3]]),  # distinct already
        ([[7, 9], [0, 1], [0, 1]], [[7, 9], [10, 11], [12, 13]]),
        ([[0, 5], [5, 6], [100]], [[0, 5], [6, 7], [100]]),
        ([[-2, -1], [-2, -1]], [[-2, -1], [0, 1]]),
    ],
)
def test_episode_numbers_stay_where_they_collide_with_none(given: Any, expected: Any) -> None:
    parts = [TensorDict({"episode": torch.tensor(numbers)}, [len(numbers)]) for numbers in given]
    assert [part["episode"].tolist() for part in replay.number_episodes(parts)] == expected


def test_numbers_that_do_not_fit_their_type_are_refused() -> None:
    number = torch.tensor([0, 200], dtype=torch.uint8)
    data = TensorDict({"episode": number}, [2])
    with pytest.raises(BMRLError, match=r"data set 1: .*'episode'.* is torch.uint8; valid: .* 401"):
        make_mixed_replay_buffer([data, data], weights=[1, 1], batch_size=2)


def test_slices_never_join_two_data_sets() -> None:
    data = [part[part["episode"] == 2] for part in files()]  # one episode each
    storage = make_mixed_replay_buffer(data, weights=[1, 1, 1], batch_size=4).storage
    sampler = SliceSampler(slice_len=3, traj_key="episode")
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=30)
    seen = set()
    for _ in range(30):
        slices = buffer.sample().reshape(10, 3)
        for key in ("file", "episode"):
            assert (slices[key] == slices[key][:, :1]).all()
        assert (slices["step"].diff(dim=1) == 1).all()
        seen.update(slices["file"].unique().tolist())
    assert seen == {0, 1, 2}


@pytest.mark.parametrize("key", ["episode", ("collector", "traj_ids")])
def test_n_steps_never_join_two_data_sets(key: Any) -> None:
    data = [part.select("file", "next", key) for part in (x[4:5] for x in files())]
    for part in data:
        part["next", "done"].zero_()  # cut off: the number alone tells that another one begins
    stored = joined(make_mixed_replay_buffer(data, weights=[1, 1, 1], batch_size=4))
    assert NStep(3, 0.9)(stored)["steps_to_next_obs"].flatten().tolist() == [1, 1, 1]
    collided = torch.cat([part.copy() for part in data])
    assert NStep(3, 0.9)(collided)["steps_to_next_obs"].flatten().tolist() == [3, 2, 1]


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


INDICES = {
    "one": torch.tensor(4),
    "none": torch.zeros(0, dtype=torch.int64),
    "rows": torch.tensor([[3, 3, 0], [46, 1, 2]]),
    "narrow": torch.tensor([3, 1], dtype=torch.int32),
    "from the end": torch.tensor([-1, 0]),
    "mask": torch.arange(47) > 40,
    "slice": slice(2, 5),
}


@every_buffer
def test_what_is_added_to_all_rows_is_not_added_to_the_buffer(make: Make) -> None:
    buffer = make()
    buffer[:]["next", "other"] = torch.zeros(len(buffer))
    assert "other" not in set(buffer[:]["next"].keys())


@pytest.mark.parametrize("index", INDICES.values(), ids=list(INDICES))
def test_a_buffer_is_indexed_as_its_data_are(index: Any) -> None:
    expected, got = torch.cat(tasks())[index], multi_task()[index]
    assert got.batch_size == expected.batch_size
    assert (got == expected).all()


@every_buffer
@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
def test_the_batch_size_can_be_given_to_a_sample(make: Make) -> None:
    buffer = make()
    assert buffer.sample(3).batch_size == (*buffer.sample().batch_size[:-1], 3)


def test_the_data_given_stay_as_they_were() -> None:
    data = tasks()
    buffer = make_multi_task_replay_buffer(data, batch_size=8)
    buffer.sample().zero_()
    data[0]["number"].zero_()
    assert (buffer[:]["number"][1:30] > 0).all()
    assert set(data[0].keys(True, True)) == {"number", "task", ("next", "double")}


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


def test_data_of_a_buffer_lie_where_they_are_told_to(tmp_path: Path) -> None:
    single(scratch_dir=str(tmp_path / "map"))
    assert any(path.is_file() for path in (tmp_path / "map").rglob("*"))


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


@every_buffer
@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_a_buffer_that_was_loaded_samples_what_the_saved_one_does(
    make: Make, way: str, tmp_path: Path
) -> None:
    saved, loaded = make(), make()
    loaded.storage.set(slice(0, len(loaded)), loaded[:].apply(torch.zeros_like))
    assert not draw(loaded, 0).any()
    copy_state(way, saved, loaded, tmp_path)
    assert torch.equal(draw(loaded, 0), draw(saved, 0))
    assert (loaded[:] == saved[:]).all()


@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_weights_are_loaded(way: str, tmp_path: Path) -> None:
    saved, loaded = mixed(weights=[0, 1, 0]), mixed(weights=[1, 0, 0])
    copy_state(way, saved, loaded, tmp_path)
    assert loaded.sample()["task"].unique().item() == 1


@pytest.mark.parametrize("way", ["dumps", "state_dict"])
@pytest.mark.parametrize("sizes", [(5, 30, 12), (30, 5), (30, 5, 13)])
def test_data_sets_of_other_sizes_are_not_loaded(
    sizes: tuple[int, ...], way: str, tmp_path: Path
) -> None:
    other = make_multi_task_replay_buffer([numbered(7, rows) for rows in sizes], batch_size=2)
    before = other[:].clone()
    with pytest.raises(BMRLError, match=r"of \[30, 5, 12\] transitions; valid: "):
        copy_state(way, multi_task(), other, tmp_path)
    assert (other[:] == before).all()


@every_buffer
@pytest.mark.parametrize("prefetch", [(0, 2), (2, 0), (1, 1)])
@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_samples_prepared_ahead_are_no_part_of_a_state(
    make: Make, way: str, prefetch: tuple[int, int], tmp_path: Path
) -> None:
    saved, loaded = (make(prefetch=number) for number in prefetch)
    saved.sample()
    copy_state(way, saved, loaded, tmp_path)
    assert loaded.sample()["number"].shape == saved.sample()["number"].shape
    assert not [file for file in tmp_path.rglob("*") if file.suffix in (".pkl", ".pt", ".t")]


def test_a_dump_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: not a dump of these data"):
        single().loads(tmp_path / "nowhere")


class Executed:
    """What runs when a pickle of it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("part", ["storage", "rng_state"])
@every_buffer
def test_a_pickle_in_a_dump_is_refused_and_not_executed(
    make: Make, part: str, tmp_path: Path
) -> None:
    saved = make()
    saved.set_rng(torch.Generator().manual_seed(0))
    saved.dumps(tmp_path / "buffer")
    before = saved[:].clone()
    folder = tmp_path / "buffer" / part
    data = TensorDict.load_memmap(folder).clone()
    hidden = TensorDict({}, data.batch_size).set_non_tensor("x", Executed(tmp_path / "executed"))
    hidden.memmap(tmp_path / "hidden")
    shutil.copytree(tmp_path / "hidden" / "x", folder / "x")
    meta = json.loads((folder / "meta.json").read_text())
    meta["x"] = json.loads((tmp_path / "hidden" / "meta.json").read_text())["x"]
    (folder / "meta.json").write_text(json.dumps(meta))
    loaded = make()
    loaded.set_rng(torch.Generator().manual_seed(0))
    with pytest.raises(DataError, match="pickle"):
        loaded.loads(tmp_path / "buffer")
    assert not (tmp_path / "executed").exists()
    assert (loaded[:] == before).all()
    with pytest.warns(FutureWarning, match="pickle"):  # it would have been
        TensorDict.load_memmap(folder)
    assert (tmp_path / "executed").exists()


def test_rows_are_found_from_the_end_too() -> None:
    buffer = single()
    index = torch.tensor([-1, 0, -50])
    assert buffer[index]["number"].tolist() == buffer[:]["number"][index].tolist()


@every_buffer
def test_a_buffer_is_not_written_to(make: Make) -> None:
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        make().extend(numbered(0, 3))


@pytest.mark.parametrize("key", ["x", ("next", "reward")])
def test_numbers_that_are_not_finite_do_not_get_into_a_buffer(key: Any) -> None:
    data = transitions()
    data[key][5] = float("nan")
    with pytest.raises(BMRLError, match=r"is not finite in transition 5; valid: finite"):
        make_replay_buffer(data, batch_size=2)
    with pytest.raises(BMRLError, match=r"data set 1: .* is not finite in transition 5"):
        make_multi_task_replay_buffer([transitions(), data], batch_size=2)


@every_ensemble
@pytest.mark.parametrize(
    ("key", "value", "difference"),
    [
        ("action", torch.zeros(8, 5), r"torch.float32 \(5,\), in data set 0 torch.float32 \(7,\)"),
        ("action", torch.zeros(8, 7).double(), r"torch.float64 \(7,\), in data set 0 torch.float3"),
        (("next", "reward"), None, r"missing, in data set 0 torch.float32 \(1,\)"),
        ("extra", torch.zeros(8, 2), r"torch.float32 \(2,\), in data set 0 missing"),
    ],
)
def test_data_sets_that_do_not_match_are_named_with_the_key(
    make: Make, key: Any, value: Any, difference: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = transitions().exclude(key) if value is None else transitions().set(key, value)
    datasets = [transitions(), transitions(), other]
    monkeypatch.setitem(globals(), "tasks", lambda: datasets)
    with pytest.raises(BMRLError, match="data set 2: .*" + difference) as caught:
        make()
    assert repr(key) in str(caught.value)


@every_ensemble
@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ([], "no data sets; valid: at least one"),
        ([numbered(0, 3), numbered(0, 0), numbered(0, 3)], r"data set 1: batch size \[0\]; valid"),
        ([numbered(0, 6).reshape(2, 3)] * 3, r"data set 0: batch size \[2, 3\]; valid: \[N\]"),
    ],
)
def test_data_sets_must_hold_transitions(
    make: Make, datasets: list[TensorDict], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "tasks", lambda: datasets)
    with pytest.raises(BMRLError, match=message):
        make()


def test_data_must_hold_transitions() -> None:
    with pytest.raises(BMRLError, match=r"the data: batch size \[0\]; valid"):
        make_replay_buffer(numbered(0, 0), batch_size=2)


BAD_WEIGHTS = ([1, 1], [1] * 4, [1, -1, 1], [1, float("nan"), 1], [1, float("inf"), 1], [0, 0, 0])


@every_ensemble
@pytest.mark.parametrize("weights", BAD_WEIGHTS)
def test_weights_must_be_one_valid_number_per_data_set(make: Make, weights: list[float]) -> None:
    with pytest.raises(ConfigError, match="valid: 3 finite numbers, one per data set"):
        make(weights=weights)


def test_a_task_without_weight_is_no_task() -> None:
    with pytest.raises(ConfigError, match="all positive"):
        multi_task(weights=[1, 0, 1])


@every_buffer
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefetch": -1}, "prefetch is -1; valid: at least 0"),
        ({"prefetch": True}, "prefetch is True"),
        ({"device": "toaster"}, "device is 'toaster'; valid: "),
    ],
)
def test_options_of_no_sense_are_refused(make: Make, options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**options)


@pytest.mark.parametrize("batch_size", [0, -1, 2.0, True])
@pytest.mark.parametrize(
    "make", [make_replay_buffer, make_multi_task_replay_buffer, make_mixed_replay_buffer]
)
def test_a_batch_holds_at_least_one_transition(make: Make, batch_size: Any) -> None:
    data = numbered(0, 3) if make is make_replay_buffer else [numbered(0, 3)]
    options = {"weights": [1]} if make is make_mixed_replay_buffer else {}
    with pytest.raises(ConfigError, match=f"batch_size is {batch_size!r}; valid: at least 1"):
        make(data, batch_size=batch_size, **options)


def test_the_sampler_has_all_that_torchrl_asks_for() -> None:
    assert not inspect.isabstract(replay.TaskSampler)
    sampler = replay.TaskSampler([2, 3], weights=[1, 2])
    sampler._empty()
    assert sampler.state_dict() == {"sizes": [2, 3], "weights": [1.0, 2.0]}
