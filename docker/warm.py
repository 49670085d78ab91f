"""What a cell cannot make at its first start: compiled C operators, and the read-only image's bytecode. Run while it is
built, or installed (docs/operating-a-cell.md).

Python images ship no bytecode. Without it every start compiles the sources again (4 s instead of 0.9 s for the
imports alone), and so does every health check; bytecode of everything would be 50 MB instead of 15.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import py_compile
import sys

os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # before onnxruntime is imported

import attentionvote.inference
from attentionvote.geometry import native

# Package and name of each file of C code that a cell calls.
FILES = (
    ("attentionvote.geometry", "pointops.c"),
    ("attentionvote.geometry", "normals.c"),
    ("attentionvote.inference.scans", "scan_bytes.c"),
)
# What uvicorn, Pillow and the health check import while they run.
LATE = (
    "uvicorn.protocols.http.h11_impl",
    "uvicorn.lifespan.on",
    "uvicorn.loops.asyncio",
    "PIL.PngImagePlugin",
    "runpy",
)


def main() -> None:
    """Compile into ``ATTENTIONVOTE_CACHE`` and, where it is set, ``PYTHONPYCACHEPREFIX``.

    The bytecode is not compared with its source's date: copies between layers change dates, and nothing changes in a
    read-only image. Elsewhere sources change, and pip and Debian make their own.
    """
    for package, file in FILES:
        if native.load(package, file) is None:
            sys.exit(f"warm: {file} was not compiled")
    if sys.pycache_prefix is None:
        return
    for module in pkgutil.walk_packages(attentionvote.inference.__path__, "attentionvote.inference."):
        importlib.import_module(module.name)
    for name in LATE:
        importlib.import_module(name)
    files = {str(getattr(module, "__file__", None)) for module in list(sys.modules.values())} - {__file__}
    sources = sorted(file for file in files if file.endswith(".py"))
    for source in sources:
        py_compile.compile(source, doraise=True, invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH)
    print(f"warm: bytecode of {len(sources)} modules")


if __name__ == "__main__":
    main()
