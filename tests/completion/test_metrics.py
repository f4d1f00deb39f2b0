"""Metrics against hand-made numbers; every evaluation code's peculiarity has its own test."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from completion.metrics import depth_metrics, mean_metrics


def maps(*pairs: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """(prediction, target) pairs as two (1, N) maps."""
    both = np.array(pairs, np.float32).T
    return both[:1], both[1:]


def test_constant_offsets() -> None:
    target = np.full((4, 5), 20.0, np.float32)
    two = depth_metrics(target + 2, target)
    assert two["tmae_mm"] == pytest.approx(1000)
    assert two["trmse_mm"] == pytest.approx(1000)
    assert two["mae_mm"] == pytest.approx(2000)
    half = depth_metrics(target + 0.5, target)
    assert half["tmae_mm"] == pytest.approx(half["mae_mm"]) == pytest.approx(500)


def test_every_metric_by_hand() -> None:
    found = depth_metrics(*maps((11.0, 10.0), (18.0, 20.0), (7.0, 0.0)))
    assert found["valid_pixels"] == 2
    assert found["mae_mm"] == pytest.approx(1500)
    assert found["rmse_mm"] == pytest.approx(1000 * math.sqrt(2.5))
    assert found["tmae_mm"] == pytest.approx(1000)
    assert found["trmse_mm"] == pytest.approx(1000)
    assert found["rel"] == pytest.approx(0.1)
    assert found["squared_rel"] == pytest.approx(0.01)
    # 1000/11 - 1000/10 and 1000/18 - 1000/20 per kilometre
    a, b = 1000 / 10 - 1000 / 11, 1000 / 18 - 1000 / 20
    assert found["imae_per_km"] == pytest.approx((a + b) / 2)
    assert found["irmse_per_km"] == pytest.approx(math.sqrt((a * a + b * b) / 2))
    assert found["lg10"] == pytest.approx((math.log10(1.1) + math.log10(20 / 18)) / 2)
    assert found["silog"] == pytest.approx(100 * np.std([math.log(10 / 11), math.log(20 / 18)]))
    assert [found[f"delta_{x}"] for x in ("1.02", "1.05", "1.10", "1.25")] == [0, 0, 0, 100]


def test_targets_beyond_the_cap_leave_only_the_thresholded_metrics() -> None:
    found = depth_metrics(*maps((10.0, 10.0), (90.0, 100.0)))
    assert found["tmae_mm"] == 0
    assert found["mae_mm"] == pytest.approx(5000)


def test_thresholded_metrics_clamp_the_prediction() -> None:
    assert depth_metrics(*maps((300.0, 79.5)))["tmae_mm"] == pytest.approx(500)


def test_indoor_threshold() -> None:
    found = depth_metrics(*maps((2.5, 2.0), (2.0, 2.05)), threshold=0.1, cap=10.0)
    assert found["tmae_mm"] == pytest.approx(75)


def test_validity_differs_between_codes() -> None:
    prediction, target = maps((1.0, 0.05), (10.0, 10.0), (0.0, 20.0), (0.4, 5e-5))
    assert depth_metrics(prediction, target, "kitti")["valid_pixels"] == 4
    assert depth_metrics(prediction, target, "nlspn")["valid_pixels"] == 3
    assert depth_metrics(prediction, target, "twise")["valid_pixels"] == 2
    assert depth_metrics(prediction, target, "ma")["valid_pixels"] == 2


def test_msg_chn_drops_predictions_of_zero_from_the_plain_metrics() -> None:
    prediction, target = maps((0.0, 20.0), (11.0, 10.0))
    assert depth_metrics(prediction, target, "msg_chn")["mae_mm"] == pytest.approx(1000)
    assert depth_metrics(prediction, target, "kitti")["mae_mm"] == pytest.approx(10500)
    # but counts them in the inverse ones, as inverse depth 0
    expected = (1000 / 20 + (100 - 1000 / 11)) / 2
    assert depth_metrics(prediction, target, "msg_chn")["imae_per_km"] == pytest.approx(expected)


def test_twise_clamps_before_the_deltas() -> None:
    prediction, target = maps((200.0, 85.0))
    assert depth_metrics(np.append(prediction, [[5.0]], 1), np.append(target, [[5.0]], 1), "twise")["delta_1.25"] == 100
    assert depth_metrics(np.append(prediction, [[5.0]], 1), np.append(target, [[5.0]], 1), "ma")["delta_1.25"] == 50


def test_dc_clamps_before_everything() -> None:
    found = depth_metrics(*maps((200.0, 100.0), (79.0, 120.0)), "dc")
    assert found["mae_mm"] == pytest.approx(500)
    assert found["tmae_mm"] == pytest.approx(500)


def test_predictions_of_zero_are_floored_and_counted() -> None:
    prediction, target = maps((0.0, 20.0), (10.0, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ours = depth_metrics(prediction, target)
        strict = depth_metrics(prediction, target, "twise", strict_reference=True)
    assert ours["floored_pixels"] == 1
    assert ours["imae_per_km"] == pytest.approx((10_000 - 50) / 2)
    assert math.isinf(strict["imae_per_km"])
    assert math.isinf(strict["lg10"])
    assert math.isnan(strict["silog"])


def test_units_scale_with_metres(rng: np.random.Generator) -> None:
    target = rng.uniform(1, 20, (5, 6))
    prediction = target + rng.normal(0, 0.3, target.shape)
    one, double = depth_metrics(prediction, target), depth_metrics(2 * prediction, 2 * target)
    assert double["mae_mm"] == pytest.approx(2 * one["mae_mm"])
    assert double["rel"] == pytest.approx(one["rel"])
    assert double["imae_per_km"] == pytest.approx(one["imae_per_km"] / 2)
    assert double["delta_1.05"] == one["delta_1.05"]


def test_mean_is_over_images_not_pixels() -> None:
    many = depth_metrics(*maps(*[(11.0, 10.0)] * 9))
    one = depth_metrics(*maps((13.0, 10.0)))
    found = mean_metrics([many, one])
    assert found["mae_mm"] == pytest.approx(2000)
    assert found["valid_pixels"] == 10


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="rules"):
        depth_metrics(*maps((1.0, 1.0)), "ours")
    with pytest.raises(ValueError, match="one shape"):
        depth_metrics(np.zeros((2, 3)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="no valid target"):
        depth_metrics(*maps((1.0, 0.0)))


@pytest.mark.parametrize(("rules", "counted"), [("twise", 1), ("ma", 1), ("kitti", 2)])
def test_a_float32_target_of_exactly_a_decimetre(rules: str, counted: int) -> None:
    # float32(0.1) is greater than the float64 0.1, but the codes compare in float32.
    target = np.array([[0.1, 10.0]], np.float32)
    assert depth_metrics(target, target, rules)["valid_pixels"] == counted
    above = np.array([[np.nextafter(np.float32(0.1), np.float32(1)), 10.0]], np.float32)
    assert depth_metrics(above, above, rules)["valid_pixels"] == 2
