"""The published networks: their weights by name and number, and their arithmetic against the long-hand twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from auglidar_base.errors import SettingsError
from detection.losses import dice_loss
from detection.models.batch import PointBatch
from detection.models.openpcdet_pointrcnn import OpenPCDetPointRCNN
from detection.models.pointrcnn import PointRCNN, canonical
from detection.models.presets import PRESETS, pointrcnn, pointrcnn2, thesis
from detection.models.warm_start import copy_matching
from detection.targets import point_labels
from tests.reference import pointrcnn_twin as twin

BACKBONE = [
    [(3, 16, 16, 32), (3, 32, 32, 64)],
    [(99, 64, 64, 128), (99, 64, 96, 128)],
    [(259, 128, 196, 256), (259, 128, 196, 256)],
    [(515, 256, 256, 512), (515, 256, 384, 512)],
]
PROPAGATION = [(256, 128, 128), (608, 256, 256), (768, 512, 512), (1536, 512, 512)]
REFINEMENT = [(131, 128, 128, 128), (131, 128, 128, 256), (259, 256, 256, 512)]


def expected_names(codes: int, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the official state dict without its counters (spec tables of the public checkpoints)."""
    found: dict[str, tuple[int, ...]] = {}

    def layer(name: str, i: int, o: int, ones: int, norm: bool) -> None:
        found[f"{name}.conv.weight"] = (o, i, *(1,) * ones)
        if not norm:
            found[f"{name}.conv.bias"] = (o,)
            return
        for part in ("weight", "bias", "running_mean", "running_var"):
            found[f"{name}.bn.bn.{part}"] = (o,)

    for s, branches in enumerate(BACKBONE):
        for b, widths in enumerate(branches):
            for k in range(3):
                layer(f"rpn.backbone_net.SA_modules.{s}.mlps.{b}.layer{k}", widths[k], widths[k + 1], 2, True)
    for s, widths in enumerate(PROPAGATION):
        for k in range(2):
            layer(f"rpn.backbone_net.FP_modules.{s}.mlp.layer{k}", widths[k], widths[k + 1], 2, True)
    for name, out in (("rpn_cls_layer", 1), ("rpn_reg_layer", codes)):
        layer(f"rpn.{name}.0", 128, 128, 1, True)
        layer(f"rpn.{name}.2", 128, out, 1, False)
    for s, widths in enumerate(REFINEMENT):
        for k in range(3):
            layer(f"rcnn_net.SA_modules.{s}.mlps.0.layer{k}", widths[k], widths[k + 1], 2, False)
    for name, i in (("xyz_up_layer.layer0", 5), ("xyz_up_layer.layer1", 128), ("merge_down_layer.layer0", 256)):
        layer(f"rcnn_net.{name}", i, 128, 2, False)
    for name, out in (("cls_layer", 1), ("reg_layer", 46)):
        for index, (i, o) in zip((0, 2, 3), ((512, width), (width, width), (width, out))):
            layer(f"rcnn_net.{name}.{index}", i, o, 1, False)
    return found


def parameters(model: nn.Module) -> int:
    return sum(parameter.numel() for parameter in model.parameters())


@pytest.mark.parametrize(
    ("preset", "count", "codes", "width"),
    [(pointrcnn(), 3_884_356, 52, 256), (pointrcnn2(), 4_555_868, 76, 512), (thesis(), 4_555_868, 76, 512)],
)
def test_published_networks_have_the_public_names_shapes_and_numbers(preset, count, codes, width) -> None:
    model = preset.build()
    assert parameters(model) == count
    state = model.state_dict()
    assert len(state) == 244
    counters = [name for name in state if name.endswith("num_batches_tracked")]
    assert len(counters) == 34
    assert {n: tuple(v.shape) for n, v in state.items() if n not in counters} == expected_names(codes, width)


