"""Figures are drawn, in the colours that carry their meaning, from ordinary and from empty inputs."""

import io

import numpy as np
import pytest
from PIL import Image

from attentionvote.drawing import figures
from attentionvote.drawing.scene_pictures import CORRECT, TRUTH, WRONG, Wireframe, scene_picture

BOX_VERTICES = np.array([[x, y, z] for x in (-0.07, 0.07) for y in (-0.02, 0.02) for z in (-0.01, 0.01)])
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def _pixels(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return np.asarray(Image.open(buffer).convert("RGB")).astype(int)


def _count(pixels, colour, tolerance=40):
    target = [int(colour[index : index + 2], 16) for index in (1, 3, 5)]
    return int((np.abs(pixels - target).max(axis=-1) < tolerance).sum())


def _poses(count, rng):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    poses[:, :3, :3] *= np.linalg.det(poses[:, :3, :3])[:, None, None]
    poses[:, :3, 3] = rng.uniform([-0.2, -0.15, 0.8], [0.2, 0.15, 0.9], (count, 3))
    return poses


def _scene(correct):
    rng = np.random.default_rng(0)
    poses = _poses(6, rng)
    centers = poses[:, :3, 3]
    points = np.repeat(centers, 50, axis=0) + rng.normal(0, 0.03, (300, 3))
    votes = np.repeat(centers, 10, axis=0) + rng.normal(0, 0.005, (60, 3))
    found = poses[: len(correct)].copy()
    found[:, 0, 3] += 0.01
    return scene_picture(
        points,
        votes,
        rng.random(60),
        centers,
        centers,
        found,
        correct,
        poses,
        [BOX_VERTICES],
        [BOX_FACES],
        title="scene 1",
    )  # fmt: skip


def test_scene_picture_shows_correct_poses_green_and_wrong_ones_red():
    good, bad = _pixels(_scene([True] * 4)), _pixels(_scene([False] * 4))
    assert good.shape[1] == 1600
    assert _count(good, CORRECT) > 1000 > 100 > _count(good, WRONG, 10)
    assert _count(bad, WRONG) > 1000 > 100 > _count(bad, CORRECT, 10)
    assert _count(good, TRUTH, 25) > 500


def test_scene_picture_of_an_empty_scene_is_a_picture():
    nothing = np.zeros((0, 3))
    none = np.zeros((0, 4, 4))
    figure = scene_picture(nothing, nothing, [], nothing, nothing, none, [], none, [BOX_VERTICES], [BOX_FACES])
    assert _pixels(figure).std() > 1


def test_scene_picture_rejects_flags_that_do_not_fit_the_poses():
    nothing = np.zeros((0, 3))
    with pytest.raises(ValueError, match="one value for each of the 2 poses, got 1"):
        scene_picture(
            nothing,
            nothing,
            [],
            nothing,
            nothing,
            np.eye(4)[None].repeat(2, 0),
            [True],
            [],
            [BOX_VERTICES],
            [BOX_FACES],
        )


def test_every_pose_is_drawn_with_the_mesh_of_its_own_part():
    nothing, pose = np.zeros((0, 3)), np.eye(4)[None]
    meshes = [BOX_VERTICES, 2 * BOX_VERTICES], [BOX_FACES, BOX_FACES]

    def extent(parts):
        figure = scene_picture(nothing, nothing, [], nothing, nothing, pose, [True], [], *meshes, parts)
        lines = np.concatenate(
            [s for c in figure.axes[2].collections if hasattr(c, "get_segments") for s in c.get_segments()]
        )
        return np.ptp(lines, axis=0)

    np.testing.assert_allclose(extent([1]), 2 * extent([0]))
    np.testing.assert_allclose(extent(None), extent([0]))
    with pytest.raises(ValueError, match=r"parts must have one value for each of the 1 poses, got shape \(2,\)"):
        extent([0, 1])


def test_wireframe_of_a_box_seen_along_an_axis_is_the_outline_of_its_face():
    pose = np.eye(4)
    pose[2, 3] = 1.0
    segments = Wireframe(BOX_VERTICES, BOX_FACES).segments(pose, "camera")
    assert len(segments) == 4  # no diagonals, no hidden edges
    np.testing.assert_allclose(np.abs(segments), np.broadcast_to([0.07, 0.02], segments.shape))
    side = Wireframe(BOX_VERTICES, BOX_FACES).segments(pose, "side")
    np.testing.assert_allclose(np.unique(side[..., 1]), [0.99, 1.01])


def test_wireframe_of_a_box_seen_at_a_corner_has_the_nine_visible_edges():
    axis = np.array([1.0, 1.0, 1.0]) / np.sqrt(3)
    other = np.cross(axis, [0, 0, 1]) / np.linalg.norm(np.cross(axis, [0, 0, 1]))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([other, np.cross(axis, other), axis])
    assert len(Wireframe(BOX_VERTICES, BOX_FACES).segments(pose, "camera")) == 9


def test_curves_are_drawn_in_the_colours_of_their_legend():
    steps = np.arange(0, 500, 5)
    losses = figures.loss_figure({"vote": (steps, np.exp(-steps / 100)), "center": (steps, 1 + 0 * steps)})
    pixels = _pixels(losses)
    assert pixels.shape[1] == 1600
    assert min(_count(pixels, figures.PALETTE[index]) for index in (0, 1)) > 300
    recall = np.linspace(0, 0.9, 50)
    curve = figures.precision_recall_figure({"10 % D": (recall, 1 - recall**4)}, {"10 % D": 0.9})
    assert _count(_pixels(curve), figures.PALETTE[0]) > 1000
    thresholds = np.linspace(0, 0.15, 16)
    area = figures.ap_threshold_figure(thresholds, {"val": thresholds / 0.15, "test": thresholds / 0.2})
    assert [text.get_text() for text in area.axes[0].texts[:3]] == ["0.133", "0.333", "0.667"]


def test_curves_take_nan_and_nothing():
    figures.loss_figure({"vote": ([], []), "center": ([1, 2], [float("nan"), 1.0])}).savefig(io.BytesIO())
    figures.precision_recall_figure({"10 % D": ([], [])}).savefig(io.BytesIO())
    figures.ap_threshold_figure([], {}).savefig(io.BytesIO())
    with pytest.raises(ValueError, match="at least one term"):
        figures.loss_figure({})


def test_smoothed_is_the_mean_of_the_last_finite_values():
    values = np.array([1.0, np.nan, 3.0, 5.0])
    expected = [np.nanmean(values[max(0, end - 2) : end]) for end in range(1, 5)]
    np.testing.assert_allclose(figures.smoothed(values, 2), expected)
    assert np.isnan(figures.smoothed([np.nan, 2.0], 1)[0])
