"""Int8 networks: near the float ones on frames like those they were calibrated on, refused without frames."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch

from completion.infer import NetworkCompleter, load_completer
from completion.models import build_model, default_spec
from completion.quantise import quantised_completer, quantised_convolutions
from tests.completion.scenes import street

needs_onnx = pytest.mark.skipif(not (find_spec("onnx") and find_spec("onnxruntime")), reason="needs the extra onnx")


@needs_onnx
@pytest.mark.filterwarnings("ignore")
def test_int8_stays_near_fp32() -> None:
    frames = [street(seed, 96, 160) for seed in range(3)]
    exact, small = load_completer("selection_small"), quantised_completer("selection_small", frames[:2])
    given = frames[2]
    expected, found = (one.complete(given.sparse, given.image).depth for one in (exact, small))
    apart = np.abs(found - expected) / expected
    assert np.median(apart) < 0.02
    assert np.abs(found - expected).max() > 0


@needs_onnx
@pytest.mark.filterwarnings("ignore")
def test_a_twin_surface_network_of_any_size() -> None:
    torch.manual_seed(0)
    spec = default_spec("twise", channels=4)
    model = build_model(spec)
    convolutions = quantised_convolutions(model, spec, [street(1, 48, 64)])
    found = NetworkCompleter(model, spec, convolutions=convolutions).complete(*_given(street(2, 50, 70)))
    expected = NetworkCompleter(model, spec).complete(*_given(street(2, 50, 70)))
    assert found.size == (50, 70)
    assert np.abs(found.depth - expected.depth).mean() < 0.05 * np.abs(expected.depth).mean() + 0.1


def _given(frame):  # type: ignore[no-untyped-def]
    return frame.sparse, frame.image


@needs_onnx
def test_ranges_need_frames_and_the_network_an_export() -> None:
    spec = default_spec("twise", channels=4)
    with pytest.raises(ValueError, match="expected sample frames"):
        quantised_convolutions(build_model(spec), spec, [])
    other = default_spec("depth_coefficients", count=8, size=10.0)
    with pytest.raises(ValueError, match="int8: expected one of"):
        quantised_convolutions(build_model(other), other, [street(1, 48, 64)])
