"""The exported graph in onnxruntime: the only place that imports it, telemetry off before it is loaded.

onnxruntime's Linux wheels write a device id and a data base below the home directory and send usage data unless
``ORT_DISABLE_TELEMETRY`` is set when the library is loaded.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime  # type: ignore[import-untyped]

from attentionvote.contract import FOUND, LAYOUT_KEY, ModelCard, TensorSpec
from attentionvote.inference.errors import BundleError, DeadlineExceeded

_ERRORS_ONLY = 3
_PROVIDERS = {
    "CPU": "CPUExecutionProvider",
    "CUDA": "CUDAExecutionProvider",
    "TensorRT": "TensorrtExecutionProvider",
    "OpenVINO": "OpenVINOExecutionProvider",
}


def providers() -> dict[str, str]:
    """onnxruntime's names of the execution paths that its wheel on this machine brings, by short name."""
    present = onnxruntime.get_available_providers()
    return {name: provider for name, provider in _PROVIDERS.items() if provider in present}


def runtime_version() -> str:
    """Version of onnxruntime."""
    return str(onnxruntime.__version__)


class Session:
    """A loaded graph that fits its card. Runs may overlap: the session holds no state of a run.

    Attributes:
        layout: centers, neighbors and radii by level of what ``run`` may be given; None: a graph of an earlier version.

    Args:
        model: the ONNX file.
        card: what its tensors must be.
        threads: of one run.
        provider: one of ``providers()``.

    Raises:
        BundleError: when the graph cannot be loaded or its tensors are not the card's.
        ValueError: when ``threads`` is no positive number.
    """

    def __init__(self, model: bytes, card: ModelCard, threads: int = 1, provider: str = _PROVIDERS["CPU"]) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.use_deterministic_compute = True
        options.log_severity_level = _ERRORS_ONLY
        # Threads that spin while they wait make a graph with loops several times slower.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=[provider])
        except Exception as error:  # onnxruntime's exceptions have no common parent
            raise BundleError(
                f"model.onnx must be a graph that onnxruntime {runtime_version()} can load, but it says: {_line(error)}"
            ) from error
        used = self._session.get_providers()[0]
        if used != provider:  # onnxruntime falls back without a word
            raise BundleError(f"onnxruntime must run the graph with {provider}, but here it falls back to {used}")
        _check_tensors("input", self._session.get_inputs(), card.inputs)
        _check_tensors("output", self._session.get_outputs(), card.outputs)
        optional = {node.name for node in self._session.get_overridable_initializers()}
        layout = self._session.get_modelmeta().custom_metadata_map.get(LAYOUT_KEY)
        self.layout: dict[str, Any] | None = json.loads(layout) if layout and optional >= set(FOUND) else None
        self._inputs = card.inputs
        self._outputs = [spec.name for spec in card.outputs]

    def run(
        self,
        points: NDArray[np.float32],
        normals: NDArray[np.float32],
        deadline_s: float | None = None,
        neighbors: Sequence[NDArray[np.int64]] = (),
    ) -> dict[str, NDArray[np.float32]]:
        """The graph's outputs by name.

        Args:
            points, normals: ``(1, N, 3)`` float32.
            deadline_s: seconds from now; the graph is stopped when they have passed. None: it runs to its end.
            neighbors: farthest-point order and neighbours as ``layout`` says; without them the graph finds its own.

        Raises:
            ValueError: when an input has another shape or type.
            DeadlineExceeded: when there was no answer in time; the work has ended, nothing goes on in the background.
            RuntimeError: when onnxruntime fails.
        """
        feed: dict[str, NDArray[Any]] = dict(zip((spec.name for spec in self._inputs), (points, normals), strict=True))
        for spec in self._inputs:
            array = feed[spec.name]
            if array.shape != spec.shape or array.dtype != np.float32:
                raise ValueError(
                    f"{spec.name} must be float32 of shape {spec.shape}, got {array.dtype} of shape {array.shape}"
                )
        feed |= dict(zip(FOUND, neighbors, strict=False))
        start = time.monotonic()
        if deadline_s is not None and not deadline_s > 0:
            raise DeadlineExceeded("the deadline had passed before the graph was started")
        options = onnxruntime.RunOptions()
        options.log_severity_level = _ERRORS_ONLY + 1  # a stopped run is no error worth a line
        timer = None
        if deadline_s is not None:
            timer = threading.Timer(min(deadline_s, threading.TIMEOUT_MAX), _stop, [options])
            timer.daemon = True
            timer.start()
        try:
            outputs = self._session.run(self._outputs, feed, options)
        except Exception as error:  # onnxruntime's exceptions have no common parent
            if options.terminate:
                raise DeadlineExceeded(f"the graph was stopped after its deadline of {deadline_s:.3f} s") from error
            raise RuntimeError(f"onnxruntime failed: {_line(error)}") from error
        finally:
            if timer is not None:
                timer.cancel()
        if deadline_s is not None and time.monotonic() - start > deadline_s:
            raise DeadlineExceeded(f"the graph ended after its deadline of {deadline_s:.3f} s")
        return dict(zip(self._outputs, outputs, strict=True))


def _stop(options: onnxruntime.RunOptions) -> None:
    options.terminate = True


def _check_tensors(kind: str, nodes: list[onnxruntime.NodeArg], expected: tuple[TensorSpec, ...]) -> None:
    """The graph's tensors must be the card's, in their order."""
    actual = {node.name: (tuple(node.shape), node.type) for node in nodes}
    if [node.name for node in nodes] != [spec.name for spec in expected]:
        raise BundleError(
            f"model.onnx must have the {kind}s {', '.join(spec.name for spec in expected)}; "
            f"got {', '.join(actual) or 'none'}: export the bundle again"
        )
    for spec in expected:
        if actual[spec.name] != (spec.shape, "tensor(float)"):
            shape, kind_of_tensor = actual[spec.name]
            raise BundleError(
                f"model.onnx must have the {kind} {spec.name} as tensor(float) of shape {spec.shape}, "
                f"got {kind_of_tensor} of shape {shape}: export the bundle again"
            )


def _line(error: Exception) -> str:
    """The first line of an exception's text, short."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]