def test_openpcdet_network_has_the_public_names_and_numbers() -> None:
    state = OpenPCDetPointRCNN().state_dict()
    assert parameters(OpenPCDetPointRCNN()) == 4_038_819
    assert len(state) == 309
    shapes = {
        "global_step": (1,),
        "backbone_3d.SA_modules.0.mlps.0.0.weight": (16, 4, 1, 1),
        "backbone_3d.SA_modules.3.mlps.1.7.running_var": (512,),
        "backbone_3d.FP_modules.0.mlp.0.weight": (128, 257, 1, 1),
        "backbone_3d.FP_modules.3.mlp.4.bias": (512,),
        "point_head.cls_layers.6.weight": (3, 256),
        "point_head.box_layers.3.weight": (256, 256),
        "point_head.box_layers.6.bias": (8,),
        "roi_head.SA_modules.2.mlps.0.7.weight": (512,),
        "roi_head.xyz_up_layer.2.bias": (128,),
        "roi_head.merge_down_layer.0.weight": (128, 256, 1, 1),
        "roi_head.cls_layers.5.weight": (256,),
        "roi_head.cls_layers.7.weight": (1, 256, 1),
        "roi_head.reg_layers.4.weight": (256, 256, 1),
        "roi_head.reg_layers.7.weight": (7, 256, 1),
    }
    assert {name: tuple(state[name].shape) for name in shapes} == shapes


def test_extra_channel_widens_only_the_first_abstraction_and_the_last_propagation() -> None:
    plain, extra = pointrcnn2().build().state_dict(), pointrcnn2(features=("semantic",)).build().state_dict()
    changed = {name: tuple(extra[name].shape) for name in plain if plain[name].shape != extra[name].shape}
    assert changed == {
        "rpn.backbone_net.SA_modules.0.mlps.0.layer0.conv.weight": (16, 4, 1, 1),
        "rpn.backbone_net.SA_modules.0.mlps.1.layer0.conv.weight": (32, 4, 1, 1),
        "rpn.backbone_net.FP_modules.0.mlp.layer0.conv.weight": (128, 257, 1, 1),
    }


