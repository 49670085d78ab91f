"""The words after a verb: settings and Hydra's flags, told apart."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from attentionvote.command.errors import ConfigurationError, nearest


@dataclass(frozen=True)
class CommandLine:
    """What a verb is asked for.

    Attributes:
        overrides: ``key=value`` and its forms with ``+``, ``++`` and ``~``, in their order.
        help: whether the settings are explained.
        multirun: whether the words are a grid.
        config_dir: folder of the user's configuration files.
        config_name: configuration to begin with instead of the verb's.
        shows: flags of Hydra's that show something and run nothing.
    """

    overrides: list[str] = field(default_factory=list)
    help: bool = False
    multirun: bool = False
    config_dir: str | None = None
    config_name: str | None = None
    shows: list[str] = field(default_factory=list)


def command_line(words: Sequence[str]) -> CommandLine:
    """The words after a verb, in any order.

    Raises:
        ConfigurationError: on a flag that does not exist, lacks its value or cannot work here.
    """
    parser = _Parser(add_help=False, allow_abbrev=False)
    for flags in _SWITCHES:
        parser.add_argument(*flags, action="store_true")
    for flags in _WITH_VALUE:
        parser.add_argument(*flags)
    parser.add_argument("overrides", nargs="*")
    asked = parser.parse_intermixed_args(list(words))
    if asked.config_path is not None:
        raise ConfigurationError(
            f"--config-path would replace the project's configuration, got {asked.config_path!r}: a folder of your own "
            "is added by --config-dir"
        )
    shows = [f"--{name.replace('_', '-')}" for name in ("resolve", "hydra_help", "version") if getattr(asked, name)]
    for name in ("cfg", "package", "info", "shell_completion"):
        if getattr(asked, name) is not None:
            shows += [f"--{name.replace('_', '-')}", getattr(asked, name)]
    return CommandLine(asked.overrides, asked.help, asked.multirun, asked.config_dir, asked.config_name, shows)


_SWITCHES = (
    ("--help", "-h"), ("--hydra-help",), ("--version",), ("--resolve",), ("--run", "-r"), ("--multirun", "-m"),
)  # fmt: skip
_WITH_VALUE = (
    ("--cfg", "-c"), ("--package", "-p"), ("--info", "-i"), ("--shell-completion", "-sc"), ("--config-path", "-cp"),
    ("--config-name", "-cn"), ("--config-dir", "-cd"),
)  # fmt: skip


class _Parser(argparse.ArgumentParser):
    """A parser whose refusals are sentences of ours."""

    def error(self, message: str) -> NoReturn:
        prefix, _, rest = message.partition(": ")
        if prefix == "unrecognized arguments":
            flag = rest.split(" ")[0]
            flags = [name for names in (*_SWITCHES, *_WITH_VALUE) for name in names]
            raise ConfigurationError(f"there is no flag {flag!r}{nearest(flag, flags)}")
        raise ConfigurationError(message)
