"""Kinds of files that sensors and their programs write and that are not read here: what to send instead."""

from __future__ import annotations

from pathlib import PurePath

# First bytes, and how the kind is called.
_BY_CONTENT = (
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file (Zivid's .zdf, .h5)"),
    (b"CDF", "a NetCDF file (Zivid's .zdf)"),
    (b"ASTM-E57", "an E57 file"),
    (b"LASF", "a LAS or LAZ file"),
    (b"#ROSBAG", "a ROS bag"),
    (b"\x89MCAP", "an MCAP recording"),
    (b"SQLite format 3", "an SQLite file (a ROS 2 bag)"),
    (b"\x1f\x8b", "a gzip file"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file"),
    (b"BZh", "a bzip2 file"),
    (b"\xfd7zXZ", "an xz file"),
    (b"7z\xbc\xaf", "a 7-Zip file"),
    (b"II*\0", "a TIFF image"),
    (b"MM\0*", "a TIFF image"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"solid ", "an STL mesh"),
)
_BY_NAME = {
    **{
        ".zdf": "a Zivid file",
        ".praw": "a Photoneo file",
        ".mrad": "a Mech-Mind file",
        ".om3": "a HALCON object model",
    },
    **{".e57": "an E57 file", ".las": "a LAS file", ".laz": "a LAZ file", ".bag": "a ROS bag", ".db3": "a ROS 2 bag"},
    **{".mcap": "an MCAP recording", ".zip": "a ZIP file", ".gz": "a gzip file", ".tif": "a TIFF image"},
    **{".tiff": "a TIFF image", ".stl": "an STL mesh", ".obj": "an OBJ mesh", ".exr": "an EXR image"},
    **{".pts": "a PTS file", ".ptx": "a PTX file"},
}
_LONGEST = max(len(magic) for magic, _ in _BY_CONTENT)


def other_kind(content: memoryview, name: str) -> str | None:
    """What a file is by its first bytes, or else by its name; None: unknown."""
    head = bytes(content[:_LONGEST])
    for magic, kind in _BY_CONTENT:
        if head.startswith(magic):
            return kind
    return _BY_NAME.get(PurePath(name).suffix.lower())
