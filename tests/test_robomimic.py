"""Demonstration files: kept to the bit, and refused with file, key and reason when damaged."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import (
    ENV_ARGS,
    LENGTHS,
    PARTS,
    assert_identical,
    assert_same,
    make_episode,
    write_file,
)

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import (
    count_episodes,
    count_steps,
    keep_episode,
    open_episodes,
    read_kept_episode,
    read_metadata,
    write_episodes,
)
from torchrl_bmrl.data.schema import find_problems
from torchrl_bmrl.data.sources import Source, open_source
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError

Damage = Callable[[Any], None]
DEMO = "data/demo_1"
ROWS = LENGTHS[1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_file(tmp_path / "lift.hdf5")
    return tmp_path / "lift.hdf5"


def read(path: Path, **options: Any) -> dict[str, Episode]:
    with open_episodes(path, **options) as episodes:
        return dict(episodes)


def opened(path: Path) -> Source:
    with open_source(path) as source:
        return source


def put(key: str, value: Any) -> Damage:
    def damage(file: Any) -> None:
        if key in file:
            del file[key]
        file[key] = value

    return damage


def change(key: str, index: Any, value: float) -> Damage:
    def damage(file: Any) -> None:
        file[key][index] = value

    return damage


def remove(*keys: str) -> Damage:
    def damage(file: Any) -> None:
        for key in keys:
            del file[key]

    return damage


def edit(path: Path, *damages: Damage) -> None:
    with h5py.File(path, "r+") as file:
        for damage in damages:
            damage(file)


# -- round trips -----------------------------------------------------------------------------------


def test_a_kept_episode_comes_back_to_the_bit(tmp_path: Path) -> None:
    episode = make_episode(terminated=True)
    keep_episode(tmp_path / "0.npz", episode)
    kept = read_kept_episode(tmp_path / "0.npz")
    assert_same(kept, episode)
    assert list(kept.observations) == list(episode.observations)


def test_episodes_come_back_to_the_bit(tmp_path: Path) -> None:
    made = write_file(tmp_path / "a.hdf5")
    episodes = read(tmp_path / "a.hdf5")
    assert list(episodes) == [f"demo_{i}" for i in range(len(LENGTHS))]
    for episode, original in zip(episodes.values(), made, strict=True):
        assert_same(episode, original)


def test_a_termination_comes_back_whatever_dones_say(tmp_path: Path) -> None:
    made = [make_episode(i, 5, terminated=i == 1) for i in range(2)]
    write_episodes(tmp_path / "a.hdf5", made, env_args={})
    for option in (False, True):
        episodes = read(tmp_path / "a.hdf5", dones_terminate=option)
        assert [e.terminated.tolist() for e in episodes.values()] == [
            [False] * 5,
            [False] * 4 + [True],
        ]


def test_an_episode_is_read_when_it_is_asked_for_and_only_then(path: Path) -> None:
    edit(path, remove(f"{DEMO}/actions"))
    with open_episodes(path) as episodes:
        assert len(episodes) == len(LENGTHS)
        assert len(episodes["demo_0"]) == LENGTHS[0]
        with pytest.raises(DataError):
            episodes["demo_1"]
        with pytest.raises(KeyError):
            episodes["demo_9"]


def test_more_than_ten_episodes_keep_their_order(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = write_file(path, [2] * 12, train=11)
    for split, expected in ((None, made), ("train", made[:11]), ("valid", made[11:])):
        episodes = list(read(path, split=split).values())
        assert len(episodes) == len(expected)
        for episode, original in zip(episodes, expected, strict=True):
            assert_identical(episode.actions, original.actions)
    assert count_episodes(path) == 12


def test_a_mask_keeps_its_own_order(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    write_episodes(
        path, [make_episode(i) for i in range(3)], env_args={}, masks={"mine": [2, 0], "no": []}
    )
    assert list(read(path, split="mine")) == ["demo_2", "demo_0"]
    assert read_metadata(path)["masks"] == {"mine": ["demo_2", "demo_0"], "no": []}


def test_names_in_a_mask_may_be_text(path: Path) -> None:
    edit(path, put("mask/valid", np.array(["demo_3"], dtype=h5py.string_dtype())))
    assert list(read(path, split="valid")) == ["demo_3"]


def test_only_the_parts_asked_for_are_read(path: Path) -> None:
    edit(path, put(f"{DEMO}/obs/image", "not even an image"))
    for episode in read(path, observation_keys=["object"]).values():
        assert list(episode.observations) == list(episode.next_observations) == ["object"]


def test_no_part_asked_for_is_not_every_part(path: Path) -> None:
    assert read(path, observation_keys=[])["demo_0"].observations == {}


def test_only_the_extras_asked_for_are_read(path: Path) -> None:
    edit(path, put(f"{DEMO}/states", "not even an array"))
    wanted = ["successes", "phases", "absent"]
    assert set(read(path, extras=wanted)["demo_1"].extras) == {"successes", "phases"}
    assert read(path, extras=[])["demo_1"].extras == {}


def test_what_other_tools_keep_beside_the_steps_is_left_alone(path: Path) -> None:
    def edit_demo(file: Any) -> None:
        del file[f"{DEMO}/states"]
        file[f"{DEMO}/datagen_info/target"] = np.zeros((3, 4, 4))
        file[f"{DEMO}/src_demo_inds"] = np.zeros(2)
        file[f"{DEMO}/text"] = "words"

    edit(path, edit_demo)
    assert set(read(path)["demo_1"].extras) == {"successes", "phases"}
    edit(path, put(f"{DEMO}/successes", "words"))  # but these are this library's
    assert refusal(path).key == f"{DEMO}/successes"
    edit(path, put(f"{DEMO}/successes", np.zeros(2)))
    assert next(find_problems(read(path)["demo_1"]))[0] == "successes"


def test_attributes_come_back_as_python_s_own_types(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    attributes = {
        "model_file": "<mujoco>" + "é<body name='x'/>" * 3500 + "</mujoco>",
        "seed": 7,
        "noise": 0.25,
        "solved": True,
        "phase_names": ["a", "bc"],
    }
    assert len(attributes["model_file"].encode()) > 50_000  # type: ignore[attr-defined]
    write_episodes(path, [replace(make_episode(), attributes=attributes)], env_args={})
    came_back = dict(read(path)["demo_0"].attributes)
    assert came_back == attributes
    assert {k: type(v) for k, v in came_back.items()} == {k: type(v) for k, v in attributes.items()}
    with h5py.File(path) as file:  # others read texts of a fixed length
        assert file["data/demo_0"].attrs["model_file"].decode() == attributes["model_file"]


def test_a_file_s_attributes_and_masks_come_back(path: Path) -> None:
    assert read_metadata(path) == {
        "total": sum(LENGTHS),
        "env_args": ENV_ARGS,
        "task": "lift",
        "action_noise": 0.2,
        "masks": {"train": ["demo_0", "demo_1", "demo_2"], "valid": ["demo_3"]},
    }


def test_a_file_of_another_writer_needs_neither_masks_nor_attributes(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = make_episode()
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["obs/x"], demo["next_obs/x"] = made.observations["object"], np.ones((5, 10))
        demo["actions"], demo["rewards"] = made.actions, made.rewards
    (episode,) = read(path).values()
    assert (dict(episode.extras), dict(episode.attributes)) == ({}, {})
    assert not episode.terminated.any()
    assert_identical(episode.observations["x"], made.observations["object"])
    assert read_metadata(path) == {"env_args": {}, "masks": {}}


def test_numbers_of_another_byte_order_become_the_machine_s(path: Path) -> None:
    before = read(path)["demo_1"].rewards
    edit(path, put(f"{DEMO}/rewards", before.astype(">f8")))
    assert_identical(read(path)["demo_1"].rewards, before)


def test_without_next_observations_the_last_step_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = write_file(path)
    edit(path, remove(*(f"data/demo_{i}/next_obs" for i in range(4))))
    for episode, original in zip(read(path).values(), made, strict=True):
        assert len(episode) == len(original) - 1
        for name in PARTS:
            assert_identical(episode.observations[name], original.observations[name][:-1])
            assert_identical(episode.next_observations[name], original.observations[name][1:])
        assert_identical(episode.actions, original.actions[:-1])
        assert_identical(episode.rewards, original.rewards[:-1])
        assert_identical(episode.extras["states"], original.extras["states"][:-1])
        assert episode.terminated.tolist() == [False] * len(episode)
    assert count_steps(path, read(path)) == sum(LENGTHS) - 4
    (told,) = opened(path).oddities
    assert "4 episodes have no next_obs, such as demo_0" in told


def test_without_next_observations_a_step_that_terminates_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    original = make_episode(terminated=True)
    write_episodes(path, [original], env_args={})
    edit(path, remove("data/demo_0/next_obs"))
    episode = read(path)["demo_0"]
    assert_identical(episode.rewards, original.rewards)
    assert episode.terminated[-1]
    for name in PARTS:
        assert_identical(episode.observations[name], original.observations[name])
        after = np.append(original.observations[name][1:], original.observations[name][-1:], axis=0)
        assert_identical(episode.next_observations[name], after)
    assert count_steps(path, read(path)) == len(original)


def test_steps_are_counted_over_the_episodes_named(path: Path) -> None:
    episodes = read(path)
    some = {name: episodes[name] for name in ("demo_0", "demo_2")}
    assert count_steps(path, some) == LENGTHS[0] + LENGTHS[2]
    assert count_steps(path, {}) == 0
    with pytest.raises(DataError, match=r"lift\.hdf5: data/demo_9/actions: missing"):
        count_steps(path, {"demo_9": make_episode()})


def test_every_faulty_mask_is_told(path: Path) -> None:
    assert opened(path).problems == opened(path).oddities == []
    edit(
        path,
        put("mask/train", np.array([b"demo_0", b"demo_7"])),
        put("mask/valid", np.array([b"demo_1", b"demo_1"])),
    )
    assert opened(path).problems == [
        ("mask/train", "row 1 names 'demo_7', which is not in the file"),
        ("mask/valid", "row 1 names 'demo_1', again"),
    ]


def test_an_episode_to_train_on_and_to_hold_out_deserves_a_look(path: Path) -> None:
    edit(path, put("mask/valid", np.array([b"demo_3", b"demo_1"])))
    assert opened(path).oddities == ["1 episodes are in train and in valid, such as demo_1"]


def test_what_could_not_be_trained_on_is_not_written(tmp_path: Path) -> None:
    path, episode = tmp_path / "a.hdf5", make_episode()
    bad = {
        "not finite in row 0": replace(episode, rewards=np.full(5, np.nan)),
        "names without '/'": replace(
            episode, observations={"a/b": np.zeros(5)}, next_observations={"a/b": np.zeros(5)}
        ),
        "other names than actions": replace(episode, extras={"dones": np.zeros(5)}),
    }
    for message, faulty in bad.items():
        with pytest.raises(DataError, match=message):
            write_episodes(path, [episode, faulty], env_args={})
    with pytest.raises(DataError, match="no episodes"):
        write_episodes(path, [], env_args={})
    with pytest.raises(ConfigError, match="mask 'train' has 1; valid: 0 to 0"):
        write_episodes(path, [episode], env_args={}, masks={"train": [0, 1]})
    assert list(tmp_path.iterdir()) == []


def test_environment_metadata_must_be_an_object(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = "[1]"
    with pytest.raises(DataError, match="env_args; valid: a JSON object"):
        read_metadata(path)


def test_dones_terminate_only_where_that_is_asked_for(path: Path) -> None:
    edit(path, remove(f"{DEMO}/terminated"))
    assert not read(path)["demo_1"].terminated.any()
    terminated = read(path, dones_terminate=True)["demo_1"].terminated
    assert terminated.tolist() == [False] * (ROWS - 1) + [True]
    edit(path, change(f"{DEMO}/dones", -1, 0))
    assert not read(path, dones_terminate=True)["demo_1"].terminated.any()


def test_dones_at_solved_steps_do_not_terminate_the_episode_there(path: Path) -> None:
    edit(path, remove(f"{DEMO}/terminated"), change(f"{DEMO}/dones", 2, 1))
    terminated = read(path, dones_terminate=True)["demo_1"].terminated
    assert terminated.tolist() == [False] * (ROWS - 1) + [True]


# -- writing ---------------------------------------------------------------------------------------


def test_the_layout_is_robomimics(path: Path) -> None:
    with h5py.File(path) as file:
        data = file["data"]
        assert set(data) == {f"demo_{i}" for i in range(4)}
        assert data.attrs["total"] == sum(LENGTHS)
        assert json.loads(data.attrs["env_args"]) == ENV_ARGS
        assert (data.attrs["task"], data.attrs["action_noise"]) == (b"lift", 0.2)
        for i, steps in enumerate(LENGTHS):
            demo = data[f"demo_{i}"]
            assert demo.attrs["num_samples"] == steps
            assert demo.attrs["seed"] == 2**32 - 1 - i
            assert demo.attrs["model_file"].startswith(b"<mujoco")
            assert list(demo.attrs["phase_names"]) == [b"descend", b"grasp", b"lift"]
            assert demo["dones"][:].tolist() == [0] * (steps - 1) + [1]
            assert demo["terminated"].dtype == bool
            assert demo["states"].shape == (steps, 11)
            for name in PARTS:
                np.testing.assert_array_equal(
                    demo[f"obs/{name}"][1:], demo[f"next_obs/{name}"][:-1]
                )
        for split, names in (("train", [b"demo_0", b"demo_1", b"demo_2"]), ("valid", [b"demo_3"])):
            assert file[f"mask/{split}"].dtype.kind == "S"
            assert file[f"mask/{split}"][:].tolist() == names


def test_every_array_carries_checksums(path: Path) -> None:
    unprotected = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and not node.fletcher32:
            unprotected.append(name)

    with h5py.File(path) as file:
        file.visititems(visit)
    assert unprotected == []


@pytest.mark.parametrize("byte", [b"\x00", b"\xff"])
def test_a_hole_in_the_file_does_not_pass_for_data(path: Path, byte: bytes) -> None:
    whole, chunks = path.read_bytes(), {}

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            chunk = node.id.get_chunk_info(0)
            chunks[name] = slice(chunk.byte_offset, chunk.byte_offset + chunk.size)

    with h5py.File(path) as file:
        file["data/demo_1"].visititems(visit)
    assert len(chunks) == 11
    for name, here in chunks.items():
        path.write_bytes(whole[: here.start] + byte * (here.stop - here.start) + whole[here.stop :])
        if name != "dones":  # not read
            assert refusal(path).key == f"{DEMO}/{name}"


def test_no_text_lies_in_a_heap_without_checksums(path: Path) -> None:
    # HDF5 reads damage there as it is, or loops for ever.
    assert b"GCOL" not in path.read_bytes()


def test_texts_of_any_length_come_back(tmp_path: Path) -> None:
    attributes = {"none": "", "long": "<geom/>" * 30_000, "names": [], "mixed": ["", "é" * 9]}
    episode = replace(make_episode(), attributes=attributes)
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    assert dict(read(tmp_path / "a.hdf5")["demo_0"].attributes) == attributes


def layout_version(content: bytes, address: int) -> int:
    """Version of the layout message in the object header at an address."""
    assert content[address : address + 5] == b"OHDR\x02"
    flags = content[address + 5]
    at = address + 6 + (16 if flags & 0x20 else 0) + (4 if flags & 0x10 else 0) + (1 << (flags & 3))
    while content[at] != 8:  # type of message (1), size (2), flags (1), perhaps order (2), content
        at += 4 + int.from_bytes(content[at + 1 : at + 3], "little") + (2 if flags & 4 else 0)
    return content[at + 4 + (2 if flags & 4 else 0)]


def test_a_file_can_be_read_by_earlier_versions_of_hdf5(path: Path) -> None:
    # Version 5 came with HDF5 2.0, and HDF5 1.14 refuses it; version 4 is 1.10's.
    with h5py.File(path) as file:
        address = h5py.h5o.get_info(file[f"{DEMO}/actions"].id).addr
    assert layout_version(path.read_bytes(), address) == 4


def test_the_same_episodes_give_the_same_bytes_a_second_later(path: Path, tmp_path: Path) -> None:
    time.sleep(1.1)  # HDF5 keeps times in seconds
    write_file(tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("existing", [True, False])
def test_a_failed_write_leaves_nothing_behind(tmp_path: Path, existing: bool) -> None:
    path = tmp_path / "data" / "lift.hdf5"
    if existing:
        write_file(path)
    before = path.read_bytes() if existing else b""

    def broken() -> Iterator[Episode]:
        yield make_episode()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_episodes(path, broken(), env_args={})
    assert list(path.parent.iterdir()) == ([path] if existing else [])
    if existing:
        assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["actions", "dones", "obs", "obs/object"])
def test_an_extra_cannot_take_the_place_of_the_layout_s_own(tmp_path: Path, name: str) -> None:
    episode = replace(make_episode(), extras={name: np.zeros((5, 7))})
    with pytest.raises(DataError, match=rf"a\.hdf5: data/demo_0/{name}: "):
        write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"not a zip file", None], ids=["empty", "text", "half"])
def test_a_damaged_kept_episode_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "0.npz"
    keep_episode(path, make_episode())
    path.write_bytes(path.read_bytes()[:-100] if content is None else content)
    with pytest.raises(DataError, match=r"0\.npz: .*remove it"):
        read_kept_episode(path)


def test_a_kept_episode_that_lacks_an_array_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "0.npz", actions=np.zeros((5, 7)))
    with pytest.raises(DataError, match=r"0\.npz: .*attributes"):
        read_kept_episode(tmp_path / "0.npz")


# -- damaged files ---------------------------------------------------------------------------------


def refusal(path: Path, **options: Any) -> DataError:
    """The error that reading gives, which names the file first."""
    with pytest.raises(DataError) as caught:
        read(path, **options)
    assert isinstance(caught.value, BMRLError)
    assert str(caught.value).startswith(f"{path}: ")
    return caught.value


READERS = (count_episodes, read_metadata, lambda path: count_steps(path, ["demo_0"]))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "lift.hdf5"))
    for reader in READERS:
        with pytest.raises(DataError, match=r"lift\.hdf5: no such file"):
            reader(tmp_path / "lift.hdf5")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    (tmp_path / "lift.hdf5").mkdir()
    assert "a folder; valid: a file" in str(refusal(tmp_path / "lift.hdf5"))


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all\n" * 100], ids=["empty", "text"])
def test_another_format_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "lift.hdf5"
    path.write_bytes(content)
    assert "not a complete HDF5 file" in str(refusal(path))


def test_a_pointer_to_git_lfs_says_how_to_get_the_data(tmp_path: Path) -> None:
    path = tmp_path / "lift.hdf5"
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n")
    assert "`git lfs pull`" in str(refusal(path))


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
def test_a_truncated_file_is_refused(path: Path, share: float) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "not a complete HDF5 file" in str(refusal(path))
    for reader in READERS:
        with pytest.raises(DataError, match="not a complete HDF5 file"):
            reader(path)


STRINGS = np.full((ROWS, 7), "a", dtype=h5py.string_dtype())
DAMAGES: dict[str, tuple[Damage, str, str]] = {
    # name: damage, key, what the message says
    "no data": (remove("data"), "data", "missing"),
    "data is an array": (put("data", np.zeros(3)), "data", "not a group"),
    "demo is an array": (put(DEMO, np.zeros(3)), DEMO, "not a group"),
    "no actions": (remove(f"{DEMO}/actions"), f"{DEMO}/actions", "missing"),
    "no rewards": (remove(f"{DEMO}/rewards"), f"{DEMO}/rewards", "missing"),
    "no obs": (remove(f"{DEMO}/obs"), f"{DEMO}/obs", "missing"),
    "no next image": (remove(f"{DEMO}/next_obs/image"), f"{DEMO}/next_obs/image", "missing"),
    "group of actions": (put(f"{DEMO}/actions/x", 1), f"{DEMO}/actions", "valid: a dataset"),
    "dangling link": (
        put(f"{DEMO}/actions", h5py.SoftLink("/nowhere")),
        f"{DEMO}/actions",
        "missing",
    ),
    "link to another file": (
        put(f"{DEMO}/obs", h5py.ExternalLink("missing.hdf5", "/x")),
        f"{DEMO}/obs",
        "missing",
    ),
    "text": (put(f"{DEMO}/actions", STRINGS), f"{DEMO}/actions", "valid: numbers"),
    "bytes": (put(f"{DEMO}/rewards", np.full(ROWS, b"a")), f"{DEMO}/rewards", "valid: numbers"),
    "complex": (put(f"{DEMO}/rewards", np.zeros(ROWS, complex)), f"{DEMO}/rewards", "numbers"),
    "half terminated": (
        put(f"{DEMO}/terminated", np.full(ROWS, 0.5)),
        f"{DEMO}/terminated",
        "0.5 in row 0; valid: 0 or 1",
    ),
    "terminated is not a number": (
        put(f"{DEMO}/terminated", np.array([0] * (ROWS - 1) + [np.nan])),
        f"{DEMO}/terminated",
        f"nan in row {ROWS - 1}; valid: 0 or 1",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_answered_with_file_key_and_what_is_valid(path: Path, name: str) -> None:
    damage, key, says = DAMAGES[name]
    if name == "group of actions":
        edit(path, remove(key))
    edit(path, damage)
    error = refusal(path)
    assert error.key == key
    assert f"{path}: {key}: " in str(error)
    assert says in str(error)


def elsewhere(path: Path) -> Path:
    """Another file with what an episode's actions may be."""
    other = path.with_name("other.hdf5")
    with h5py.File(other, "w") as file:
        file["actions"] = np.zeros((ROWS, 7))
    return other


