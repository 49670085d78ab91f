"""A bundle: the one artefact a cell trusts. A folder whose manifest names every file's hash and is signed.

``load_bundle`` reads every file once, checks it, and keeps what the cell runs (the model, the card, the golden
clouds) in memory: what was verified is what is run, whatever happens to the folder afterwards.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.inference.bundles.external_data import external_tensor
from attentionvote.inference.bundles.graph_card import card_text
from attentionvote.inference.bundles.manifest import (
    BESIDE,
    CARD,
    GOLDEN,
    MANIFEST,
    MODEL,
    MOST_MANIFEST_BYTES,
    SIGNATURE,
    files_in,
    most_bytes,
    opened,
    parse_manifest,
    read_file,
)
from attentionvote.inference.bundles.signature import load_public_key, verify
from attentionvote.inference.errors import BundleError
from attentionvote.inference.scans.array_bytes import arrays_from_npz
from attentionvote.inference.scans.limits import Budget

# The key whose signature is demanded, or its file; None checks hashes but no signature.
Trusted: TypeAlias = Ed25519PublicKey | Path | str | None
_MOST_GOLDEN_BYTES = 256 * 1024 * 1024


class GoldenCloud(NamedTuple):
    """A cloud with the poses that the estimator found in it when the bundle was made.

    Attributes:
        name: of its file.
        points: ``(P, 3)`` float32 metres, camera frame, as a sensor gives it.
        camera_from_part: ``(n, 4, 4)`` float64.
        confidence: ``(n,)`` float32.
        part_ids: ``(n,)`` int64, index of each pose's class; all 0 where the file says nothing.
    """

    name: str
    points: NDArray[np.float32]
    camera_from_part: NDArray[np.float64]
    confidence: NDArray[np.float32]
    part_ids: NDArray[np.int64]


@dataclass(frozen=True)
class Bundle:
    """A verified bundle.

    Attributes:
        path: the folder it was read from.
        card: the model's card.
        digest: sha256 of the manifest, which names the bundle.
        model: the ONNX file.
        golden_files: the golden clouds' files by name.
    """

    path: Path
    card: ModelCard
    digest: str
    model: bytes = field(repr=False)
    golden_files: Mapping[str, bytes] = field(default_factory=dict, repr=False)

    def golden(self) -> list[GoldenCloud]:
        """The golden clouds, sorted by name.

        Raises:
            BundleError: when a file does not hold one.
        """
        return [_golden(name, content) for name, content in sorted(self.golden_files.items())]


def load_bundle(path: Path | str, trusted: Trusted) -> Bundle:
    """Read and verify a bundle.

    Args:
        path: its folder; the folder may be a link, nothing inside it may.
        trusted: the public key that must have signed it, or its file; None leaves the signature unchecked, for tools.

    Raises:
        BundleError: with one sentence that names the file and what to do.
    """
    folder = Path(path)
    key = load_public_key(Path(trusted)) if isinstance(trusted, (Path, str)) else trusted
    with opened(folder) as handle:
        manifest = read_file(handle, MANIFEST, MOST_MANIFEST_BYTES, folder)
        signature = read_file(handle, SIGNATURE, MOST_MANIFEST_BYTES, folder)
        try:
            if key is not None:
                verify(manifest, signature, key)  # before anything of the manifest is believed
            entries = parse_manifest(manifest)
        except BundleError as error:
            raise BundleError(f"{folder}: {error}") from error
        unlisted = sorted(set(files_in(handle, folder)) - set(entries) - {MANIFEST, SIGNATURE} - BESIDE)
        if unlisted:
            raise BundleError(f"{folder}: {unlisted[0]} is not in {MANIFEST}: remove it, or export the bundle again")
        contents = {}
        for name, entry in sorted(entries.items(), key=lambda item: item[1].bytes):
            content = read_file(handle, name, most_bytes(name), folder)
            if len(content) != entry.bytes:
                raise BundleError(
                    f"{folder}: {name} must have {entry.bytes} bytes, got {len(content)}: "
                    "copy or export the bundle again"
                )
            if hashlib.sha256(content).hexdigest() != entry.sha256:
                raise BundleError(
                    f"{folder}: {name} must have the sha256 {entry.sha256[:12]}..., but its content was changed: "
                    "copy or export the bundle again"
                )
            if name in (MODEL, CARD) or name.startswith(f"{GOLDEN}/"):
                contents[name] = content
    card = _card(folder, contents.pop(CARD), contents[MODEL])
    model = contents.pop(MODEL)
    return Bundle(folder, card, hashlib.sha256(manifest).hexdigest(), model, contents)


def _card(folder: Path, content: bytes, model: bytes) -> ModelCard:
    """The card in ``card.json``, which must be the one that the graph carries."""
    try:
        card = ModelCard.from_json(content.decode("utf-8"))
        for part in (card.part, *card.parts):
            Symmetry(**part.symmetry)
    except (ValueError, TypeError) as error:  # TypeError: arguments that no symmetry has
        raise BundleError(f"{folder}: {CARD}: {error}") from error
    try:
        inside, outside = card_text(model), external_tensor(model)
    except ValueError as error:
        raise BundleError(f"{folder}: {MODEL} must be an ONNX file, but {error}: export the bundle again") from error
    if outside is not None:
        raise BundleError(
            f"{folder}: {MODEL} must hold the numbers of all its tensors, but tensor {outside!r} names a file outside: "
            "export the bundle again, with the data inside"
        )
    if inside is None:
        raise BundleError(f"{folder}: {MODEL} must carry its card, but it carries none: export the bundle again")
    if inside != card.core().to_json():
        raise BundleError(
            f"{folder}: {CARD} must be the card that {MODEL} carries, but they differ: "
            "model and card are of two exports, export the bundle again"
        )
    return card


def _golden(name: str, content: bytes) -> GoldenCloud:
    try:
        arrays = arrays_from_npz(content, Budget(_MOST_GOLDEN_BYTES, math.inf))
        cloud = GoldenCloud(
            name.removeprefix(f"{GOLDEN}/").removesuffix(".npz"),
            arrays["points"],
            arrays["camera_from_part"],
            arrays["confidence"],
            arrays.get("part_ids", np.zeros(len(arrays["confidence"]), dtype=np.int64)),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{name} must be a golden cloud, but {error}: export the bundle again") from error
    n = len(cloud.camera_from_part) if cloud.camera_from_part.ndim else 0
    right = (
        cloud.points.dtype == np.float32
        and cloud.points.ndim == 2
        and cloud.points.shape[1] == 3
        and cloud.camera_from_part.dtype == np.float64
        and cloud.camera_from_part.shape == (n, 4, 4)
        and cloud.confidence.dtype == np.float32
        and cloud.confidence.shape == (n,)
        and cloud.part_ids.dtype == np.int64
        and cloud.part_ids.shape == (n,)
    )
    if not right:
        raise BundleError(
            f"{name} must hold points (P, 3) float32, camera_from_part (n, 4, 4) float64 and confidence (n,) float32, "
            "of several parts also part_ids (n,) int64, "
            f"got {', '.join(f'{a.shape} {a.dtype}' for a in cloud[1:])}: export the bundle again"
        )
    return cloud
