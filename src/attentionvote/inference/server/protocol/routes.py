"""The Open Inference Protocol's endpoints: health, metadata, inference, and the repository's index and load."""

from __future__ import annotations

import asyncio
import importlib.metadata
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from attentionvote.inference.server.answering import Answering
from attentionvote.inference.server.bounded_json import parse_json
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.model.following import Watch
from attentionvote.inference.server.model.serving import Served
from attentionvote.inference.server.protocol.answer import EXTENSIONS, model_config, model_metadata
from attentionvote.inference.server.protocol.request import LENGTH_HEADER
from attentionvote.inference.server.reception import Reception
from attentionvote.inference.server.refusal import Refusal

_MOST_INDEX_BYTES, _INDEX_S, _LOOK_S = 4096, 5.0, 30.0
_LONGEST_LENGTH = 40


class ProtocolRoutes:
    """The endpoints.

    Args:
        answering: answers inference requests.
        watch: looks at the served path when asked.
        version: of the server.
    """

    def __init__(self, answering: Answering, watch: Watch, version: str) -> None:
        self._answering, self._serving, self._watch, self._version = answering, answering.serving, watch, version
        self._reception = Reception(_MOST_INDEX_BYTES)
        self._looking: asyncio.Task[str | None] | None = None

    def routes(self) -> list[Route]:
        """For the application."""
        model, versioned = "/v2/models/{name}", "/v2/models/{name}/versions/{version}"
        return [
            Route("/v2", self._server),
            Route("/v2/models/stats", self._statistics),
            Route("/v2/health/live", self._live),
            Route("/v2/health/ready", self._ready),
            *(Route(prefix, self._model) for prefix in (model, versioned)),
            *(Route(prefix + "/ready", self._model_ready) for prefix in (model, versioned)),
            *(Route(prefix + "/config", self._config) for prefix in (model, versioned)),
            *(Route(prefix + "/stats", self._statistics) for prefix in (model, versioned)),
            *(Route(prefix + "/infer", self._infer, methods=["POST"]) for prefix in (model, versioned)),
            Route("/v2/repository/index", self._index, methods=["POST"]),
            Route("/v2/repository/models/{name}/load", self._load, methods=["POST"]),
        ]

    async def _server(self, _: Request) -> Response:
        content = {"name": "attentionvote", "version": self._version, "extensions": list(EXTENSIONS)}
        return JSONResponse(content | {"runtime": f"onnxruntime {importlib.metadata.version('onnxruntime')}"})

    async def _live(self, _: Request) -> Response:
        return JSONResponse({"live": True})

    async def _ready(self, _: Request) -> Response:
        served = self._serving.ready()
        content = {"ready": True, "model": served.name, "version": served.version}
        return JSONResponse(content | registered(served))

    async def _model(self, request: Request) -> Response:
        served = self._serving.model(**request.path_params)
        return JSONResponse(model_metadata(served.name, served.version, served.card))

    async def _config(self, request: Request) -> Response:
        return JSONResponse(model_config(self._serving.model(**request.path_params).name))

    async def _statistics(self, request: Request) -> Response:
        served = self._serving.model(**request.path_params)
        return JSONResponse({"model_stats": [self._answering.tally.statistics(served.name, served.version)]})

    async def _model_ready(self, request: Request) -> Response:
        served = self._serving.ready(**request.path_params)
        return JSONResponse({"name": served.name, "ready": True})

    async def _infer(self, request: Request) -> Response:
        job = {"kind": "infer", "header_length": _short(request.headers.get(LENGTH_HEADER))}
        return await self._answering.ask(request, job, **request.path_params)

    async def _index(self, request: Request) -> Response:
        with await self._reception.body(request, Deadline(_INDEX_S)) as body:
            if body.size:
                parse_json("the request", body.content())  # `ready` may be asked for: all there is, is ready
        served = self._serving.current
        models: list[dict[str, Any]] = []
        if served is not None:
            reason = self._watch.problem or ""
            model = {"name": served.name, "version": served.version, "state": "READY", "reason": reason}
            models.append(model | registered(served))
        return JSONResponse(models)

    async def _load(self, request: Request) -> Response:
        if self._serving.current is not None:
            self._serving.model(request.path_params["name"])
        if self._looking is None or self._looking.done():  # all who ask meanwhile get the same answer
            self._looking = asyncio.create_task(self._watch.check())
        done, _ = await asyncio.wait({self._looking}, timeout=_LOOK_S)
        if not done:
            sentence = f"the look at the bundle must end within {_LOOK_S:g} s, but it goes on: the index has its result"
            raise Refusal(504, sentence, "rejected")
        problem = self._looking.result()
        if problem is not None:
            raise Refusal(409, problem, "rejected")
        served = self._serving.model()
        return JSONResponse({"name": served.name, "version": served.version, "state": "READY"})


def _short(text: str | None) -> str | None:
    """A header's value for a worker, which refuses it; no right one is longer."""
    return None if text is None else text[:_LONGEST_LENGTH]


def registered(served: Served) -> dict[str, Any]:
    """``{"registry": {"name": ..., "version": ...}}`` of a model from a registry, else nothing."""
    if served.origin is None:
        return {}
    return {"registry": {"name": served.origin.name, "version": served.origin.version}}
