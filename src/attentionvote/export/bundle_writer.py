"""A bundle on disk: graph, card, mesh, golden clouds, manifest and signature, written whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray

from attentionvote.cad.mesh_file import write_surface
from attentionvote.contract import ModelCard
from attentionvote.files import naming_full_disk, sync
from attentionvote.inference import BundleError, Estimate, PoseEstimator
from attentionvote.inference.bundles.bundle import Bundle, load_bundle
from attentionvote.inference.bundles.manifest import CARD, GOLDEN, MESH, MODEL, write_manifest
from attentionvote.inference.golden import clear_confidence, self_test
from attentionvote.part import Parts

LATEST = "latest"
_DRAFT, _OLD, _LINK = ".writing-bundle", ".old-bundle", ".writing-link"


def write_bundle(
    model: bytes,
    card: ModelCard,
    part: Parts,
    clouds: Iterable[tuple[str, NDArray[np.float32]]],
    golden: int,
    key: Ed25519PrivateKey,
    folder: Path,
) -> Bundle:
    """Write ``folder/DIGEST`` and point ``folder/latest`` at it.

    The golden poses are what the shipped estimator answers here and now; a cell that answers otherwise must not serve.
    The bundle is loaded and tested as a cell would before it gets its name. One process at a time may write in the
    folder.

    Args:
        model: the ONNX file.
        card: with all figures.
        part: its mesh, for viewers; of a set the meshes of all, ``part.ply`` being the first part's and the others
            ``part_NAME.ply``.
        clouds: names and clouds ``(P, 3)`` of scenes that were held out; the first that show clear poses become golden.
        golden: how many of them.
        key: signs the manifest.
        folder: of the part's bundles.

    Raises:
        ValueError: when no cloud shows a clear pose, or the bundle does not pass its own self-test.
        OSError: when it cannot be written (DiskFull without room); ``latest`` stays where it was.
    """
    with naming_full_disk(folder):
        folder.mkdir(parents=True, exist_ok=True)
        draft, old = folder / _DRAFT, folder / _OLD
        for leftover in (draft, old):  # of a killed process
            shutil.rmtree(leftover, ignore_errors=True)
        try:
            (draft / GOLDEN).mkdir(parents=True)
            (draft / MODEL).write_bytes(model)
            (draft / CARD).write_text(card.to_json(), encoding="utf-8")
            for k, member in enumerate(part.parts):
                write_surface(member.vertices, member.faces, draft / (MESH if k == 0 else f"part_{member.name}.ply"))
            _write_golden(model, card, clouds, golden, draft)
            write_manifest(draft, key)
            bundle = load_bundle(draft, key.public_key())
            with PoseEstimator(bundle) as estimator:
                problems = self_test(estimator, bundle)
            if problems:
                raise ValueError(f"the bundle must pass its own self-test, but {problems[0]}")
            bundle_folder = folder / bundle.digest[:12]
            if not _is_whole(bundle_folder, key):
                _settle(draft)
                if bundle_folder.exists():
                    bundle_folder.rename(old)
                draft.rename(bundle_folder)
                sync(folder)
        finally:
            for leftover in (draft, old):
                shutil.rmtree(leftover, ignore_errors=True)
        point_latest(bundle_folder)
    return load_bundle(bundle_folder, key.public_key())


def _is_whole(bundle_folder: Path, key: Ed25519PrivateKey) -> bool:
    """Whether a folder holds a bundle that this key signed, with nothing missing, damaged or added."""
    try:
        load_bundle(bundle_folder, key.public_key())
    except BundleError:
        return False
    return True


def point_latest(bundle_folder: Path) -> None:
    """Point ``latest`` at a bundle in one step: a server that watches it sees the old bundle or the new one."""
    temporary, link = bundle_folder.with_name(_LINK), bundle_folder.with_name(LATEST)
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(bundle_folder.name)
    temporary.replace(link)
    sync(bundle_folder.parent)


def _write_golden(
    model: bytes, card: ModelCard, clouds: Iterable[tuple[str, NDArray[np.float32]]], count: int, draft: Path
) -> None:
    written, clear = 0, clear_confidence(card.confidence_threshold)
    with PoseEstimator(Bundle(draft, card, "", model)) as estimator:
        for name, points in clouds:
            answer = estimator.estimate_parts_only(points)
            if not isinstance(answer, Estimate) or answer.detections[0].confidence < clear:
                continue  # it would test nothing
            detections = answer.detections
            arrays: dict[str, NDArray] = {
                "points": points,
                "camera_from_part": np.stack([d.camera_from_part for d in detections]),
                "confidence": np.array([d.confidence for d in detections], dtype=np.float32),
            }
            if card.parts:
                arrays["part_ids"] = np.array([card.classes.index(d.part) for d in detections], dtype=np.int64)
            np.savez(draft / GOLDEN / f"{name}.npz", **arrays)  # type: ignore[arg-type]
            written += 1
            if written == count:
                return
    if not written:
        raise ValueError(
            f"a golden cloud must show a pose with confidence of at least {clear:.3g}, but the model finds none in any "
            "held-out scene: train it longer"
        )


def _settle(folder: Path) -> None:
    """Everything on the disk before the folder gets its name: a power cut leaves no half bundle under it."""
    for path in [*sorted(folder.rglob("*")), folder]:
        sync(path)
