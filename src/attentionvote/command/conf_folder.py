"""The configuration files: those of the checkout, a folder of the user's beside them; the scripts of the verbs."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from omegaconf import OmegaConf

from attentionvote.command.errors import ConfigurationError

# Verbs run in a checkout, where conf/ and pipelines/ lie beside src/: no wheel brings them.
_CHECKOUT = Path(__file__).resolve().parents[3]
CONF, SCRIPTS = _CHECKOUT / "conf", _CHECKOUT / "pipelines"
VARIABLE = "ATTENTIONVOTE_CONF"  # the user's folder, for us and for every process that is started from here


def folders(conf: Path = CONF) -> tuple[Path, ...]:
    """The project's folder and, after it, the user's."""
    user = os.environ.get(VARIABLE, "")
    return (conf, Path(user)) if user else (conf,)


def add_folder(folder: str | Path, conf: Path = CONF) -> None:
    """Add a folder of the user's: its files can be chosen as the project's can, its modules named by ``_target_``.

    Raises:
        ConfigurationError: there is no such folder, or a file in it has the name of one of the project's.
    """
    path = Path(folder).absolute()
    if not path.is_dir():
        raise ConfigurationError(f"the configuration folder must exist, got {folder}")
    for file in files(path):
        if (conf / file).is_file():
            raise ConfigurationError(
                f"a configuration folder must not have a file of the project's name, got {path / file}: the project's "
                "would be taken; give yours another name"
            )
    os.environ[VARIABLE] = str(path)


def new_file(group: str, name: str) -> Path:
    """Where a verb writes a file of a group: in the user's folder where there is one, else in the project's."""
    return folders()[-1] / group / f"{name}.yaml"


def see_modules() -> None:
    """Let ``_target_`` name modules of the current folder and of the user's configuration folder."""
    ours = [os.getcwd(), *map(str, folders()[1:])]
    sys.path += [folder for folder in ours if folder not in sys.path]


def files(folder: Path) -> Iterator[Path]:
    """Configuration files below a folder, by their place in it."""
    return (path.relative_to(folder) for path in sorted(folder.rglob("*.yaml")))


def choices(group: str, conf: Path = CONF) -> list[str]:
    """The names that may be chosen for a group, sorted."""
    return sorted(path.stem for folder in folders(conf) for path in (folder / group).glob("*.yaml"))


def groups(conf: Path = CONF) -> list[str]:
    """Every group, as ``a`` or ``a/b``."""
    return sorted({file.parent.as_posix() for folder in folders(conf) for file in files(folder)} - {"."})


def is_group(name: str, conf: Path = CONF) -> bool:
    """Whether a word of this name chooses a file."""
    return any((folder / name).is_dir() for folder in folders(conf))


def primary_file(name: str, conf: Path = CONF) -> Path:
    """The configuration that a verb begins with.

    Raises:
        ConfigurationError: when no folder has it.
    """
    for folder in folders(conf):
        if (folder / f"{name}.yaml").is_file():
            return folder / f"{name}.yaml"
    raise ConfigurationError(
        f"--config-name must name a file of {' or '.join(map(str, folders(conf)))}, got {name!r}: there is no "
        f"{name}.yaml"
    )


def primary_groups(name: str, conf: Path = CONF) -> dict[str, str | None]:
    """Group and choice of a defaults list, those of the files that it includes among them."""
    primary = OmegaConf.to_container(OmegaConf.load(primary_file(name, conf)), resolve=False)
    assert isinstance(primary, dict)
    defaults: dict[str, str | None] = {}
    for item in primary.get("defaults", []):
        if isinstance(item, dict):
            for group, choice in item.items():
                defaults[str(group).removeprefix("override ").removeprefix("optional ").split("@")[0].strip("/")] = (
                    choice
                )
        elif any((folder / f"{item}.yaml").is_file() for folder in folders(conf)):
            defaults |= primary_groups(item, conf)
    return defaults
