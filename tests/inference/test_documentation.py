"""The operator's pages on the cell: by the command, and in a wheel that is installed without the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from attentionvote.inference.command_line import main

PAGES = ("container", "operating-a-cell", "several-parts")


def test_the_pages_are_listed_and_printed(repository: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["docs"])
    assert left.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(PAGES)
    assert lines[1].split("  ")[-1].strip() == "Operating a cell"
    for name in PAGES:
        with pytest.raises(SystemExit):
            main(["docs", name])
        assert capsys.readouterr().out == (repository / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_another_page_is_refused_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["docs", "contaner"])
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert said == (
        f"attentionvote: the page must be one of {', '.join(PAGES)}, got 'contaner', did you mean 'container'?\n"
    )


def test_the_pages_lie_in_git_once(repository: Path) -> None:
    folder = repository / "src" / "attentionvote" / "inference" / "pages"
    for page in folder.iterdir():
        assert page.is_symlink(), page
        assert page.resolve() == repository / "docs" / page.name


def run(*command: str | Path, cwd: Path) -> str:
    """The output of a command that must succeed, without this process' ways to find the sources."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run([*map(str, command)], cwd=cwd, env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_wheel_brings_them_with_version_and_licence(repository: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(repository / name, source)
    pages = [f"docs/{name}.md" for name in PAGES]
    (source / "docs").mkdir()
    for page in pages:
        shutil.copy(repository / page, source / page)
    unwanted = shutil.ignore_patterns("*.egg-info", "__pycache__")
    shutil.copytree(repository / "src", source / "src", symlinks=True, ignore=unwanted)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    wheel = ["wheel", "-q", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path / "wheel")]
    run(*pip, *wheel, source, cwd=tmp_path)
    (file,) = (tmp_path / "wheel").iterdir()
    shutil.rmtree(source)
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "cell", cwd=tmp_path)
    python, program = tmp_path / "cell" / "bin" / "python", tmp_path / "cell" / "bin" / "attentionvote"
    run(*pip, "--python", python, "install", "-q", "--no-index", "--no-deps", file, cwd=tmp_path)
    for page in pages:
        text = run(program, "docs", Path(page).stem, cwd=tmp_path)
        assert text == (repository / page).read_text(encoding="utf-8")
    assert run(program, "--version", cwd=tmp_path).startswith("attentionvote ")
    question = "import importlib.metadata as m; print(m.metadata('attentionvote')['License-Expression'])"
    assert run(python, "-c", question, cwd=tmp_path) == "Apache-2.0\n"
