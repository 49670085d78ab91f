"""What a training begins with: random weights, those of another one (``init``), or the same with fewer epochs."""

from __future__ import annotations

import hashlib
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import nn

log = logging.getLogger("attentionvote.train")
MODEL = "model.ckpt"
_RUN = re.compile(r"[0-9a-f]{32}")
_VERSION = "models:/"
_EXPECTED = "init must be a .ckpt file, a training's folder, the id of an MLflow run, or models:/NAME@champion"


def origin(init: str, store: str | None) -> dict[str, str]:
    """What ``init`` means, wherever it lies: the digest of a file, or a run.

    Args:
        init: see the setting.
        store: of the runs.

    Raises:
        ValueError: it is none of these, or there is no such file or version.
    """
    if init.startswith(_VERSION):
        return {"run": _run_of_version(init, store)}
    if _RUN.fullmatch(init):
        return {"run": init}
    path = _file(init)
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def checkpoint_of(init: str, run_id: str | None, store: str | None, folder: Path) -> Path:
    """The file that ``init`` means, fetched into a folder where it is a run's.

    Args:
        init: see the setting.
        run_id: that ``origin`` said; None where it is a file.
        store: of the runs.
        folder: for what is fetched.

    Raises:
        ValueError: the store does not have it.
    """
    if run_id is None:
        return _file(init)
    from mlflow.exceptions import MlflowException

    from attentionvote.tracking.store import connect, resolve_store, shown

    uri = resolve_store(store)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return Path(connect(uri).download_artifacts(run_id, f"checkpoints/{MODEL}", str(folder)))
    except (MlflowException, OSError) as error:
        raise ValueError(
            f"init must name a run of {shown(uri)} with a complete training, got {init}: it has no checkpoints/{MODEL}"
        ) from error


def take_weights(model: nn.Module, path: Path, init: str) -> None:
    """Give a network every weight of a checkpoint that has its name and shape; the rest stays as it was made.

    Raises:
        ValueError: the file is no checkpoint of ours, or none of its weights fits.
    """
    from attentionvote.training.checkpoint import load_trained

    trained, metadata = load_trained(path)
    ours = model.state_dict()
    fitting = {n: w for n, w in trained.state_dict().items() if n in ours and ours[n].shape == w.shape}
    if not fitting:
        raise ValueError(f"init must hold weights of this network, but none of {init} has the name and shape of ours")
    model.load_state_dict({**ours, **fitting})
    anew = [name for name in ours if name not in fitting]
    log.info(
        "beginning with %d of %d weights of %s (%s)%s",
        len(fitting), len(ours), metadata["part"]["name"], init,
        f"; made anew, because there they have another shape: {', '.join(anew)}" if anew else "",
    )  # fmt: skip


def take_over(earlier: Path, folder: Path) -> None:
    """Copy the checkpoints of a training of fewer epochs to where a longer one goes on from them, if they are there."""
    import torch

    from attentionvote.training.checkpoint import write_atomically

    files = sorted((earlier / "checkpoints").glob("*.ckpt"))
    if not files:
        log.info(
            "trained anew, because the checkpoints of %s are gone (make prune); init=%s takes its weights",
            earlier,
            earlier,
        )
        return
    for file in files:
        content = torch.load(file, map_location="cpu", weights_only=True)
        write_atomically(_moved(content, str(earlier), str(folder)), folder / "checkpoints" / file.name)
    log.info("going on after the last epoch of %s", earlier)


def _moved(content: Any, old: str, new: str) -> Any:
    """Plain containers with every path below a folder moved to another one: Lightning remembers its files."""
    if isinstance(content, str):
        return new + content[len(old) :] if content.startswith(f"{old}/") else content
    if isinstance(content, dict):
        return type(content)((_moved(key, old, new), _moved(value, old, new)) for key, value in content.items())
    if type(content) in (list, tuple):
        return type(content)(_moved(item, old, new) for item in content)
    return content


def _file(init: str) -> Path:
    path = Path(init)
    if (path / MODEL).is_file():
        return path / MODEL
    if path.is_file():
        return path
    raise ValueError(f"{_EXPECTED}; got {init!r}, which is no file" if path.suffix else f"{_EXPECTED}; got {init!r}")


def _run_of_version(init: str, store: str | None) -> str:
    from mlflow.exceptions import MlflowException

    from attentionvote.tracking.store import connect, resolve_store, shown

    name, at, alias = init.removeprefix(_VERSION).partition("@")
    name, _, number = (name, "", "") if at else name.partition("/")
    uri = resolve_store(store)
    client = connect(uri)
    try:
        version = client.get_model_version_by_alias(name, alias) if at else client.get_model_version(name, number)
    except MlflowException as error:
        raise ValueError(f"{_EXPECTED}; got {init!r}, which {shown(uri)} does not have") from error
    if not version.run_id:
        raise ValueError(f"init must name a version whose training is known, got {init}: it has no run")
    return str(version.run_id)
