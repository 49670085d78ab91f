"""A job's result or exception as bytes, the same way back from every kind of worker."""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

# What numpy, torch, OpenBLAS and MKL read when they are imported.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def perform(task: Callable[[], Callable[[Any], Any]], job: bytes) -> bytes:
    """Do one pickled job in a worker; the pickled pair (it succeeded, its result or exception). Never raises.

    Args:
        task: gets the task, unpickled once a worker; where that fails, every job does.
        job: pickled.
    """
    try:
        value = task()(pickle.loads(job))
    except BaseException as error:
        return failed(error)
    try:
        return pickle.dumps((True, value))
    except Exception as error:
        return failed(TypeError(f"the result of a job must be picklable, got {type(value).__name__}: {error}"))


def failed(error: BaseException) -> bytes:
    """The outcome of a job that raised ``error``: itself, with its traceback as a note, if it survives pickling."""
    text = "".join(traceback.format_exception(error)).rstrip()
    try:
        copy = pickle.loads(pickle.dumps(error))
        faithful = type(copy) is type(error) and str(copy) == str(error)
    except Exception:
        faithful = False
    if not faithful:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"In the worker:\n{text}")
    return pickle.dumps((False, error))


def result_of(outcome: bytes) -> Any:
    """The result.

    Raises:
        BaseException: what the task raised, same type and message.
    """
    succeeded, value = pickle.loads(outcome)
    if succeeded:
        return value
    raise value


def worker_environment(threads: int) -> dict[str, str]:
    """Variables of a worker's process: its threads, and where this process finds modules."""
    search_path = os.pathsep.join(path for path in sys.path if path)
    return dict.fromkeys(THREAD_VARIABLES, str(threads)) | {"PYTHONPATH": search_path}


@contextmanager
def inherited(variables: dict[str, str]) -> Iterator[None]:
    """Have these environment variables while child processes are started."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
