"""How large and how long an experiment with Frustum PointNet is (Table 3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class FrustumBudget:
    """Data, training and test of every run with Frustum PointNet.

    train_frames, test_frames   frames; size (height, width) of synthetic images, None for KITTI's own
    steps, batch, points        updates, frustums of each, points of a frustum
    copies       of every labelled box, moved at random
    classes      that the network learns; AP is that of cars
    completion   budget of the networks that complete the depth ("smoke", "small", "paper"), trained on the training
                 frames, or on as many synthetic ones where the data set has no dense true depth (KITTI)
    completers   weights to use instead, by row: {"ma": PATH, "dc": PATH}; bundled names are taken too
    boxes        2D boxes of the test frames: "labels", a list as Frustum PointNets publishes (rgb_detection_val.txt),
                 or a folder of KITTI result files
    resamples    of the bootstrap over test frames
    seconds_...  of one core, for the plan alone; no result depends on them. Measured is a step of the budget paper
                 (torch 2.13, AMD EPYC); the others are estimates
    """

    train_frames: int
    test_frames: int
    size: tuple[int, int] | None
    steps: int
    batch: int
    points: int
    copies: int
    learning_rate: float
    decay_samples: int
    classes: tuple[str, ...]
    completion: str
    completers: Mapping[str, str] = field(default_factory=dict)
    boxes: str = "labels"
    resamples: int = 300
    seconds_per_step: float = 0.1
    seconds_per_frame: float = 0.5
    seconds_per_data_frame: float = 2.5


# Two steps of training complete nothing, and without points on objects there is no frustum to train on.
_AT_ONCE = {"ma": "classical", "dc": "dc_small"}

FRUSTUM: dict[str, FrustumBudget] = {
    "smoke": FrustumBudget(2, 2, (188, 620), 2, 2, 64, 1, 0.001, 800_000, ("Car",), "smoke", _AT_ONCE, resamples=10),
    "small": FrustumBudget(
        160, 80, None, 1500, 8, 256, 5, 0.001, 3000, ("Car",), "small", seconds_per_step=0.25, seconds_per_frame=1.5
    ),
    # The published training: 201 epochs of batches of 32.
    "paper": FrustumBudget(
        3712, 3769, None, 500_000, 32, 1024, 5, 0.001, 800_000, ("Car", "Pedestrian", "Cyclist"), "paper",
        resamples=1000, seconds_per_step=2.7, seconds_per_frame=30.0,
    ),
}  # fmt: skip
