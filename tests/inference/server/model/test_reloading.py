"""Exchange of bundles on a running server: good, bad in every way, missing, and killed in the middle."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.inference.bundles.signature import load_private_key, make_keys
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.bundle_loading import BundleLoader
from attentionvote.inference.server.model.last_known_good import LastKnownGood
from attentionvote.inference.server.model.reloading import BundleWatch
from attentionvote.inference.server.model.serving import Served, Serving
from attentionvote.inference.server.worker.process import WorkerSettings
from attentionvote.inference.server.worker.workers import Workers

Make = Callable[..., Path]
LARGE = 8 * 1024 * 1024


def point(link: Path, target: Path) -> None:
    """Let a link lead elsewhere, in one step."""
    new = link.with_name(link.name + ".new")
    new.symlink_to(target)
    new.replace(link)


def padded(folder: Path) -> None:
    """A bundle with a large file: copying it takes a while."""
    (folder / "part.ply").write_bytes(os.urandom(LARGE))


def test_good_bad_good_without_a_failed_request(
    start_server: Any, continuous_requests: Any, make_bundle: Make, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    first = make_bundle("first")
    flipped = make_bundle("flipped", graph={"confidence": (0.6, 0.75, 0.3, 0.9)})
    truncated = make_bundle("truncated", graph={"confidence": (0.6, 0.8, 0.3, 0.9)})
    foreign = make_bundle("foreign", graph={"confidence": (0.6, 0.85, 0.3, 0.9)})
    wrong_poses = make_bundle("wrong_poses", change=lambda f: move_golden(f, 0.004))
    last = make_bundle("last", graph={"confidence": (0.7, 0.9, 0.3, 0.99)})
    model = bytearray((flipped / "model.onnx").read_bytes())
    model[len(model) // 2] ^= 1
    (flipped / "model.onnx").write_bytes(model)
    os.truncate(truncated / "model.onnx", 1000)
    sign_again(foreign, tmp_path / "other-keys")

    link = tmp_path / "latest"
    point(link, first)
    server = start_server(link)
    version = server.version()
    with continuous_requests(server, npy(make_cloud())) as answers:
        for folder, sentence in (
            (flipped, "model.onnx must have the sha256 .* but its content was changed"),
            (truncated, "model.onnx must have .* bytes, got 1000"),
            (foreign, "must be signed by the trusted key .* but it is signed by key"),
            (wrong_poses, "the self-test failed: golden cloud cloud_0 must give pose 0 .* off by 4.00 mm"),
            (tmp_path / "nowhere", "must be a bundle's folder, but it cannot be opened"),
        ):
            point(link, folder)
            server.wait_until(
                lambda sentence=sentence: re.search(sentence, server.reload_error()) is not None, f"it says {sentence}"
            )
            assert server.version() == version
            assert server.metric("reload_failing") == 1
        point(link, last)
        server.wait_until(lambda: server.version() != version, "the last bundle serves")
        server.wait_until(lambda: answers[-1]["model"] == server.version(), "it answers too")
        assert server.reload_error() == ""
    assert {answer["model"] for answer in answers} == {version, server.version()}
    best = {answer["model"]: answer["poses"][0]["confidence"] for answer in answers}
    assert best[version] == pytest.approx(0.95)
    assert best[server.version()] == pytest.approx(0.9)
    # Every poll saw each bad bundle; the log says it once, and that the problem is over once.
    said = [line for line in server.log("reload") if line["level"] == "error"]
    assert len(said) == 5
    assert all(f"bracket {version} goes on serving" in line["message"] for line in said)
    assert server.log("reload")[-1]["message"].endswith("the problem is over")
    assert server.metric("reloads_total", outcome="loaded") == 2
    assert server.metric("reloads_total", outcome="refused") >= 5


def move_golden(folder: Path, metres: float) -> None:
    """Expect every pose of the golden clouds elsewhere."""
    for path in (folder / "golden").iterdir():
        arrays = dict(np.load(path))
        arrays["camera_from_part"][:, 0, 3] += metres
        np.savez(path, **arrays)


def sign_again(folder: Path, keys: Path) -> None:
    """Sign a bundle with a key that nobody trusts."""
    from attentionvote.inference.bundles.manifest import write_manifest

    write_manifest(folder, load_private_key(make_keys(keys)[0]))


def test_a_bad_bundle_that_is_mended_in_place_is_taken_up(start_server: Any, make_bundle: Make) -> None:
    folder, new = make_bundle("served"), make_bundle("new", graph={"confidence": (0.7, 0.9, 0.3, 0.99)})
    server = start_server(folder)
    version = server.version()
    # Copied over file by file, the manifest first, as a careless person does.
    for name in ("manifest.json", "manifest.sig"):
        shutil.copyfile(new / name, folder / name)
    server.wait_until(lambda: server.metric("reload_failing") == 1, "the half copy is refused")
    assert server.version() == version
    assert server.post("/v2/repository/models/bracket/load").status == 409
    assert server.post("/v2/repository/index").json[0]["reason"] == server.reload_error()
    for name in ("model.onnx", "card.json", "part.ply", "golden/cloud_0.npz"):
        shutil.copyfile(new / name, folder / name)
    server.wait_until(lambda: server.version() != version, "the whole copy serves")
    assert server.reload_error() == ""


def test_a_running_request_ends_on_the_model_it_began_with(
    start_server: Any, make_bundle: Make, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    link = tmp_path / "latest"
    point(link, make_bundle("slow", graph={"loops": 600_000}))
    server = start_server(link, "--deadline-ms", "30000", "--poll-s", "3600")
    version = server.version()
    replies: list[Any] = []
    running = threading.Thread(target=lambda: replies.append(server.post("/poses", npy(make_cloud()))))
    running.start()
    server.wait_until(lambda: server.metric("queue_depth") == 1, "the request runs")
    point(link, make_bundle("fast", card={"part": {"name": "gear"}}))
    loaded = server.post("/v2/repository/models/bracket/load")  # looks at once
    assert loaded.status == 200
    assert loaded.json["name"] == "gear"
    assert loaded.json["version"] == server.version() != version
    assert server.get("/v2/models/bracket").status == 404  # another part is another name
    running.join()
    assert replies[0].json["model"] == version
    assert replies[0].json["part"] == "bracket"


def test_killed_in_the_middle_of_a_copy_nothing_is_lost(start_server: Any, make_bundle: Make, tmp_path: Path) -> None:
    link, state = tmp_path / "latest", tmp_path / "state"
    point(link, make_bundle("old"))
    server = start_server(link, "--state", str(state))
    version = server.version()
    point(link, make_bundle("new", graph={"confidence": (0.7, 0.9, 0.3, 0.99)}, change=padded))
    until = time.monotonic() + 20
    while not list(state.glob("staging-*")):
        assert time.monotonic() < until
    server.kill()
    assert list(state.glob("staging-*"))  # killed in time, not after it
    assert [p.name.endswith(version) for p in (state / "kept").iterdir()] == [True]

    shutil.rmtree(link.resolve())  # and the registry is gone as well
    restarted = start_server(link, "--state", str(state))
    assert restarted.version() == version
    assert restarted.metric("serving_last_known_good") == 1
    assert not list(state.glob("staging-*"))


def test_the_registry_is_down_at_the_start_and_comes_back(
    start_server: Any, make_bundle: Make, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    link, state = tmp_path / "latest", tmp_path / "state"
    point(link, make_bundle("a"))
    server = start_server(link, "--state", str(state))
    version = server.version()
    assert server.stop() == 0
    point(link, tmp_path / "unreachable")
    server = start_server(link, "--state", str(state))
    assert server.version() == version
    assert server.post("/poses", npy(make_cloud())).json["answer"] == "estimate"
    assert server.metric("serving_last_known_good") == 1
    assert server.metric("reloads_total", outcome="last_known_good") == 1
    assert "cannot be opened" in server.reload_error()
    (line,) = server.log("model")
    assert line["last_known_good"] is True
    assert line["level"] == "warning"
    # Back, with a truncated copy first: the last known good goes on; then with what served before.
    point(link, make_bundle("truncated", graph={"confidence": (0.7, 0.9, 0.3, 0.99)}))
    os.truncate(link.resolve() / "part.ply", 3)
    server.wait_until(lambda: "part.ply must have" in server.reload_error(), "the truncated copy is refused")
    assert server.version() == version
    point(link, make_bundle("b", graph={"confidence": (0.7, 0.92, 0.3, 0.99)}))
    server.wait_until(lambda: server.metric("serving_last_known_good") == 0, "the path's own bundle serves")
    assert server.version() != version
    assert server.reload_error() == ""
    # Down again, and the newest copy has rotted: the one before serves.
    server.kill()
    point(link, tmp_path / "unreachable")
    (max((state / "kept").iterdir()) / "model.onnx").write_bytes(b"rot")
    server = start_server(link, "--state", str(state))
    assert server.version() == version
    assert any("a kept copy cannot serve" in line["message"] for line in server.log("last_known_good"))


def test_nothing_to_start_from_is_live_but_not_ready_until_there_is(
    start_server: Any, make_bundle: Make, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "served"
    server = start_server(folder, ready=False)
    assert server.get("/v2/health/live").status == 200
    server.wait_until(
        lambda: "no last known good copy" in server.get("/v2/health/ready").error, "it says what it lacks"
    )
    reply = server.get("/v2/health/ready")
    assert reply.status == 503
    assert f"no model is ready: {folder} must be a bundle's folder" in reply.error
    assert server.metric("ready") == 0
    refused = server.post("/poses", npy(make_cloud()))
    assert refused.status == 503
    assert refused.headers["Retry-After"] == "2"
    assert server.post("/v2/repository/index").json == []
    assert server.get("/").json["model"] is None
    make_bundle("elsewhere").rename(folder)
    server.wait_ready()
    assert server.metric("ready") == 1


def limit_file_size(server: Any, size: int) -> None:
    """From now on the process can write no file beyond this size."""
    import resource

    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def test_a_bundle_that_cannot_be_kept_is_not_taken_up(start_server: Any, make_bundle: Make, tmp_path: Path) -> None:
    link, state = tmp_path / "latest", tmp_path / "state"
    point(link, make_bundle("a"))
    server = start_server(link, "--state", str(state))
    version = server.version()
    limit_file_size(server, LARGE // 2)
    point(link, make_bundle("b", graph={"confidence": (0.7, 0.9, 0.3, 0.99)}, change=padded))
    server.wait_until(lambda: "File too large; it is tried again" in server.reload_error(), "it says why")
    assert server.version() == version
    assert not list(state.glob("staging-*"))
    assert len(list((state / "kept").iterdir())) == 1
    limit_file_size(server, 10 * LARGE)
    server.wait_until(lambda: server.version() != version, "it is tried again by itself")
    assert server.metric("last_known_good_kept") == 1


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of this size in memory; skips where none can be mounted."""
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_at_the_start_serves_but_says_so(start_server: Any, make_bundle: Make, tmp_path: Path) -> None:
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("mounting a small disk needs root")
    disk = tmp_path / "disk"
    with small_disk(disk, "1m"):
        server = start_server(make_bundle(change=padded), "--state", str(disk / "state"))
        assert server.metric("last_known_good_kept") == 0
        server.wait_until(lambda: len(server.log("last_known_good")) > 0, "it says so")
        # The bundle at the path serves all the same: nothing fails but the copy.
        assert (server.metric("reload_failing"), server.reload_error()) == (0, "")
        assert server.post("/v2/repository/models/bracket/load").status == 200
        (line,) = server.log("last_known_good")
        assert "the bundle serves but cannot be kept for the next start: No space left" in line["message"]
        assert not list((disk / "state").glob("staging-*"))
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        server.wait_until(lambda: server.metric("last_known_good_kept") == 1, "it is kept when there is room")
        assert server.reload_error() == ""
        assert server.stop() == 0


