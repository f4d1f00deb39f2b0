"""The pictures a network is tried with."""

from __future__ import annotations

import numpy as np
import pytest

from completion.pictures import PICTURES, fitted, other_number, other_picture, pictures_of


def test_pictures_by_hand() -> None:
    own, other = np.full((3, 4, 3), 7, np.uint8), np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    found = pictures_of(own, other)
    assert tuple(found) == PICTURES
    assert found["true"] is own
    assert (found["grey"] == 128).all()
    np.testing.assert_array_equal(found["other"], np.concatenate([other, other[-1:]]))


@pytest.mark.parametrize("size", [(1, 2), (2, 2), (5, 9)])
def test_another_picture_is_cut_or_continued(size: tuple[int, int]) -> None:
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    found = fitted(image, size)
    assert found.shape == (*size, 3)
    np.testing.assert_array_equal(found[:2, :3], image[: size[0], : size[1]])
    np.testing.assert_array_equal(found[-1, -1], image[min(size[0], 2) - 1, min(size[1], 3) - 1])


def test_the_other_frame_is_far_from_the_frame() -> None:
    assert [other_number(number, 8) for number in range(8)] == [4, 5, 6, 7, 0, 1, 2, 3]
    assert all(other_number(number, count) != number for count in (2, 3, 11) for number in range(count))
    only = np.arange(6, dtype=np.uint8).reshape(1, 2, 3)
    assert other_picture(0, [only])[0, 0].tolist() == [3, 4, 5]
