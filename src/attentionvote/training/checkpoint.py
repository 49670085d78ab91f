"""Checkpoint files: written whole or not at all, checked before they are used, readable without the configuration.

Without Lightning, whose import takes longer than torch's: an export only reads.
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from attentionvote.files import remove_leftovers, whole
from attentionvote.model.network import AttentionVote

log = logging.getLogger(__name__)

FORMAT = 1
KEY = "attentionvote"  # of the metadata in a checkpoint
_PREFIX = "model."  # of the network's weights among the module's


def write_atomically(content: Mapping[str, Any], path: Path) -> None:
    """``torch.save`` under a temporary name in the same folder, then renamed.

    Raises:
        OSError: with one sentence when the file cannot be written (disk full, say); what was there stays.
    """
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())

    try:
        whole(path, write)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error
        raise OSError(
            f"checkpoint {path} cannot be written ({reason}); the one before it is kept, the same command goes on from "
            "there"
        ) from error


def usable_checkpoint(paths: Sequence[Path], shapes: Mapping[str, torch.Size]) -> Path | None:
    """The first of ``paths`` from which a training can go on, None when there is none.

    A file that is torn, or that belongs to another network, is named in a warning and passed over; so are temporary
    files of a killed process removed.

    Args:
        paths: in order of preference.
        shapes: of the module's weights by name.
    """
    for path in paths:
        remove_leftovers(path)
        if not path.is_file():
            continue
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
            stored_shapes = {name: value.shape for name, value in content["state_dict"].items()}
        except Exception as error:  # whatever torch says of a torn file: it cannot be used
            log.warning("checkpoint %s cannot be read (%s) and is passed over", path, type(error).__name__)
            continue
        if stored_shapes == dict(shapes):
            return path
        log.warning("checkpoint %s belongs to another network and is passed over", path)
    return None


def load_weights(module: torch.nn.Module, path: Path) -> None:
    """Load the weights of a checkpoint (the averaged ones where there is an average) into the module it came from."""
    module.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["state_dict"])


def save_trained(model: AttentionVote, metadata: Mapping[str, Any], path: Path) -> None:
    """Write a trained network with everything that is needed to build it again.

    Args:
        metadata: see :func:`load_trained`; plain values only.
    """
    weights = {_PREFIX + name: value.detach().cpu().clone() for name, value in model.state_dict().items()}
    write_atomically({KEY: dict(metadata), "state_dict": weights}, path)


def load_trained(path: Path | str) -> tuple[AttentionVote, dict[str, Any]]:
    """A trained network, ready for inference on the CPU, and its metadata; needs no configuration.

    Reads ``model.ckpt`` and the training's ``best.ckpt`` and ``last.ckpt`` alike. The metadata:

    * ``format``, ``version``: of this file's layout and of the package that wrote it;
    * ``model``: arguments of ``AttentionVote.from_arguments``;
    * ``part``: ``name``, ``title``, ``diameter`` (metres), ``digest``, ``symmetry``;
    * ``parts``: of a set the same of each, in the order of the classes; ``part`` is then the set, without symmetry;
    * ``points``: N of a sample; ``clouds``: sensor, density, pool and neighbours of the normals;
    * ``peak_threshold``; ``confidence_threshold``: None before the test;
    * ``data``: digests of the scenes by split; of a dataset's also ``cycles``, see ``data.dataset_splits``;
    * ``dataset``: where a dataset's scenes were and how they were split; ``test``: figures, empty before the test.

    Raises:
        ValueError: with one sentence, when the file cannot be read or is none of this project's.
        FileNotFoundError: when there is no such file.
    """
    content = _read(path)
    metadata: dict[str, Any] = content[KEY]
    try:
        model = AttentionVote.from_arguments(metadata["model"])
        weights = content["state_dict"].items()
        model.load_state_dict({name.removeprefix(_PREFIX): v for name, v in weights if name.startswith(_PREFIX)})
    except (RuntimeError, TypeError, KeyError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(f"checkpoint {path} does not fit this version's network: {reason}") from error
    return model.eval(), metadata


def read_metadata(path: Path | str) -> dict[str, Any]:
    """The metadata of a checkpoint alone, see :func:`load_trained`; weights are not read.

    Raises:
        ValueError, FileNotFoundError: as there.
    """
    metadata: dict[str, Any] = _read(path, mmap=True)[KEY]
    return metadata


def _read(path: Path | str, mmap: bool = False) -> dict[str, Any]:
    """The content of a checkpoint of ours."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"checkpoint {path} must exist: train one with `make train`")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:  # torch raises a dozen kinds for torn files
        raise ValueError(
            f"checkpoint {path} cannot be read ({type(error).__name__}): it is torn or no checkpoint"
        ) from error
    metadata = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(metadata, dict) or "state_dict" not in content:
        raise ValueError(f"checkpoint {path} must be one of attentionvote's, but it has no '{KEY}' entry")
    if metadata.get("format") != FORMAT:
        raise ValueError(
            f"checkpoint {path} must have format {FORMAT}, got {metadata.get('format')}: "
            f"it was written by attentionvote {metadata.get('version', 'of an unknown version')}"
        )
    return dict(content)
