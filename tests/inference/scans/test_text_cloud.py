"""Clouds as text of any separator, with names and comments before them; other texts are none."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud

pytestmark = pytest.mark.usefixtures("way")
EXPECTED = np.float32([[0.1, -0.2, 0.8], [1, 2, 3e-1]])


@pytest.mark.parametrize(
    "text",
    [
        "0.1 -0.2 0.8\n1 2 3e-1\n",
        "0.1\t-0.2\t0.8\r\n1\t2\t.3",
        "  0.1   -.2 0.8 \r1. 2 0.3\r",
        "0.1,-0.2,0.8\n1,2,0.3\n",
        "0.1, -0.2, 0.8,\n1, 2, 0.3,\n",
        "0.1;-0.2;0.8\n1 ; 2 ;0.3\n",
        "\ufeff0.1 -0.2 0.8\n1 2 0.3\n",
        "# a scan\n// of points\n\n0.1 -0.2 0.8\n1 2 0.3\n",
        "x,y,z\n0.1,-0.2,0.8\n1,2,0.3\n",
        "2\n0.1 -0.2 0.8 77\n1 2 0.3 78\n",
        '"X";"Y";"Z";"I"\n0.1;-0.2;0.8;5\n1;2;0.3;6\n',
        "//X Y Z R G B\n0.1 -0.2 0.8 1 2 3\n1 2 0.3 4 5 6\n",
        "r,g,z,y,x,name\n1,2,0.8,-0.2,0.1,a b\n1,2,0.3,2,1,c\n",
        "0.1 -0.2 0.8\n\n\n1 2 0.3\n\n",
    ],
)
def test_a_text_of_numbers_is_a_cloud(text: str) -> None:
    np.testing.assert_array_equal(read_cloud(text.encode()), EXPECTED, strict=True)


def test_missing_points_keep_their_places() -> None:
    cloud = read_cloud(b"1 2 3\nnan nan nan\n0 0 0\n-inf 1 2\nNaN 1 2\n")
    np.testing.assert_array_equal(cloud, np.float32([[1, 2, 3], *[[np.nan] * 3] * 4]))


@pytest.mark.parametrize("text", ["0,1;0,2;0,8\n", "0,1 0,2 0,8\n", "x;y;z\n-0,1;-0,2;0,8\n"])
def test_decimal_commas_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"its numbers must have decimal points, got commas: write 0\.5, not 0,5"):
        read_cloud(text.encode())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5\n", "its points must be rows of 3 numbers, got rows of 2"),
        ("1 2 3\n4 5 6 7\n", "its points must be rows of 3 numbers, got rows of 4"),
        ("1 2 3\nx y z\n", "its points must be rows of 3 numbers, got something else"),
        ("1,2,3\n4,,6\n", "its points must be rows of 3 numbers, got something else"),
        ("1,2,3\n4 5 6\n", "its points must be rows of 3 numbers, got rows of 1"),
    ],
)
def test_a_damaged_text_is_one_sentence(text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^the file must be a point cloud, but {message}$"):
        read_cloud(text.encode())


@pytest.mark.parametrize(
    "text",
    [
        '{"inputs": [1, 2, 3]}',
        "hello",
        "1 2\n3 4\n",
        "a\nb\n1 2 3\n",
        "#\n" * 300 + "1 2 3\n",
        "<html>\n",
        "1 2 3\0\n",
        ",",
    ],
)
def test_other_texts_are_another_kind_of_file(text: str) -> None:
    with pytest.raises(InputError, match="got another kind of file"):
        read_cloud(text.encode())


@given(
    st.lists(
        st.sampled_from(["1", " ", ",", ";", "\n", "\r", "nan", "x", "#", "//", "-", ".5", "\0", "e9"]), min_size=1
    )
)
def test_no_text_raises_anything_else(pieces: list[str]) -> None:
    with suppress(InputError):
        assert read_cloud("".join(pieces).encode()).shape[1:] == (3,)
