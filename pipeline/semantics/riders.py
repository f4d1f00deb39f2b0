"""Cycles without anybody on them: furniture of the street, not cyclists."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.semantics.conventions import CLASSES, NONE

_PEOPLE = [CLASSES.index(name) for name in ("person", "rider")]
_CYCLES = [CLASSES.index(name) for name in ("motorcycle", "bicycle")]
# A rider covers about as many pixels as the cycle; a few pixels called a person in a rack of bicycles are none.
SMALLEST_SHARE = 0.2


def without_parked_cycles(semantics: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) uint8 trainIds with the cycles that nobody rides or pushes as 255.

    Cycles and people that touch are one thing; its cycles stay if people cover a fifth as many pixels or more. KITTI
    has boxes of cyclists and none of parked cycles, and racks of them are what else would be kept as people.
    """
    people, cycles = np.isin(semantics, _PEOPLE), np.isin(semantics, _CYCLES)
    if not cycles.any():
        return semantics
    count, thing = cv2.connectedComponents((people | cycles).astype(np.uint8), connectivity=8)
    shown = np.bincount(thing[people], minlength=count)
    parked = shown < SMALLEST_SHARE * np.bincount(thing[cycles], minlength=count)
    found = semantics.copy()
    found[cycles & parked[thing]] = NONE
    return found
