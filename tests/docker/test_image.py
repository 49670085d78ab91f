"""The real image, built without any image registry (tests/fixtures/cell_image.py).

Where this cannot be done the tests say why, and test_serving_environment.py is what is left.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from cell_image import NAME, CannotBuildError, Tools, build_image, find_tools

import attentionvote

if TYPE_CHECKING:
    from conftest import Cell

USER = 65532
MOST_BYTES = 300 * 10**6
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def tools() -> Tools:
    """The tools, or a skip that says what is missing."""
    try:
        return find_tools()
    except CannotBuildError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def image(tools: Tools) -> dict[str, Any]:
    """The built image's configuration."""
    try:
        build_image(tools)
    except CannotBuildError as error:
        pytest.skip(str(error))
    return dict(json.loads(tools.run("buildah", "inspect", "--type", "image", NAME))["Docker"]["config"])


@dataclass(frozen=True)
class Container:
    """A container that runs nothing yet.

    Attributes:
        name: for buildah.
        root: its root file system, mounted.
    """

    name: str
    root: Path

    def files(self) -> dict[str, tuple[int, int, int]]:
        """Time of change, size and mode of everything below the root, by path."""
        found = {}
        for folder, _, names in os.walk(self.root):
            for path in (Path(folder), *(Path(folder, name) for name in names)):
                facts = path.lstat()
                found[str(path.relative_to(self.root))] = (facts.st_ctime_ns, facts.st_size, facts.st_mode)
        # Where buildah mounts a file of its own for every command.
        return {path: facts for path, facts in found.items() if path not in ("run", "run/.containerenv")}


@pytest.fixture(scope="module")
def container(tools: Tools, image: dict[str, Any]) -> Iterator[Container]:
    """A container of the image."""
    assert image
    name = tools.run("buildah", "from", NAME).strip()
    try:
        yield Container(name, Path(tools.run("buildah", "mount", name).strip()))
    finally:
        tools.run("buildah", "rm", name)


def test_the_image_is_small(container: Container) -> None:
    size = sum(path.lstat().st_size for path in container.root.rglob("*") if not path.is_dir())
    print(f"image: {size / 1e6:.0f} MB")
    assert size <= MOST_BYTES


def test_the_image_holds_nothing_to_build_or_install_with(container: Container) -> None:
    files = sorted(container.files())
    unwanted = {"pip", "setuptools", "pkg_resources", "ensurepip", "apt", "apt-get", "gcc", "cc", "perl", "curl"}
    assert not [file for file in files if Path(file).name in unwanted]
    packages = [file for file in files if "site-packages/" in file]
    assert packages
    assert not [file for file in packages if "/tests/" in file or file.endswith(".pyi")]
    assert not [file for file in files if file.endswith((".h", ".a")) and "/" in file]
    modes = {file: container.root.joinpath(file).lstat().st_mode for file in files}
    assert not [file for file, mode in modes.items() if stat.S_ISREG(mode) and mode & (stat.S_ISUID | stat.S_ISGID)]


def test_the_configuration_is_the_dockerfiles(tools: Tools, image: dict[str, Any], stages: dict[str, Any]) -> None:
    stage = stages["inference"]
    assert image["User"] == f"{USER}:{USER}"
    assert image["Entrypoint"] == stage["ENTRYPOINT"]
    assert image["Cmd"] == stage["CMD"]
    assert image["Healthcheck"]["Test"] == ["CMD", *stage["HEALTHCHECK"]]
    assert set(image["Volumes"]) == {"/state"}
    labels = image["Labels"]
    assert labels["org.opencontainers.image.title"] == "attentionvote"
    assert labels["org.opencontainers.image.version"] == attentionvote.__version__
    assert labels["org.opencontainers.image.revision"].startswith(tools.run("git", "rev-parse", "HEAD").strip())


def read_only(container: Container, yes: bool) -> None:
    """Mount the container's root read-only, or writable again."""
    option = "ro" if yes else "rw"
    subprocess.run(["mount", "-o", f"remount,bind,{option}", str(container.root)], check=True)