def linked(demo: h5py.Group, other: Path) -> None:
    demo["actions"] = h5py.ExternalLink(other, "/actions")


def stored_outside(demo: h5py.Group, other: Path) -> None:
    demo.create_dataset("actions", (ROWS, 7), "u1", external=[(str(other), 0, ROWS * 7)])


def virtual(demo: h5py.Group, other: Path) -> None:
    layout = h5py.VirtualLayout((ROWS, 7), "f8")
    layout[:] = h5py.VirtualSource(other, "actions", (ROWS, 7))
    demo.create_virtual_dataset("actions", layout)


def enormous(demo: h5py.Group, other: Path) -> None:
    options = {"chunks": (1024, 7), "fillvalue": 0.5}
    demo.create_dataset("actions", (10**12, 7), "f8", **options)


@pytest.mark.parametrize(
    ("put_actions", "says"),
    [
        (linked, "lies in .*other.hdf5; valid: in this file"),
        (stored_outside, "its content lies in other files"),
        (virtual, "its content lies in other files"),
        (enormous, "claims 56000000000000 bytes, more than the file can hold"),
    ],
)
def test_what_lies_in_another_file_or_is_larger_than_its_own_is_not_read(
    path: Path, put_actions: Any, says: str
) -> None:
    other = elsewhere(path)
    with h5py.File(path, "r+") as file:
        del file[DEMO]["actions"]
        put_actions(file[DEMO], other)
    error = refusal(path)
    assert error.key == f"{DEMO}/actions"
    assert re.search(says, str(error))


