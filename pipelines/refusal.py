"""The outcome no: work that is done and did not come to what was asked for."""

from __future__ import annotations

from typing import Any


class Refused(ValueError):
    """The work is done and its outcome is no: the JSON line is printed all the same, the exit code is 1.

    Args:
        sentence: why.
        result: the dictionary of the JSON line.
    """

    def __init__(self, sentence: str, result: dict[str, Any]) -> None:
        super().__init__(sentence)
        self.result = result
