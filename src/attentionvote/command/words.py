"""The words after a verb, as Hydra's grammar reads them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from attentionvote.command.conf_folder import CONF
from attentionvote.command.errors import ConfigurationError


def parse(overrides: Sequence[str]) -> list[Override]:
    """The words after the verb, parsed by Hydra's grammar.

    Raises:
        ConfigurationError: on a word that is no ``key=value``.
    """
    parsed = []
    for word in overrides:
        try:
            parsed.append(OverridesParser.create().parse_override(word))
        except (OverrideParseException, HydraException) as error:
            raise ConfigurationError(f"every argument must be key=value, got {word!r}") from error
    return parsed


def words_of(sections: Collection[str], words: Sequence[str]) -> list[str]:
    """The words that choose or change one of these sections (what a setting's name has before its first dot)."""
    return [word for word, section in _sections(words) if section in sections]


def words_beside(verb: str, more: Collection[str], words: Sequence[str]) -> list[str]:
    """The words that a verb hands on: neither of settings that its own file makes, nor of the sections ``more``."""
    handled = set(OmegaConf.load(CONF / f"{verb}.yaml")) - {"defaults"} | set(more)
    return [word for word, section in _sections(words) if section not in handled]


def _sections(words: Sequence[str]) -> list[tuple[str, str]]:
    """Every word with its section."""
    return [(word, str(o.key_or_group).split(".")[0]) for word, o in zip(words, parse(words), strict=True)]
