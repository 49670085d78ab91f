"""A client of a cell's server: numpy and the standard library, nothing else.

``PoseClient("http://127.0.0.1:8000").estimate(points)`` sends a cloud through the Open Inference Protocol's binary
tensors and returns poses. One client belongs to one thread; its connection is kept open between calls.
"""

from __future__ import annotations

import http.client
import json
import math
import ssl
import time
import urllib.parse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.client.answer import (
    LENGTH_HEADER,
    Answer,
    DeadlinePassed,
    PoseClientError,
    Rejected,
    ServerFailed,
    Unauthorized,
    Unavailable,
    Unreachable,
    decode_answer,
)
from attentionvote.inference.client.timed_connection import TimedConnection

_MOST_ANSWER_BYTES = 64 * 1024 * 1024
# The server gives up at the deadline; its answer about that needs a moment to arrive.
_GRACE_S = 1.0


class _Response(NamedTuple):
    status: int
    headers: http.client.HTTPMessage
    body: bytes


class PoseClient:
    """Asks one server.

    Args:
        url: ``http://HOST:PORT`` or ``https://HOST:PORT``.
        token: of the server's token file; None when it asks for none.
        timeout_s: longest time a call may take when it names no deadline: connecting, sending, waiting, reading and
            asking again, all together, and at most one second more.
        part: the part that must be served; None takes what is served at the first call and holds on to it.
        ca_file: certificates to trust instead of the system's.

    Raises:
        ValueError: when the address is none.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        timeout_s: float = 10.0,
        part: str | None = None,
        ca_file: Path | str | None = None,
    ) -> None:
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.path.strip("/") or parts.query:
            raise ValueError(f"url must be http://HOST:PORT or https://HOST:PORT, got {url!r}")
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise ValueError(f"timeout_s must be positive seconds, got {timeout_s}")
        self._host, self._port, self._url = parts.hostname, parts.port, f"{parts.scheme}://{parts.netloc}"
        self._tls = ssl.create_default_context(cafile=ca_file) if parts.scheme == "https" else None
        self._headers = {} if token is None else {"Authorization": f"Bearer {_checked_token(token)}"}
        self._timeout_s, self._part = timeout_s, part
        self._connection: TimedConnection | None = None

    def estimate(self, points: NDArray[Any], deadline_ms: float | None = None) -> Answer:
        """Poses of the parts in a cloud.

        A server without a free place (503) is asked again when it says, as long as the deadline allows.

        Args:
            points: ``(P, 3)`` metres, camera frame.
            deadline_ms: for everything together, retries included, and a second more for the answer; the
                client's ``timeout_s`` when None.

        Raises:
            ValueError: when the points are no numbers of that shape.
            PoseClientError: one of its kinds, with the server's sentence.
        """
        cloud = np.asarray(points)
        if cloud.ndim != 2 or cloud.shape[1] != 3 or cloud.dtype.kind != "f":
            raise ValueError(f"points must be floating-point metres (P, 3), got {cloud.dtype} of shape {cloud.shape}")
        seconds = self._timeout_s if deadline_ms is None else deadline_ms / 1e3
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"deadline_ms must be positive milliseconds, got {deadline_ms}")
        end = time.monotonic() + seconds
        raw = np.ascontiguousarray(cloud, dtype="<f4").tobytes()
        tensor = {"name": "points", "datatype": "FP32", "shape": list(cloud.shape)}
        head = json.dumps(
            {
                "inputs": [tensor | {"parameters": {"binary_data_size": len(raw)}}],
                "parameters": {"binary_data_output": True},
            }
        ).encode()
        if self._part is None:
            self._part = _model_name(_json(self._until("GET", "/", b"", {}, end)))
        path = f"/v2/models/{urllib.parse.quote(self._part, safe='')}/infer"
        response = self._until("POST", path, head + raw, {LENGTH_HEADER: str(len(head))}, end)
        return decode_answer(response.body, response.headers.get(LENGTH_HEADER))

    def ready(self) -> bool:
        """Whether the server is reachable and a verified model serves."""
        try:
            return self._send("GET", "/v2/health/ready", b"", {}, self._patience()).status == 200
        except (Unreachable, DeadlinePassed):
            return False

    def metadata(self) -> dict[str, Any]:
        """What the server says about itself: its version, and under ``model`` the model and its part (None: none yet).

        Raises:
            PoseClientError: one of its kinds.
        """
        return _json(self._checked(self._send("GET", "/", b"", {}, self._patience())))

    def _patience(self) -> float:
        """When a call without a deadline of its own ends, of the monotonic clock."""
        return time.monotonic() + self._timeout_s

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def __enter__(self) -> PoseClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _until(self, method: str, path: str, body: bytes, headers: Mapping[str, str], end: float) -> _Response:
        """Ask until there is an answer other than "try again", or the deadline is too near for another try."""
        while True:
            left = end - time.monotonic()
            if left <= 0:
                raise DeadlinePassed(f"{self._url} did not answer within the deadline")
            deadline = {"X-Deadline-Ms": f"{min(max(1e3 * left, 1.0), 60_000.0):.0f}"}
            response = self._send(method, path, body, {**headers, **deadline}, end + _GRACE_S)
            if response.status == 200 and path == "/" and _json(response).get("model", {}) is None:
                wait, unavailable = 0.5, Unavailable(f"{self._url} serves no model yet")
            elif response.status == 503:
                wait, unavailable = _wait_s(response), Unavailable(_sentence(response))
            else:
                return self._checked(response)
            if time.monotonic() + wait >= end:
                raise unavailable
            time.sleep(wait)

    def _send(self, method: str, path: str, body: bytes, headers: Mapping[str, str], until: float) -> _Response:
        """One exchange. A kept connection that the server has closed meanwhile is replaced once."""
        while True:
            fresh = self._connection is None
            try:
                return self._exchange(method, path, body, headers, until)
            except TimeoutError as error:
                self.close()
                raise DeadlinePassed(f"{self._url} did not answer within the deadline") from error
            except (OSError, http.client.HTTPException) as error:
                self.close()
                if fresh:
                    reason = str(error) or type(error).__name__
                    raise Unreachable(f"{self._url} cannot be reached: {reason}") from error

    def _exchange(self, method: str, path: str, body: bytes, headers: Mapping[str, str], until: float) -> _Response:
        connection = self._connection
        if connection is None:
            connection = self._connection = TimedConnection(self._host, self._port, self._tls)
        connection.until = until
        connection.request(method, path, body=body or None, headers={**self._headers, **headers})
        response = connection.getresponse()
        if response.length is not None and response.length <= _MOST_ANSWER_BYTES:
            return _Response(response.status, response.headers, response.read())
        # A proxy may send chunks, whose sum nobody knows before.
        content = response.read(_MOST_ANSWER_BYTES + 1) if response.length is None else b""
        if response.length is not None or len(content) > _MOST_ANSWER_BYTES:
            self.close()
            raise ServerFailed(f"the answer must have at most {_MOST_ANSWER_BYTES} bytes, got more")
        return _Response(response.status, response.headers, content)

    def _checked(self, response: _Response) -> _Response:
        """The response when it is a good one.

        Raises:
            PoseClientError: the kind that belongs to its status.
        """
        if response.status == 200:
            return response
        kinds: dict[int, type[PoseClientError]] = {401: Unauthorized, 503: Unavailable, 504: DeadlinePassed}
        kind = kinds.get(response.status, Rejected if 400 <= response.status < 500 else ServerFailed)
        raise kind(_sentence(response))


def _wait_s(response: _Response) -> float:
    """How long the server asks to wait: its own header in milliseconds, else the standard one."""
    for name, factor in (("X-Retry-After-Ms", 1e-3), ("Retry-After", 1.0)):
        text = response.headers.get(name, "")
        if text.isdecimal():
            return max(int(text[:9]) * factor, 0.01)
    return 1.0


def _sentence(response: _Response) -> str:
    try:
        return str(json.loads(response.body)["error"])
    except (ValueError, KeyError, TypeError):
        return f"the server answered with status {response.status} and no sentence"


def _checked_token(token: str) -> str:
    """A token as a header may carry it, without the line end of the file it was read from; never in a message."""
    token = token.strip()
    if not token or not all("!" <= character <= "~" for character in token):
        raise ValueError("token must be printable ASCII characters without blanks, got others: is it the file's name?")
    return token


def _model_name(content: Mapping[str, Any]) -> str:
    try:
        return str(content["model"]["name"])
    except (KeyError, TypeError) as error:
        raise ServerFailed("the answer must name a model, but it does not: is it an attentionvote server?") from error


def _json(response: _Response) -> dict[str, Any]:
    try:
        content = json.loads(response.body)
        if isinstance(content, dict):
            return content
    except ValueError:
        pass
    raise ServerFailed("the answer must be a JSON object, got another kind of text: is it an attentionvote server?")
