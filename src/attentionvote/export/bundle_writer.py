"""A bundle on disk: graph, card, mesh, golden clouds, manifest and signature, written whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference import Abstention, PoseEstimator
from attentionvote.inference.bundle import Bundle, load_bundle
from attentionvote.inference.golden import self_test
from attentionvote.inference.manifest import CARD, GOLDEN, MESH, MODEL, write_manifest
from attentionvote.part import Part
from attentionvote.simulation.mesh import write_surface

LATEST = "latest"


def write_bundle(
    model: bytes,
    card: ModelCard,
    part: Part,
    clouds: Mapping[str, NDArray[np.float32]],
    key: Ed25519PrivateKey,
    folder: Path,
) -> Bundle:
    """Write ``folder/DIGEST`` and point ``folder/latest`` at it.

    The golden poses are what the shipped estimator answers for ``clouds`` here and now; a cell that answers
    otherwise must not serve. The bundle is loaded and tested as a cell would before it gets its name.

    Args:
        model: the ONNX file.
        card: with all figures.
        part: its mesh, for viewers.
        clouds: name to ``(P, 3)``: golden clouds of scenes that were held out.
        key: signs the manifest.
        folder: of the part's bundles.

    Raises:
        ValueError: when a cloud shows nothing to the model, or the bundle does not pass its own self-test.
        OSError: when it cannot be written; ``latest`` stays where it was.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(".writing-*"):
        if not _alive(int(leftover.suffix[1:] or 0)):
            shutil.rmtree(leftover, ignore_errors=True)
    draft = folder / f".writing-bundle.{os.getpid()}"
    try:
        (draft / GOLDEN).mkdir(parents=True)
        (draft / MODEL).write_bytes(model)
        (draft / CARD).write_text(card.to_json(), encoding="utf-8")
        write_surface(part.vertices, part.faces, draft / MESH)
        _write_golden(model, card, clouds, draft)
        write_manifest(draft, key)
        bundle = load_bundle(draft, key.public_key())
        with PoseEstimator(bundle) as estimator:
            problems = self_test(estimator, bundle)
        if problems:
            raise ValueError(f"the bundle must pass its own self-test, but {problems[0]}")
        _settle(draft)
        place = folder / bundle.digest[:12]
        if place.exists():
            shutil.rmtree(place)  # the same content: at most a damaged copy is lost
        draft.rename(place)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    _point(folder / LATEST, place.name)
    return load_bundle(place, key.public_key())


def _write_golden(model: bytes, card: ModelCard, clouds: Mapping[str, NDArray[np.float32]], draft: Path) -> None:
    with PoseEstimator(Bundle(draft, card, "", model)) as estimator:
        for name, points in clouds.items():
            answer = estimator.estimate_parts_only(points)
            if isinstance(answer, Abstention):
                raise ValueError(f"golden cloud {name} must show poses, but the model finds none: {answer.message}")
            np.savez(
                draft / GOLDEN / f"{name}.npz",
                points=points,
                camera_from_part=np.stack([d.camera_from_part for d in answer.detections]),
                confidence=np.array([d.confidence for d in answer.detections], dtype=np.float32),
            )


def _settle(folder: Path) -> None:
    """Everything on the disk before the folder gets its name: a power cut leaves no half bundle under it."""
    for path in sorted(folder.rglob("*")):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _point(link: Path, target: str) -> None:
    """Move a symbolic link in one step: a server that watches it sees the old bundle or the new one."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    temporary.replace(link)


def _alive(process: int) -> bool:
    return process > 0 and Path(f"/proc/{process}").exists()
