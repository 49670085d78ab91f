"""The classical baselines over scenes: what they find beside the truth, and how long they take.

``baselines`` and ``evaluation`` do not know each other; this is where the one's answers become the other's results.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version as package_version
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from attentionvote.baselines.clouds import Detections
from attentionvote.baselines.fpfh import FpfhDetector
from attentionvote.baselines.open3d import open3d_version, registration
from attentionvote.baselines.opencv import surface_matching
from attentionvote.baselines.ppf import PpfDetector
from attentionvote.baselines.settings import FpfhSettings, PpfSettings
from attentionvote.evaluation import SceneResult
from attentionvote.execution import WorkerDied, run_all
from attentionvote.geometry.pointcloud import estimate_normals
from attentionvote.part import Part
from attentionvote.scene import Scene

BaselineSettings: TypeAlias = PpfSettings | FpfhSettings


class _Method(NamedTuple):
    """What belongs to settings: a name, and the library, which is imported only when it is asked for."""

    name: str
    library: Callable[[], ModuleType]


_METHODS: dict[type[BaselineSettings], _Method] = {
    PpfSettings: _Method("PPF", surface_matching),
    FpfhSettings: _Method("FPFH", registration),
}

# What a user would try, in this order: OpenCV's as voted, with its ICP, ranked by what ICP explains; and Open3D's.
VARIANTS: dict[str, BaselineSettings] = {
    "ppf": PpfSettings(icp_iterations=0),
    "ppf_icp": PpfSettings(),
    "ppf_icp_fit": PpfSettings(score="fit"),
    "fpfh_icp": FpfhSettings(),
}


@dataclass(frozen=True)
class BaselineTask:
    """Searches a scene; a worker makes the detector for its first one."""

    part: Part
    settings: BaselineSettings

    def __call__(self, scene: Scene) -> tuple[Detections, float]:
        """What is found, and the seconds of it: normals, when the scene has none, and the search; not the making."""
        detector = self._detector
        start = time.perf_counter()
        normals = scene.normals
        points = scene.points
        if normals is None and len(points) < 3:  # nothing to estimate normals from, and no pose either
            points = normals = points[:0]
        elif normals is None:
            normals = estimate_normals(points)
        return detector.detect(points, normals), (time.perf_counter() - start)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_detector"}

    @cached_property
    def _detector(self) -> PpfDetector | FpfhDetector:
        part, settings = self.part, self.settings
        return PpfDetector(part, settings) if isinstance(settings, PpfSettings) else FpfhDetector(part, settings)


def identity(settings: BaselineSettings, scenes: str, part: Part) -> str:
    """Sha256 of all that a baseline's results depend on, ``scenes`` the digest of theirs: what is stored goes by it."""
    library = (
        package_version("opencv-contrib-python-headless") if isinstance(settings, PpfSettings) else open3d_version()
    )
    return hashlib.sha256(json.dumps([asdict(settings), scenes, part.digest, library]).encode()).hexdigest()


def baseline_results(
    part: Part,
    scenes: Sequence[Scene],
    settings: BaselineSettings,
    workers: int = 1,
    shown: Callable[[Iterator[Any]], Iterable[Any]] = iter,
) -> tuple[list[SceneResult], NDArray[np.float64]]:
    """What a baseline finds in every scene, and the seconds ``(S,)`` that each took on one thread.

    A scene without normals has them estimated for all its points, inside the time, as the cell's estimator does.

    Args:
        part: the part in the scenes.
        scenes: as the sensor gives them; ``data.clouds.sense`` gives what the network's estimator is measured on.
        settings: of the detector, and which one it is.
        workers: processes. The results do not depend on it; the times do where they share cores.
        shown: wraps the scenes as they are done, such as a progress bar.

    Raises:
        ValueError: when the library of the baseline is missing.
        OSError: when the worker of one scene died again and again.
    """
    method = _METHODS[type(settings)]
    method.library()  # whether it can work here, said before any work
    task = BaselineTask(part, settings)
    scene_results: list[SceneResult | None] = [None] * len(scenes)
    seconds = np.zeros(len(scenes))
    try:
        with closing(run_all(task, scenes, workers=workers)) as results:
            for index, (detections, elapsed) in shown(results):
                scene = scenes[index]
                occlusion = 1.0 - np.minimum(scene.visible_fraction, 1.0)
                scene_results[index] = SceneResult(
                    detections.camera_from_part, detections.scores, scene.camera_from_part, occlusion
                )
                seconds[index] = elapsed
    except WorkerDied as error:
        raise OSError(
            f"a worker process died in the {method.name} baseline (out of memory? {error.how}) {error.times} times at "
            f"scene {error.job}"
        ) from error
    return [result for result in scene_results if result is not None], seconds
