"""Cycles stay where somebody is on them."""

import numpy as np

from pipeline.data.frame import Frame
from pipeline.semantics.riders import without_parked_cycles
from pipeline.semantics.sources import ModelMasks, ObjectsOnly

PERSON, RIDER, CAR, MOTORCYCLE, BICYCLE, NONE = 11, 12, 13, 17, 18, 255


def street() -> np.ndarray:
    """A cyclist (rider on 20 pixels of bicycle), a rack of 40 with 4 pixels of a person, a motorcycle beside a car."""
    semantics = np.zeros((30, 60), np.uint8)
    semantics[6:11, 5:9] = RIDER
    semantics[11:16, 5:9] = BICYCLE
    semantics[10:14, 20:30] = BICYCLE
    semantics[9, 20:24] = PERSON
    semantics[20:24, 40:46] = MOTORCYCLE
    semantics[20:24, 46:58] = CAR
    semantics[2:8, 50:53] = PERSON
    return semantics


def test_only_ridden_cycles_stay() -> None:
    semantics = street()
    found = without_parked_cycles(semantics)
    expected = semantics.copy()
    expected[10:14, 20:30] = NONE
    expected[20:24, 40:46] = NONE
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(semantics, street())  # the given map stays as it is
    # Corner to corner is touching, a pixel between is not.
    for distance, kept in ((0, True), (1, False)):
        pair = np.zeros((8, 8), np.uint8)
        pair[:3, :3], pair[3 + distance : 6 + distance, 3:6] = RIDER, BICYCLE
        assert (without_parked_cycles(pair) == BICYCLE).any() == kept
    road = np.zeros((4, 4), np.uint8)
    assert without_parked_cycles(road) is road


def test_the_source_of_our_network_leaves_them_out() -> None:
    class Fixed:
        def segment(self, image: np.ndarray) -> np.ndarray:
            return street()

    frame = Frame("1", {"image": lambda: np.zeros((30, 60, 3), np.uint8)})
    assert not (ObjectsOnly(ModelMasks(Fixed())).semantics(frame) == MOTORCYCLE).any()
