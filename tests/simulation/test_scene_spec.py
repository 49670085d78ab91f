"""Specifications: what changes the digest, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from attentionvote.part import Part
from attentionvote.section import read
from attentionvote.setting import SettingError
from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.camera import Camera, CameraSettings
from attentionvote.simulation.drop_settings import BinSettings, DropSettings
from attentionvote.simulation.scene_spec import SceneSetSpec, SimulationSettings, scene_set_directory, scene_set_specs

SPEC = SceneSetSpec("0" * 64, "train", 10)
OTHERS = {
    "part_digest": "1" * 64,
    "split": "val",
    "cycles": 11,
    "seed": 1,
    "drop_counts": (6, 10),
    "bin": BinSettings(jitter=0.1),
    "camera": CameraSettings(tilt_degrees=5),
    "drop": DropSettings(timestep=0.005),
    "visibility_stride": 3,
    "format_version": 2,
    "keep_every": 2,
    "pile_share": 0.5,
}


def test_every_field_changes_the_digest() -> None:
    assert set(OTHERS) == set(SceneSetSpec.__dataclass_fields__)
    digests = {replace(SPEC, **{name: value}).digest() for name, value in OTHERS.items()}
    assert len(digests | {SPEC.digest()}) == len(OTHERS) + 1
    assert replace(SPEC, camera=CameraSettings(Camera(fx=1701.0))).digest() != SPEC.digest()


def test_the_digest_does_not_depend_on_how_the_values_were_written() -> None:
    listed = replace(SPEC, drop_counts=list(SPEC.drop_counts), drop=DropSettings(friction=[0.2, 0.6]))  # type: ignore[arg-type]
    assert listed.digest() == SPEC.digest()
    assert json.loads(json.dumps(SPEC.as_dict())) == SPEC.as_dict()


def test_a_set_that_keeps_all_has_the_digest_of_before_it_could_keep_less() -> None:
    assert SPEC.digest() == "50102b90a47fad025f336c451a6ea8689085edcc65b97c97175dc6cb83442d1b"  # of commit 83d427a


def test_what_came_later_changes_a_digest_only_where_it_is_used() -> None:
    later = [replace(SPEC, bin=BinSettings(walls=Walls())), replace(SPEC, drop=DropSettings(area=(0.1, 0.1)))]
    assert len({spec.digest() for spec in (SPEC, *later)}) == 3
    assert "walls" not in SPEC.as_dict()["bin"]
    assert later[0].as_dict()["bin"]["walls"]["radius"] == Walls().radius
    assert replace(SPEC, bin=BinSettings(walls=Walls(radius=0.02))).digest() != later[0].digest()


def test_cycles_in_turn_keep_all_counts_between_them() -> None:
    counts = SPEC.drop_counts
    thin = replace(SPEC, keep_every=3)
    assert [thin.counts_of(cycle) for cycle in (0, 1, 2)] == [counts[0::3], counts[1::3], counts[2::3]]
    assert thin.counts_of(7) == thin.counts_of(1)
    assert thin.scenes == 3 * len(counts) + 5  # cycles 0 to 8, and cycle 9 as cycle 0
    assert sorted(thin.counts_of(0) + thin.counts_of(1) + thin.counts_of(2)) == list(counts)
    few = replace(SPEC, drop_counts=(2, 5), keep_every=3)
    assert [few.counts_of(cycle) for cycle in (0, 1, 2)] == [(2,), (5,), (2,)]  # at least one
    assert (SPEC.counts_of(4), SPEC.scenes) == (counts, 130)


def test_a_cycle_ends_at_its_share_of_the_drops() -> None:
    low = replace(SPEC, pile_share=0.43)
    assert low.counts_of(3) == (6, 8, 10, 12)
    assert low.scenes == 40
    assert [replace(low, keep_every=3).counts_of(cycle) for cycle in (0, 1, 2)] == [(6, 12), (8,), (10,)]
    assert replace(SPEC, pile_share=0.4).counts_of(0)[-1] == 12  # 12 of 30 drops
    assert replace(SPEC, pile_share=0.1).counts_of(0) == (6,)  # at least one


def test_cycles_of_all_splits_have_their_own_seeds() -> None:
    words = {
        tuple(replace(SPEC, split=split, seed=seed).cycle_seed(cycle).generate_state(4))
        for split in ("train", "val", "test")
        for seed in (0, 1)
        for cycle in range(50)
    }
    assert len(words) == 300
    # More cycles are the same cycles and some more.
    longer = replace(SPEC, cycles=99)
    assert list(longer.cycle_seed(3).generate_state(4)) == list(SPEC.cycle_seed(3).generate_state(4))


def test_the_directory_names_part_split_and_digest() -> None:
    assert scene_set_directory(Path("d"), "gear", SPEC) == Path("d/gear") / f"train-{SPEC.digest()[:12]}"


def test_specifications_of_the_splits_from_plain_settings(bracket: Part) -> None:
    settings = {
        "seed": 3,
        "cycles": {"train": 5, "test": 2},
        "drop_counts": [2, 4],
        "bin": {"size": None, "jitter": 0.1},
        "camera": {"camera": {"width": 640, "height": 480}, "distance": 0.5},
        "drop": {"friction": [0.3, 0.3]},
        "visibility_stride": 4,
        "keep_every": {"test": 2},
        "pile_share": {"train": 0.75},
    }
    specs = scene_set_specs(bracket, read(SimulationSettings, settings))
    assert specs["test"] == SceneSetSpec(
        bracket.digest, "test", 2, 3, (2, 4), BinSettings(None, 0.1), CameraSettings(Camera(640, 480), 0.5),
        DropSettings(friction=(0.3, 0.3)), 4, keep_every=2,
    )  # fmt: skip
    assert (specs["train"].cycles, specs["train"].keep_every, set(specs)) == (5, 1, {"train", "test"})
    assert (specs["train"].pile_share, specs["train"].counts_of(0)) == (0.75, (2,))
    assert settings["seed"] == 3
    assert settings["camera"]["camera"] == {"width": 640, "height": 480}  # type: ignore[index]
    with pytest.raises(SettingError, match=r"^there is no setting 'dorp', did you mean 'drop'"):
        read(SimulationSettings, settings | {"dorp": 1})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"split": "a/b"}, "split must be a word of letters, digits, - and _, got 'a/b'"),
        ({"split": ""}, "split must be a word"),
        ({"cycles": 0}, "cycles must be at least 1, got 0"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"drop_counts": ()}, "drop_counts must be increasing numbers within 1..200, got []"),
        ({"drop_counts": (5, 5)}, "drop_counts must be increasing numbers within 1..200, got"),
        ({"drop_counts": (0, 5)}, "drop_counts must be increasing numbers within 1..200, got"),
        ({"visibility_stride": 9}, "visibility_stride must lie in 1..8, got 9"),
        ({"keep_every": 0}, "keep_every must be at least 1, got 0"),
        ({"pile_share": 0.0}, "pile_share must be above 0 and at most 1, got 0.0"),
    ],
)
def test_impossible_specifications(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("[]", r"\[\]")):
        replace(SPEC, **change)
