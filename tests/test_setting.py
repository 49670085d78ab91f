"""One setting and sections of them: what is read, what is refused and with which sentence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.model.settings import NetworkSettings
from attentionvote.section import Target, check, check_value, find, leaves, read
from attentionvote.setting import ChoicesOf, Setting, SettingError, fields_of

KINDS = ("round", "square")


@dataclass(frozen=True)
class Lens:
    """An inner section."""

    focal: Annotated[float, Setting("Focal length.", above=0, high=10)]
    kind: Annotated[str, Setting("Form.", choices=KINDS)] = "round"

    def __post_init__(self) -> None:
        check(self)
        if self.kind == "square" and self.focal > 5:
            raise ValueError("a square lens must be short")


@dataclass(frozen=True)
class Camera:
    """A section with every kind of setting."""

    name: Annotated[str, Setting("Name.")]
    lens: Lens
    pixels: Annotated[tuple[int, int], Setting("Size.", low=1, high=100)]
    spare: Lens | None = None
    exposures: Annotated[tuple[float, ...], Setting("Seconds.", low=0, high=1)] = ()
    layers: Annotated[tuple[tuple[int, ...], ...], Setting("Widths.", low=1, high=9)] = ()
    counts: Annotated[dict[str, int], Setting("By split.", low=1, high=9)] = field(default_factory=dict)
    threads: Annotated[int | None, Setting("Threads.", low=1, high=8)] = None
    flash: Annotated[bool, Setting("Whether.")] = False
    mode: Annotated[Literal["auto", "manual"], Setting("Mode.")] = "auto"
    extra: Annotated[Any, Setting("Anything.")] = None


@dataclass(frozen=True)
class Network:
    """A section with one that checks itself."""

    model: NetworkSettings


SMALL: dict[str, Any] = {
    "centers": [4, 3, 2, 1], "neighbors": [2] * 4, "widths": [[4]] * 4, "propagation": [4], "residual": False,
    "radius_fraction": 0.1, "voxel_fraction": 0.1, "voting": [4], "proposals": 2, "gathered": 2, "fusion": [4],
    "head": [4],
}  # fmt: skip
PLAIN: dict[str, Any] = {"name": "left", "lens": {"focal": 2}, "pixels": [4, 3]}


def test_plain_values_become_a_section_and_nothing_is_converted() -> None:
    camera = read(
        Camera, PLAIN | {"spare": {"focal": 1.5, "kind": "square"}, "layers": [[1, 2], [3]], "counts": {"a": 2}}
    )
    assert camera == Camera("left", Lens(2), (4, 3), Lens(1.5, "square"), layers=((1, 2), (3,)), counts={"a": 2})
    assert type(camera.lens.focal) is int  # as typed: identities are made of what was typed


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"pixles": [1, 1]}, "there is no setting 'pixles', did you mean 'pixels'?"),
        ({"lens": {"focal": 1, "knid": "round"}}, "there is no setting 'lens.knid', did you mean 'lens.kind'?"),
        ({"lens": {}}, "lens.focal must be given"),
        ({"lens": 3}, "lens must be a section; got 3"),
        ({"lens": None}, "lens must be a section; got null"),
        ({"spare": 3}, "spare must be a section or null; got 3"),
        ({"lens": {"focal": 0}}, "lens.focal must be greater than 0 and at most 10; got 0"),
        ({"lens": {"focal": math.nan}}, "lens.focal must be greater than 0 and at most 10; got nan"),
        ({"lens": {"focal": True}}, "lens.focal must be a number greater than 0 and at most 10; got True"),
        ({"lens": {"focal": 9, "kind": "square"}}, "a square lens must be short"),
        ({"lens": {"focal": 1, "kind": "rund"}},
         "lens.kind must be one of round, square; got 'rund', did you mean 'round'?"),
        ({"pixels": [4]}, "pixels must be a list of 2; got [4]"),
        ({"pixels": "ab"}, "pixels must be a list; got 'ab'"),
        ({"pixels": [4, 0]}, "pixels must be at least 1 and at most 100; got 0"),
        ({"pixels": [4, 1.5]}, "pixels must be a whole number at least 1 and at most 100; got 1.5"),
        ({"layers": [[1], [0]]}, "layers must be at least 1 and at most 9; got 0"),
        ({"counts": {"a": 0}}, "counts.a must be at least 1 and at most 9; got 0"),
        ({"counts": [1]}, "counts must be a section; got [1]"),
        ({"threads": 9}, "threads must be a whole number at least 1 and at most 8; got 9"),
        ({"threads": "x"}, "threads must be a whole number at least 1 and at most 8; got 'x'"),
        ({"flash": 1}, "flash must be true or false; got 1"),
        ({"name": None}, "name must be a text; got null"),
        ({"mode": "atuo"}, "mode must be one of auto, manual; got 'atuo', did you mean 'auto'?"),
    ],
)  # fmt: skip
def test_what_is_impossible_gets_one_sentence(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SettingError) as refused:
        read(Camera, PLAIN | change)
    assert str(refused.value) == sentence


def test_the_first_impossible_value_in_the_files_order_is_named() -> None:
    with pytest.raises(SettingError, match=r"^pixels "):
        read(Camera, {"pixels": [0, 1], "name": 3, "lens": {"focal": 1}})


def test_a_section_made_in_code_is_checked_as_one_that_was_read() -> None:
    with pytest.raises(SettingError, match=r"^focal must be greater than 0 and at most 10; got -1$"):
        Lens(-1)


@given(st.one_of(st.integers(), st.floats(), st.text(), st.booleans(), st.none(), st.lists(st.integers())))
def test_a_bounded_number_is_accepted_exactly_inside_its_bounds(value: Any) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    inside = number and 0 < value <= 10
    try:
        check_value(Camera, "lens.focal", value)
    except SettingError:
        assert not inside
    else:
        assert inside


def test_settings_are_searched_by_dotted_names() -> None:
    assert find(Camera, "lens.focal") == fields_of(Lens)["focal"]
    assert find(Camera, "layers[0]") == fields_of(Camera)["layers"]
    counts = find(Camera, "counts.train")
    assert counts is not None
    assert (counts.type, counts.setting.high) == (int, 9)
    assert find(Camera, "lens.nothing") is None
    assert find(Camera, "name.nothing") is None
    assert [key for key, _ in leaves(Camera)][:4] == ["name", "lens.focal", "lens.kind", "pixels"]


def make(name: str, size: Annotated[float, Setting("Size.", above=0, high=1)] = 0.5) -> tuple[str, float]:
    """What a section with a target configures."""
    return name, size


def test_a_section_with_a_target_is_checked_against_its_signature_and_called() -> None:
    path = f"{__name__}.make"
    target = Target.of({"_target_": path, "_convert_": "all", "name": "a", "size": 1}, "object")
    assert (target.name, target()) == ("a", ("a", 1))
    for values, sentence in (
        ({"name": "a"}, "object must have _target_, the dotted name of what it configures; got none"),
        ({"_target_": path, "name": "a", "sise": 1}, "there is no setting 'object.sise', did you mean 'object.size'?"),
        ({"_target_": path, "name": "a", "size": 2}, "object.size must be greater than 0 and at most 1; got 2"),
        ({"_target_": path}, "object.name must be given"),
    ):
        with pytest.raises(SettingError) as refused:
            Target.of(values, "object")
        assert str(refused.value) == sentence
    for wrong in ("nowhere.make", f"{__name__}.nothing", f"{__name__}.KINDS", "x"):
        with pytest.raises(SettingError, match=f"must be the dotted name of a class or function; got '{wrong}'"):
            Target.of({"_target_": wrong}, "object")


def anything(name: str, **more: int) -> tuple[str, dict[str, int]]:
    """A target that takes arguments of every name."""
    return name, more


def later(name: "Unknown") -> str:  # type: ignore[name-defined]  # noqa: UP037
    """A target annotated with a name that only type checkers know."""
    return name


def test_targets_of_a_users_own_are_called_as_they_are() -> None:
    assert Target.of({"_target_": f"{__name__}.anything", "name": "a", "size": 3})() == ("a", {"size": 3})
    assert Target.of({"_target_": f"{__name__}.later", "name": "a"})() == "a"
    inner = {"_target_": f"{__name__}.make", "name": "b"}
    assert Target.of({"_target_": f"{__name__}.later", "name": inner})() == ("b", 0.5)
    raw = Target.of({"_target_": f"{__name__}.later", "_recursive_": False, "name": inner})
    assert raw() == inner
    with pytest.raises(SettingError, match="must be a class or function with a signature"):
        Target.of({"_target_": "builtins.dict", "name": 1})
    with pytest.raises(SettingError, match=r"^object takes its arguments by name, got _args_: leave it out$"):
        Target.of({"_target_": f"{__name__}.make", "_args_": [1]}, "object")


def test_a_section_that_does_not_fit_together_is_named_in_full() -> None:
    with pytest.raises(SettingError, match=r"^model.centers must have 4 entries, one a level; got \[3\]$"):
        read(Network, {"model": SMALL | {"centers": [3]}})


def test_choices_that_take_seconds_to_import_are_looked_up_for_others_alone() -> None:
    lazy = Setting("Kind.", choices=ChoicesOf("attentionvote.nowhere", "KINDS", ("round",)))
    from attentionvote.setting import scalar_problem

    assert scalar_problem("round", str, lazy, False) == ""
    with pytest.raises(ModuleNotFoundError):
        scalar_problem("square", str, lazy, False)
    here = Setting("Kind.", choices=ChoicesOf(__name__, "KINDS", ("round",)))
    assert scalar_problem("square", str, here, False) == ""
    assert scalar_problem("cubic", str, here, False) == "one of round, square; got 'cubic'"
