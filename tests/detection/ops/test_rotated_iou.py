"""Rotated IoU against Shapely (1e-12), on random, touching, contained, identical, flat and far boxes."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.ops import iou_3d, iou_3d_aligned, iou_bev
from detection.ops._rotated_iou_torch import iou_3d_aligned_torch, iou_3d_torch, iou_bev_torch
from tests.reference import ops_boxes as twin

EXACT = 1e-12


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    centre = rng.uniform([-4, 0.5, 40], [4, 2, 48], (count, 3))
    size = rng.uniform([0.5, 0.4, 0.4], [2, 2.5, 6], (count, 3))
    return np.column_stack([centre, size, rng.uniform(-2 * np.pi, 2 * np.pi, count)])


CAR = np.array([3.0, 1.6, 55.0, 1.5, 1.6, 4.0, 0.3])


def moved(along: float = 0.0, across: float = 0.0, **changes: float) -> np.ndarray:
    """CAR shifted in its own frame, with columns replaced."""
    box, cos, sin = CAR.copy(), math.cos(CAR[6]), math.sin(CAR[6])
    box[0] += along * cos + across * sin
    box[2] += -along * sin + across * cos
    for name, value in changes.items():
        box["xyzhwlr".index(name)] = value
    return box


DEGENERATE = {
    "identical": (moved(), 1.0),
    "turned by pi": (moved(r=CAR[6] + math.pi), 1.0),
    "turned by -2 pi": (moved(r=CAR[6] - 2 * math.pi), 1.0),
    "crossed at right angles": (moved(r=CAR[6] + math.pi / 2), 1.6 * 1.6 / (2 * 6.4 - 1.6 * 1.6)),
    "half along": (moved(along=2.0), 1 / 3),
    "touching at the front": (moved(along=4.0), 0.0),
    "touching at the side": (moved(across=1.6), 0.0),
    "touching at a corner": (moved(along=4.0, across=1.6), 0.0),
    "contained": (moved(w=0.8, l=2.0), 0.25),
    "contained, sharing an edge": (moved(across=0.4, w=0.8), 0.5),
    "same, sliver of a nanometre": (moved(along=4.0 - 1e-9), 1e-9 / 8),
    "no width": (moved(w=0.0), 0.0),
    "no length": (moved(l=0.0), 0.0),
    "a line and turned": (moved(w=0.0, r=1.0), 0.0),
    "negative size, as in DontCare": (moved(h=-1.0, w=-1.0, l=-1.0), 0.0),
    "far away": (moved(along=1000.0), 0.0),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_pairs_by_hand(case: str) -> None:
    other, expected = DEGENERATE[case]
    for a, b in ((CAR, other), (other, CAR)):
        assert iou_bev(a[None], b[None])[0, 0] == pytest.approx(expected, abs=EXACT)
        assert iou_3d(a[None], b[None])[0, 0] == pytest.approx(expected, abs=EXACT)
        assert abs(iou_bev(a[None], b[None])[0, 0] - twin.iou_bev(a, b)) <= EXACT


def test_identical_boxes_overlap_by_exactly_one(rng: np.random.Generator) -> None:
    boxes = random_boxes(rng, 200)
    assert np.array_equal(np.diag(iou_bev(boxes, boxes)), np.ones(200))


def test_random_pairs_agree_with_shapely(rng: np.random.Generator) -> None:
    a, b = random_boxes(rng, 70), random_boxes(rng, 60)
    assert np.abs(iou_bev(a, b) - twin.matrix(twin.iou_bev, a, b)).max() <= EXACT
    assert np.abs(iou_3d(a, b) - twin.matrix(twin.iou_3d, a, b)).max() <= EXACT
    assert (iou_bev(a, b) > 0).mean() > 0.1, "the sample should hold overlapping pairs"


number = st.floats(-3, 3)
size = st.one_of(st.sampled_from([0.5, 1.0, 2.0, 4.0]), st.floats(0.0625, 6))
turn = st.one_of(st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 4]), st.floats(-7, 7))
a_box = st.tuples(st.one_of(st.sampled_from([-1.0, 0.0, 0.5]), number), number, number, size, size, size, turn)


@given(a_box, a_box)
@settings(max_examples=150, deadline=None)
def test_any_pair_agrees_with_shapely_and_is_symmetric(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    a, b = np.array([first]), np.array([second])
    assert abs(iou_bev(a, b)[0, 0] - twin.iou_bev(a[0], b[0])) <= EXACT
    assert abs(iou_3d(a, b)[0, 0] - twin.iou_3d(a[0], b[0])) <= EXACT
    assert abs(iou_bev(a, b)[0, 0] - iou_bev(b, a)[0, 0]) <= EXACT


def test_height_is_measured_upwards_from_the_bottom() -> None:
    # y points down: a box at y = 1 of height 2 spans -1 ... 1; one at y = 2 of height 1.5 spans 0.5 ... 2.
    low = np.array([[0, 2.0, 10, 1.5, 1, 1, 0]])
    high = np.array([[0, 1.0, 10, 2.0, 1, 1, 0]])
    assert iou_3d(low, high)[0, 0] == pytest.approx(0.5 / 3.0, abs=1e-15)


def test_torch_arithmetic_agrees_with_numba(rng: np.random.Generator) -> None:
    extremes = np.stack([box for box, _ in DEGENERATE.values()])
    a = np.concatenate([random_boxes(rng, 40), extremes])
    b = np.concatenate([extremes, random_boxes(rng, 40)])
    tensors = torch.from_numpy(a), torch.from_numpy(b)
    assert np.abs(iou_bev_torch(*tensors).numpy() - iou_bev(a, b)).max() <= 1e-14
    assert np.abs(iou_3d_torch(*tensors).numpy() - iou_3d(a, b)).max() <= 1e-14
    assert np.abs(iou_3d_aligned_torch(*tensors).numpy() - iou_3d_aligned(a, b)).max() <= 1e-14
    assert np.array_equal(iou_3d_aligned(a, b), np.diag(iou_3d(a, b)))


def test_tensors_keep_their_dtype_and_numpy_gives_float64(rng: np.random.Generator) -> None:
    boxes = random_boxes(rng, 5)
    single = torch.from_numpy(boxes).float()
    assert iou_bev(single, single).dtype == torch.float32
    assert torch.allclose(iou_3d(single, single).diagonal(), torch.ones(5))
    assert iou_bev(boxes.astype(np.float32), boxes).dtype == np.float64


def test_no_boxes_give_an_empty_matrix() -> None:
    assert iou_bev(np.zeros((0, 7)), CAR[None]).shape == (0, 1)
    assert iou_3d(CAR[None], np.zeros((0, 7))).shape == (1, 0)
    assert iou_bev(torch.zeros(0, 7), torch.zeros(3, 7)).shape == (0, 3)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"boxes_b: expected \(N, 7\).*got shape \(2, 6\)"):
        iou_bev(CAR[None], np.zeros((2, 6)))
    with pytest.raises(ValueError, match="boxes_a: 1 boxes hold NaN"):
        iou_3d(np.full((1, 7), np.nan), CAR[None])
    with pytest.raises(ValueError, match="as many boxes in both, got 1 and 2"):
        iou_3d_aligned(CAR[None], np.stack([CAR, CAR]))
    with pytest.raises(ValueError, match=r"boxes_a: expected \(N, 7\)"):
        iou_bev(torch.zeros(7), torch.zeros(1, 7))


def test_numpy_path_never_imports_torch() -> None:
    program = (
        "import sys, numpy as np; from detection.ops import iou_bev, nms_rotated, points_in_boxes\n"
        "box = np.array([[0, 0, 9, 1, 1, 1, 0.5]]); assert iou_bev(box, box) == 1\n"
        "nms_rotated(box, np.ones(1), 0.5); points_in_boxes(box[:, :3], box)\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)
