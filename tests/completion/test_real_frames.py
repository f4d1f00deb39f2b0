"""Real KITTI frames: full size in, full size out, and held-out samples close to their interpolation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from completion.checkpoints import Card, save_checkpoint
from completion.infer import load_completer, network_completer
from completion.metrics import depth_metrics
from completion.models import build_model, default_spec
from completion.models.classical import linear_inverse_depth, nearest_depth
from pipeline.data import open_dataset

pytestmark = pytest.mark.real_data


def test_linear_interpolation_beats_nearest_on_held_out_samples(kitti_object: Path, rng: np.random.Generator) -> None:
    sparse = open_dataset("kitti_object", kitti_object)["000003"].sparse_depth
    held_out = (sparse > 0) & (rng.random(sparse.shape) < 0.2)
    given, target = np.where(held_out, 0, sparse), np.where(held_out, sparse, 0)
    linear = depth_metrics(linear_inverse_depth(given), target)
    nearest = depth_metrics(nearest_depth(given), target)
    assert linear["tmae_mm"] < 250
    assert linear["tmae_mm"] < nearest["tmae_mm"]


def test_a_network_completes_a_real_frame_at_full_size(kitti_object: Path) -> None:
    frame = open_dataset("kitti_object", kitti_object)["000003"]
    torch.manual_seed(0)
    spec = default_spec("selection", width=8)
    completed = network_completer(build_model(spec), spec, decoding="hard").complete(frame.sparse_depth, frame.image)
    assert completed.size == frame.image.shape[:2]
    measured = frame.sparse_depth > 0
    assert np.median(np.abs(completed.depth - frame.sparse_depth)[measured]) < 1.0  # untrained, it already interpolates


def test_nlspn_completes_a_real_frame_through_its_kernels(kitti_object: Path, tmp_path: Path) -> None:
    """Before any training its affinities are 0: measured pixels stay as they are, sizes that are odd somewhere too."""
    frame = open_dataset("kitti_object", kitti_object)["000003"]
    torch.manual_seed(0)
    spec = default_spec("nlspn", layers=18, width=4)
    path = save_checkpoint(tmp_path / "nlspn", build_model(spec), Card(spec, "depth"))
    completed = load_completer(path, backend="auto").complete(frame.sparse_depth, frame.image)
    assert completed.size == frame.image.shape[:2]
    measured = frame.sparse_depth > 0
    np.testing.assert_array_equal(completed.depth[measured], frame.sparse_depth[measured])
