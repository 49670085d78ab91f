"""The interface of every reader: names of scenes in order, and for each of them camera, ground truth and ``Scene``."""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.benchmark_objects import BenchmarkObject, benchmark_object
from attentionvote.datasets.depth_image import PinholeCamera
from attentionvote.datasets.text_files import read_json
from attentionvote.scene import BACKGROUND, Scene

# Fewer drops than these are not scored (paper section 4.1).
LEAST_DROPS = 5
# What `make write-data` leaves in a folder of its own: such a set carries a public one's layout, not its content.
RECEIPT = "written.json"


class GroundTruth(NamedTuple):
    """Where the parts are.

    Attributes:
        camera_from_part: ``(I, 4, 4)`` float64, metres, OpenCV camera frame.
        visible_fraction: ``(I,)`` float64 in [0, 1].
        part_ids: ``(I,)`` int32, index into the dataset's ``parts``.
        label_ids: ``(I,)`` int64, the number that stands for the instance in the file of labels.
    """

    camera_from_part: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    part_ids: NDArray[np.int32]
    label_ids: NDArray[np.int64]

    @property
    def occlusion_rate(self) -> NDArray[np.float64]:
        """``(I,)`` in [0, 1], what the Bregier average precision asks for."""
        return 1.0 - self.visible_fraction

    @classmethod
    def none(cls) -> GroundTruth:
        """Of a scene about which nothing is known, or without parts."""
        return cls(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, np.int32), np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture and what is in it.

    Attributes:
        depth: ``(H, W)`` metres, NaN where nothing was measured.
        instance: ``(H, W)`` int32, row of the ground truth, ``BACKGROUND`` for none.
        unknown_pixels: pixels whose label is no instance's and no background's.
        camera: intrinsics.
        ground_truth: empty when it was not asked for.
        background: ``(H, W)`` depth of the empty bin, or None.
        background_tolerance: metres; a pixel this near to the empty bin is not a part's.
        nearest, farthest: metres; what is outside is not a part's.
    """

    depth: NDArray[np.float64]
    instance: NDArray[np.int32]
    unknown_pixels: int
    camera: PinholeCamera
    ground_truth: GroundTruth
    background: NDArray[np.float64] | None = None
    background_tolerance: float = 0.0
    nearest: float | None = None
    farthest: float | None = None

    @property
    def knows_background(self) -> bool:
        """Whether the format tells the bin from the parts without looking at labels."""
        return self.background is not None or self.farthest is not None

    def parts_only(self) -> NDArray[np.float64]:
        """The depth ``(H, W)`` with the bin and what is out of range missing, without a look at labels."""
        depth = self.depth.copy()
        with np.errstate(invalid="ignore"):
            if self.background is not None:
                depth[np.abs(depth - self.background) <= self.background_tolerance] = np.nan
            if self.nearest is not None:
                depth[depth < self.nearest] = np.nan
            if self.farthest is not None:
                depth[depth > self.farthest] = np.nan
        return depth


class Dataset(ABC):
    """Scenes of one object (IPA, Sileane) or of one split and sensor (BOP).

    Attributes:
        format: ``ipa``, ``sileane`` or ``bop``.
        directory: where it is.
        title: object or dataset, for people.
        split: ``train``, ``test``, ``real`` or the folder's own word.
        parts: names of the parts; ``part_ids`` index them.
        names: of the scenes, in order.
        has_labels: whether there are images of labels; else every point's instance is unknown.
    """

    format: str
    directory: Path
    title: str
    split: str
    parts: tuple[str, ...]
    names: tuple[str, ...]
    has_labels: bool

    @abstractmethod
    def drop_count(self, name: str) -> int:
        """Number of parts in the bin of a scene."""

    @abstractmethod
    def camera(self, name: str) -> PinholeCamera:
        """Intrinsics of a scene's picture."""

    @abstractmethod
    def ground_truth(self, name: str) -> GroundTruth:
        """Poses and visibility of a scene; the picture is not opened.

        Raises:
            ValueError: with one sentence, when it is missing or breaks a rule of the format.
        """

    @abstractmethod
    def frame(self, name: str, labels: bool = True) -> Frame:
        """The picture of a scene; with ``labels=False`` without ground truth, which then need not exist.

        Raises:
            ValueError: with one sentence, when a file is missing or breaks a rule of the format.
        """

    @abstractmethod
    def missing_files(self) -> dict[str, list[str]]:
        """Names of the scenes that lack a file, by its kind (``depth``, ``gt``, ``labels``); no picture is opened."""

    @abstractmethod
    def truth_bytes(self, name: str) -> bytes:
        """What the files say of a scene's poses and visibility, unread: digests of many thousand scenes need it.

        Raises:
            ValueError: with one sentence, when it is missing.
        """

    @abstractmethod
    def picture_rule(self, name: str) -> str:
        """What makes points of a scene's picture (camera, meaning of a count), as a text; no picture is opened."""

    def cycle_of(self, name: str) -> str:
        """The drop cycle (BOP: scene) that a scene belongs to: scenes of one are nearly the same picture."""
        return self._checked(name).rpartition("/")[0]

    @property
    def diameters(self) -> tuple[float | None, ...]:
        """D of every part in metres, where the files or the paper's Table 1 say it."""
        return tuple(benchmark.diameter if benchmark else None for benchmark in map(benchmark_object, self.parts))

    @property
    def camera_from_file(self) -> NDArray[np.float64]:
        """``(4, 4)``, what takes poses as they stand in the files into the OpenCV camera frame."""
        return np.eye(4)

    @cached_property
    def benchmark(self) -> BenchmarkObject | None:
        """The paper's object that this is, if it is one."""
        return benchmark_object(self.parts[0]) if len(self.parts) == 1 else None

    @property
    def is_generated(self) -> bool:
        """Whether ``make write-data`` wrote it: then nobody printed how many scenes it must have."""
        return (self.directory / RECEIPT).is_file()

    @property
    def written_from(self) -> str | None:
        """Digest of the generated scenes that ``make write-data`` wrote here; None of other data."""
        if not self.is_generated:
            return None
        digest = read_json(self.directory / RECEIPT, dict).get("scene_set")
        return digest if isinstance(digest, str) else None

    @property
    def scored_names(self) -> tuple[str, ...]:
        """Scenes with at least five drops: what the paper's Table 1 counts and its tables score."""
        return tuple(name for name in self.names if self.drop_count(name) >= LEAST_DROPS)

    def points(self, name: str, remove_background: bool | None = None) -> NDArray[np.float32]:
        """The cloud ``(P, 3)`` of a scene that need not have ground truth, in random order; see ``scene``."""
        return self.scene_of(name, self.frame(name, labels=False), remove_background).points

    def scene(self, name: str, remove_background: bool | None = None) -> Scene:
        """A scene in the camera frame, its points in a random order that the name decides.

        Args:
            name: one of ``names``.
            remove_background: leave out the bin, by the picture of the empty one or the depth limits of the format;
                None: where the format has either.

        Raises:
            ValueError: with one sentence, also when the background is to be removed and nothing says what it is.
        """
        return self.scene_of(name, self.frame(name), remove_background)

    def scene_of(self, name: str, frame: Frame, remove_background: bool | None = None) -> Scene:
        """The scene of a picture that is open already; see ``scene``."""
        remove = remove_background
        if remove and not frame.knows_background:
            raise ValueError(
                f"{self.directory}: the background of {name} cannot be removed, because there is no picture of the "
                "empty bin and no depth limit: crop the bin instead"
            )
        wanted = frame.knows_background if remove is None else remove
        points, pixels = frame.camera.points(frame.parts_only() if wanted else frame.depth)
        order = np.random.default_rng(zlib.crc32(name.encode())).permutation(len(points))
        truth = frame.ground_truth
        return Scene(
            points=points[order],
            instance_ids=frame.instance.reshape(-1)[pixels[order]],
            camera_from_part=truth.camera_from_part,
            visible_fraction=truth.visible_fraction,
            part_ids=truth.part_ids,
        )

    def _checked(self, name: str) -> str:
        if name not in self._name_set:
            raise ValueError(f"{self.directory}: there is no scene {name!r}, the names go from {self._range}")
        return name

    @cached_property
    def _name_set(self) -> frozenset[str]:
        return frozenset(self.names)

    @property
    def _range(self) -> str:
        return f"{self.names[0]!r} to {self.names[-1]!r}" if self.names else "none to none"


def rows_of_labels(
    labels: NDArray[np.int64], label_ids: NDArray[np.int64], background: tuple[int, ...]
) -> tuple[NDArray[np.int32], int]:
    """Row of the ground truth ``(H, W)`` int32 for an image of labels, and how many pixels have an unknown label.

    Args:
        labels: ``(H, W)``.
        label_ids: ``(I,)`` label of every row.
        background: labels that are no instance; they may not occur in ``label_ids``.
    """
    table = np.full(int(max(labels.max(initial=0), label_ids.max(initial=0))) + 1, BACKGROUND, dtype=np.int32)
    table[label_ids] = np.arange(len(label_ids), dtype=np.int32)
    rows = table[labels]
    unknown = (rows == BACKGROUND) & ~np.isin(labels, background)
    return rows, int(unknown.sum())
