"""What is compiled while the image is built: all C code that a cell calls."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
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


def test_outside_of_an_image_the_c_code_is_compiled_and_no_bytecode(repository: Path, tmp_path: Path) -> None:
    """Bytecode that is never compared with its source would outlive an update of the system's Python."""
    environment = {**os.environ, "ATTENTIONVOTE_CACHE": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("PYTHONPYCACHEPREFIX", None)
    words = [sys.executable, str(repository / "docker" / "warm.py")]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    names = sorted(path.name.partition("-")[0] for path in tmp_path.iterdir())
    assert names == ["normals", "pointops", "scan_bytes"]
    # Another user than who compiled it reads it.
    assert all(path.stat().st_mode & 0o055 == 0o055 for path in tmp_path.iterdir())
