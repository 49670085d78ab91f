"""Parts, scenes and sensors: everything that makes training data.

The public names are loaded on first use, so that reading a part does not import the physics engine.
"""

from importlib import import_module
from typing import Any

_MODULE_OF = {
    "BUILTIN_PARTS": "cad",
    "builtin_surface": "cad",
    "largest_vertex_distance": "mesh",
    "load_surface": "mesh",
    "load_part": "part_files",
    "load_parts": "part_files",
    "detect_symmetry": "symmetry_detection",
    "symmetry_residual": "symmetry_detection",
    "Camera": "camera",
    "CameraSettings": "camera",
    "convex_hulls": "decomposition",
    "BinSettings": "drop",
    "DropSettings": "drop",
    "drop_parts": "drop",
    "PartCaster": "raycast",
    "SceneRecord": "scene_record",
    "SceneSet": "scene_set",
    "generate_scene_set": "scene_set",
    "SceneSetSpec": "scene_spec",
    "scene_set_directory": "scene_spec",
    "scene_set_specs": "scene_spec",
    "Sensor": "sensor",
    "synthesize": "sensor",
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
