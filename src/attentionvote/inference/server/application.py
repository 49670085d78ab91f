"""The application: the protocol's endpoints, plain ``/poses``, ``/metrics`` and a word about itself at ``/``."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from attentionvote.inference.errors import InputError, nearest
from attentionvote.inference.server.access import Tokens
from attentionvote.inference.server.answering import Answering
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.following import Watch
from attentionvote.inference.server.protocol.answer import parts_of
from attentionvote.inference.server.protocol.routes import ProtocolRoutes, registered
from attentionvote.inference.server.refusal import Refusal, bad_request
from attentionvote.inference.server.request_log import RequestLog

DOCUMENTATION = "attentionvote docs operating-a-cell"  # a command: the cell has it, the repository it has not
_PATHS = (
    "/poses", "/metrics", "/v2", "/v2/health/live", "/v2/health/ready", "/v2/models/MODEL", "/v2/models/MODEL/infer",
    "/v2/models/MODEL/ready", "/v2/models/MODEL/config", "/v2/models/MODEL/stats",
    "/v2/repository/index", "/v2/repository/models/MODEL/load",
)  # fmt: skip


def application(answering: Answering, watch: Watch, metrics: Metrics, tokens: Tokens | None, version: str) -> Starlette:
    """The ASGI application.

    Args:
        answering: answers requests for poses.
        watch: runs while the application does.
        metrics: of ``/metrics``.
        tokens: accepted; None: no token is asked for.
        version: of the server.
    """
    pages = _Pages(answering, metrics, version)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(watch.run())
        task.add_done_callback(_watch_ended)
        yield
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        watch.close()
        answering.serving.close()

    app = Starlette(
        routes=[
            Route("/", pages.itself),
            Route("/poses", pages.poses, methods=["POST"]),
            Route("/metrics", pages.metrics),
            *ProtocolRoutes(answering, watch, version).routes(),
        ],
        exception_handlers={HTTPException: _http_error, InputError: _input_error, Refusal: _refusal},
        middleware=[Middleware(RequestLog, metrics=metrics, tokens=tokens)],
        lifespan=lifespan,
    )
    app.router.redirect_slashes = False
    return app


class _Pages:
    """The endpoints that belong to no protocol."""

    def __init__(self, answering: Answering, metrics: Metrics, version: str) -> None:
        self._answering, self._metrics, self._version = answering, metrics, version

    async def itself(self, _: Request) -> Response:
        """What is served here and where to read on."""
        served = self._answering.serving.current
        model: dict[str, Any] | None = None
        if served is not None:
            part = asdict(served.card.part)
            model = {"name": served.name, "version": served.version, "digest": served.digest, "part": part}
            model |= {"parts": parts_of(served.card), **registered(served)}
        content = {
            "name": "attentionvote",
            "version": self._version,
            "model": model,
            "endpoints": list(_PATHS),
            "documentation": DOCUMENTATION,
        }
        return JSONResponse(content)

    async def poses(self, request: Request) -> Response:
        """Poses of the cloud or depth image that the body is."""
        return await self._answering.ask(request, {"kind": "file"})

    async def metrics(self, _: Request) -> Response:
        """Prometheus' text."""
        return Response(self._metrics.text(), headers={"Content-Type": CONTENT_TYPE_LATEST})


async def _http_error(request: Request, error: Exception) -> Response:
    """Starlette's own refusals, in the server's form."""
    assert isinstance(error, HTTPException)
    path = request.url.path
    if error.status_code == 405:
        allowed = ", ".join(sorted((error.headers or {}).get("Allow", "another").split(", ")))
        sentence = f"the method for {path[:80]} must be {allowed}, got {request.method}"
        refusal = Refusal(405, sentence, "rejected", {"Allow": allowed})
    elif error.status_code == 404:
        hint = nearest(path[:200], _PATHS) or f", see `{DOCUMENTATION}`"
        refusal = bad_request(f"the path must be one that is served here, got {path[:80]!r}{hint}", 404)
    else:
        refusal = bad_request(str(error.detail), error.status_code)
    return await _refusal(request, refusal)


async def _input_error(request: Request, error: Exception) -> Response:
    return await _refusal(request, bad_request(str(error)))


async def _refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    record = request.state.record
    record.outcome, record.error = error.outcome, error.sentence
    return error.response()


def _watch_ended(task: asyncio.Task[None]) -> None:
    """The watch never ends by itself; if it does, the log must know."""
    if not task.cancelled() and task.exception() is not None:
        say("error", f"the bundle's watch ended: {task.exception()!r}; restart the server", logging.CRITICAL)