def test_without_a_place_for_copies_it_serves_and_takes_up_bundles(
    start_server: Any, make_bundle: Make, tmp_path: Path
) -> None:
    link = tmp_path / "latest"
    point(link, make_bundle("a"))
    (tmp_path / "file").write_text("no folder")
    server = start_server(link, "--state", str(tmp_path / "file" / "state"))
    version = server.version()
    assert server.metric("last_known_good_kept") == 0
    (line,) = server.log("last_known_good")
    assert "nothing can be kept for the next start" in line["message"]
    point(link, make_bundle("b", graph={"confidence": (0.7, 0.9, 0.3, 0.99)}))
    server.wait_until(lambda: server.version() != version, "the second serves")


def test_a_path_that_hangs_does_not_keep_the_cell_from_starting(
    make_bundle: Make, trusted_key: Path, tmp_path: Path
) -> None:
    """A network folder whose server is down blocks for ever; here an event takes its place."""
    answers = threading.Event()

    class Hanging(BundleLoader):
        def from_source(self, source: Path, *, must_keep: bool) -> tuple[Served, OSError | None]:
            answers.wait(30)
            return super().from_source(source, must_keep=must_keep)

    source = make_bundle()
    store = LastKnownGood(tmp_path / "state")
    loader = Hanging(trusted_key, lambda bundle, _: Workers(bundle, WorkerSettings()), store)
    bundle, workers = loader.tested(source)
    workers.close()
    store.keep(source, bundle, trusted_key)

    async def start() -> tuple[bool, bool]:
        serving, metrics = Serving(Metrics()), Metrics()
        watch = BundleWatch(source, loader, serving, metrics, poll_s=0.05, patience_s=0.1)
        task = asyncio.create_task(watch.run())
        while serving.current is None:
            await asyncio.sleep(0.01)
        first = serving.current.last_known_good
        assert "does not answer within 0.1 s" in (watch.problem or "")
        answers.set()
        while serving.current.last_known_good:
            await asyncio.sleep(0.01)
        task.cancel()
        watch.close()
        serving.close()
        return first, watch.problem is None

    assert asyncio.run(asyncio.wait_for(start(), 20)) == (True, True)
    store.close()
