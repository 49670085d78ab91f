"""Vague words in identifiers: counted over the whole code, with a bound."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Each stood for several things at once (found: neighbourhoods, detections, a gate's finding ...): use the noun.
VAGUE = {"found", "known", "chosen", "own", "kept", "said", "place", "one", "given", "told"}
MOST = 5  # of 1,000 identifiers


def identifiers(tree: ast.Module) -> Iterator[str]:
    """Every identifier, each time it stands there."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.arg(arg=str(name)) | ast.keyword(arg=str(name)) | ast.Name(id=name) | ast.Attribute(attr=name):
                yield name
            case ast.alias(name=name, asname=asname):
                yield asname or name


def vague(name: str) -> bool:
    """Whether a word of the identifier is vague."""
    return bool(VAGUE & set(name.lower().strip("_").split("_")))


def test_identifiers_are_nouns_of_the_field() -> None:
    total, counts = 0, Counter[str]()
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "pipelines").glob("*.py")]:
        for name in identifiers(ast.parse(path.read_text(encoding="utf-8"))):
            total += 1
            counts[f"{path.relative_to(ROOT)}: {name}"] += vague(name)
    share = 1000 * counts.total() / total
    assert share <= MOST, f"{share:.1f} in 1,000, most of them {counts.most_common(10)}"


def test_vague_words_are_seen_inside_names() -> None:
    names = list(identifiers(ast.parse("def find(found): return x.last_known_good(own_mean=kept_rows, grounded=1)")))
    assert {name for name in names if vague(name)} == {"found", "last_known_good", "own_mean", "kept_rows"}
