"""models_info.json: every kind of symmetry written and read, slightly wrong ones mended, ambiguous ones refused."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from attentionvote.datasets import bop_models
from attentionvote.datasets.bop_models import BopModel, read_diameters, read_models_info
from attentionvote.datasets.bop_writer import write_models
from attentionvote.geometry.pose import quaternion_from_matrix, rotation_about, rotation_angle, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part

CUBE = quaternion_from_matrix(Rotation.create_group("O").as_matrix()).tolist()
Z = {"axis": [0, 0, 1], "offset": [0, 0, 0]}


def entry_file(folder: Path, **entry: Any) -> Path:
    """A file with object 5, 100 mm large."""
    path = folder / "models_info.json"
    path.write_text(json.dumps({"5": {"diameter": 100, **entry}}))
    return path


def rows(rotations: np.ndarray, translations: object = (0, 0, 0)) -> list[list[float]]:
    """Sixteen numbers of each transform, as a file lists them."""
    return transform(rotations, translations).reshape(-1, 16).tolist()


def read(folder: Path, **entry: Any) -> BopModel:
    return read_models_info(entry_file(folder, **entry))[5]


def same_rotations(a: np.ndarray, b: np.ndarray, within: float) -> bool:
    apart = rotation_angle(a[:, None], b)
    return len(a) == len(b) and max(apart.min(0).max(), apart.min(1).max()) < within


@pytest.mark.parametrize(
    "symmetry",
    [
        Symmetry(),
        Symmetry("cyclic", (0, 1, 0), 4),
        Symmetry("cyclic", (0.6, 0, 0.8), 72),
        Symmetry("cyclic", (0, 0, 1), 1000),
        Symmetry("dihedral", (0, 0, 1), 2),
        Symmetry("dihedral", (0, 0, 1), 3, flip_axis=(1, 0, 0)),
        Symmetry("dihedral", (0, 0.6, 0.8), 144, flip_axis=(1, 0, 0)),
        Symmetry("group", quaternions=CUBE),
        Symmetry("revolution", (1, 0, 0)),
        Symmetry("revolution", (0, 0.6, 0.8), flip=True),
    ],
)
def test_what_is_written_is_read_back(
    tmp_path: Path, box: Part, symmetry: Symmetry, caplog: pytest.LogCaptureFixture
) -> None:
    write_models(tmp_path, {3: Part("part", box.vertices, box.faces, 0.08, symmetry)})
    model = read_models_info(tmp_path / "models_info.json")[3]
    np.testing.assert_allclose(model.diameter, np.sqrt(0.06**2 + 0.04**2 + 0.02**2))
    assert read_diameters(tmp_path / "models_info.json") == {3: model.diameter}
    assert not caplog.records
    assert np.abs(model.center).max() < 1e-12
    assert model.symmetry is not None
    assert (model.symmetry.kind, model.symmetry.order) == (symmetry.kind, symmetry.order)
    # As they stand in the file, to the last digit.
    np.testing.assert_array_equal(model.discrete[:, :3, :3], symmetry.rotations()[1:])
    if symmetry.is_revolution:
        np.testing.assert_allclose(model.symmetry.axis, symmetry.axis, atol=1e-12)
        assert model.symmetry.flip == symmetry.flip
        assert [axis.tolist() for axis, _ in model.continuous] == [list(symmetry.axis)]
    else:
        assert same_rotations(model.symmetry.rotations(), symmetry.rotations(), 1e-6)


def test_what_could_not_be_read_is_not_written(tmp_path: Path, box: Part) -> None:
    tiny = Part("part", box.vertices / 100, box.faces, 0.0008)
    with pytest.raises(ValueError, match=r"object 1 must have a diameter in millimetres, 1 to 10000, got 0\.748"):
        write_models(tmp_path, {1: tiny})
    fine = Part("part", box.vertices, box.faces, 0.08, Symmetry("cyclic", (0, 0, 1), 5000))
    with pytest.raises(ValueError, match="object 1 must have at most 4096 symmetries with the identity, got 5000"):
        write_models(tmp_path, {1: fine})


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["cyclic", "dihedral", "revolution", "flip"]),
    st.integers(2, 72),
    st.floats(0, 2),
    st.sampled_from([0.0, 0.4, 3.0]),
    st.integers(0, 2**31),
)
def test_symmetries_about_any_point_that_are_off_are_mended(
    tmp_path_factory: pytest.TempPathFactory, kind: str, order: int, degrees: float, reach: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    frame = Rotation.random(random_state=seed).as_matrix()
    if kind in ("cyclic", "dihedral"):
        symmetry = Symmetry(kind, (0, 0, 1), order)  # type: ignore[arg-type]
    else:
        symmetry = Symmetry("revolution", (0, 0, 1), flip=kind == "flip")
    group, axis = frame @ symmetry.rotations() @ frame.T, frame[:, 2]
    center = 100 * reach * rng.normal(size=3)
    direction = rng.normal(size=(len(group) - 1, 3))
    vector = np.radians(degrees) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # About its own centre each is off, whatever the translation is then.
    off = Rotation.from_rotvec(vector).as_matrix() @ group[1:] if len(group) > 1 else group[1:]
    entry: dict[str, Any] = {"symmetries_discrete": rows(off, center - off @ center)}
    if symmetry.is_revolution:
        along = center + 30 * rng.normal() * axis
        entry["symmetries_continuous"] = [{"axis": (3 * axis).tolist(), "offset": along.tolist()}]
    model = read(tmp_path_factory.mktemp("models"), **entry)
    assert model.symmetry is not None
    assert (model.symmetry.kind, model.symmetry.flip) == (symmetry.kind, symmetry.flip)
    within = 1e-7 + np.radians(1.3 * degrees)
    if symmetry.is_revolution:
        assert np.abs(np.asarray(model.symmetry.axis) - axis).max() < 1e-9
    else:
        assert same_rotations(model.symmetry.rotations(), group, within)
    # What is on the axis, or the point where all meet, is the centre.
    missed = 1000 * model.center - center
    missed -= 0 if kind in ("dihedral", "flip") else axis * (missed @ axis)
    assert np.linalg.norm(missed) < 1e-6 + 3 * within * (100 + np.linalg.norm(center))


@pytest.mark.parametrize(
    ("degrees", "said"),
    [(0.0, False), (0.0001, False), (0.9, True), (1.5, True)],
)
def test_a_half_turn_that_is_off_is_mended_with_one_sentence(
    tmp_path: Path, degrees: float, said: bool, caplog: pytest.LogCaptureFixture
) -> None:
    # LINEMOD's glue and eggbox.
    half = rotation_about((0.01, -0.02, 1), np.pi - np.radians(degrees))
    model = read(tmp_path, symmetries_discrete=rows(half[None], (0.2, 0.1, 0.006)))
    assert model.symmetry is not None
    assert (model.symmetry.kind, model.symmetry.order) == ("cyclic", 2)
    np.testing.assert_array_equal(model.discrete[0, :3, :3], half)
    sentence = (
        f"object 5: its symmetries are off by up to {degrees:.2g} degrees and 0.006 mm; the 2 rotations of the "
        "nearest group are taken, and only BOP's score goes by the file's own, as the toolkit does"
    )
    assert [r.getMessage().partition(": ")[2] for r in caplog.records] == ([sentence] if said else [])
    assert all(record.levelno == logging.WARNING for record in caplog.records)


def test_a_rounded_part_of_a_group_is_said_and_completed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sixth = [0.5, -0.866, 0, 0, 0.866, 0.5, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    model = read(tmp_path, symmetries_discrete=[sixth])
    assert model.symmetry == Symmetry("cyclic", (0, 0, 1), 6, flip_axis=model.symmetry.flip_axis)
    assert len(model.discrete) == 1  # the score's, as the toolkit's
    (record,) = caplog.records
    assert "off by up to 0.00073 degrees and 0 mm and listed without 4 of their products" in record.getMessage()


def test_what_changes_nothing_may_be_listed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    half = rotation_about((0, 0, 1), np.pi)
    turns = np.stack([np.eye(3), half, half])
    model = read(tmp_path, symmetries_discrete=rows(turns), symmetries_continuous=[])
    assert model.symmetry is not None
    assert (model.symmetry.order, len(model.discrete)) == (2, 3)
    nested = read(tmp_path, symmetries_discrete=transform(half, (0, 0, 0))[None].tolist())
    assert nested.symmetry == model.symmetry
    assert read(tmp_path, symmetries_discrete=[]).symmetry == Symmetry()
    both = read(tmp_path, symmetries_discrete=rows(turns), symmetries_continuous=[Z, Z])
    assert both.symmetry == Symmetry("revolution")
    assert not caplog.records


def test_a_ball_has_no_symmetry_of_ours_and_can_be_scored(tmp_path: Path) -> None:
    across = {"axis": [1, 0, 0], "offset": [0, 0, 0]}
    model = read(tmp_path, symmetries_continuous=[Z, across])
    assert model.symmetry is None
    assert len(model.continuous) == 2


MATRIX = np.eye(4)
MATRIX[:3, :3], MATRIX[:3, 3] = rotation_about((0, 0, 1), np.pi), (4, 6, 0)
TWICE = "got 'symmetries_discrete' 3 times"
WRONG = [
    ({"diameter": 0}, "object 5 must have a positive diameter in millimetres, got 0"),
    ({"diameter": 0.14}, "object 5 must have a diameter in millimetres, 1 to 10000, got 0.14: looks like metres"),
    ({"diameter": 140000}, "got 140000: looks like micrometres"),
    ({"diameter": "100"}, r"object 5: diameter must be a number within \+-1e9, got '100'"),
    ({"diameter": [100]}, r"object 5: diameter must be a number within \+-1e9, got \[100\]"),
    (
        {"symmetries_continuous": [{"axis": [1e10, 0, 0], "offset": [0] * 3}]},
        r"axis must be 3 numbers within .*, got \[1",
    ),
    ({"diameter": True}, r"object 5: diameter must be a number within \+-1e9, got True"),
    ({"diameter": 10**400}, r"object 5: diameter must be a number within \+-1e9, got 1000"),
    ({"diameter": float("nan")}, r"object 5: diameter must be a number within \+-1e9, got nan"),
    ({"size_x": float("inf")}, r"object 5: size_x must be a number within \+-1e9, got inf"),
    ({"min_x": None}, r"object 5: min_x must be a number within \+-1e9, got None"),
    ({"size_x": -3}, "a size_x, size_y and size_z of at least 0, got -3"),
    (
        {"size_x": 0.08, "size_y": 0.05, "size_z": 0.01},
        r"the longest side and the diagonal of its box, 0.08 and 0.0948683, got 100: are both in millimetres\?",
    ),
    ({"symmetries_discrete": [MATRIX[:3, :3].tolist()]}, r"row by row, 16 numbers within .*, got 9 numbers"),
    (
        {"symmetries_discrete": MATRIX.ravel().tolist()},
        "row by row, 16 numbers within .*, got 1 numbers",
    ),
    ({"symmetries_discrete": [["0"] * 16]}, r"row by row, 16 numbers within .*, got \['0', '0'"),
    ({"symmetries_discrete": None}, "object 5: symmetries_discrete must be a list, got None"),
    (
        {"symmetries_discrete": [MATRIX.T.tolist()]},
        r"row 0 0 0 1, got \[4.0, 6.0, 0.0, 1.0\]: looks like column by",
    ),
    ({"symmetries_discrete": [[2] * 16]}, r"the last row 0 0 0 1, got \[2.0, 2.0, 2.0, 2.0\]$"),
    (
        {"symmetries_discrete": [np.diag([-1, 1, 1, 1]).tolist()]},
        r"\[0\] must be a rotation .*, got a mirror image,",
    ),
    ({"symmetries_discrete": [np.diag([-2, -2, 2, 1]).tolist()]}, r"\[0\] must be a rotation .*, got one scaled by 2$"),
    ({"symmetries_discrete": [np.diag([1, 0, 0, 1]).tolist()]}, r"must be a rotation .*, got R R\^T off from I by 1$"),
    (
        {"symmetries_discrete": rows(Rotation.random(3, random_state=0).as_matrix())},
        "object 5 must have symmetries_discrete within 3 degrees of a group of rotations, all but the identity, got 3",
    ),
    ({"symmetries_discrete": rows(np.eye(3)[None], (20, 0, 0))}, "leave one point where it is, got .* by 20 mm"),
    ({"symmetries_discrete": rows(rotation_about((0, 0, 1), np.pi)[None], (0, 0, 30))}, "got .* by 30 mm"),
    (
        {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0] * 3}]},
        r"\[0\]: axis must have a direction, got",
    ),
    ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, r"continuous\[0\] must have offset, got only axis"),
    ({"symmetries_continuous": [[0, 0, 1]]}, r"continuous\[0\] must be a JSON object with axis and offset, got \[0, 0"),
    (
        {"symmetries_continuous": [Z, {"axis": [0, 0, 1], "offset": [0, 30, 0]}]},
        "axes that miss each other, .* 15 mm",
    ),
    (
        {"symmetries_continuous": [Z, {"axis": [0, 0.1, 1], "offset": [0] * 3}]},
        "a ball, at least 30 apart, got 5.7",
    ),
    (
        {"symmetries_continuous": [Z], "symmetries_discrete": rows(rotation_about((1, 0, 0), np.radians(110))[None])},
        "or turn it over, within 3 degrees, got one that turns it by 70.0",
    ),
    ({"symmetries_continuous": [Z] * 4097}, "at most 4096 symmetries with the identity, got 4097"),
    (
        {"symmetries_discret": []},
        "under symmetries_discrete and symmetries_continuous, got 'symmetries_discret'",
    ),
]


@pytest.mark.parametrize(("entry", "message"), WRONG)
def test_what_is_no_model_is_refused(tmp_path: Path, entry: dict[str, Any], message: str) -> None:
    path = entry_file(tmp_path, **entry)
    with pytest.raises(ValueError, match=message) as refused:
        read_models_info(path)
    assert str(refused.value).startswith(f"{path}: object 5")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"5": {"diameter": 100}, "5": {"diameter": 90}}', "every key once, got '5' 2 times"),
        ('{"5": {"diameter": 100, "symmetries_discrete": []' + ', "symmetries_discrete": []' * 2 + "}}", TWICE),
        ('{"1": {"diameter": 9}, "01": {"diameter": 9}}', "got '01': it is there beside '1', which is the same object"),
        ('{"01": {"diameter": 9}}', "an object id without leading zeros, got '01': write '1'"),
        ('{"\u0663": {"diameter": 9}}', "got '\u0663': write '3'"),
        ('{"obj_1": {"diameter": 9}}', "got 'obj_1': a model's entry belongs under its number"),
        ('{"-1": {"diameter": 9}}', "got '-1': a model's entry"),
        ('{"5": [100]}', r"object 5 must be a JSON object with its diameter, got \[100\]"),
        ('{"5": {}}', "object 5 must have diameter, got only nothing"),
        ('{"5": {"size_x": 1}}', "object 5 must have diameter, got only size_x"),
        ("[]", "the file must hold a JSON dict, got list"),
        ('{"5": {', "the file must be JSON, got Expecting"),
        ('{"5": ' * 100_000, "the file must be JSON, got maximum recursion depth"),
        ('{"5": {"diameter": ' + "9" * 5000 + "}}", "the file must be JSON, got Exceeds the limit"),
    ],
)
@pytest.mark.parametrize("reader", [read_models_info, read_diameters])
def test_a_file_that_says_two_things_or_none_is_refused(tmp_path: Path, reader: Any, text: str, message: str) -> None:
    path = tmp_path / "models_info.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as refused:
        reader(path)
    assert str(refused.value).startswith(f"{path}: ")


def test_a_huge_file_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = entry_file(tmp_path)
    monkeypatch.setattr(bop_models, "LARGEST_FILE", 10)
    with pytest.raises(ValueError, match=r"the file must have at most 10 bytes, got 24$"):
        read_models_info(path)


def test_a_meter_and_a_millimetre_are_parts(tmp_path: Path) -> None:
    for diameter in (1, 1200):
        assert read(tmp_path, diameter=diameter, size_x=0, size_y=0, size_z=diameter).diameter == diameter / 1000
