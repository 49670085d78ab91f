"""What a cell mounts into its container, made by the real code: a tiny signed bundle, its public key, a token."""

from __future__ import annotations

import http.client
import io
import json
import os
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cell_image import CannotBuildError, fetch_wheels
from numpy.typing import NDArray

from attentionvote.contract import CARD_KEY, ModelCard, PartCard
from attentionvote.inference import Bundle, PoseEstimator, load_private_key, make_keys, write_manifest

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n0.1 0 0\n0 0.1 0\n3 0 1 2\n"


def _card() -> ModelCard:
    part = PartCard("bracket", "a bracket", 0.1, "0" * 64, {"kind": "none"}, ((-0.05,) * 3, (0.05,) * 3))
    return ModelCard(part, ("bracket",), 256, 64, 2, 2000, 30, 0.4, 0.5, (0.6, 1.0), 0.43)


def _graph(card: ModelCard) -> bytes:
    """Two proposals beside the centroid of the points; one of them is confident."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    constants = {
        "axis": np.array([1], np.int64),
        "start": np.array([0], np.int64),
        "end": np.array([card.votes], np.int64),
        "step": np.float32(0.01),
        "seeds": np.zeros((1, 2, 3), np.float32),
        "offsets": np.array([[[0, 0, 0], [0.05, 0, 0]]], np.float32),
        "peak_heat": np.array([[9, 6]], np.float32),
        "quaternion": np.array([[[1, 0, 0, 0], [0, 0.6, 0.8, 0]]], np.float32),
        "class_logits": np.zeros((1, 2, 1), np.float32),
        "confidence": np.array([[0.2, 0.9]], np.float32),
    }
    nodes = [
        helper.make_node("Slice", ["points", "start", "end", "axis"], ["first_points"]),
        helper.make_node("Slice", ["normals", "start", "end", "axis"], ["first_normals"]),
        helper.make_node("Mul", ["first_normals", "step"], ["along"]),
        helper.make_node("Add", ["first_points", "along"], ["vote_xyz"]),
        helper.make_node("ReduceMean", ["points", "axis"], ["mean"], keepdims=1),
        helper.make_node("Add", ["mean", "seeds"], ["center_seed"]),
        helper.make_node("Add", ["mean", "offsets"], ["center"]),
    ]
    fixed = ("peak_heat", "quaternion", "class_logits", "confidence")
    nodes += [helper.make_node("Identity", [f"{name}_value"], [name]) for name in fixed]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(s.name, TensorProto.FLOAT, s.shape) for s in card.inputs],
        [helper.make_tensor_value_info(s.name, TensorProto.FLOAT, s.shape) for s in card.outputs],
        [numpy_helper.from_array(np.asarray(v), f"{n}_value" if n in fixed else n) for n, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(model, {CARD_KEY: card.core().to_json()})
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))


def _cloud(seed: int) -> NDArray[np.float32]:
    xy = np.random.default_rng(seed).uniform(-0.1, 0.1, (3000, 2))
    z = 0.8 + 0.01 * np.sin(60 * xy[:, 0]) * np.cos(50 * xy[:, 1])
    return np.c_[xy, z].astype(np.float32)


@dataclass(frozen=True)
class Cell:
    """What is mounted, and one question with its answer.

    Attributes:
        bundles: folder with a bundle and ``latest``, a link to it.
        secrets: folder with ``signing.pub`` and ``token``.
        token: the token's text.
        cloud: ``(P, 3)`` points, metres.
        camera_from_part: ``(4, 4)``, the one pose the estimator finds in this process.
    """

    bundles: Path
    secrets: Path
    token: str
    cloud: NDArray[np.float32]
    camera_from_part: NDArray[np.float64]

    def ask(self, port: int, token: str | None = None) -> tuple[int, Any]:
        """POST the cloud to a server on the loopback interface: status and the answer's JSON."""
        body = io.BytesIO()
        np.save(body, self.cloud)
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        try:
            bearer = {"Authorization": f"Bearer {token or self.token}"}
            connection.request("POST", "/poses", body.getvalue(), bearer)
            response = connection.getresponse()
            return response.status, json.loads(response.read())
        finally:
            connection.close()

    def wait_ready(self, port: int, alive: Callable[[], bool]) -> None:
        """Wait until a model serves; ``alive`` says whether the server still runs."""
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
                connection.request("GET", "/v2/health/ready")
                if connection.getresponse().status == 200:
                    return
            except OSError:
                pass
            finally:
                connection.close()
            assert alive(), "the server ended before it was ready"
            assert time.monotonic() < until, f"the server was not ready within {PATIENCE_S:.0f} s"
            time.sleep(0.1)

    def check_answers(self, port: int) -> None:
        """One question answered as in this process, and none without the token."""
        status, answer = self.ask(port)
        assert status == 200, answer
        (found,) = answer["poses"]
        np.testing.assert_allclose(found["camera_from_part"], self.camera_from_part, atol=1e-5)
        status, answer = self.ask(port, "another-token-of-some-length")
        assert status == 401, answer


