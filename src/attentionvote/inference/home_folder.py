"""Folders below a user's home, for users that have none."""

from __future__ import annotations

import os
from pathlib import Path

from attentionvote.inference.errors import InputError


def home_folder(variable: str, below: str, option: str) -> Path:
    """The folder that an environment variable names, else ``attentionvote`` below a folder of the user's home.

    Args:
        variable: its name.
        below: the folder in the home.
        option: what else names such a folder or a file in it, for the sentence.

    Raises:
        InputError: when there is neither the variable nor a home.
    """
    named = os.environ.get(variable)
    try:
        return Path(named).expanduser() if named else Path.home() / below / "attentionvote"
    except RuntimeError as error:
        raise InputError(
            f"this user must have a home folder, or {option} or {variable} must be set, got none of them"
        ) from error