@pytest.mark.parametrize("rows", [ROWS - 1, ROWS + 1])
def test_dones_that_terminate_must_have_a_row_for_each_step(path: Path, rows: int) -> None:
    edit(path, remove(f"{DEMO}/terminated"), put(f"{DEMO}/dones", np.zeros(rows)))
    error = refusal(path, dones_terminate=True)
    assert error.key == f"{DEMO}/dones"
    assert f"shape ({rows},); valid: ({ROWS},)" in str(error)
    edit(path, remove(f"{DEMO}/dones"))
    assert refusal(path, dones_terminate=True).key == f"{DEMO}/dones"
    assert len(read(path)) == len(LENGTHS)  # they are not read where they say nothing


@pytest.mark.parametrize("damage", [remove("data"), put("data", np.zeros(3))])
def test_episodes_cannot_be_counted_without_their_group(path: Path, damage: Damage) -> None:
    edit(path, damage)
    for reader in (count_episodes, read_metadata):
        with pytest.raises(DataError, match=r"lift\.hdf5: data: "):
            reader(path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (remove("mask/valid"), "missing; valid masks: train"),
        (remove("mask"), "missing; valid masks: none; the file has no masks"),
        (put("mask/valid", np.array([b"demo_3", b"demo_9"])), "row 1 names 'demo_9', which is not"),
        (put("mask/valid", np.array([b"demo_3", b"demo_3"])), "row 1 names 'demo_3', again"),
        (put("mask/valid", np.array([], dtype="S6")), "no demonstrations"),
        (put("mask/valid", np.array([3])), "row 0 names '3'"),
        (put("mask/valid", h5py.SoftLink("/data")), "valid: a dataset"),
    ],
    ids=["missing", "no masks", "unknown demo", "twice", "empty", "numbers", "group"],
)
def test_a_bad_mask_is_named(path: Path, damage: Damage, says: str) -> None:
    edit(path, damage)
    error = refusal(path, split="valid")
    assert error.key == "mask/valid"
    assert says in str(error)
    assert len(read(path)) == len(LENGTHS)  # without a mask all is whole


