from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from detection.frustum.network import FrustumOutput, FrustumPointNet, draw_object_points


def shaken(variant: str, channels: int = 4) -> FrustumPointNet:
    """A network whose normalisations and biases are not those of a fresh one."""
    torch.manual_seed(3)
    model = FrustumPointNet(variant, channels).eval()
    for name, value in model.state_dict().items():
        if name.endswith(("running_var", "bias", "running_mean")) or ("bn" in name and name.endswith("weight")):
            value.copy_(torch.rand(value.shape) * 0.5 + (0.7 if name.endswith(("var", "weight")) else -0.25))
        elif value.dim() > 1:
            value.copy_(torch.randn(value.shape) * (2 / value.shape[1]) ** 0.5)
    return model


def frustum(count: int = 3, points: int = 40) -> tuple[Tensor, Tensor]:
    torch.manual_seed(4)
    return torch.randn(count, points, 4), torch.eye(3)[torch.arange(count) % 3]


def layer(model: FrustumPointNet, name: str, norm: str, rows: Tensor, eps: float) -> Tensor:
    """One layer, written out."""
    state = model.state_dict()
    rows = rows @ state[f"{name}.weight"].flatten(1).t() + state[f"{name}.bias"]
    if not norm:
        return rows
    mean, variance = state[f"{norm}.running_mean"], state[f"{norm}.running_var"]
    return F.relu((rows - mean) / (variance + eps).sqrt() * state[f"{norm}.weight"] + state[f"{norm}.bias"])


def obvious_pointnet(model: FrustumPointNet, part: str, rows: Tensor, one_hot: Tensor, eps: float) -> Tensor:
    for k in range(1, 5 if part == "est" else 4):
        rows = layer(model, f"{part}.conv{k}", f"{part}.bn{k}", rows, eps)
    rows = torch.cat([rows.max(dim=1).values, one_hot], dim=1)
    for k in (1, 2):
        rows = layer(model, f"{part}.fc{k}", f"{part}.fcbn{k}", rows, eps)
    return layer(model, f"{part}.fc3", "", rows, eps)


def obvious(model: FrustumPointNet, points: Tensor, one_hot: Tensor, chosen: Tensor) -> FrustumOutput:
    """The network as its table reads, every product taken for every point."""
    eps, skip = (1e-3, 3) if model.variant == "tf" else (1e-5, 2)
    rows, kept = points, {}
    for k in range(1, 6):
        rows = kept[k] = layer(model, f"InsSeg.conv{k}", f"InsSeg.bn{k}", rows, eps)
    count = points.shape[1]
    whole = rows.max(dim=1).values[:, None].expand(-1, count, -1)
    rows = torch.cat([kept[skip], whole, one_hot[:, None].expand(-1, count, -1)], dim=2)
    assert rows.shape[-1] == 1091
    for k in range(1, 5):
        rows = layer(model, f"InsSeg.dconv{k}", f"InsSeg.dbn{k}", rows, eps)
    logits = layer(model, "InsSeg.dconv5", "", rows, eps)
    mask = logits[..., 1] > logits[..., 0]
    means, objects = [], []
    for own, xyz, index in zip(mask, points[..., :3], chosen):
        mean = xyz[own].mean(dim=0) if own.any() else torch.zeros(3)
        picked = (xyz - mean)[index]
        means.append(mean)
        objects.append(picked if own.any() or model.variant == "tf" else torch.zeros_like(picked))
    delta = obvious_pointnet(model, "STN", torch.stack(objects), one_hot, eps)
    box = obvious_pointnet(model, "est", torch.stack(objects) - delta[:, None], one_hot, eps)
    return FrustumOutput(logits, mask, torch.stack(means), torch.stack(means) + delta, box)


def test_parameters_are_the_published_ones() -> None:
    model = FrustumPointNet()
    assert sum(p.numel() for p in model.parameters()) == 1_641_472
    parts = {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    assert parts == {"InsSeg": 893_890, "STN": 151_683, "est": 595_899}
    assert len(model.state_dict()) == 146


@pytest.mark.parametrize("variant", ["tf", "port"])
@pytest.mark.parametrize("empty", [False, True])
def test_network_equals_its_table(variant: str, empty: bool) -> None:
    model, (points, one_hot) = shaken(variant), frustum()
    if empty:
        model.state_dict()["InsSeg.dconv5.bias"].copy_(torch.tensor([1e3, 0.0]))
    with torch.no_grad():
        mask = model.InsSeg(points, one_hot).diff(dim=-1)[..., 0] > 0
        assert bool(mask.any()) != empty
        chosen = torch.from_numpy(draw_object_points(mask.numpy(), np.random.default_rng(5)))
        ours, twin = model(points, one_hot, chosen=chosen), obvious(model, points, one_hot, chosen)
    for name in ("logits", "mean", "first_centre", "box"):
        mine, theirs = getattr(ours, name), getattr(twin, name)
        assert float((mine - theirs).abs().max()) < 1e-4 * max(float(theirs.std()), 1e-3), name


def test_variants_differ() -> None:
    points, one_hot = frustum()
    port, original = FrustumPointNet("port").eval(), shaken("tf")
    port.load_state_dict(original.state_dict())
    with torch.no_grad():
        assert float((port.InsSeg(points, one_hot) - original.InsSeg(points, one_hot)).abs().max()) > 0.01


def test_order_and_repetition_of_points_change_nothing() -> None:
    model, (points, one_hot) = shaken("tf"), frustum()
    order = torch.randperm(points.shape[1])
    with torch.no_grad():
        straight = model.InsSeg(points, one_hot)
        torch.testing.assert_close(model.InsSeg(points[:, order], one_hot), straight[:, order], atol=1e-4, rtol=1e-4)
        twice = model.InsSeg(points.repeat(1, 2, 1), one_hot)
        torch.testing.assert_close(twice, straight.repeat(1, 2, 1), atol=1e-4, rtol=1e-4)
        turned = model.InsSeg(points, one_hot.roll(1, dims=1))
    assert float((turned - straight).abs().max()) > 1e-3


def test_object_points_are_drawn_as_published() -> None:
    mask = np.zeros((3, 900), bool)
    mask[0, :700] = True
    mask[1, 20:30] = True
    drawn = draw_object_points(mask, np.random.default_rng(0))
    assert drawn.shape == (3, 512)
    assert len(np.unique(drawn[0])) == 512
    assert drawn[0].max() < 700
    assert (np.diff(drawn[0]) < 0).any()
    assert set(drawn[1]) == set(range(20, 30))
    assert not drawn[2].any()


def test_numbers_of_the_box_lie_where_the_files_have_them() -> None:
    zero = torch.zeros(1, 3)
    output = FrustumOutput(torch.zeros(1, 1, 2), torch.zeros(1, 1) > 0, zero, zero + 1, torch.arange(59.0)[None])
    assert output.centre[0].tolist() == [1, 2, 3]
    assert output.heading_scores[0].tolist() == list(range(3, 15))
    assert output.heading_units[0].tolist() == list(range(15, 27))
    assert float(output.heading_residuals[0, 1]) == pytest.approx(16 * np.pi / 12)
    assert output.size_scores[0].tolist() == list(range(27, 35))
    assert output.size_units[0, 1].tolist() == [38, 39, 40]
    assert float(output.size_residuals[0, 1, 2]) == pytest.approx(40 * 2.20532825)


@pytest.mark.parametrize("options", [{"variant": "caffe"}, {"channels": 5}])
def test_unknown_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"expected .*(tf, port|3 \(x y z\))"):
        FrustumPointNet(**options)  # type: ignore[arg-type]
