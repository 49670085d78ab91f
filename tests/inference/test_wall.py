"""The cell's wall: the estimator runs without the training stack, writes nothing below the home, knows its names."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import attentionvote.inference

TRAINING_STACK = (
    "torch",
    "lightning",
    "mlflow",
    "hydra",
    "omegaconf",
    "open3d",
    "trimesh",
    "onnx",
    "jaxtyping",
    "mujoco",
)
BLOCKED = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {TRAINING_STACK!r}:
            raise ImportError(f"{{name}} is not on the cell")
sys.meta_path.insert(0, Blocked())
"""


def python(program: str, *words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Another Python with nothing of this one's environment but the path and what is given."""
    given = {"PATH": os.environ["PATH"], "HOME": "/nonexistent"} | environment
    command = [sys.executable, "-W", "error", "-c", program, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=given)


ESTIMATE = """
import sys
import numpy as np
from attentionvote.inference import PoseEstimator, load_bundle, self_test
bundle = load_bundle(sys.argv[1], sys.argv[2])
with PoseEstimator(bundle) as estimator:
    assert self_test(estimator, bundle) == []
    print(len(estimator.estimate(np.load(sys.argv[3])).detections), "poses")
"""


@pytest.fixture
def cloud_file(tmp_path: Path, make_cloud: Callable[..., NDArray[np.float32]]) -> Path:
    """A cloud on disk."""
    np.save(tmp_path / "cloud.npy", make_cloud())
    return tmp_path / "cloud.npy"


def test_the_estimator_runs_without_the_training_stack(
    bundle_folder: Path, trusted_key: Path, cloud_file: Path
) -> None:
    program = BLOCKED + ESTIMATE + f"print(sorted(set({TRAINING_STACK!r}) & set(sys.modules)))"
    done = python(program, bundle_folder, trusted_key, cloud_file)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "2 poses\n[]\n"
    assert done.stderr == ""


def test_every_module_of_the_cell_imports_without_it(repository: Path) -> None:
    package = repository / "src" / "attentionvote" / "inference"
    modules = [
        ".".join(path.relative_to(repository / "src").with_suffix("").parts).removesuffix(".__init__")
        for path in sorted(package.rglob("*.py"))
    ]
    assert "attentionvote.inference.estimator" in modules
    assert "attentionvote.inference.server.serve" in modules
    done = python(BLOCKED + "import importlib\nfor name in sys.argv[1:]: importlib.import_module(name)", *modules)
    assert done.returncode == 0, done.stderr


def test_the_block_would_notice() -> None:
    done = python(BLOCKED + "import torch")
    assert "ImportError: torch is not on the cell" in done.stderr


@pytest.mark.parametrize("asked", [None, "0"])
def test_an_estimate_leaves_no_file_below_the_home(
    bundle_folder: Path, trusted_key: Path, cloud_file: Path, tmp_path: Path, asked: str | None
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    environment = {"HOME": str(home)} | ({} if asked is None else {"ORT_DISABLE_TELEMETRY": asked})
    done = python(ESTIMATE, bundle_folder, trusted_key, cloud_file, **environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert list(home.rglob("*")) == []


def test_only_one_module_imports_the_runtime_and_sets_the_variable_first(repository: Path) -> None:
    package = repository / "src" / "attentionvote"
    importers = [p for p in package.rglob("*.py") if "import onnxruntime" in p.read_text(encoding="utf-8")]
    text = (package / "inference" / "runtime.py").read_text(encoding="utf-8")
    assert text.index('os.environ["ORT_DISABLE_TELEMETRY"] = "1"') < text.index("\nimport onnxruntime")
    assert [p.relative_to(package).as_posix() for p in importers if "inference" in p.parts] == ["inference/runtime.py"]


def test_the_http_process_holds_neither_runtime_nor_scipy() -> None:
    """They belong to the workers: what the server does not load can neither crash nor slow it."""
    program = "import sys, attentionvote.inference.server.serve\n"
    done = python(program + "print(sorted({'onnxruntime', 'scipy', 'PIL'} & set(sys.modules)))")
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_public_names_are_loaded_when_they_are_used() -> None:
    program = """
import sys
import attentionvote.inference
print(sorted({"numpy", "onnxruntime", "cryptography"} & set(sys.modules)))
from attentionvote.inference import load_bundle
print("onnxruntime" in sys.modules)
"""
    assert python(program).stdout == "[]\nFalse\n"


def test_every_public_name_is_there() -> None:
    for name in attentionvote.inference.__all__:
        assert getattr(attentionvote.inference, name).__module__.startswith("attentionvote.inference.")
    with pytest.raises(AttributeError, match="has no attribute 'PoseEstimater'"):
        attentionvote.inference.PoseEstimater  # noqa: B018
