"""Hydra's flags and the settings between them."""

from __future__ import annotations

import pytest

from attentionvote.command.command_line import CommandLine, command_line
from attentionvote.command.errors import ConfigurationError


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("a=1 +b=2 ~c", CommandLine(["a=1", "+b=2", "~c"])),
        ("a=-1 -m b=1,2", CommandLine(["a=-1", "b=1,2"], multirun=True)),
        ("a=1 --config-dir x b=2 -cn y", CommandLine(["a=1", "b=2"], config_dir="x", config_name="y")),
        ("--config-dir=x", CommandLine(config_dir="x")),
        ("--cfg job --resolve a=1", CommandLine(["a=1"], shows=["--resolve", "--cfg", "job"])),
        ("a=1 -h", CommandLine(["a=1"], help=True)),
        ("-r a=1", CommandLine(["a=1"])),
    ],
)
def test_flags_and_settings_in_any_order(words: str, expected: CommandLine) -> None:
    assert command_line(words.split()) == expected


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--multrun a=1", "there is no flag '--multrun', did you mean '--multirun'?"),
        ("--config-dir", "argument --config-dir/-cd: expected one argument"),
        ("-cp x", "--config-path would replace the project's configuration, got 'x': a folder of your own is added by "
                  "--config-dir"),
    ],
)  # fmt: skip
def test_what_no_flag_is_gets_one_sentence(words: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        command_line(words.split())
    assert str(raised.value) == sentence
