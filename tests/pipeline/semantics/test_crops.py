"""Crops of labelled images: labels stay with their pixels, objects are found, grain differs by class."""

from dataclasses import replace

import numpy as np

from pipeline.semantics.conventions import NONE
from pipeline.semantics.crops import CropSettings, draw_crop

# Nothing but the cut.
PLAIN = CropSettings(crop=(24, 32), zoom=1.0, jitter=0, gamma=0, noise=0, grey=0)
ROAD, CAR = 0, 13


def halves(size: tuple[int, int] = (60, 80)) -> tuple[np.ndarray, np.ndarray]:
    """Grey road (100), and a car (200) of 4 x 6 pixels near the right border."""
    semantics = np.full(size, ROAD, np.uint8)
    semantics[40:44, 70:76] = CAR
    image = np.where(semantics[..., None] == CAR, 200, 100).repeat(3, axis=2).astype(np.uint8)
    return image, semantics


def test_labels_stay_with_their_pixels() -> None:
    random, image, semantics = np.random.default_rng(0), *halves()
    for _ in range(20):
        crop, labels = draw_crop(image, semantics, PLAIN, random)
        assert crop.shape == (24, 32, 3)
        np.testing.assert_array_equal(crop[..., 0] == 200, labels == CAR)


def test_objects_are_in_as_many_crops_as_asked() -> None:
    image, semantics = halves()
    shares = []
    for objects in (0.0, 1.0):
        random = np.random.default_rng(1)
        crops = [draw_crop(image, semantics, replace(PLAIN, objects=objects), random)[1] for _ in range(60)]
        shares.append(np.mean([(labels == CAR).any() for labels in crops]))
    assert shares[1] == 1
    assert shares[0] < 0.6
    road = np.zeros_like(semantics)
    assert (draw_crop(image, road, replace(PLAIN, objects=1.0), random)[1] == ROAD).all()


def test_images_smaller_than_the_crop_are_padded_without_labels() -> None:
    image, semantics = halves((44, 76))
    labels = draw_crop(image, semantics, replace(PLAIN, crop=(50, 80)), np.random.default_rng(2))[1]
    assert (labels == NONE).sum() == 50 * 80 - 44 * 76


def test_grain_blur_and_balance_change_pictures_and_no_labels() -> None:
    image, semantics = halves()
    for change in ({"texture": 0.5}, {"balance": 0.3}, {"blur": 2.0}):
        random = np.random.default_rng(3)
        crops = [draw_crop(image, semantics, replace(PLAIN, objects=1.0, **change), random) for _ in range(8)]
        assert any(len(np.unique(crop[labels == ROAD])) > 1 for crop, labels in crops), change
        assert all((labels == CAR).sum() == 24 for _, labels in crops if (labels == CAR).sum() > 23), change


def test_grain_is_of_one_mean_and_of_another_strength_in_each_class() -> None:
    image = np.full((128, 128, 3), 100, np.uint8)
    semantics = np.repeat([[0] * 64 + [8] * 64], 128, axis=0).astype(np.uint8)
    settings = replace(PLAIN, crop=(128, 128), texture=0.4)
    spreads = []
    for seed in range(6):
        crop, labels = draw_crop(image, semantics, settings, np.random.default_rng(seed))
        assert 85 < crop.mean() < 125
        spreads.append([crop[..., 0][labels == label].std() for label in (0, 8)])
    ratios = np.array(spreads)[:, 0] / np.array(spreads)[:, 1]
    assert ratios.max() > 1.5 * ratios.min()
