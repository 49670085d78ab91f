"""Write the image's requirement files: exact versions and the sha256 of the one file that pip picks for each.

    .venv/bin/python docker/lock.py

Run it on the platform of the image (Linux x86-64, Python 3.11) after a change of the dependencies in pyproject.toml
or of constraints.txt. What is asked for comes from pyproject.toml, the versions from constraints.txt, the files from
whatever index pip is configured with; no address is written. tests/docker/test_lock.py holds that the files agree.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEADER = "# {subject}. Written by docker/lock.py; do not edit.\n"


def wanted() -> dict[str, tuple[str, list[str]]]:
    """Subject and direct requirements of each file, by its name beside this script."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    tracking = [*(line for line in extras["train"] if line.startswith("mlflow")), *extras["team"]]
    return {
        "requirements.txt": ("What the cell's server needs, closed", project["project"]["dependencies"]),
        "requirements-build.txt": ("What builds the project's wheel", project["build-system"]["requires"]),
        "requirements-mlflow.txt": ("What the MLflow server needs, closed", tracking),
    }


def locked(requirements: list[str]) -> list[str]:
    """A ``name==version --hash=sha256:...`` line for every package that pip would install, sorted by name.

    Raises:
        subprocess.CalledProcessError: when pip finds no solution; its own words are on stderr.
    """
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--dry-run"]
    pip += ["--ignore-installed", "--only-binary", ":all:", "--report", "-", "-c", str(ROOT / "constraints.txt")]
    done = subprocess.run([*pip, *requirements], stdout=subprocess.PIPE, text=True, check=True)
    lines = []
    for entry in json.loads(done.stdout)["install"]:
        digest = entry["download_info"]["archive_info"]["hashes"]["sha256"]
        lines.append(f"{entry['metadata']['name']}=={entry['metadata']['version']} --hash=sha256:{digest}")
    return sorted(lines, key=str.lower)


def main() -> None:
    """Write the three files beside this script."""
    for name, (subject, requirements) in wanted().items():
        text = HEADER.format(subject=subject) + "\n".join(locked(requirements)) + "\n"
        (ROOT / "docker" / name).write_text(text, encoding="utf-8")
        print(f"docker/{name}: {text.count('--hash')} packages")


if __name__ == "__main__":
    main()
