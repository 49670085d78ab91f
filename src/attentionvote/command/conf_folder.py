"""The configuration files of the checkout: groups and their choices. And the scripts beside them."""

from __future__ import annotations

from pathlib import Path

from omegaconf import OmegaConf

# Verbs run in a checkout, where conf/ and pipelines/ lie beside src/: no wheel brings them.
_CHECKOUT = Path(__file__).resolve().parents[3]
CONF, SCRIPTS = _CHECKOUT / "conf", _CHECKOUT / "pipelines"


def choices(group: str, conf: Path = CONF) -> list[str]:
    """The names that may be chosen for a group, sorted."""
    return sorted(p.stem for p in (conf / group).glob("*.yaml"))


def groups(conf: Path = CONF) -> list[str]:
    """Every group, as ``a`` or ``a/b``."""
    return sorted(p.relative_to(conf).as_posix() for p in conf.rglob("*") if p.is_dir() and any(p.glob("*.yaml")))


def primary_groups(verb: str, conf: Path = CONF) -> dict[str, str | None]:
    """Group and choice of a verb's defaults list, those of other verbs' files that it includes among them."""
    primary = OmegaConf.to_container(OmegaConf.load(conf / f"{verb}.yaml"), resolve=False)
    assert isinstance(primary, dict)
    defaults: dict[str, str | None] = {}
    for item in primary.get("defaults", []):
        if isinstance(item, dict):
            for group, choice in item.items():
                defaults[str(group).removeprefix("override ").removeprefix("optional ").split("@")[0].strip("/")] = (
                    choice
                )
        elif (conf / f"{item}.yaml").is_file():
            defaults |= primary_groups(item, conf)
    return defaults