def randomised(model: nn.Module, seed: int) -> nn.Module:
    """Weights and statistics of a trained network's order of magnitude, so that every term matters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in model.state_dict().items():
            if name.endswith("running_var"):
                value.copy_(torch.rand(value.shape, generator=generator) + 0.5)
            elif name.endswith(("running_mean", "bias")):
                value.copy_(torch.randn(value.shape, generator=generator) * 0.1)
            elif value.dim() == 1 and value.is_floating_point():
                value.copy_(torch.rand(value.shape, generator=generator) + 0.5)
            elif value.dim() > 1:
                scale = (1.5 / value.shape[1]) ** 0.5
                value.copy_(torch.randn(value.shape, generator=generator) * scale)
    return model.eval()


def scene(count: int, extra: int, seed: int) -> torch.Tensor:
    """(1, count, 3 + extra) points of two dense patches in front of the camera."""
    rng = np.random.default_rng(seed)
    centre = np.where(rng.random((count, 1)) < 0.5, [[-3.0, 1.0, 12.0]], [[4.0, 1.2, 30.0]])
    xyz = centre + rng.normal(0, [1.6, 0.5, 1.6], (count, 3))
    return torch.tensor(np.concatenate([xyz, rng.random((count, extra))], axis=1), dtype=torch.float32)[None]


@pytest.mark.parametrize(("preset", "soft"), [(pointrcnn(), False), (pointrcnn2(features=("intensity",)), True)])
def test_forward_agrees_with_the_twin(preset, soft) -> None:
    model = randomised(preset.build(), 3)
    assert isinstance(model, PointRCNN)
    settings = model.settings
    points = scene(900, settings.extra_channels, 5)
    with torch.no_grad():
        rpn, proposals, refined = model(points)
        state = model.state_dict()
        features = twin.backbone(state, points[0])
        logits, codes = twin.heads(state, features)
        torch.testing.assert_close(rpn.backbone_features[0], features, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(rpn.cls[0, :, 0], logits, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(rpn.reg[0], codes, rtol=1e-4, atol=1e-4)
        # From here on the twin takes our heads, so that a logit at a tie cannot send the two different ways.
        boxes = model.decode_proposals(points, rpn)[0]
        expected = twin.proposal_boxes(points[0], rpn.reg[0], settings.fine_location, soft)
        np.testing.assert_allclose(boxes.numpy(), expected, rtol=1e-4, atol=1e-4)
        for k in np.flatnonzero(proposals.valid[0].numpy())[:4]:
            logit, box = twin.refine(
                state,
                points[0],
                rpn.cls[0, :, 0],
                rpn.backbone_features[0],
                proposals.rois[0, k].double().numpy(),
                settings.mask_threshold,
                settings.pool_margin,
                soft,
            )
            assert refined.cls[0, k, 0].item() == pytest.approx(logit, rel=1e-3, abs=1e-3)
            np.testing.assert_allclose(refined.boxes[0, k].numpy(), box, rtol=1e-3, atol=1e-3)


def test_batched_frames_do_not_see_each_other() -> None:
    model = randomised(pointrcnn().build(), 1)
    assert isinstance(model, PointRCNN)
    a, b = scene(300, 0, 1), scene(300, 0, 2)
    with torch.no_grad():
        together = model.rpn(torch.cat([a, b])).cls
        alone = torch.cat([model.rpn(a).cls, model.rpn(b).cls])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)


def test_a_new_channel_started_from_old_weights_changes_nothing() -> None:
    old = randomised(pointrcnn2().build(), 2)
    new = pointrcnn2(features=("semantic",)).build().eval()
    assert len(copy_matching(old, new)) == 3
    assert isinstance(old, PointRCNN)
    assert isinstance(new, PointRCNN)
    points = scene(300, 1, 4)
    with torch.no_grad():
        torch.testing.assert_close(new.rpn(points).reg, old.rpn(points[..., :3]).reg, rtol=1e-4, atol=1e-4)


def test_warm_start_refuses_another_network() -> None:
    with pytest.raises(ValueError, match=r"cls_layer\.0\.conv\.weight is \(256, 512, 1\)"):
        copy_matching(pointrcnn(fine_location=True).build(), pointrcnn2().build())


def test_canonical_puts_the_roi_at_the_origin_with_its_length_along_x() -> None:
    # Heading pi/2: the box's front (+x of its own frame) looks to -z of the scene.
    roi = torch.tensor([[[5.0, 1.0, 20.0, 1.5, 1.6, 4.0, torch.pi / 2]]])
    front_and_left = torch.tensor([[[[5.0, 1.0, 18.0, 9.0], [5.8, 0.0, 20.0, 9.0]]]])
    local = canonical(front_and_left, roi)[0, 0]
    torch.testing.assert_close(local, torch.tensor([[2.0, 0.0, 0.0, 9.0], [0.0, -1.0, 0.8, 9.0]]), atol=1e-6, rtol=0)


def test_second_stage_sends_no_gradient_to_the_first() -> None:
    model = pointrcnn2().build().train()
    assert isinstance(model, PointRCNN)
    points = scene(400, 0, 6)
    rpn = model.rpn(points)
    model.refine(points, rpn, torch.tensor([[[-3.0, 1.8, 12.0, 1.5, 1.6, 3.9, 0.3]]])).cls.sum().backward()
    assert all(parameter.grad is None for parameter in model.rpn.parameters())
    assert model.rcnn_net.cls_layer[0].conv.weight.grad is not None


def test_openpcdet_forward_is_shaped_and_repeatable() -> None:
    model = randomised(OpenPCDetPointRCNN(), 4)
    points = scene(400, 1, 8)[..., [2, 0, 1, 3]]
    with torch.no_grad():
        heads, proposals, refined = model(points)
        again = model(points)[2]
    assert heads.backbone_features.shape == (1, 128, 400)
    assert heads.cls.shape == (1, 400, 3)
    assert heads.box.shape == (1, 400, 8)
    assert proposals.rois.shape == refined.boxes.shape == (1, 100, 7)
    assert torch.equal(refined.boxes, again.boxes)


def test_openpcdet_forward_agrees_with_the_twin() -> None:
    model = randomised(OpenPCDetPointRCNN(), 4)
    assert isinstance(model, OpenPCDetPointRCNN)
    points = scene(700, 1, 8)[..., [2, 0, 1, 3]]
    state = model.state_dict()
    named = state | twin.official_names(state, bare="xyz_up_layer|merge_down_layer")
    with torch.no_grad():
        heads, proposals, refined = model(points)
        features = twin.backbone(named, points[0])
        torch.testing.assert_close(heads.backbone_features[0], features, rtol=1e-4, atol=1e-4)
        hidden = features
        for conv, norm in ((0, 1), (3, 4)):
            hidden = twin.dense(state, "point_head.cls_layers", conv, norm, hidden)
        logits = state["point_head.cls_layers.6.weight"] @ hidden + state["point_head.cls_layers.6.bias"][:, None]
        torch.testing.assert_close(heads.cls[0].T, logits, rtol=1e-4, atol=1e-4)
        boxes = model.decode_proposals(points, heads)[0]
        code, mean = heads.box[0, 5].double(), [(3.9, 1.6, 1.56), (0.8, 0.6, 1.73), (1.76, 0.6, 1.73)]
        l, w, h = mean[int(heads.cls[0, 5].argmax())]
        dx, dy, dz, *logs, cos, sin = code.tolist()
        centre = points[0, 5, :3].double().numpy() + np.array([dx * np.hypot(l, w), dy * np.hypot(l, w), dz * h])
        expected = [*centre, *(np.exp(logs) * [l, w, h]), np.arctan2(sin, cos)]
        np.testing.assert_allclose(boxes[5].numpy(), expected, rtol=1e-4)
        score, depth = heads.cls[0].max(dim=1).values.sigmoid(), points[0, :, :3].norm(dim=1) / 70 - 0.5
        extra = torch.cat([score[:, None], depth[:, None], heads.backbone_features[0].T], dim=1)
        for k in range(4):
            logit, box = twin.openpcdet_refine(named, points[0], extra, proposals.rois[0, k].double().numpy())
            assert refined.cls[0, k, 0].item() == pytest.approx(logit, rel=1e-3, abs=1e-3)
            np.testing.assert_allclose(refined.boxes[0, k].numpy(), box, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_can_be_rebuilt_from_their_options(name) -> None:
    preset = PRESETS[name]()
    again = PRESETS[name](**preset.options)
    assert again.inputs == preset.inputs
    assert again.outputs == preset.outputs
    assert again.options == preset.options
    assert parameters(again.build()) == parameters(preset.build())


def test_the_thesis_trains_on_512_proposals_and_tests_on_64() -> None:
    settings = thesis().build().settings
    assert (settings.proposals_train.after, settings.proposals_test.after, settings.rois.rois) == (512, 64, 64)
    assert settings.proposals_train.before == settings.proposals_test.before == 8000


def test_the_losses_of_the_options_are_those_that_train() -> None:
    plain = pointrcnn2().build().eval()
    chosen = pointrcnn2(segmentation_loss="dice", raw_iou=True)
    model = PRESETS[chosen.name](**chosen.options).build().eval()
    assert model.rpn.rpn_cls_layer[2].conv.bias.item() == 0  # no rare foreground to begin with, unlike the focal loss
    model.load_state_dict(plain.state_dict())
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1, 600, 3, generator=generator) * torch.tensor([8.0, 2.0, 8.0]) + torch.tensor([-4.0, 0, 6])
    car = torch.tensor([[0.0, 2.0, 10.0, 1.6, 1.7, 4.0, 0.3]])
    batch = PointBatch(points, [points[0]], [car], [torch.ones(1, dtype=torch.long)])
    losses = [network.training_losses(batch, np.random.default_rng(0)) for network in (plain, model)]
    labels = point_labels(points[0], car, batch.classes[0])[0][None]
    assert losses[1]["rpn_cls"].item() == pytest.approx(dice_loss(plain.rpn(points).cls, labels).item(), rel=1e-5)
    assert losses[1]["rpn_cls"].item() != pytest.approx(losses[0]["rpn_cls"].item(), rel=0.01)
    assert losses[1]["rpn_consistency"].item() != pytest.approx(losses[0]["rpn_consistency"].item(), rel=0.01)
    assert losses[1]["rpn_reg"].item() == pytest.approx(losses[0]["rpn_reg"].item(), rel=1e-5)


def test_an_unknown_segmentation_loss_is_refused_by_name() -> None:
    with pytest.raises(SettingsError, match="segmentation_loss: expected one of focal, dice, bce, got 'lovasz'"):
        pointrcnn(segmentation_loss="lovasz")
