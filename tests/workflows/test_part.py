"""The verb part: a file becomes a configured object, or one sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import part
import pytest
import trimesh
from omegaconf import OmegaConf
from surface_symmetry import symmetry_residual

from attentionvote.command.conf_folder import CONF
from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.section import Target
from attentionvote.workflows.settings import PartSettings


@pytest.fixture(scope="module")
def mesh_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A step wedge in millimetres, away from its file's origin: C2 about its upright axis."""
    boxes = [trimesh.creation.box([60, 30, 10]), trimesh.creation.box(bounds=[[-20, -10, 0], [20, 10, 15]])]
    solid = trimesh.boolean.union(boxes)
    solid.apply_translation([200, 50, 7])
    path = tmp_path_factory.mktemp("cad") / "Step wedge.stl"
    solid.export(path)
    return path


def run(mesh: Path, folder: Path, *words: str) -> dict:
    places = [f"parts={folder}/parts", f"objects={folder}/object"]
    return part.run(compose(PartSettings, [f"mesh='{mesh}'", *places, *words]))


def test_a_file_becomes_an_object_that_loads(mesh_file: Path, tmp_path: Path) -> None:
    result = run(mesh_file, tmp_path, "name=step_wedge", "units=mm")
    assert json.loads(json.dumps(result, default=lambda v: v.tolist()))["stage"] == "part"
    assert sorted(p.name for p in (tmp_path / "parts").iterdir()) == ["step_wedge.ply", "step_wedge.png"]
    assert [p.name for p in (tmp_path / "object").iterdir()] == ["step_wedge.yaml"]
    loaded = Target.of(OmegaConf.to_container(OmegaConf.load(tmp_path / "object" / "step_wedge.yaml")))()
    assert (loaded.name, loaded.title) == ("step_wedge", "Step wedge")
    assert loaded.diameter == result["diameter"] == pytest.approx(0.001 * np.linalg.norm([50, 25, 20]), rel=0.2)
    assert loaded.symmetry == Symmetry("cyclic", order=2)
    assert symmetry_residual(loaded.vertices, loaded.faces, loaded.symmetry) < 1e-3 * loaded.diameter
    np.testing.assert_allclose(result["covariance_root"], loaded.covariance_root, atol=1e-7)
    # Moved: the file's origin is outside of the part. part_from_file is what carries grasps over.
    assert result["moved"]
    original = trimesh.load_mesh(mesh_file)
    back = loaded.vertices - result["part_from_file"][:3, 3]
    back = back @ result["part_from_file"][:3, :3]
    assert trimesh.proximity.closest_point_naive(original, back[:50] * 1000)[1].max() < 1e-3


def test_the_configuration_explains_its_figures(mesh_file: Path, tmp_path: Path) -> None:
    run(mesh_file, tmp_path, "name=wedge", "units=mm", "title='A wedge: new'")
    text = (tmp_path / "object" / "wedge.yaml").read_text()
    for words in ("from Step wedge.stl in mm", "NOT the file's", "part_from_file", "Largest distance", "rejected"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 130
    builtin = OmegaConf.load(CONF / "object" / "gear.yaml")
    config = OmegaConf.load(tmp_path / "object" / "wedge.yaml")
    assert [key for key in config if key not in ("near_symmetric", "mirror_image")] == list(builtin)
    assert config.title == "A wedge: new"


def test_what_was_healed_is_in_the_result_and_in_the_configuration(tmp_path: Path) -> None:
    box = trimesh.creation.box([60, 30, 10])
    block = trimesh.creation.box([20, 10, 10], trimesh.transformations.translation_matrix([80, 0, 0]))
    triangles = np.concatenate([box.triangles[1:], block.triangles])
    trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(69).reshape(-1, 3), process=False).export(tmp_path / "two.stl")
    with pytest.raises(
        ConfigurationError, match=r"2 bodies 40 mm apart: an assembly\? BODY=1 \(60.0 x 30.0 x 10.0 mm\)"
    ):
        run(tmp_path / "two.stl", tmp_path, "name=plate", "units=mm")
    with pytest.raises(ConfigurationError, match=r"body must be a whole number at least 0"):
        run(tmp_path / "two.stl", tmp_path, "name=plate", "units=mm", "body=-1")
    assert [p.name for p in tmp_path.iterdir()] == ["two.stl"]
    result = run(tmp_path / "two.stl", tmp_path, "name=plate", "units=mm", "body=1")
    assert result["healed"] == "body 1 of 2; closed 1 hole (3 open edges)"
    assert result["surface_moved"] == 0
    text = (tmp_path / "object" / "plate.yaml").read_text()
    assert text.startswith(
        "# plate: made by `make part` from two.stl in mm: body 1 of 2; closed 1 hole (3 open edges).\n"
    )
    loaded = Target.of(OmegaConf.to_container(OmegaConf.load(tmp_path / "object" / "plate.yaml")))()
    assert trimesh.Trimesh(loaded.vertices, loaded.faces).volume == pytest.approx(60 * 30 * 10e-9, rel=1e-5)


def test_a_file_that_is_open_is_refused_with_a_picture_and_nothing_else(tmp_path: Path) -> None:
    rod = trimesh.creation.cylinder(10, 30)
    cup = rod.triangles[rod.face_normals[:, 2] < 0.5]
    trimesh.Trimesh(cup.reshape(-1, 3), np.arange(3 * len(cup)).reshape(-1, 3), process=False).export(
        tmp_path / "cup.stl"
    )
    with pytest.raises(ConfigurationError, match=r"got 32 open edges .*parts/cup-refused.png shows where; close it in"):
        run(tmp_path / "cup.stl", tmp_path, "name=cup", "units=mm")
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*")) == ["cup.stl", "parts/cup-refused.png"]


