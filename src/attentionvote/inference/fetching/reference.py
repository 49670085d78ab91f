"""The name of a model in a registry: ``models:/NAME@ALIAS`` follows an alias, ``models:/NAME/VERSION`` is a pin."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import NamedTuple

from attentionvote.inference.errors import InputError

SCHEME = "models:/"
PREFIX = "attentionvote-"  # of registered names; the rest is the part's
_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"
_REFERENCE = re.compile(rf"models:/({_NAME})(?:@([A-Za-z0-9_-]{{1,100}})|/([1-9][0-9]{{0,8}}))")
_SCHEMES = re.compile(r"models?:|[a-z][a-z0-9+.-]*:/")
# MLflow keeps these for itself: no alias has such a name.
_NO_ALIAS = re.compile(r"latest|v[0-9]+", re.IGNORECASE)


class RegistryVersion(NamedTuple):
    """One version of a registered model.

    Attributes:
        name: of the registered model, ``attentionvote-<part>``.
        version: its number, as text.
        digest: sha256 of its bundle's manifest, hexadecimal.
    """

    name: str
    version: str
    digest: str

    def __str__(self) -> str:
        return f"version {self.version} of {self.name}"


@dataclass(frozen=True)
class Reference:
    """What is asked of the registry.

    Attributes:
        name: of the registered model.
        alias: that is followed; None for a pin.
        version: that is pinned; None when an alias is followed.
    """

    name: str
    alias: str | None = None
    version: str | None = None

    def __str__(self) -> str:
        return f"{SCHEME}{self.name}" + (f"@{self.alias}" if self.alias is not None else f"/{self.version}")


def is_reference(text: str) -> bool:
    """Whether a word names a model in a registry, well or badly, and not a folder that exists."""
    return _SCHEMES.match(text) is not None and not os.path.exists(text)


def parse_reference(text: str) -> Reference:
    """The reference in ``models:/NAME@ALIAS`` or ``models:/NAME/VERSION``.

    Raises:
        InputError: when it is neither, with the nearest that is.
    """
    match = _REFERENCE.fullmatch(text)
    if match and not (match[2] and _NO_ALIAS.fullmatch(match[2])):
        return Reference(match[1], match[2], match[3])
    raise InputError(
        f"a registry's model must be models:/NAME@ALIAS or models:/NAME/VERSION, got {text[:200]!r}{_nearest(text)}"
    )


def _nearest(text: str) -> str:
    """A well-formed reference to the same name, as a question; nothing when no name can be seen."""
    name = re.match(rf"(?:[A-Za-z0-9+.-]*:)?/*({_NAME})", text)
    if name is None:
        return ""
    number = re.fullmatch(r"[/@:]*v?([1-9][0-9]{0,8})/?", text[name.end() :], re.IGNORECASE)
    return f", did you mean {Reference(name[1], version=number[1]) if number else Reference(name[1], 'champion')}?"