def test_an_unknown_mask_lists_the_valid_ones(path: Path) -> None:
    assert "mask/test: missing; valid masks: train, valid" in str(refusal(path, split="test"))


def test_masks_must_be_a_group(path: Path) -> None:
    edit(path, put("mask", np.zeros(3)))
    assert refusal(path, split="train").key == "mask"
    with pytest.raises(DataError, match=r"lift\.hdf5: mask: not a group"):
        read_metadata(path)


def test_a_file_without_demonstrations_is_refused(path: Path) -> None:
    edit(path, remove(*(f"data/demo_{i}" for i in range(4))))
    error = refusal(path)
    assert error.key == "data"
    assert "no demonstrations" in str(error)
    assert count_episodes(path) == 0


@pytest.mark.parametrize("value", ["{not JSON", 3.5, h5py.Empty("f8"), np.zeros(2)])
def test_env_args_that_are_not_json_are_named(path: Path, value: Any) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = value
    with pytest.raises(DataError, match=r"lift\.hdf5: data: attribute env_args is not"):
        read_metadata(path)


@pytest.mark.parametrize("key", ["actions", "rewards", "successes", "obs/object", "obs/image"])
def test_a_flipped_bit_in_an_array_is_found_when_it_is_read(path: Path, key: str) -> None:
    with h5py.File(path) as file:
        chunk = file[f"{DEMO}/{key}"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)
    assert refusal(path).key == f"{DEMO}/{key}"
