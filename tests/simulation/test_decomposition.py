"""Convex pieces of a part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from attentionvote.part import Part
from attentionvote.simulation import decomposition
from attentionvote.simulation.decomposition import convex_hulls, volume_ratio


def test_pieces_of_a_bracket_are_its_two_boxes(bracket: Part, hull_cache: Path) -> None:
    hulls = convex_hulls(bracket)
    true_volume = 0.06 * 0.02 * 0.008 + 0.008 * 0.02 * 0.032
    assert sum(ConvexHull(h).volume for h in hulls) == pytest.approx(true_volume, rel=0.03)
    half_spaces = [ConvexHull(h).equations for h in hulls]
    points = bracket.surface_points(500, np.random.default_rng(0))
    outside = np.min([(points @ e[:, :3].T + e[:, 3]).max(axis=1) for e in half_spaces], axis=0)
    assert outside.max() < 0.01 * bracket.diameter
    assert (hull_cache / "hulls").is_dir()


def test_same_pieces_again_and_from_the_cache(
    bracket: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    first = convex_hulls(bracket, cache=tmp_path / "a")
    again = convex_hulls(bracket, cache=tmp_path / "b")
    monkeypatch.setattr(decomposition, "_decompose", lambda *_: pytest.fail("the cache was not used"))
    stored = convex_hulls(bracket, cache=tmp_path / "a")
    for hulls in (again, stored):
        assert len(hulls) == len(first)
        assert all(np.array_equal(x, y) for x, y in zip(first, hulls, strict=True))
    assert [p.suffix for p in (tmp_path / "a" / "hulls").iterdir()] == [".npz"]
    assert capfd.readouterr().out == ""


def test_other_settings_are_other_entries(bracket: Part, tmp_path: Path) -> None:
    convex_hulls(bracket, cache=tmp_path)
    convex_hulls(bracket, max_vertices=32, cache=tmp_path)
    assert len(list((tmp_path / "hulls").iterdir())) == 2


def test_pieces_do_not_depend_on_the_size(bracket: Part, tmp_path: Path) -> None:
    tiny = Part("tiny", bracket.vertices / 8, bracket.faces, bracket.diameter / 8)
    for a, b in zip(convex_hulls(bracket, cache=tmp_path), convex_hulls(tiny, cache=tmp_path), strict=True):
        np.testing.assert_allclose(a / 8, b, atol=1e-9)


def test_a_ring_is_split_until_its_pieces_leave_the_hole_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = trimesh.creation.annulus(0.040, 0.050, 0.008, sections=32)
    ring = Part("ring", np.array(mesh.vertices), np.array(mesh.faces), 0.1)
    coarse = convex_hulls(ring, threshold=0.4, cache=tmp_path)
    before = volume_ratio(ring, coarse)
    assert before > 1.2
    with caplog.at_level("INFO"):
        fine = convex_hulls(ring, threshold=0.4, cache=tmp_path, most_volume=1.1)
    assert volume_ratio(ring, fine) <= 1.1
    assert len(fine) > len(coarse)
    assert f"{before:.2f} times the part's volume, at most 1.1 are asked for" in caplog.text
    # Nothing at the centre: another ring's rim can lie there.
    assert min(ConvexHull(hull).equations[:, 3].max() for hull in fine) > 0.02


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threshold": 0.0}, r"hull threshold must lie in 0.01..1 \(coacd's range\), got 0.0"),
        ({"max_vertices": 4}, "hull vertices must lie in 8..256, got 4"),
    ],
)
def test_impossible_settings(bracket: Part, settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        convex_hulls(bracket, **settings)
