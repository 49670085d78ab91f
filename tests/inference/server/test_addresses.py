"""Where running servers are known from: their files, which nobody else can write and no dead server keeps."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.server.addresses import Announcement, local_url, running_servers


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of this test's own: other servers of the user are not seen."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


def test_a_server_is_known_while_it_lives(temporary: Path) -> None:
    assert running_servers() == []
    one = Announcement("https://127.0.0.1:8443")
    two = Announcement("http://127.0.0.1:8000")
    assert running_servers() == ["http://127.0.0.1:8000", "https://127.0.0.1:8443"]
    (folder,) = temporary.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o600}
    two.withdraw()
    assert running_servers() == ["https://127.0.0.1:8443"]
    one.withdraw()
    assert list(folder.iterdir()) == []


def test_the_file_of_a_killed_server_counts_for_nothing_and_is_removed(temporary: Path) -> None:
    program = "import os; from attentionvote.inference.server.addresses import Announcement as A\n"
    program += "a = A('http://127.0.0.1:1'); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=30).returncode == -9
    (left,) = temporary.glob("*/serve-*.url")
    assert left.read_text() == "http://127.0.0.1:1"
    assert running_servers() == []
    announcement = Announcement("http://127.0.0.1:2")
    assert running_servers() == ["http://127.0.0.1:2"]
    assert not left.exists()
    announcement.withdraw()


def test_children_of_a_server_do_not_hold_its_lock() -> None:
    """A worker that outlives its server must not make it look alive."""
    program = "import os, subprocess; from attentionvote.inference.server.addresses import Announcement as A\n"
    program += "a = A('http://127.0.0.1:1'); subprocess.Popen(['sleep', '60'], stdin=-3, stdout=-3, stderr=-3)\n"
    program += "print(subprocess.run(['true']).returncode, flush=True); os.kill(os.getpid(), 9)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.wait(30) == -9
        try:
            assert running_servers() == []
        finally:
            os.killpg(process.pid, 9)


@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_folder_that_others_can_write_to_is_not_believed(temporary: Path, mode: int) -> None:
    Announcement("http://127.0.0.1:1")
    (folder,) = temporary.iterdir()
    folder.chmod(mode)
    assert running_servers() == []
    with pytest.raises(PermissionError, match="must be a folder of this user that nobody else can write to"):
        Announcement("http://127.0.0.1:2")


def test_a_link_in_place_of_the_folder_is_not_followed(temporary: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (temporary / f"attentionvote-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(PermissionError):
        Announcement("http://127.0.0.1:2")
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("0.0.0.0", "http://127.0.0.1:80"),
        ("::", "http://[::1]:80"),
        ("192.0.2.7", "http://192.0.2.7:80"),
        ("::1", "http://[::1]:80"),
    ],
)
def test_a_server_on_every_address_is_asked_on_loopback(host: str, url: str) -> None:
    assert local_url("http", host, 80) == url


def test_a_server_without_a_folder_serves_and_says_how_it_can_be_asked(
    start_server: Any, bundle_folder: Path, temporary: Path
) -> None:
    server = start_server(bundle_folder, environment={"TMPDIR": str(temporary / "nowhere")})
    (line,) = (entry for entry in server.log("start") if entry["level"] == "warning")
    assert f"attentionvote health needs --url {server.url}: No such file or directory" in line["message"]
