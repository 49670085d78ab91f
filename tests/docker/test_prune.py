"""What the image leaves out of its packages is nothing that the cell imports."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CELL = ("inference", "geometry", "contract.py", "part.py", "scene.py")


def removed() -> set[str]:
    """Dotted names of what prune.sh removes."""
    text = (ROOT / "docker" / "prune.sh").read_text(encoding="utf-8")
    names = {f"scipy.{name}" for name in re.search(r"for unused in (.*); do", text)[1].split()}  # type: ignore[index]
    return names | {path.replace("/", ".") for path in re.findall(r"onnxruntime/(?!capi)\w+", text)}


def imported() -> set[str]:
    """Dotted names of every module and name that the cell's side imports, wherever in a file."""
    places = [ROOT / "src" / "attentionvote" / name for name in CELL]
    files = [file for place in places for file in (place.rglob("*.py") if place.is_dir() else [place])]
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_the_cell_imports_nothing_that_is_removed() -> None:
    gone, wanted = removed(), imported()
    assert {"scipy.stats", "onnxruntime.tools"} <= gone
    assert {"scipy.spatial", "onnxruntime"} <= wanted
    assert not {name for name in wanted for other in gone if name == other or name.startswith(f"{other}.")}
