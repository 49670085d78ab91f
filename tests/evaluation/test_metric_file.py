"""``poseutils.json``: both types become the metric they describe, and what is wrong is one sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from attentionvote.evaluation import read_metric
from attentionvote.geometry.pose import inverse
from attentionvote.geometry.symmetry import Symmetry


def affine(**change) -> dict:
    return {"type": "AffinePoseUtils", "Lambda": np.diag([1.0, 2, 3]).tolist(), "G": [np.eye(3).tolist()],
            "distance_threshold": 0.02} | change  # fmt: skip


def revolution(**change) -> dict:
    return {"type": "RevolutionPoseUtils", "lambda": 0.3, "rotoreflection_symmetry": True,
            "distance_threshold": 0.015} | change  # fmt: skip


@pytest.fixture
def file(tmp_path):
    def write(content):
        path = tmp_path / "poseutils.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write


def test_a_finite_group_is_read(file):
    turns = Symmetry("cyclic", order=3).rotations()
    metric, threshold = read_metric(file(affine(G=turns.tolist(), Lambda=np.diag([1.0, 1, 3]).tolist())))
    assert threshold == 0.02
    np.testing.assert_allclose(metric.symmetry.rotations(), turns, atol=1e-12)
    np.testing.assert_array_equal(metric.covariance_root, np.diag([1.0, 1, 3]))
    assert read_metric(file(affine()))[0].symmetry == Symmetry()


def test_a_body_of_revolution_is_read(file):
    metric, threshold = read_metric(file(revolution()))
    assert (threshold, metric.symmetry) == (0.015, Symmetry("revolution", flip=True))
    assert metric.revolution_radius == pytest.approx(0.3, rel=1e-14)
    assert not read_metric(file(revolution(rotoreflection_symmetry=False)))[0].symmetry.flip


def test_the_object_frame_moves_the_reference_and_the_toolbox_frame_does_not(file, make_poses):
    rng = np.random.default_rng(4)
    reference_from_part = make_poses(rng, 1)[0]
    frame = {"Rref2i": reference_from_part[:3, :3].tolist(), "tref2i": reference_from_part[:3, 3:].tolist()}
    a, b = make_poses(rng, 3), make_poses(rng, 3)
    plain = read_metric(file(affine()))[0]
    framed = file(affine(**frame))
    np.testing.assert_array_equal(read_metric(framed)[0].distances(a, b), plain.distances(a, b))
    back = inverse(reference_from_part)
    moved = read_metric(framed, "object")[0]
    np.testing.assert_allclose(moved.distances(a, b), plain.distances(a @ back, b @ back), atol=1e-12)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("[", "the file must be JSON, got Expecting"),
        ("[]", "the file must hold an object with type, got list"),
        (affine(type="Cube"), "type must be AffinePoseUtils or RevolutionPoseUtils, got 'Cube'$"),
        (affine(type="affine_pose_utils"), r"got 'affine_pose_utils', did you mean 'AffinePoseUtils'\?"),
        (affine(type="Revolution"), r"got 'Revolution', did you mean 'RevolutionPoseUtils'\?"),
        (affine(Lambda=[1, 2, 3]), r"Lambda must be 3 x 3 finite numbers, got \[1, 2, 3\]"),
        (affine(G=[]), r"G must be n x 3 x 3 finite numbers, got \[\]"),
        (affine(G=[(-np.eye(3)).tolist()]), r"G\[0\] must be a rotation .* determinant -1"),
        (affine(G=Symmetry("cyclic", order=3).rotations()[:2].tolist()), "G must be a group: the product of two"),
        (affine(distance_threshold="wide"), "distance_threshold must be one number, got 'wide'"),
        (affine(distance_threshold=-1), "distance_threshold must be at least 0 metres, got -1"),
        (revolution(rotoreflection_symmetry="false"), "rotoreflection_symmetry must be true or false, got 'false'"),
        ({"type": "AffinePoseUtils", "lambda": 1}, r"Lambda must be given, got only lambda, did you mean 'lambda'\?"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(file, content, text):
    path = file(content)
    with pytest.raises(ValueError, match=text) as caught:
        read_metric(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_the_object_frame_must_be_in_the_file_and_known(file):
    with pytest.raises(ValueError, match="Rref2i must be given, got only Lambda, G, distance_threshold"):
        read_metric(file(affine()), "object")
    with pytest.raises(ValueError, match="frame must be one of toolbox, object, got 'part'"):
        read_metric(file(affine()), "part")
