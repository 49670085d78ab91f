"""Records of one cycle on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.scene_record import SceneRecord, load_records, save_records


def test_what_is_loaded_is_what_was_saved(scene_record: Callable[..., SceneRecord], tmp_path: Path) -> None:
    records = [replace(scene_record(count), cycle=3, scene_seed=2**63 - count) for count in (1, 4)]
    save_records(tmp_path / "a.npz", records)
    loaded = load_records(tmp_path / "a.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
    assert len(loaded) == 2
    for a, b in zip(records, loaded, strict=True):
        np.testing.assert_allclose(b.camera_from_part, a.camera_from_part, atol=1e-14)
        np.testing.assert_allclose(b.camera_from_bin, a.camera_from_bin, atol=1e-14)
        np.testing.assert_array_equal(b.visible_fraction, a.visible_fraction)
        np.testing.assert_array_equal(b.bin_size, a.bin_size)
        assert (b.cycle, b.drop_count, b.camera, b.friction, b.scene_seed) == (
            a.cycle, a.drop_count, a.camera, a.friction, a.scene_seed,
        )  # fmt: skip


def test_walls_are_kept_where_there_are_some(scene_record: Callable[..., SceneRecord], tmp_path: Path) -> None:
    walls = Walls(thickness=0.002, radius=0.02, draft_degrees=3)
    save_records(tmp_path / "a.npz", [replace(scene_record(count), walls=walls) for count in (1, 2)])
    save_records(tmp_path / "b.npz", [scene_record(1)])
    loaded = load_records(tmp_path / "a.npz")
    assert [record.walls for record in loaded] == [walls, walls]
    assert loaded[0].bin_surface.walls == walls
    assert [record.walls for record in load_records(tmp_path / "b.npz")] == [None]
    with np.load(tmp_path / "b.npz") as stored:
        assert "walls" not in stored.files  # what has none looks as it always did


def test_a_cycle_without_scenes(tmp_path: Path) -> None:
    save_records(tmp_path / "a.npz", [])
    assert load_records(tmp_path / "a.npz") == []


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 half an archive"])
def test_a_broken_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"a.npz must be a shard of a scene set, but it cannot be read"):
        load_records(tmp_path / "a.npz")
