"""What a new user meets before Python runs: the Makefile's help, its checks and its stamp."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with nothing but what set-up looks at."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def program(folder: Path, name: str, text: str) -> Path:
    """An executable shell script."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def make(folder: Path, *words: str, first_on_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Make in ``folder``, without what an outer make has put into the environment."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS", "PYTHON"))}
    if first_on_path:
        environment["PATH"] = f"{first_on_path}:{environment['PATH']}"
    return subprocess.run(
        ["make", *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def test_help_is_the_default_and_names_every_target(checkout: Path) -> None:
    done = make(checkout)
    assert done.returncode == 0
    for target in (
        "setup",
        "train",
        "smoke",
        "export",
        "serve",
        "keys",
        "bench-serve",
        "image",
        "generate",
        "view",
        "part",
        "ui",
        "test",
        "test-fast",
        "lint",
        "clean",
    ):
        assert f"\n  {target} " in done.stdout, target


def test_another_python_is_named_in_one_sentence(checkout: Path) -> None:
    old = program(checkout / "bin", "python3.9", 'case "$1" in --version) echo "Python 3.9.2";; *) exit 1;; esac')
    done = make(checkout, "setup", f"PYTHON={old}")
    assert done.returncode == 2
    assert done.stderr.startswith("setup: Python 3.11 is needed, found Python 3.9.2; install it (Debian: python3.11)")
    assert not (checkout / ".venv").exists()


def test_a_missing_compiler_is_named_with_its_package(checkout: Path) -> None:
    program(checkout / "bin", "cc", "exit 127")
    python = program(checkout / "bin", "python3.11", "exit 0")
    done = make(checkout, "setup", f"PYTHON={python}", first_on_path=checkout / "bin")
    assert done.returncode == 2
    assert "a C compiler with headers (cc) is missing; install it (Debian: gcc libc6-dev)" in done.stderr


@pytest.mark.parametrize(
    ("library", "sentence"),
    [
        ("libstdc++", "the library libstdc++.so.6 is missing; install it (Debian: libstdc++6)"),
        ("libusb", "the library libusb-1.0.so.0, which Open3D loads, is missing; install it (Debian: libusb-1.0-0)"),
    ],
)
def test_a_missing_library_is_named_with_its_package(checkout: Path, library: str, sentence: str) -> None:
    program(checkout / "bin", "cc", "exit 0")
    python = program(checkout / "bin", "python3.11", f'case "$*" in *{library}*) exit 1 ;; *) exit 0 ;; esac')
    done = make(checkout, "setup", f"PYTHON={python}", first_on_path=checkout / "bin")
    assert done.returncode != 0
    assert sentence in done.stderr


def test_a_failed_installation_leaves_no_stamp_and_says_so(checkout: Path) -> None:
    program(checkout / "bin", "cc", "exit 0")
    python = program(checkout / "bin", "python3.11", "exit 0")
    program(checkout / ".venv", "unused", "exit 0")
    program(checkout / ".venv" / "bin", "python", "echo 'no network' >&2; exit 1")
    done = make(checkout, "setup", f"PYTHON={python}", first_on_path=checkout / "bin")
    assert done.returncode == 2
    assert "no network" in done.stderr
    assert "setup: the installation failed" in done.stderr
    assert not (checkout / ".venv" / ".setup-complete").exists()


def test_setup_happens_once_and_again_when_the_pins_change(checkout: Path) -> None:
    program(checkout / "bin", "cc", "exit 0")
    python = program(checkout / "bin", "python3.11", "exit 0")
    program(checkout / ".venv", "unused", "exit 0")
    program(checkout / ".venv" / "bin", "python", 'echo "ran $*" >&2')
    first, second = (make(checkout, "setup", f"PYTHON={python}", first_on_path=checkout / "bin") for _ in range(2))
    assert "ran -m pip install" in first.stderr
    assert "-c constraints.txt -e .[train,cad,cluster,team,benchmark,dev]" in first.stderr
    assert "ran" not in second.stderr
    later = (checkout / ".venv" / ".setup-complete").stat().st_mtime + 10
    os.utime(checkout / "constraints.txt", (later, later))
    third = make(checkout, "setup", f"PYTHON={python}", first_on_path=checkout / "bin")
    assert "ran -m pip install" in third.stderr


def test_words_reach_the_verb(checkout: Path) -> None:
    done = make(checkout, "--dry-run", "train", "OBJECT=gear", "ARGS=trainer.max_epochs=2 seed=1")
    assert done.stdout.rstrip().endswith("pipelines/train.py object=gear trainer.max_epochs=2 seed=1")
    done = make(checkout, "--dry-run", "export", "OBJECT=gear", "RUN=70e1")
    assert done.stdout.rstrip().endswith("""pipelines/export.py object=gear "run='70e1'\"""")
    done = make(checkout, "--dry-run", "serve", "OBJECT=gear", "ARGS=--port 80")
    assert done.stdout.rstrip().endswith("attentionvote serve outputs/export/gear/latest --port 80")
    done = make(checkout, "serve")
    assert "OBJECT must be given, e.g. make serve OBJECT=connecting_rod" in done.stderr
    done = make(checkout, "--dry-run", "part", "NAME=bracket", "MESH=my meshes/b.stl", "UNITS=mm", "BODY=2")
    assert " ".join(done.stdout.replace("\\", " ").split()).endswith(
        """pipelines/part.py name=bracket "mesh='my meshes/b.stl'" units=mm body=2"""
    )
    done = make(
        checkout, "--dry-run", "part", "NAME=b", "MESH=b.step", "SENSOR=phoxi_m", "BIN=360x280x160", "DISTANCE=800"
    )
    assert " ".join(done.stdout.replace("\\", " ").split()).endswith(
        "sensor=phoxi_m \"bin='360x280x160'\" distance=800"
    )
