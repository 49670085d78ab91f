"""The image's command without an image: in a fresh environment that holds docker/requirements.txt and nothing else.

It proves that the dependencies are closed, and it is what is left where no image can be built.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import attentionvote

if TYPE_CHECKING:
    from conftest import Cell

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def run(*command: str | Path, cwd: Path | None = None) -> str:
    """The output of a command that must succeed."""
    done = subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory, wheels: Path) -> Path:
    """A virtual environment with the locked packages and the wheel of `python -m build`."""
    folder = tmp_path_factory.mktemp("serving")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    target = folder / "environment"
    run(sys.executable, "-m", "venv", "--without-pip", target)
    pip = [sys.executable, "-m", "pip", "--python", str(target / "bin" / "python"), "--disable-pip-version-check"]
    offline = ("--quiet", "--no-compile", "--no-index", "--find-links", wheels, "--no-deps")
    run(*pip, "install", *offline, "--require-hashes", "-r", ROOT / "docker" / "requirements.txt")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder / "wheel", source)
    (wheel,) = (folder / "wheel").glob(f"attentionvote-{attentionvote.__version__}-*.whl")
    run(*pip, "install", *offline, wheel)
    assert "No broken requirements found." in run(*pip, "check")
    return target


def test_the_containers_command_answers_without_the_training_stack(
    environment: Path, cell: Cell, stages: dict[str, Any], tmp_path: Path, free_port: int
) -> None:
    image = stages["inference"]
    moved = {"/bundles": cell.bundles, "/run/secrets": cell.secrets, "/state": tmp_path / "state"}
    words = [*image["ENTRYPOINT"], *image["CMD"]]
    for before, after in moved.items():
        assert any(word.startswith(before) for word in words), before
        words = [word.replace(before, str(after)) if word.startswith(before) else word for word in words]
    words = [str(free_port) if word == "8000" else "127.0.0.1" if word == "0.0.0.0" else word for word in words]
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL", "ATTENTIONVOTE"))}
    clean |= {"PATH": f"{environment / 'bin'}:{os.environ['PATH']}", "HOME": str(tmp_path / "home")}
    clean["TMPDIR"] = str(tmp_path / "tmp")
    for name in ("home", "tmp"):
        (tmp_path / name).mkdir()

    def healthy() -> int:
        return subprocess.run(
            image["HEALTHCHECK"], env=clean, cwd=tmp_path, capture_output=True, check=False
        ).returncode

    assert healthy() == 1
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen(words, env=clean, cwd=tmp_path, stdout=log, stderr=log)
    try:
        cell.wait_ready(free_port, lambda: server.poll() is None)
        cell.check_answers(free_port)
        assert healthy() == 0
    finally:
        server.terminate()
        assert server.wait(30) == 0, (tmp_path / "log").read_text(encoding="utf-8")
    assert not list((tmp_path / "home").iterdir()), "something was written below the home folder"
    assert list((tmp_path / "state").iterdir()), "the bundle was not kept for the next start"


def test_the_environment_is_what_it_says(environment: Path) -> None:
    locked = (ROOT / "docker" / "requirements.txt").read_text(encoding="utf-8").count("--hash")
    folder = next((environment / "lib").glob("python3*/site-packages"))
    assert len(list(folder.glob("*.dist-info"))) == locked + 1
    absent = "import importlib.util as u; print([n for n in ('torch', 'mlflow', 'onnx', 'pip') if u.find_spec(n)])"
    assert run(environment / "bin" / "python", "-c", absent).strip() == "[]"
