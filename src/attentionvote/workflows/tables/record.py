"""What was measured of a table: in a file beside the page that shows it, so who has the page has its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attentionvote.files import write_json
from attentionvote.workflows.page_sections import record_of, stored_beside


@dataclass
class BenchmarkRecord:
    """The cells of a table by row and object.

    Args:
        table: name of the table.
        place: file that keeps them; None keeps nothing.
        cells: see ``benchmark_cells``.
    """

    table: str
    path: Path | None
    cells: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def beside(cls, page: str, table: str) -> BenchmarkRecord:
        """What earlier calls kept beside a page; nothing, and nothing is kept, without a page.

        Raises:
            ValueError: when the file is damaged: the page would lose what it shows.
        """
        if not page:
            return cls(table, None)
        cells = stored_beside(Path(page), table, "cells") or []
        return cls(table, record_of(Path(page), table), {(cell["row"], cell["object"]): cell for cell in cells})

    def add(self, row: str, name: str, cell: Mapping[str, Any]) -> None:
        """Keep a cell, in place of what was there."""
        self.cells[row, name] = {"row": row, "object": name, **cell}
        if self.path is not None:
            write_json(self.path, {"table": self.table, "cells": list(self.cells.values())})
