"""``attentionvote docs [PAGE]``: the pages that a cell's operator needs, on the cell itself.

In the repository ``pages/`` holds links to ``docs/``; a wheel gets what they lead to.
"""

from __future__ import annotations

import argparse
from importlib import resources
from importlib.resources.abc import Traversable

from attentionvote.inference.errors import InputError, nearest

_ENDING = ".md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    parser.add_argument("page", nargs="?", metavar="PAGE", help="which one is printed; without it they are listed")


def run(options: argparse.Namespace) -> int:
    """Print a page, or list all of them with their titles.

    Raises:
        InputError: when there is no such page.
    """
    pages = _pages()
    if options.page is None:
        width = max(map(len, pages))
        for name, page in sorted(pages.items()):
            title = page.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
            print(f"{name:{width}}  {title}")
        return 0
    name = options.page.removesuffix(_ENDING)
    if name not in pages:
        hint = nearest(name, pages)
        raise InputError(f"the page must be one of {', '.join(sorted(pages))}, got {options.page[:80]!r}{hint}")
    print(pages[name].read_text(encoding="utf-8"), end="")
    return 0


def _pages() -> dict[str, Traversable]:
    """The pages by name."""
    folder = resources.files("attentionvote.inference") / "pages"
    return {file.name.removesuffix(_ENDING): file for file in folder.iterdir() if file.name.endswith(_ENDING)}
