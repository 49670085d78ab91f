"""Around every request: its id, its token, a line in the log, its outcome in the metrics, and no traceback outside."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from attentionvote.inference.server.access import OPEN_PATHS, Tokens, names_this_machine
from attentionvote.inference.server.answering import Record
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.refusal import Refusal

ID_HEADER = "X-Request-Id"
_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_QUIET = (*OPEN_PATHS, "/metrics")
_GONE = 499  # nginx' number for a client that left; never sent, only logged


class RequestLog:
    """ASGI middleware around the application.

    Args:
        app: answers requests.
        metrics: counts outcomes.
        tokens: accepted; None: everybody's.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, tokens: Tokens | None) -> None:
        self._app, self._metrics, self._tokens = app, metrics, tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other kinds of messages pass."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun = time.monotonic()
        headers = Headers(scope=scope)
        asked = headers.get(ID_HEADER, "")
        identity = asked if _ID.fullmatch(asked) else secrets.token_hex(6)
        record = scope.setdefault("state", {})["record"] = Record()
        status = 0

        async def numbered(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[ID_HEADER] = identity
            await send(message)

        try:
            self._check_connections(scope)
            self._check_host(headers)
            self._authorize(scope["path"], headers)
            await self._app(scope, receive, numbered)
        except Refusal as refusal:
            record.outcome, record.error = refusal.outcome, refusal.sentence
            await refusal.response()(scope, receive, numbered)
        except asyncio.CancelledError:  # the server ends, and the time for open requests has passed
            record.outcome = "unavailable"
            if status == 0:
                sentence = "the request must end while the server does, but it took longer: send it again"
                await Refusal(503, sentence, "unavailable").response()(scope, receive, numbered)
        except ClientDisconnect:
            status, record.outcome = _GONE, "gone"
        except Exception:
            say("error", "a request failed in an unforeseen way", logging.ERROR, trace=True, id=identity)
            record.outcome = "failed"
            if status == 0:
                sentence = f"internal error: the server's log has the details under request id {identity}"
                await Refusal(500, sentence, "failed").response()(scope, receive, numbered)
        self._end(scope, record, identity, status, time.monotonic() - begun)

    def _check_connections(self, scope: Scope) -> None:
        """A connection beyond the limit is there for questions about health."""
        most = scope["state"].get("most_connections")
        if most is not None and scope["path"] not in OPEN_PATHS:
            raise Refusal(
                503,
                f"at most {most} connections may have a request in progress, and all have: try again shortly",
                "overloaded",
                {"Retry-After": "1"},
            )

    def _check_host(self, headers: Headers) -> None:
        """Without a token a web page must not reach this server under a name of its own (DNS rebinding)."""
        host = headers.get("host")
        if self._tokens is None and host is not None and not names_this_machine(host):
            raise Refusal(
                421,
                f"the header Host must name this machine, such as localhost, without --token-file, got {host[:80]!r}: "
                "ask 127.0.0.1, or start the server with a token file",
                "rejected",
            )

    def _authorize(self, path: str, headers: Headers) -> None:
        if self._tokens is None or path in OPEN_PATHS:
            return
        authorization = headers.get("authorization")
        if not self._tokens.accept(authorization):
            what = "another token" if (authorization or "").lower().startswith("bearer ") else "another scheme"
            what = what if authorization is not None else "none"
            raise Refusal(
                401,
                f"the header Authorization must be 'Bearer' and the token of the server's token file, got {what}",
                "unauthorized",
                {"WWW-Authenticate": "Bearer"},
            )

    def _end(self, scope: Scope, record: Record, identity: str, status: int, seconds: float) -> None:
        path: str = scope["path"]
        client = scope["client"][0] if scope.get("client") else None
        outcome = record.outcome or ("ok" if status < 400 else "rejected")
        reason = record.reason or ("deadline_exceeded" if outcome == "deadline" else None)
        if path == "/poses" or path.endswith("/infer"):
            self._metrics.requests.labels(outcome).inc()
            self._metrics.seconds.labels("total").observe(seconds)
            if reason is not None:
                self._metrics.abstentions.labels(reason).inc()
        elif status == 200 and path in _QUIET:
            return
        stages = {stage: round(1e3 * value, 1) for stage, value in record.seconds.items()}
        say(
            "request", id=identity, method=scope["method"], path=path[:200], status=status, ms=round(1e3 * seconds, 1),
            outcome=outcome, points=record.points, detections=record.detections, reason=reason,
            error=record.error, client=client, stages_ms=stages or None,
        )  # fmt: skip
