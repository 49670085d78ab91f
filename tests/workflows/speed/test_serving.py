"""The load bench: it counts what clients see, and notices wrong and missing answers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bench_serve
import numpy as np
import pytest

from attentionvote.workflows.speed.serving import Expected, Tally, _ask, expectations, server

ROOT = Path(__file__).resolve().parents[3]
# Writes a tiny signed bundle with the tests' own builder, in a process of its own: fixtures do not cross folders.
BUILDER = """
import importlib.util, sys
from pathlib import Path
from attentionvote.inference.bundles.signature import make_keys
spec = importlib.util.spec_from_file_location("builder", sys.argv[1])
builder = importlib.util.module_from_spec(spec)
sys.modules["builder"] = builder
spec.loader.exec_module(builder)
folder = Path(sys.argv[2])
make = getattr(builder.make_bundle, "__wrapped__", None) or builder.make_bundle._fixture_function
make(folder, make_keys(folder / "keys"))("bundle", golden=3)
"""


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """A bundle and the public key that signed it."""
    folder = tmp_path_factory.mktemp("bench")
    builder = ROOT / "tests" / "fixtures" / "tiny_bundle.py"
    words = [sys.executable, "-c", BUILDER, str(builder), str(folder)]
    subprocess.run(words, check=True, timeout=120, stdout=subprocess.DEVNULL)
    yield folder / "bundle", folder / "keys" / "signing.pub"
    shutil.rmtree(folder)


def test_a_second_of_load_is_answered_right(signed: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    bundle, key = signed
    assert bench_serve.main([str(bundle), "--key", str(key), "--seconds", "1", "--queue", "1"]) == 0
    out, err = capsys.readouterr()
    (line,) = out.splitlines()
    result = json.loads(line)
    assert result["stage"] == "bench-serve"
    assert result["answered"] > 4
    assert (result["wrong"], result["lost"]) == (0, 0)
    assert 0 < result["p50_ms"] <= result["p99_ms"]
    assert result["per_second"] == pytest.approx(result["answered"] / result["seconds"], rel=0.02)
    assert result["clients"] == 4
    assert "p50, p99" in err
    assert "503, asked again" in err


def test_a_wrong_answer_is_noticed(
    signed: tuple[Path, Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle, key = signed
    right = expectations(bundle, key)
    assert len(right) == 3
    moved = right[1].camera_from_part.copy()
    moved[0, 0, 3] += 1e-5  # ten micrometres
    monkeypatch.setattr(bench_serve, "expectations", lambda *_: [right[0], right[1]._replace(camera_from_part=moved)])
    assert bench_serve.main([str(bundle), "--key", str(key), "--seconds", "0.5", "--clients", "2"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["wrong"] > 0
    assert result["answered"] > 0


def test_a_missing_answer_is_noticed() -> None:
    tally = Tally()
    nothing = Expected(np.zeros((1, 3), np.float32), np.zeros((0, 4, 4)), np.zeros(0, np.float32))
    _ask("http://127.0.0.1:1", [nothing], 0, tally, time.monotonic() + 0.2)
    assert not tally.seconds
    assert tally.lost[0].startswith("Unreachable: http://127.0.0.1:1 cannot be reached")


@pytest.mark.parametrize("options", [["--seconds", "0"], ["--clients", "0"], ["--queue", "-1"]])
def test_impossible_arguments(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_serve.main(["bundle", *options]) == 2
    assert "must be positive numbers" in capsys.readouterr().err


def test_a_bundle_that_cannot_be_trusted_is_one_sentence(
    signed: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, sentence in (
        ([str(tmp_path), "--key", str(signed[1])], "manifest.json is missing"),
        ([str(signed[0]), "--key", str(tmp_path / "no.pub")], "must be a public key"),
    ):
        assert bench_serve.main(arguments) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("bench-serve: ")
        assert sentence in line


def test_a_server_that_does_not_start_is_one_sentence(signed: tuple[Path, Path], tmp_path: Path) -> None:
    def start() -> Any:
        with server(signed[0], tmp_path / "no.pub", 2) as url:
            return url

    with pytest.raises(OSError, match=r"the server did not start: serve: .*no\.pub must be a public key"):
        start()
