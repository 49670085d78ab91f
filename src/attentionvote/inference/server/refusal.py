"""The one way a request is refused: a status, a sentence, and what a client should do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from starlette.responses import JSONResponse


class Refusal(Exception):
    """Answers a request with an error.

    Attributes:
        status: the HTTP status.
        sentence: what was wrong: rule, expected, actual.
        headers: of the answer, e.g. ``Retry-After``.
        content: further fields of the JSON body beside ``error``.
        outcome: what the metrics count it as.
    """

    def __init__(
        self,
        status: int,
        sentence: str,
        outcome: str,
        headers: Mapping[str, str] | None = None,
        content: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(sentence)
        self.status = status
        self.sentence = sentence
        self.outcome = outcome
        self.headers = dict(headers or {})
        self.content = dict(content or {})

    def response(self) -> JSONResponse:
        """``{"error": sentence}``, which is what the Open Inference Protocol asks for."""
        return JSONResponse({"error": self.sentence, **self.content}, self.status, headers=self.headers)


def bad_request(sentence: str, status: int = 400) -> Refusal:
    """A refusal that is the client's to mend."""
    return Refusal(status, sentence, "rejected")
