"""Every file under conf/ composes into the settings of a verb, and every object describes a part."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from omegaconf import OmegaConf
from settings_of_verbs import settings_of

from attentionvote.command.conf_folder import CONF, primary_groups
from attentionvote.command.configuration import compose
from attentionvote.part import Part, PartSet
from attentionvote.section import Target

FILES = sorted(CONF.rglob("*.yaml"))
VERBS = [p.stem for p in FILES if p.parent == CONF]
OBJECTS = [p.stem for p in FILES if p.parent.name == "object"]
MANDATORY = {"benchmark": ["table=table_6"], "part": ["name=bracket", "mesh=bracket.stl"]}


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
            return compose(settings_of(verb), [*words, f"{group}={path.stem}"])
    raise AssertionError(f"no verb has the group {group}: the file is dead")


@pytest.mark.parametrize("path", FILES, ids=identifier)
def test_file_composes(path: Path) -> None:
    cfg = composed(path) if group_of(path) else compose(settings_of(path.stem), words_for(path.stem))
    assert cfg.composed


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


def part_settings(name: str) -> Target:
    """The section of one object, without a verb around it."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        section = OmegaConf.to_container(hydra_compose(f"object/{name}").object, resolve=True)
    assert isinstance(section, dict)
    return Target.of({str(key): value for key, value in section.items()})


@pytest.mark.parametrize("name", OBJECTS)
def test_object_describes_a_part(
    name: str, shared_data: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_DATA", "nowhere")
    assert part_settings(name).name == name
    if "ATTENTIONVOTE_DATA" in (CONF / "object" / f"{name}.yaml").read_text(encoding="utf-8"):
        # The mesh is the user's: without it the sentence says where it belongs, with it the part loads.
        with pytest.raises(FileNotFoundError, match=r"must be at 'nowhere/meshes/"):
            part_settings(name)()
        monkeypatch.setenv("ATTENTIONVOTE_DATA", str(shared_data("")))
        if not (mesh := Path(part_settings(name).arguments["mesh"])).exists():
            pytest.skip(f"the check data has no {mesh.name}")
    settings = part_settings(name)
    part = settings()
    assert part.name == name
    if members := settings.arguments.get("parts"):
        assert isinstance(part, PartSet)
        assert [one.name for one in part.parts] == list(members)
        assert part.diameter == max(one["diameter"] for one in members.values())
        return
    assert isinstance(part, Part)
    assert part.diameter == pytest.approx(settings.arguments["diameter"])