def test_the_server_answers_as_nobody_on_a_read_only_root(
    tools: Tools, container: Container, image: dict[str, Any], cell: Cell, tmp_path: Path, free_port: int
) -> None:
    state, scratch, secrets = tmp_path / "state", tmp_path / "tmp", tmp_path / "secrets"
    shutil.copytree(cell.secrets, secrets)
    for folder, mode in ((state, 0o700), (scratch, 0o777)):
        folder.mkdir()
        folder.chmod(mode)
    os.chown(state, USER, USER)
    for path in secrets.iterdir():
        path.chmod(0o400)
        os.chown(path, USER, USER)
    mounts = [f"{cell.bundles}:/bundles:ro", f"{secrets}:/run/secrets:ro", f"{state}:/state", f"{scratch}:/tmp"]
    start = ["buildah", "run", *(word for mount in mounts for word in ("--volume", mount)), container.name, "--"]
    health = image["Healthcheck"]["Test"][1:]
    command = [str(free_port) if word == "8000" else word for word in (*image["Entrypoint"], *image["Cmd"])]
    command[command.index("0.0.0.0")] = "127.0.0.1"

    with pytest.raises(OSError, match="cannot be reached"):
        tools.run(*start, *health, "--url", f"http://127.0.0.1:{free_port}")
    (container.root / "run" / ".containerenv").touch()  # buildah's own mount point, before the root is closed
    before = container.files()
    read_only(container, True)
    began = time.monotonic()
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen(
            [*start, *command],
            env=tools.environment,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert line, (tmp_path / "log").read_text(encoding="utf-8")
        process = json.loads(line)["pid"]
        # The server's own view of the root is another mount and stays as it is; buildah wants to clean up behind it.
        read_only(container, False)
        cell.wait_ready(free_port, lambda: server.poll() is None)
        print(f"image: ready after {time.monotonic() - began:.1f} s")
        cell.check_answers(free_port)
        assert "ready: bracket" in tools.run(*start, *health)
        facts = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
        assert f"Uid:\t{USER}\t{USER}\t{USER}\t{USER}\n" in facts
        assert "CapEff:\t0000000000000000\n" in facts
        views = Path(f"/proc/{process}/mountinfo").read_text(encoding="utf-8").splitlines()
        (root,) = [view.split() for view in views if view.split()[4] == "/"][-1:]
        assert "ro" in root[5].split(","), root
        os.kill(process, signal.SIGTERM)
        assert server.wait(60) == 0
    finally:
        if server.poll() is None:
            os.killpg(server.pid, signal.SIGKILL)
        server.communicate()
        read_only(container, False)
    assert container.files() == before, "something was written outside /state and /tmp"
    assert list(state.iterdir()), "the bundle was not kept for the next start"
    left = [path for path in scratch.rglob("*") if not path.is_dir()]
    assert not left, "something was left below the home folder"


def test_debians_copyright_notices_stay(container: Container) -> None:
    notices = [path for path in (container.root / "usr" / "share" / "doc").rglob("*") if not path.is_dir()]
    assert {path.name for path in notices} == {"copyright"}
    assert {"libc6", "libssl3", "zlib1g"} <= {path.parent.name for path in notices}
    size = sum(path.lstat().st_size for path in notices)
    print(f"image: copyright notices of {len(notices)} packages, {size / 1e6:.1f} MB")
    assert size < 5e6


def test_the_operators_pages_are_in_the_image(tools: Tools, container: Container) -> None:
    for words in (["docs", "operating-a-cell"], ["--version"]):
        text = tools.run("buildah", "run", container.name, "--", "attentionvote", *words)
        assert text.startswith("# Operating a cell\n" if words[0] == "docs" else "attentionvote ")


def test_the_point_operators_need_no_compiler(tools: Tools, container: Container, stages: dict[str, Any]) -> None:
    program = (
        "import warnings; warnings.simplefilter('error')\n"
        "from attentionvote.geometry import native\n"
        "print(native.load('attentionvote.geometry', 'pointops.c')._name)"
    )
    library = tools.run("buildah", "run", container.name, "--", "python", "-c", program).strip()
    assert library.startswith(stages["inference"]["ENV"]["ATTENTIONVOTE_CACHE"] + "/pointops-")
