"""The three scalings of colour, by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from completion.inputs import scale_rgb


@pytest.mark.parametrize(
    ("scaling", "expected"),
    [
        ("raw", (51, 102, 204)),
        ("unit", (0.2, 0.4, 0.8)),
        # ImageNet: (0.2 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (0.8 - 0.406) / 0.225
        ("standardised", (-1.244541, -0.25, 1.751111)),
    ],
)
def test_one_pixel_by_hand(scaling: str, expected: tuple[float, ...]) -> None:
    """Three unlike values: neither the channels nor the statistics may come in another order."""
    pixel = torch.tensor([51, 102, 204], dtype=torch.uint8).view(1, 3, 1, 1)
    np.testing.assert_allclose(scale_rgb(pixel, scaling).flatten(), expected, rtol=1e-5)
