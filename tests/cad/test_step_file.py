"""STEP files: exact surfaces in the file's own unit, one body of an assembly, and plain words without cascadio."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from attentionvote.cad.part_import import import_part
from attentionvote.cad.step_file import length_units

FILES = Path(__file__).resolve().parents[1] / "data" / "step"
BUSHING = np.pi * (25**2 * 6 + 14**2 * 24 - 10**2 * 30 - 3 * 2.5**2 * 6)  # mm^3
pytest.importorskip("cascadio")


@pytest.mark.parametrize("name", ["bushing_mm.step", "bushing_inch.stp"])
def test_a_bushing_is_true_to_its_cylinders(name: str) -> None:
    part = import_part(FILES / name)
    solid = trimesh.Trimesh(part.vertices, part.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(BUSHING * 1e-9, rel=2e-3)
    diameter = float(np.hypot(50, 0))
    # Every vertex of the flange's rim lies on its cylinder, and no edge cuts it by more than 0.02 % of D and a little.
    radius = np.hypot(*part.vertices[:, :2].T) * 1000
    assert radius.max() == pytest.approx(25, abs=1e-5)
    middles = part.vertices[solid.edges_unique].mean(axis=1)
    outer = np.hypot(*part.vertices[solid.edges_unique][..., :2].T).T.min(axis=1) * 1000 > 25 - 1e-4
    assert (25 - np.hypot(*middles[outer][:, :2].T) * 1000).max() < 5e-4 * diameter
    assert part.line == f"{name}: nothing to heal"


def test_the_unit_is_the_files() -> None:
    assert import_part(FILES / "bushing_inch.stp", "inch").bodies == ["50.0 x 50.0 x 30.0 mm"]
    with pytest.raises(ValueError, match=r"left out for STEP file 'bushing_inch.stp', which is in inch; got mm"):
        import_part(FILES / "bushing_inch.stp", "mm")


@pytest.mark.parametrize(
    ("entity", "unit"),
    [
        ("( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) )", "mm"),
        ("(NAMED_UNIT(*)LENGTH_UNIT()SI_UNIT($,.METRE.))", "m"),
        ("( LENGTH_UNIT ( ) NAMED_UNIT ( * ) SI_UNIT ( .CENTI. , .METRE. ) )", "cm"),
        ("(CONVERSION_BASED_UNIT('INCHES',#7)\nLENGTH_UNIT()NAMED_UNIT(#8))", "inch"),
        ("(CONVERSION_BASED_UNIT('FOOT',#7) LENGTH_UNIT() NAMED_UNIT(#8))", "foot"),
    ],
)
def test_units_of_length_are_read_as_programs_write_them(entity: str, unit: str) -> None:
    # The millimetre of which an inch is made is no unit of the shape.
    text = (
        f"#3={entity};\n#9=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MICRO.,.METRE.));\n"
        "#5=( GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNIT_ASSIGNED_CONTEXT((#3,#4)) );"
    )
    assert length_units(text) == {unit}


def test_an_assembly_is_listed_and_one_body_picked() -> None:
    path = FILES / "assembly_mm.step"
    with pytest.raises(ValueError, match=r"2 bodies 40 mm apart: .* BODY=1 \(50.0 x 50.0 x 30.0 mm\) or BODY=2 \(60.0"):
        import_part(path)
    part = import_part(path, body=2)
    assert trimesh.Trimesh(part.vertices, part.faces).volume == pytest.approx(12e-6, rel=1e-6)
    assert part.line == "assembly_mm.step: body 2 of 2"
    # A body is cut as finely as if it were alone.
    assert len(import_part(path, body=1).faces) == pytest.approx(
        len(import_part(FILES / "bushing_mm.step").faces), rel=0.2
    )


def test_rubbish_is_refused(tmp_path: Path) -> None:
    (tmp_path / "part.step").write_text("no STEP at all")
    with pytest.raises(ValueError, match=r"'part.step' could not be read as STEP: it holds no shapes"):
        import_part(tmp_path / "part.step")


def test_without_cascadio_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    with pytest.raises(ValueError, match=r"needs cascadio: run `make setup`, or pip install 'attentionvote\[cad\]'"):
        import_part(FILES / "bushing_mm.step")
