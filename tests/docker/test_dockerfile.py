"""What the Dockerfile promises, read off it: pins, user, environment, and files that exist."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
Stages = dict[str, dict[str, Any]]


def test_the_cell_is_the_default_and_nothing_of_the_base_stays_below_it(stages: Stages) -> None:
    assert list(stages)[-1] == "inference"
    assert stages["inference"]["FROM"] == "scratch"
    bases = {stage["FROM"] for stage in stages.values()} - {"scratch"} - set(stages)
    assert bases == {"${BASE}"}
    text = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
    assert "\nARG BASE=docker.io/library/python:3.11-slim-bookworm\n" in text


def test_every_download_is_checked_by_its_hash(stages: Stages) -> None:
    steps = [step for stage in stages.values() for run in stage["RUN"] for step in run.split("&&") if "pip" in step]
    installs = [step for step in steps if " install " in step and "apt-get" not in step]
    assert len(installs) == 4
    for step in installs:
        assert "--require-hashes --no-deps" in step or "--no-index --no-deps" in step, step


def test_the_cell_runs_as_nobody_and_says_nothing_to_anybody(stages: Stages) -> None:
    image = stages["inference"]
    assert image["USER"] == "65532:65532"
    wanted = {"ORT_DISABLE_TELEMETRY": "1", "PYTHONDONTWRITEBYTECODE": "1", "HOME": "/tmp"}
    assert wanted.items() <= image["ENV"].items()
    assert image["ENTRYPOINT"] == ["attentionvote"]
    # No address: one would be wrong with another port or with TLS.
    assert image["HEALTHCHECK"] == ["python", "-m", "attentionvote.inference.server.health"]
    assert stages["mlflow"]["ENV"]["MLFLOW_DISABLE_TELEMETRY"] == "true"


def test_what_is_copied_exists_and_passes_the_ignore_file(stages: Stages) -> None:
    lines = (ROOT / "docker" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    allowed = [line[1:] for line in lines if line.startswith("!")]
    copies = [step.split()[:-1] for stage in stages.values() for step in stage["COPY"] if "--from=" not in step]
    names = {name for copy in copies for name in copy}
    assert "src" in names
    pages = (ROOT / "src" / "attentionvote" / "inference" / "pages").iterdir()
    assert {f"docs/{page.name}" for page in pages} <= names
    for name in names:
        assert (ROOT / name).exists(), name
        assert any(fnmatch(name, rule) or name.startswith(f"{rule}/") for rule in allowed), name


def test_a_cells_token_reaches_neither_the_images_nor_git() -> None:
    """compose.yaml looks for it in docker/cell, which is below what the images may see."""
    assert "/cell/" in (ROOT / "docker" / ".gitignore").read_text(encoding="utf-8").splitlines()
    rules = (ROOT / "docker" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert rules.index("docker/cell") > rules.index("!docker")
