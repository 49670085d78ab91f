"""Every file under conf/ composes, and what it names with _target_ exists and takes the keys beside it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf

from attentionvote.command.conf_folder import CONF, primary_groups
from attentionvote.command.configuration import compose, leaves
from attentionvote.command.schema import violation
from attentionvote.part import Part, PartSet

FILES = sorted(CONF.rglob("*.yaml"))
VERBS = [p.stem for p in FILES if p.parent == CONF]
OBJECTS = [p.stem for p in FILES if p.parent.name == "object"]
MANDATORY = {"benchmark": ["table=table_6"], "part": ["name=bracket", "mesh=bracket.stl"]}
INSTANTIATE_KEYS = {"_target_", "_partial_", "_recursive_", "_convert_", "_args_"}


def identifier(path: Path) -> str:
    """Test id: the path below conf/."""
    return path.relative_to(CONF).as_posix()


def group_of(path: Path) -> str:
    """``a/b`` for ``conf/a/b/x.yaml``; empty for a verb's primary file."""
    return path.parent.relative_to(CONF).as_posix().removeprefix(".")


def defaults_of(verb: str) -> dict[str, str]:
    """Group and choice of a verb's defaults list."""
    return {group: str(choice) for group, choice in primary_groups(verb).items()}


def words_for(verb: str) -> list[str]:
    """What a user has to say at least."""
    object_word = ["object=connecting_rod"] if defaults_of(verb).get("object") == "???" else []
    return [*object_word, *MANDATORY.get(verb, [])]


def composed(path: Path) -> Any:
    """The configuration of the first verb that knows the file's group, with this file chosen."""
    group = group_of(path)
    for verb in VERBS:
        if group in defaults_of(verb):
            words = [w for w in words_for(verb) if not w.startswith(f"{group}=")]
            return compose(verb, [*words, f"{group}={path.stem}"])
    raise AssertionError(f"no verb has the group {group}: the file is dead")


def targets(node: Any) -> Iterator[Mapping[str, Any]]:
    """Every mapping that is to be instantiated."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield node
        for value in node.values():
            yield from targets(value)
    elif isinstance(node, list):
        for item in node:
            yield from targets(item)


@pytest.mark.parametrize("path", FILES, ids=identifier)
def test_file_composes_and_its_targets_take_its_keys(path: Path) -> None:
    cfg = composed(path) if group_of(path) else compose(path.stem, words_for(path.stem))
    for node in targets(OmegaConf.to_container(cfg, resolve=True)):
        target = get_object(node["_target_"])
        arguments = {key: None for key in node if key not in INSTANTIATE_KEYS}
        inspect.signature(target).bind_partial(**arguments)


@pytest.mark.parametrize("path", FILES, ids=identifier)
def test_file_opens_with_what_it_is_for(path: Path) -> None:
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("#"), "the first line says what the file is for"


def test_primary_lists_start_with_self_so_that_an_experiment_wins() -> None:
    for verb in VERBS:
        primary = OmegaConf.to_container(OmegaConf.load(CONF / f"{verb}.yaml"))
        assert isinstance(primary, dict)
        if "defaults" in primary:
            assert primary["defaults"][0] == "_self_", verb


def part_settings(name: str) -> Any:
    """The section of one object, without a verb around it."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra_compose(f"object/{name}").object


@pytest.mark.parametrize("name", OBJECTS)
def test_object_describes_a_part(
    name: str, shared_data: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_DATA", "nowhere")
    settings = part_settings(name)
    assert settings.name == name
    assert not [
        v for key, value in leaves({"object": OmegaConf.to_container(settings)}) if (v := violation(key, value))
    ]
    if "ATTENTIONVOTE_DATA" in (CONF / "object" / f"{name}.yaml").read_text(encoding="utf-8"):
        # The mesh is the user's: without it the sentence says where it belongs, with it the part loads.
        with pytest.raises(Exception, match=r"must be at 'nowhere/meshes/"):
            instantiate(settings)
        monkeypatch.setenv("ATTENTIONVOTE_DATA", str(shared_data("")))
        settings = part_settings(name)
        if not Path(settings.mesh).exists():
            pytest.skip(f"the check data has no {Path(settings.mesh).name}")
    part = instantiate(settings)
    assert part.name == name
    if "parts" in settings:
        assert isinstance(part, PartSet)
        assert [one.name for one in part.parts] == list(settings.parts)
        assert part.diameter == max(one.diameter for one in settings.parts.values())
        return
    assert isinstance(part, Part)
    assert part.diameter == pytest.approx(settings.diameter)
