"""The log's line of a request: what it says, and what it never says."""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path
from typing import Any

TOKEN = "swordfish-" + "7" * 20


def test_a_line_a_request_without_secrets_or_clouds(
    start_server: Any, bundle_folder: Path, make_cloud: Any, npy: Any, tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o644)
    server = start_server(bundle_folder, "--token-file", str(token))
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    cloud = make_cloud()
    good = server.post(f"/poses?key={TOKEN}", npy(cloud), {**bearer, "X-Request-Id": "robot-1.scan_7"})
    assert good.headers["X-Request-Id"] == "robot-1.scan_7"
    assert good.status == 200
    made_up = server.post("/poses", npy(cloud * 1000), {**bearer, "X-Request-Id": "a b\tc" + "d" * 99})
    assert re.fullmatch(r"[0-9a-f]{12}", made_up.headers["X-Request-Id"])
    wrong = {"none": None, "another token": f"Bearer {TOKEN}x", "another scheme": "Basic x"}
    for got, authorization in wrong.items():
        headers = {"Authorization": authorization} if authorization else {}
        for path in ("/poses", "/metrics", "/", "/v2", "/v2/models/bracket", "/v2/repository/index", "/nowhere"):
            refused = server.ask(
                "POST" if path == "/poses" else "GET", path, npy(cloud) if path == "/poses" else None, headers
            )
            assert refused.status == 401
            assert refused.headers["WWW-Authenticate"] == "Bearer"
            assert refused.error.endswith(f"got {got}")
    assert server.get("/v2/health/live").status == 200
    assert server.get("/v2/health/ready").status == 200
    server.headers = bearer
    assert server.metric("requests_total", outcome="unauthorized") == 3
    assert server.get("/").status == 200

    lines = server.log("request")
    first = next(line for line in lines if line["id"] == "robot-1.scan_7")
    assert (first["method"], first["path"], first["status"], first["outcome"]) == ("POST", "/poses", 200, "ok")
    assert (first["points"], first["detections"]) == (3000, 2)
    assert first["ms"] > 0
    assert list(first["stages_ms"]) == ["receive", "queue", "parse", "estimate"]
    second = next(line for line in lines if line["status"] == 400)
    assert "were millimetres sent" in second["error"]
    assert not [line for line in lines if line["path"] in ("/metrics", "/v2/health/ready") and line["status"] == 200]
    text = server.log_file.read_text(encoding="utf-8")
    assert "swordfish" not in text
    assert "chmod 600" in text  # everybody on the machine could read the token
    assert not re.search(r"0\.\d{5}", text)  # no coordinate of any cloud


def test_every_line_is_json_with_the_same_beginning(shared_server: Any) -> None:
    shared_server.get("/nowhere")
    for line in shared_server.log_file.read_text(encoding="utf-8").splitlines():
        content = json.loads(line)
        assert list(content)[:3] == ["time", "level", "event"]
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", content["time"])


def test_without_a_token_only_this_machine_s_names_are_answered(shared_server: Any) -> None:
    for path in ("/v2", "/v2/health/live", "/metrics"):
        refused = shared_server.ask("GET", path, headers={"Host": "evil.example:8000"})
        assert refused.status == 421
        assert refused.error == (
            "the header Host must name this machine, such as localhost, without --token-file, got 'evil.example:8000': "
            "ask 127.0.0.1, or start the server with a token file"
        )
        assert shared_server.ask("GET", path, headers={"Host": "localhost:1"}).status == 200
    host, port = shared_server.address.split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(b"GET /v2 HTTP/1.0\r\n\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_with_a_token_any_name_is_answered(start_server: Any, bundle_folder: Path, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    server = start_server(bundle_folder, "--token-file", str(token), ready=False)
    headers = {"Host": "cell.example", "Authorization": f"Bearer {TOKEN}"}
    assert server.ask("GET", "/v2", headers=headers).status == 200