@pytest.fixture(scope="session")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    """A cell's mounts, readable by the container's user."""
    folder = tmp_path_factory.mktemp("cell")
    private, public = make_keys(folder / "keys")
    bundle, secrets = folder / "bundles" / "bracket", folder / "secrets"
    (bundle / "golden").mkdir(parents=True)
    secrets.mkdir()
    card = _card()
    model = _graph(card)
    (bundle / "model.onnx").write_bytes(model)
    (bundle / "card.json").write_text(card.to_json(), encoding="utf-8")
    (bundle / "part.ply").write_bytes(PLY)
    with PoseEstimator(Bundle(bundle, card, "0" * 64, model)) as estimator:
        golden, asked = (estimator.estimate(_cloud(seed)).detections for seed in (0, 1))
    np.savez(
        bundle / "golden" / "cloud_0.npz",
        points=_cloud(0),
        camera_from_part=np.array([found.camera_from_part for found in golden]),
        confidence=np.array([found.confidence for found in golden], np.float32),
    )
    write_manifest(bundle, load_private_key(private))
    (folder / "bundles" / "latest").symlink_to("bracket")
    (secrets / "signing.pub").write_bytes(public.read_bytes())
    token = os.urandom(20).hex()
    (secrets / "token").write_text(token, encoding="utf-8")
    for path in folder.rglob("*"):
        if path.is_relative_to(folder / "keys") or path.is_symlink():
            continue
        path.chmod(0o755 if path.is_dir() else 0o644)
    return Cell(folder / "bundles", secrets, token, _cloud(1), asked[0].camera_from_part)


@pytest.fixture(scope="session")
def compose() -> dict[str, Any]:
    """The file docker/compose.yaml, parsed."""
    content = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


@pytest.fixture(scope="session")
def interpolate() -> Callable[..., str]:
    """A text of compose.yaml with its variables replaced as compose does: ``${A:-default}``, ``${A:+when set}``."""

    def replaced(text: str, **values: str) -> str:
        def value(match: re.Match[str]) -> str:
            given = values.get(match[1], "")
            return (given or match[3]) if match[2] == "-" else match[3] * bool(given)

        done = re.sub(r"\$\{([A-Z_]+):([-+])([^}]*)\}", value, text)
        assert "$" not in done, done
        return done

    return replaced


@pytest.fixture(scope="session")
def stages() -> dict[str, dict[str, Any]]:
    """The Dockerfile's stages by name, each with its instructions: the last one's words; ENV and COPY gathered."""
    text = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n", " ", "\n".join(x for x in text.splitlines() if not x.lstrip().startswith("#"))).splitlines()
    found: dict[str, dict[str, Any]] = {}
    stage: dict[str, Any] = {}
    for line in filter(str.strip, lines):
        name, _, words = line.strip().partition(" ")
        if name == "FROM":
            image, _, alias = words.partition(" AS ")
            stage = found[alias] = {"FROM": image, "RUN": [], "COPY": [], "ENV": {}}
        elif name in ("RUN", "COPY"):
            stage[name].append(" ".join(words.split()))
        elif name == "ENV":
            stage[name] |= dict(word.split("=", 1) for word in words.split())
        elif stage:
            start = words.find("[")
            stage[name] = json.loads(words[start:]) if start >= 0 and words.endswith("]") else words
    return found


@pytest.fixture(scope="session")
def wheels() -> Path:
    """The locked packages' files; skips where pip cannot fetch them."""
    try:
        return fetch_wheels()
    except CannotBuildError as error:
        pytest.skip(str(error))


@pytest.fixture
def free_port() -> int:
    """A TCP port of the loopback interface that nobody uses at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
