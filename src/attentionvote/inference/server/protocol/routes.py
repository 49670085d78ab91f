"""The Open Inference Protocol's endpoints: health, metadata, inference, and the repository's index and load."""

from __future__ import annotations

from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from attentionvote.inference.runtime import runtime_version
from attentionvote.inference.server.admission import Deadline, read_body
from attentionvote.inference.server.answering import Answering, Question, Reply
from attentionvote.inference.server.bounded_json import parse_json
from attentionvote.inference.server.model.reloading import Watch
from attentionvote.inference.server.model.serving import Served
from attentionvote.inference.server.protocol.answer import (
    EXTENSIONS,
    answer_parameters,
    encode_answer,
    model_metadata,
    pose_tensors,
)
from attentionvote.inference.server.protocol.request import InferRequest, parse_request
from attentionvote.inference.server.refusal import Refusal

LENGTH_HEADER = "Inference-Header-Content-Length"
_MOST_INDEX_BYTES, _INDEX_S = 4096, 5.0


class ProtocolRoutes:
    """The endpoints.

    Args:
        answering: answers inference requests.
        watch: looks at the served path when asked.
        version: of the server.
    """

    def __init__(self, answering: Answering, watch: Watch, version: str) -> None:
        self._answering, self._serving, self._watch, self._version = answering, answering.serving, watch, version

    def routes(self) -> list[Route]:
        """For the application."""
        model, versioned = "/v2/models/{name}", "/v2/models/{name}/versions/{version}"
        return [
            Route("/v2", self._server),
            Route("/v2/health/live", self._live),
            Route("/v2/health/ready", self._ready),
            *(Route(prefix, self._model) for prefix in (model, versioned)),
            *(Route(prefix + "/ready", self._model_ready) for prefix in (model, versioned)),
            *(Route(prefix + "/infer", self._infer, methods=["POST"]) for prefix in (model, versioned)),
            Route("/v2/repository/index", self._index, methods=["POST"]),
            Route("/v2/repository/models/{name}/load", self._load, methods=["POST"]),
        ]

    async def _server(self, _: Request) -> Response:
        content = {"name": "attentionvote", "version": self._version, "extensions": list(EXTENSIONS)}
        return JSONResponse(content | {"runtime": f"onnxruntime {runtime_version()}"})

    async def _live(self, _: Request) -> Response:
        return JSONResponse({"live": True})

    async def _ready(self, _: Request) -> Response:
        served = self._serving.model()
        content = {"ready": True, "model": served.name, "version": served.version}
        return JSONResponse(content | registered(served))

    async def _model(self, request: Request) -> Response:
        served = self._serving.model(**request.path_params)
        return JSONResponse(model_metadata(served.name, served.version))

    async def _model_ready(self, request: Request) -> Response:
        served = self._serving.model(**request.path_params)
        return JSONResponse({"name": served.name, "ready": True})

    async def _infer(self, request: Request) -> Response:
        length = request.headers.get(LENGTH_HEADER)

        def read(body: bytes) -> Question:
            asked = parse_request(body, length)
            return Question({"points": asked.points}, asked.deadline_ms, asked)

        reply = await self._answering.ask(request, read, **request.path_params)
        body, head = await run_in_threadpool(_encoded, reply)
        headers = {} if head is None else {LENGTH_HEADER: str(head)}
        return Response(
            body, media_type="application/json" if head is None else "application/octet-stream", headers=headers
        )

    async def _index(self, request: Request) -> Response:
        body = await read_body(request, _MOST_INDEX_BYTES, Deadline(_INDEX_S))
        if body:
            parse_json("the request", body)  # `ready` may be asked for: all there is, is ready
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
        problem = await self._watch.check()
        if problem is not None:
            raise Refusal(409, problem, "rejected")
        served = self._serving.model()
        return JSONResponse({"name": served.name, "version": served.version, "state": "READY"})


def registered(served: Served) -> dict[str, Any]:
    """``{"registry": {"name": ..., "version": ...}}`` of a model from a registry, else nothing."""
    if served.origin is None:
        return {}
    return {"registry": {"name": served.origin.name, "version": served.origin.version}}


def _encoded(reply: Reply) -> tuple[bytes, int | None]:
    answer, served = reply.answer.to_dict(), reply.served
    asked: InferRequest = reply.question.request
    parameters = answer_parameters(answer, served.name, served.digest)
    tensors = pose_tensors(answer["poses"])
    return encode_answer(served.name, served.version, asked.id, parameters, tensors, asked.outputs)