def test_a_part_has_a_cell(mesh_file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        chosen = run(mesh_file, tmp_path, "name=wedge", "units=mm", "bin=360x280x160", "distance=800", "sensor=phoxi_m")
    assert chosen["cell"] == {
        "sensor": "phoxi_m", "distance": 0.8, "bin": [0.36, 0.28, 0.16], "area": pytest.approx([0.174, 0.135], abs=0.01)
    }  # fmt: skip
    assert "pixels across, about" in caplog.text
    cell = OmegaConf.load(tmp_path / "object" / "wedge.yaml").cell
    assert (cell.sensor, cell.distance, cell.bin.walls.draft_degrees) == ("phoxi_m", 0.8, 2.0)
    # Larger than bins are, and nothing is said of its cell: as before.
    large = run(mesh_file, tmp_path, "name=large", "units=cm")
    assert (large["cell"], OmegaConf.load(tmp_path / "object" / "large.yaml").cell) == (None, None)
    assert "gets no cell" in caplog.text
    with pytest.raises(ConfigurationError, match="bin must be given for a part of 678 mm"):
        run(mesh_file, tmp_path, "name=huge", "units=cm", "sensor=phoxi_l")
    default = run(mesh_file, tmp_path, "name=plain", "units=mm")
    assert default["cell"]["sensor"] in ("phoxi_s", "phoxi_m")


def test_a_part_too_small_for_its_sensor_is_said(
    mesh_file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # The file's millimetres read as tenths of them would be: 6 mm long.
    small = trimesh.load_mesh(mesh_file)
    small.apply_scale(0.1)
    small.export(tmp_path / "small.stl")
    run(tmp_path / "small.stl", tmp_path, "name=small", "units=mm", "sensor=realsense_d435")
    assert "AP at 5 % D will be near 0" in caplog.text
    assert "take phoxi_s at 442 mm" in caplog.text


def test_an_object_is_replaced_only_by_force(mesh_file: Path, tmp_path: Path) -> None:
    run(mesh_file, tmp_path, "name=wedge", "units=mm")
    config = tmp_path / "object" / "wedge.yaml"
    before = config.read_text()
    with pytest.raises(ConfigurationError, match=r"object 'wedge' exists already \(.*wedge.yaml\), add force=true"):
        run(mesh_file, tmp_path, "name=wedge", "units=cm")
    assert config.read_text() == before
    run(mesh_file, tmp_path, "name=wedge", "units=cm", "force=true")
    assert config.read_text() != before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["name=Step-Wedge"], "name must be small letters, .*; got 'Step-Wedge', e.g. name=step_wedge"),
        (["name=2nd"], "got '2nd', e.g. name=part_2nd"),
        ([], "name must be given, e.g. name=widget"),
        (["name=wedge"], r"between 1 mm and 5 m long, got 60 m with units=m; try units=mm \(0.06 m\)"),
        (["name=wedge", "units=feet"], "units must be one of m, cm, mm, inch"),
        (["name=wedge", "units=mm", "tolerance=0.5"], "tolerance must be greater than 0 and at most 0.05; got 0.5"),
        (["name=wedge", "mesh=nowhere.stl"], "mesh file 'nowhere.stl' does not exist"),
        (["name=wedge", "units=mm", "sensor=phoxi"], "sensor must be one of phoxi_s, phoxi_m, .*; got 'phoxi'"),
        (
            ["name=wedge", "units=mm", "sensor=phoxi_s", "distance=800"],
            "must lie within 384..520 mm, .* got 800: take 520",
        ),
        (["name=wedge", "units=mm", "bin=huge"], "bin must be inner length x width x height in mm, e.g. 360x280x160"),
        (["name=wedge", "units=mm", "sensor=custom", "camera=no.json"], "camera file 'no.json' does not exist"),
        (["name=wedge", "mesh=''"], "mesh must be given, e.g. mesh=widget.stl"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_written(
    mesh_file: Path, tmp_path: Path, words: list[str], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run(mesh_file, tmp_path, *words)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_nothing_half_written(
    mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from attentionvote.cad import part_picture

    def fails(_: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(part_picture, "write_picture", fails)
    with pytest.raises(KeyboardInterrupt):
        run(mesh_file, tmp_path, "name=wedge", "units=mm")
    assert [p.name for p in (tmp_path / "parts").iterdir()] == ["wedge.ply"]
    assert not (tmp_path / "object").exists()


def test_the_command_prints_one_json_line(mesh_file: Path, tmp_path: Path) -> None:
    words = ["name=wedge", "units=mm", f"mesh='{mesh_file}'", f"parts={tmp_path}/parts", f"objects={tmp_path}/object"]
    script = Path(part.__file__)
    done = subprocess.run([sys.executable, str(script), *words], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["symmetry"] == {"kind": "cyclic", "axis": [0.0, 0.0, 1.0], "order": 2}
    again = subprocess.run([sys.executable, str(script), *words], capture_output=True, text=True, cwd=tmp_path)
    assert (again.returncode, again.stdout) == (2, "")
    assert "exists already" in again.stderr
    assert "Traceback" not in again.stderr
