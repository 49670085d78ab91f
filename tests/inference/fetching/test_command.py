"""``attentionvote fetch``: a bundle's folder on stdout, or one sentence; without the training stack in the process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.command_line import main

Make = Callable[..., Path]
pytestmark = pytest.mark.slow  # the first one starts an MLflow server


def said(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of the command in this process."""
    with pytest.raises(SystemExit) as left:
        main(["fetch", *map(str, words)])
    captured = capsys.readouterr()
    assert isinstance(left.value.code, int)
    return left.value.code, captured.out, captured.err


def test_it_says_where_the_bundle_is(
    real_registry: Any,
    bundle_folder: Path,
    trusted_key: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, bundle_folder)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", real_registry.url)
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(trusted_key.parent))
    digest = load_bundle(bundle_folder, None).digest[:12]
    code, out, err = said(capsys, f"models:/{name}@champion")
    assert (code, out) == (0, f"bundles/{digest}\n")
    assert (
        err == f"attentionvote: models:/{name}@champion is version 1 of {name}, bundle {digest}, fetched and verified\n"
    )
    assert load_bundle(tmp_path / "bundles" / "latest", trusted_key).digest.startswith(digest)
    code, out, err = said(capsys, f"models:/{name}/1", "--to", tmp_path / "bundles")
    assert (code, out) == (0, f"{tmp_path}/bundles/{digest}\n")
    assert "already there and verified" in err


def test_refusals_are_one_sentence(
    real_registry: Any,
    make_bundle: Make,
    trusted_key: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    name = real_registry.new_name()
    real_registry.register(name, make_bundle())
    (tmp_path / "file").write_text("no folder")
    good = ["--registry", real_registry.url, "--key", trusted_key, "--to", tmp_path / "to"]
    for words, code, sentence in (
        ([f"models:/{name}", *good], 2, f"did you mean models:/{name}@champion?"),
        ([f"models:/{name}@champion", "--key", trusted_key], 2, "needs its registry, got none"),
        ([f"models:/{name}@champion", *good, "--registry", "http://a:b@c"], 2, "must not hold credentials"),
        ([f"models:/{name}@champion", *good, "--key", tmp_path / "none"], 1, "none must be a public key"),
        ([f"models:/{name}@champoin", *good], 1, "did you mean champion?"),
        (
            [f"models:/{name}@champion", *good, "--to", tmp_path / "file" / "x"],
            1,
            "must take the bundle, but",
        ),
        ([f"models:/{name}@champion", *good, "--registry", "http://127.0.0.1:9"], 1, "cannot be reached: Connection"),
    ):
        left, out, err = said(capsys, *words)
        assert (left, out) == (code, "")
        assert sentence in err
        assert err.count("\n") == 1
    assert not (tmp_path / "to" / "latest").exists()


def test_it_runs_without_the_training_stack(
    real_registry: Any, bundle_folder: Path, trusted_key: Path, tmp_path: Path
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, bundle_folder)
    blocked = ("torch", "lightning", "mlflow", "hydra", "omegaconf", "requests", "onnx", "jaxtyping", "onnxruntime")
    program = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ImportError(f"{{name}} is not on the cell")
sys.meta_path.insert(0, Blocked())
from attentionvote.inference.command_line import main
main(sys.argv[1:])
"""
    words = ["fetch", f"models:/{name}@champion", "--registry", real_registry.url, "--key", trusted_key, "--to", "here"]
    command = [sys.executable, "-W", "error", "-c", program, *map(str, words)]
    environment = {"PATH": os.environ["PATH"], "HOME": "/nonexistent"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env=environment, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert load_bundle(tmp_path / done.stdout.strip(), trusted_key).digest
