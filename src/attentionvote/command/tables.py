"""Tables for people, on stderr."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def show_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str | None = None,
    numbers: Sequence[str] = (),
    width: int | None = None,
) -> None:
    """Print rows under their columns.

    Args:
        columns: their names.
        rows: cells as texts; rich's markup counts.
        title: above the table.
        numbers: the columns that are flush right.
        width: of the terminal; None asks it.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right" if name in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(stderr=True, width=width).print(table)
