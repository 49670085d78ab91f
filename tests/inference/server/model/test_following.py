"""A cell that follows a real registry: moves, returns, stays pinned, outlives it, and takes nothing bad."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.bundles.manifest import write_manifest
from attentionvote.inference.bundles.signature import load_private_key, load_public_key, make_keys
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.bundles import FetchedBundles
from attentionvote.inference.fetching.reference import parse_reference
from attentionvote.inference.fetching.registry import Registry
from attentionvote.inference.server import health
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.bundle_loading import BundleLoader
from attentionvote.inference.server.model.following import Following
from attentionvote.inference.server.model.reloading import BundleWatch
from attentionvote.inference.server.model.serving import Serving
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers

Make = Callable[..., Path]
pytestmark = pytest.mark.slow  # the first one starts an MLflow server
QUICK = ("--registry-poll-s", "0.1")
# Another confidence is another bundle, and its answers can be told apart.
CONFIDENCE = {"1": (0.7, 0.95, 0.3, 0.99), "2": (0.7, 0.9, 0.3, 0.99), "3": (0.7, 0.85, 0.3, 0.99)}


def short(folder: Path) -> str:
    """The version of a bundle for clients."""
    return load_bundle(folder, None).digest[:12]


@pytest.fixture
def bundles(make_bundle: Make) -> dict[str, Path]:
    """Three bundles by the version they will be."""
    return {number: make_bundle(f"v{number}", graph={"confidence": c}) for number, c in CONFIDENCE.items()}


def registered(server: Any) -> dict[str, str] | None:
    """Which registered version the server says that it serves."""
    return server.get("/v2/health/ready").json.get("registry")


def registry_log(server: Any, level: str) -> list[str]:
    return [line["message"] for line in server.log("registry") if line["level"] == level]


def test_promoted_rolled_back_and_alone(
    own_registry: Any,
    start_server: Any,
    continuous_requests: Any,
    bundles: Any,
    make_cloud: Any,
    npy: Any,
    tmp_path: Path,
) -> None:
    name, state = "attentionvote-bracket", tmp_path / "state"
    own_registry.register(name, bundles["1"])
    options = ("--registry", own_registry.url, *QUICK, "--state", str(state))
    server = start_server(f"models:/{name}@champion", *options)
    first, second = short(bundles["1"]), short(bundles["2"])
    assert server.version() == first
    assert registered(server) == {"name": name, "version": "1"}
    body = npy(make_cloud())
    with continuous_requests(server, body) as answers:
        own_registry.register(name, bundles["2"])  # champion by the same call
        server.wait_until(lambda: answers[-1]["model"] == second, "it moves to version 2")
        server.wait_until(lambda: registered(server) == {"name": name, "version": "2"}, "it names version 2")
        own_registry.move(name, "champion", "1")
        server.wait_until(lambda: answers[-1]["model"] == first, "it returns to version 1")
    best = {answer["model"]: answer["poses"][0]["confidence"] for answer in answers}
    assert best == {first: pytest.approx(0.95), second: pytest.approx(0.9)}
    digest = load_bundle(bundles["1"], None).digest
    information = {"digest": digest, "model": name, "version": "1"}
    server.wait_until(lambda: server.metric("registry_info", **information) == 1, "the metric names version 1")
    assert server.metric("registry_failing") == 0

    own_registry.kill()
    server.wait_until(lambda: server.metric("registry_polls_total", outcome="away") >= 3, "it has noticed")
    assert server.metric("registry_failing") == 1
    assert server.post("/poses", body).json["model"] == first
    refused = f"the registry {own_registry.url} cannot be reached: Connection refused"
    server.wait_until(lambda: server.post("/v2/repository/index").json[0]["reason"] == refused, "the index says why")
    said = registry_log(server, "error")
    assert len(said) == len(set(said)) <= 2  # once each, however often it asked; the first may be a cut connection
    assert f"{refused}; bracket {first} goes on serving" in said
    assert server.stop() == 0

    server = start_server(f"models:/{name}@champion", *options)
    assert (server.version(), registered(server)) == (first, {"name": name, "version": "1"})
    server.wait_until(lambda: server.metric("registry_failing") == 1, "it says that nobody confirms it")
    assert server.post("/poses", body).json["model"] == first
    assert server.stop() == 0

    # A pin starts what it pins, and nothing else that lies there.
    server = start_server(f"models:/{name}/2", *options)
    assert (server.version(), registered(server)) == (second, {"name": name, "version": "2"})
    assert server.stop() == 0
    server = start_server(f"models:/{name}/3", *options, ready=False)
    server.wait_until(lambda: server.metric("registry_polls_total", outcome="away") >= 2, "it has asked")
    time.sleep(0.3)
    assert server.get("/v2/health/ready").status == 503
    assert "cannot be reached: Connection refused" in server.get("/v2/health/ready").error
    assert len(list((state / "kept").iterdir())) == 2


def test_a_pin_never_moves_and_asks_nobody_once_it_is_here(
    gate: Any, real_registry: Any, start_server: Any, bundles: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, bundles["1"])
    server = start_server(f"models:/{name}/1", "--registry", gate.url, *QUICK)
    assert registered(server) == {"name": name, "version": "1"}
    assert server.get("/").json["model"]["registry"] == {"name": name, "version": "1"}
    assert health.main(["--url", server.url]) == 0
    assert capsys.readouterr().out == f"ready: bracket {server.version()}, version 1 of {name}\n"
    asked = len(gate.asked)
    real_registry.register(name, bundles["2"])
    polls = server.metric("registry_polls_total", outcome="answered")
    server.wait_until(lambda: server.metric("registry_polls_total", outcome="answered") > polls + 3, "it went on")
    assert server.version() == short(bundles["1"])
    assert len(gate.asked) == asked


def test_what_is_bad_does_not_serve_and_is_said_once(
    gate: Any, real_registry: Any, start_server: Any, bundles: Any, make_bundle: Make, tmp_path: Path
) -> None:
    def wrong(folder: Path) -> None:
        with np.load(folder / "golden" / "cloud_0.npz") as file:
            arrays = dict(file)
        arrays["camera_from_part"][:, 2, 3] += 0.01
        np.savez(folder / "golden" / "cloud_0.npz", **arrays)

    foreign = bundles["3"]
    write_manifest(foreign, load_private_key(make_keys(tmp_path / "other-keys")[0]))
    name, state = real_registry.new_name(), tmp_path / "state"
    for folder in (bundles["1"], make_bundle("wrong", change=wrong), foreign, bundles["1"]):
        real_registry.register(name, folder, alias=None)
    real_registry.move(name, "champion", "1")
    options = ("--registry", gate.url, *QUICK, "--state", str(state))
    server = start_server(f"models:/{name}@champion", *options)
    good = server.version()

    real_registry.move(name, "champion", "3")
    server.wait_until(lambda: server.metric("registry_polls_total", outcome="refused") >= 4, "it refused version 3")
    (said,) = registry_log(server, "error")
    assert (
        f"models:/{name}@champion cannot be taken up: version 3 of {name}: the bundle must be signed by the trusted"
        in said
    )
    assert f"bracket {good} goes on serving" in said
    assert "signed by key" in server.get("/metrics").body.decode()
    assert "signed by key" in server.post("/v2/repository/index").json[0]["reason"]
    refused = server.post("/v2/repository/models/bracket/load")
    assert (refused.status, "signed by key" in refused.error) == (409, True)
    assert not [file for file in gate.files()[-2:] if file not in ("manifest.json", "manifest.sig")]

    real_registry.move(name, "champion", "2")
    server.wait_until(lambda: "the self-test failed" in server.reload_error(), "version 2 fails its self-test")
    assert server.metric("registry_failing") == 0  # the registry did its part
    assert "the self-test failed" in server.post("/v2/repository/index").json[0]["reason"]
    assert (server.version(), registered(server)) == (good, {"name": name, "version": "1"})
    assert len(server.log("reload")) == 1
    server.kill()

    gate.status = 503  # the link leads to version 2, which cannot serve, and nobody says otherwise
    server = start_server(f"models:/{name}@champion", *options)
    assert (server.version(), registered(server)) == (good, {"name": name, "version": "1"})
    assert server.metric("serving_last_known_good") == 1

    gate.status = None
    real_registry.move(name, "champion", "4")  # the same bundle by another number
    server.wait_until(lambda: registered(server) == {"name": name, "version": "4"}, "it is version 4 now")
    server.wait_until(lambda: server.metric("serving_last_known_good") == 0, "no copy serves any more")
    assert server.version() == good
    assert server.metric("registry_failing") == server.metric("reload_failing") == 0
    assert registry_log(server, "info")[-1].startswith(f"models:/{name}@champion ")


def test_killed_while_it_fetches_and_a_registry_that_hangs(
    gate: Any, real_registry: Any, start_server: Any, bundles: Any, tmp_path: Path
) -> None:
    name, state = real_registry.new_name(), tmp_path / "state"
    real_registry.register(name, bundles["1"])
    options = ("--registry", gate.url, *QUICK, "--state", str(state))
    server = start_server(f"models:/{name}@champion", *options)
    gate.stop_after = lambda path: 1000 if path.endswith("model.onnx") else None
    real_registry.register(name, bundles["2"])
    assert gate.stopped.wait(30)
    server.kill()
    assert list((state / "registry").glob("fetching-*"))
    gate.stop_after = lambda _: 0  # now it hangs at every question
    started = time.monotonic()
    server = start_server(f"models:/{name}@champion", *options)
    assert time.monotonic() - started < 8, "the cell waited for the registry before it served what it has"
    assert server.version() == short(bundles["1"])
    assert server.stop() == 0  # though a question is open
    gate.stop_after = lambda _: None
    gate.go_on.set()
    server = start_server(f"models:/{name}@champion", *options)
    server.wait_until(lambda: server.version() == short(bundles["2"]), "version 2 is fetched after all")
    assert not list((state / "registry").glob("fetching-*"))
    assert os.readlink(state / "registry" / "latest") == short(bundles["2"])


def test_credentials_reach_the_registry_and_no_log(
    gate: Any, real_registry: Any, start_server: Any, bundles: Any, tmp_path: Path
) -> None:
    name = real_registry.new_name()
    real_registry.register(name, bundles["1"])
    gate.demanded = "Basic Y2VsbDpodW50ZXIy"
    file = tmp_path / "credentials"
    file.write_text("cell:hunter2\n")
    options = ("--registry", gate.url, *QUICK, "--registry-auth-file", str(file))
    server = start_server(f"models:/{name}@champion", *options)
    gate.demanded = "Basic another"
    server.wait_until(lambda: server.metric("registry_failing") == 1, "it is refused")
    (said,) = registry_log(server, "error")
    assert "must know who asks, but it takes no or other credentials (401)" in said
    assert "can be read by everybody on this machine: chmod 600" in registry_log(server, "warning")[0]
    shown = server.log_file.read_text() + server.get("/metrics").body.decode()
    assert "hunter2" not in shown
    assert "Y2VsbD" not in shown


def test_the_longer_it_is_away_the_rarer_it_is_asked(trusted_key: Path, free_port: int, tmp_path: Path) -> None:
    key = load_public_key(trusted_key)
    fetched = FetchedBundles(tmp_path / "state", parse_reference("models:/gear@champion"), key)

    async def waits() -> list[float]:
        metrics = Metrics()
        serving = Serving(metrics)
        watch = BundleWatch(
            fetched.link, BundleLoader(key, lambda bundle, _: Workers(bundle, WorkerSettings()), None), serving, metrics
        )
        following = Following(Registry(Access(f"http://127.0.0.1:{free_port}")), fetched, watch, serving, metrics)
        found = [await following._step() for _ in range(5)]
        assert serving.waits_for == following.problem
        following.close()
        serving.close()
        return found

    assert asyncio.run(waits()) == [10, 20, 40, 60, 60]
