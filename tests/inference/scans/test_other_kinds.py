"""Files of sensors' own programs are named, with the way out."""

from __future__ import annotations

from pathlib import Path

import pytest

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud
from attentionvote.inference.scans.depth_files import read_depth


@pytest.mark.parametrize(
    ("content", "name", "kind"),
    [
        (b"\x89HDF\r\n\x1a\n" + bytes(50), "the body", r"an HDF5 file \(Zivid's \.zdf, \.h5\)"),
        (b"CDF\x02" + bytes(50), "scan.zdf", r"a NetCDF file \(Zivid's \.zdf\)"),
        (b"????" + bytes(50), "scan.ZDF", "a Zivid file"),
        (b"????" + bytes(50), "scan.praw", "a Photoneo file"),
        (b"????" + bytes(50), "scan.mrad", "a Mech-Mind file"),
        (b"????" + bytes(50), "a/b.c/scan.om3", "a HALCON object model"),
        (b"ASTM-E57" + bytes(50), "the body", "an E57 file"),
        (b"\x1f\x8b\x08" + bytes(50), "scan.ply.gz", "a gzip file"),
        (b"#ROSBAG V2.0\n" + bytes(50), "the body", "a ROS bag"),
        (b"LASF" + bytes(50), "the body", "a LAS or LAZ file"),
        (b"II*\0" + bytes(50), "the body", "a TIFF image"),
        (b"v 1 2 3\nv 4 5 6\n", "part.obj", "an OBJ mesh"),
    ],
)
def test_a_kind_that_is_not_read_is_named_with_the_way_out(content: bytes, name: str, kind: str) -> None:
    message = (
        f"^{name} must be a point cloud as PLY, PCD, NPY, NPZ or XYZ text, got {kind}: "
        "export it so from the sensor's viewer or SDK, or unpack it$"
    )
    with pytest.raises(InputError, match=message):
        read_cloud(content, name)
    with pytest.raises(
        InputError, match=f"^{name} must be a 16-bit PNG or a .npy file with a depth image, got {kind}$"
    ):
        read_depth(content, name)


def test_what_can_be_read_is_read_whatever_its_name(tmp_path: Path) -> None:
    (tmp_path / "scan.pts").write_bytes(b"1\n1 2 3 4\n")
    assert read_cloud(tmp_path / "scan.pts").tolist() == [[1, 2, 3]]
    with pytest.raises(InputError, match=r"got another kind of file$"):
        read_cloud(b"????", "the body")
