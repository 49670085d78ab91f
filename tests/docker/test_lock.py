"""The image's requirement files: closed, pinned as everywhere else, each line with the hash of its file."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LINE = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)==(?P<version>[A-Za-z0-9.!+]+) --hash=sha256:[0-9a-f]{64}")
SERVING = PROJECT["project"]["dependencies"]
EXTRAS = PROJECT["project"]["optional-dependencies"]
TRACKING = [*(r for r in EXTRAS["train"] if r.startswith("mlflow")), *EXTRAS["team"]]
RENEW = "run `.venv/bin/python docker/lock.py`"


def locked(file: str) -> dict[str, str]:
    """Versions by canonical name; every line must be a pin with its hash."""
    pins = {}
    for line in (ROOT / "docker" / file).read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            match = LINE.fullmatch(line)
            assert match, f"docker/{file}: {line}"
            pins[canonicalize_name(match["name"])] = match["version"]
    return pins


def constraints() -> dict[str, str]:
    """Versions of constraints.txt by canonical name."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.partition("==") for line in lines if not line.startswith("#"))
    return {canonicalize_name(name): version for name, _, version in pairs}


def closure(requirements: list[str]) -> set[str]:
    """Everything that requirements need in turn, by the metadata of what is installed here."""
    found: set[str] = set()
    waiting = [Requirement(line) for line in requirements]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in found:
            continue
        found.add(name)
        for line in metadata.requires(name) or ():
            inner = Requirement(line)
            extras = requirement.extras or {""}
            if inner.marker is None or any(inner.marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(inner)
    return found


@pytest.mark.parametrize(
    ("file", "requirements"), [("requirements.txt", SERVING), ("requirements-mlflow.txt", TRACKING)]
)
def test_the_set_is_closed_and_pinned_like_the_rest(file: str, requirements: list[str]) -> None:
    pins, exact = locked(file), constraints()
    assert set(pins) == closure(requirements), RENEW
    assert pins == {name: exact[name] for name in pins}, RENEW


def test_what_builds_the_wheel_is_pinned() -> None:
    (requirement,) = (Requirement(line) for line in PROJECT["build-system"]["requires"])
    ((name, version),) = locked("requirements-build.txt").items()
    assert name == requirement.name
    assert requirement.specifier.contains(version), RENEW


def test_the_cell_gets_no_training_stack() -> None:
    assert not {"torch", "lightning", "mlflow", "hydra-core", "omegaconf", "trimesh", "onnx"} & set(
        locked("requirements.txt")
    )
