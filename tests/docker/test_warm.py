"""What is compiled while the image is built: all C code that a cell calls."""

from __future__ import annotations

import ast
from pathlib import Path


def test_every_c_file_of_the_package_is_compiled_beforehand(repository: Path) -> None:
    tree = ast.parse((repository / "docker" / "warm.py").read_text(encoding="utf-8"))
    (files,) = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "FILES"
    ]
    source = repository / "src"
    cell = [path for name in ("geometry", "inference") for path in (source / "attentionvote" / name).rglob("*.c")]
    assert set(files) == {(".".join(path.parent.relative_to(source).parts), path.name) for path in cell}
    assert ("attentionvote.inference.scans", "scan_bytes.c") in files
