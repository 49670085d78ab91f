"""Compiling the project's small C files once per machine and calling them through ctypes.

No torch headers, no CUDA, no build step at installation: the first use compiles into the user's cache folder.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np

from attentionvote.files import cache_folder

# Never -ffast-math: in a shared object it makes GCC flush subnormals to zero in the whole process. The running
# maxima vectorise only under -ffinite-math-only (speed reference, "own C operators").
PORTABLE = ("-O3", "-std=gnu99", "-ffinite-math-only", "-fno-signed-zeros", "-shared", "-fPIC")


_disabled = False


@contextlib.contextmanager
def disabled() -> Iterator[None]:
    """Inside, ``load`` finds nothing: the slow references take over, to be compared with or timed against."""
    global _disabled
    before, _disabled = _disabled, True
    try:
        yield
    finally:
        _disabled = before


def load(package: str, file: str, tuned: bool = False, make: bool = True) -> ctypes.CDLL | None:
    """The compiled library of a C file that lies in a package, or None (with one warning) without a C compiler or
    a place to keep it.

    Args:
        package: dotted name of the package.
        file: name of the C file in it.
        tuned: compile for exactly this processor; results may differ in the last bit between machines.
        make: whether it is compiled when it is not there; without, nothing is written and nothing is said.

    Raises:
        OSError: when the compiler refuses the file, with the compiler's words.
    """
    if _disabled or not (make or _library(package, file, tuned)[0].exists()):
        return None
    return compiled(package, file, tuned)


@functools.cache
def compiled(package: str, file: str, tuned: bool) -> ctypes.CDLL | None:
    """What ``load`` returns, once per process and file."""
    path, flags, source = _library(package, file, tuned)
    if not path.exists():
        if not _writable(path.parent):
            warnings.warn(
                f"{path.parent} cannot be written, {file} is replaced by slow Python: set ATTENTIONVOTE_CACHE",
                stacklevel=2,
            )
            return None
        compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            warnings.warn(f"no C compiler found, {file} is replaced by slow Python: install gcc", stacklevel=2)
            return None
        _compile(compiler, flags, source, path)
    return ctypes.CDLL(str(path))


def _library(package: str, file: str, tuned: bool) -> tuple[Path, tuple[str, ...], bytes]:
    """Where a C file's library is kept, how it is compiled, and its source."""
    # ATTENTIONVOTE_MARCH names another processor than this one, to see what depends on it: x86-64 has no AVX. The flags
    # are part of the key, so each has a library of its own.
    flags = (*PORTABLE, f"-march={os.environ.get('ATTENTIONVOTE_MARCH') or 'native'}") if tuned else PORTABLE
    source = resources.files(package).joinpath(file).read_bytes()
    machine = _processor() if tuned else platform.machine()
    key = hashlib.sha256("\0".join([source.decode(), *flags, machine]).encode()).hexdigest()
    return cache_folder() / f"{Path(file).stem}-{key[:16]}.so", flags, source


def call(function: ctypes._NamedFuncPointer, *arguments: object) -> bool:
    """Call a C function that returns 0 for success, 1 for no memory and 2 where it cannot serve its arguments.

    Arrays and None go as pointers. The interpreter's lock is released during the call, so several threads may work at
    once.

    Returns:
        whether it served; where it did not, its results mean nothing, and the slow reference answers.

    Raises:
        MemoryError: when there is no memory.
    """
    converted: list[object] = []
    for argument in arguments:
        if argument is None:
            converted.append(ctypes.c_void_p(None))
        elif isinstance(argument, np.ndarray):
            converted.append(ctypes.c_void_p(argument.ctypes.data))
        elif isinstance(argument, float):
            converted.append(ctypes.c_float(argument))
        else:
            converted.append(argument)
    answer = function(*converted)
    if answer == 1:
        raise MemoryError(f"{function.__name__} ran out of memory")
    return bool(answer == 0)


def long(value: int) -> ctypes.c_int64:
    """A 64-bit argument; plain integers are passed as 32-bit ones."""
    return ctypes.c_int64(value)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() + platform.machine()
    return "\n".join(line for line in lines if line.startswith(("model name", "flags", "Features")))


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def _compile(compiler: str, flags: tuple[str, ...], source: bytes, path: Path) -> None:
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        c_file, library = Path(folder, "source.c"), Path(folder, "library.so")
        c_file.write_bytes(source)
        command = [compiler, *flags, str(c_file), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{compiler} could not compile {path.stem}: {done.stderr.strip()[:500]}")
        library.replace(path)  # atomic: two processes may compile at once
