"""Parts by configuration: built-ins, files, and the sentences when something is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
from attentionvote.cad.mesh_file import write_surface
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.section import Target
from attentionvote.simulation.part_files import load_part, load_parts

FROM_DATASETS = {"bunny": 0.234355236, "tless_20": 0.107, "tless_22": 0.108, "tless_29": 0.135}


def configured(repository: Path, name: str) -> Target:
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        return Target.of(OmegaConf.to_container(compose(f"object/{name}").object, resolve=True))


@pytest.mark.parametrize("name", BUILTIN_PARTS)
def test_the_configuration_of_a_builtin_says_what_the_catalogue_says(repository: Path, name: str) -> None:
    part = configured(repository, name)()
    assert (part.name, part.title) == (name, BUILTIN_PARTS[name].title)
    assert part.diameter == BUILTIN_PARTS[name].diameter
    assert part.symmetry == BUILTIN_PARTS[name].symmetry
    assert part.digest == load_part("other", f"builtin:{name}").digest


@pytest.mark.parametrize(("name", "diameter"), FROM_DATASETS.items())
def test_a_dataset_part_without_its_mesh_says_where_it_belongs(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, diameter: float
) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_DATA", str(tmp_path))
    config = configured(repository, name)
    assert config.arguments["diameter"] == diameter
    pattern = rf"mesh of object '{name}', .*Siléane.*, must be at '{tmp_path}/meshes/\w+\.\w+', which does not exist"
    with pytest.raises(FileNotFoundError, match=pattern):
        config()


def test_a_file_gets_the_configured_diameter_and_symmetry(tmp_path: Path) -> None:
    vertices, faces = builtin_surface("brick")
    path = tmp_path / "block.ply"
    write_surface(vertices * 1000, faces, path)
    plain = load_part("block", str(path), units="mm")
    assert plain.diameter == pytest.approx(0.037, abs=1e-7)
    assert plain.symmetry == Symmetry()
    np.testing.assert_allclose(plain.vertices, vertices, atol=1e-8)
    settings = {"kind": "cyclic", "order": 2, "axis": [0, 0, 1]}
    part = load_part("block", str(path), 0.04, "mm", settings, "A block", base_radius=0.01, voxel_size=0.001)
    assert (part.diameter, part.symmetry, part.title) == (0.04, Symmetry("cyclic", order=2), "A block")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"symmetry": {"kind": "cyclik"}}, "symmetry kind must be one of .*, got 'cyclik'"),
        ({"symmetry": {"kind": "cyclic", "ordr": 2}}, "symmetry must only have the keys .*order.*, got 'ordr'"),
        ({"diameter": -1.0}, "diameter must be positive metres .*, got -1"),
        ({"base_radius": float("nan")}, "base_radius must be positive metres .*, got nan"),
        ({"voxel_size": 0.0}, "voxel_size must be positive metres .*, got 0.0"),
    ],
)
def test_impossible_settings_are_one_sentence(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_part("gear", "builtin:gear", **settings)


@pytest.fixture
def block(tmp_path: Path) -> Path:
    mesh = trimesh.creation.box([0.1, 0.06, 0.02])
    write_surface(np.array(mesh.vertices), np.array(mesh.faces), tmp_path / "block.ply")
    return tmp_path / "block.ply"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"symmetry": {"kind": "cyclic", "order": 4}},
            "symmetry must leave the surface in place, but cyclic of",
        ),
        ({"symmetry": {"kind": "cyclic", "order": "two"}}, "must have a whole order of at least 2, got 'two'"),
        ({"symmetry": {"kind": "cyclic", "order": 2, "axis": "0 0 1"}}, r"as in \[0, 0, 1\]; got '0 0 1'"),
        ({"symmetry": {"kind": "revolution", "flip": "no"}}, "symmetry flip must be true or false, got 'no'"),
        (
            {"diameter": 1.183},
            "diameter must be the size of its mesh, in metres, got 1.183 .*: 0.118322 is right",
        ),
        ({"near_symmetric": "a half turn"}, "near_symmetric must be as `make part` writes it, got 'a half turn'"),
        ({"mirror_image": 0.5}, "mirror_image must be as `make part` writes it, got 0.5"),
    ],
)
def test_what_a_person_edits_is_checked_against_the_mesh(block: Path, settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^thing: .*{message}"):
        load_part("thing", str(block), **settings)


@pytest.mark.usefixtures("block")
def test_a_set_of_one_mesh_in_two_files_is_refused(tmp_path: Path) -> None:
    moved = trimesh.creation.box([0.1, 0.06, 0.02])
    moved.apply_translation([0.001, 0, 0])
    write_surface(np.array(moved.vertices), np.array(moved.faces), tmp_path / "moved.ply")
    parts = {name: {"name": name, "mesh": str(tmp_path / f"{name}.ply")} for name in ("block", "moved")}
    with pytest.raises(ValueError, match="two: the parts of a set must differ in shape, but block and moved are one"):
        load_parts("two", parts)
