"""The classical baseline over scenes: what point pair features find beside the truth, and how long they take.

``baselines`` and ``evaluation`` do not know each other; this is where the one's answers become the other's results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.baselines.opencv import surface_matching
from attentionvote.baselines.ppf import Detections, PpfDetector
from attentionvote.baselines.settings import PpfSettings
from attentionvote.evaluation import SceneResult
from attentionvote.execution import WorkerDied, run_all
from attentionvote.geometry.pointcloud import estimate_normals
from attentionvote.part import Part
from attentionvote.scene import Scene

# What a user would try, in this order: as voted, with OpenCV's ICP, and ranked by what ICP explains.
VARIANTS = {
    "ppf": PpfSettings(icp_iterations=0),
    "ppf_icp": PpfSettings(),
    "ppf_icp_fit": PpfSettings(score="fit"),
}


@dataclass(frozen=True)
class PpfTask:
    """Searches a scene; a worker trains the detector for its first one."""

    part: Part
    settings: PpfSettings

    def __call__(self, scene: Scene) -> tuple[Detections, float]:
        """What is found, and the seconds of it: normals, when the scene has none, and the search; not the training."""
        detector = self._detector
        start = time.perf_counter()
        normals = scene.normals
        if normals is None and len(scene.points) >= 3:
            normals = estimate_normals(scene.points)
        return detector.detect(scene.points, np.zeros_like(scene.points) if normals is None else normals), (
            time.perf_counter() - start
        )

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_detector"}

    @cached_property
    def _detector(self) -> PpfDetector:
        return PpfDetector(self.part, self.settings)


def ppf_results(
    part: Part,
    scenes: Sequence[Scene],
    settings: PpfSettings | None = None,
    workers: int = 1,
    shown: Callable[[Iterator[Any]], Iterable[Any]] = iter,
) -> tuple[list[SceneResult], NDArray[np.float64]]:
    """What the baseline finds in every scene, and the seconds ``(S,)`` that each took on one thread.

    A scene without normals has them estimated for all its points, inside the time, as the cell's estimator does.

    Args:
        part: the part in the scenes.
        scenes: as the sensor gives them; ``data.clouds.sense`` gives what the network's estimator is measured on.
        settings: of the detector.
        workers: processes. The results do not depend on it; the times do where they share cores.
        shown: wraps the scenes as they are done, such as a progress bar.

    Raises:
        ValueError: when OpenCV with its surface matching is missing.
        OSError: when the worker of one scene died again and again.
    """
    surface_matching()  # whether it can work here, said before any work
    task = PpfTask(part, settings or PpfSettings())
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
            f"a worker process died in the PPF baseline (out of memory? {error.how}) {error.times} times at scene "
            f"{error.job}"
        ) from error
    return [result for result in scene_results if result is not None], seconds
