"""docs/operating-a-cell.md says what the server says: every sentence, option and metric, and no others."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path

from attentionvote.inference.server import serve
from attentionvote.inference.server.metrics import Metrics

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "operating-a-cell.md").read_text(encoding="utf-8")
CELL = ROOT / "src" / "attentionvote" / "inference"
RAISERS = {"InputError", "BundleError", "Refusal", "bad_request"}


def text_of(node: ast.AST) -> str:
    """A sentence with … for its values; empty for what is none."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or "…" for part in node.values)
    return ""


def sentences(path: Path, raisers: set[str] | None) -> Iterator[str]:
    """The sentences in a module: all texts with a blank, or only those that are given to one of the raisers."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if raisers is None:
            found = [text_of(node)]
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            found = [text_of(argument) for argument in node.args] if name in raisers else []
        else:
            found = []
        yield from (text for text in found if " " in text)


def test_every_sentence_of_the_server_is_on_the_page() -> None:
    count = 0
    documented = [
        part.strip(" …:") for part in re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL))
    ]
    for path in sorted((CELL / "server").rglob("*.py")):
        for sentence in sentences(path, RAISERS):
            count += 1
            assert any(part in sentence for part in documented if len(part) > 12), f"{path.name}: {sentence}"
    assert count > 45


def test_every_sentence_on_the_page_is_said_by_the_code() -> None:
    said = [text for path in CELL.rglob("*.py") for text in sentences(path, None)]
    tables = PAGE.partition("## Sentences and what to do")[2].partition("## Load")[0]
    rows = [line.split("|") for line in tables.splitlines() if line.startswith("| ") and "---" not in line]
    count = 0
    for row in rows:
        cell = row[2] if len(row) == 5 else row[1]
        for sentence in re.findall(r"`([^`]+)`", cell):
            pieces = [piece for piece in sentence.split("…") if piece.strip(" .:,()")]
            if sentence in ("load", "cell file …"):
                continue
            count += 1
            pattern = re.compile(".*?".join(map(re.escape, pieces)), re.DOTALL)
            assert any(pattern.search(text) for text in said), sentence
    assert count > 70


def test_options_and_metrics_are_the_real_ones() -> None:
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    options = {word for action in parser._actions for word in action.option_strings if word.startswith("--")}
    table = PAGE.partition("| option |")[2].partition("\n\n")[0]
    assert set(re.findall(r"`(--[a-z][a-z-]*)", table)) == options - {"--help"}
    names = {
        name.removeprefix("attentionvote_")
        for name in re.findall(r"^# TYPE (\S+)", Metrics().text().decode(), re.MULTILINE)
    }
    table = PAGE.partition("| metric |")[2].partition("\n\n")[0]
    documented = {
        re.sub(r"\{.*", "", name)
        for line in table.splitlines()[2:]
        for name in re.findall(r"`([^`]+)`", line.split("|")[1])
    }
    assert documented == names
