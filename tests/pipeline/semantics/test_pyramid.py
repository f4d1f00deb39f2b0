"""The segmentation network on EfficientNet-Lite0: padding, import, folding, files, thresholds."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pipeline.base.errors import DataError, UsageError
from pipeline.cli import main
from pipeline.semantics.checkpoints import load_segmenter, read_segmenter, save_segmenter
from pipeline.semantics.conventions import GROUPS
from pipeline.semantics.efficientnet_lite import EfficientNetLite, SamePadConv, backbone_state
from pipeline.semantics.inference import NetworkSegmenter, _thresholded
from pipeline.semantics.pyramid import PyramidSegmenter
from pipeline.semantics.sources import DEFAULT_WEIGHTS, network_choice, open_semantics
from pipeline.semantics.training import SegmentationSettings, train_segmenter

# Kernel, input and output channels of the sixteen blocks of EfficientNet-B0 (Table 1 of the paper), written out.
BLOCKS = [(3, 32, 16), (3, 16, 24), (3, 24, 24), (5, 24, 40), (5, 40, 40), (3, 40, 80), (3, 80, 80), (3, 80, 80)]
BLOCKS += [(5, 80, 112), (5, 112, 112), (5, 112, 112), (5, 112, 192), *[(5, 192, 192)] * 3, (3, 192, 320)]


@dataclass(frozen=True)
class Sample:
    image: np.ndarray
    semantics: np.ndarray


def published() -> dict[str, Tensor]:
    """Random weights under the names and in the shapes of the published file."""
    torch.manual_seed(5)
    state: dict[str, Tensor] = {}

    def norm(name: str, width: int) -> None:
        for part in ("weight", "bias", "running_mean"):
            state[f"{name}.{part}"] = torch.randn(width) * 0.3
        state[f"{name}.running_var"] = torch.rand(width) + 0.5
        state[f"{name}.num_batches_tracked"] = torch.tensor(9)

    state["_conv_stem.weight"] = torch.randn(32, 3, 3, 3) * 0.2
    norm("_bn0", 32)
    for number, (kernel, narrow, out) in enumerate(BLOCKS):
        block, wide = f"_blocks.{number}", narrow if number == 0 else 6 * narrow
        if number:
            state[f"{block}._expand_conv.weight"] = torch.randn(wide, narrow, 1, 1) * 0.1
            norm(f"{block}._bn0", wide)
        state[f"{block}._depthwise_conv.weight"] = torch.randn(wide, 1, kernel, kernel) * 0.2
        norm(f"{block}._bn1", wide)
        state[f"{block}._project_conv.weight"] = torch.randn(out, wide, 1, 1) * 0.1
        norm(f"{block}._bn2", out)
    state["_conv_head.weight"] = torch.randn(8, 320, 1, 1)
    return state


@pytest.mark.parametrize(
    ("kernel", "row", "expected"),
    [
        (3, [1, 2, 3, 4], [1 + 2 + 3, 3 + 4]),
        (3, [1, 2, 3, 4, 5], [1 + 2, 2 + 3 + 4, 4 + 5]),
        (5, [1, 2, 3, 4], [1 + 2 + 3 + 4, 2 + 3 + 4]),
    ],
)
def test_strided_padding_is_that_of_tensorflow(kernel: int, row: list[int], expected: list[int]) -> None:
    """Four values and kernel 3: one value of padding, behind the last; kernel 5: one before, two behind."""
    convolution = SamePadConv(1, 1, kernel, 2, bias=False)
    nn.init.zeros_(convolution.weight)
    convolution.weight.data[0, 0, kernel // 2] = 1
    rows = torch.tensor(row, dtype=torch.float32).repeat(7, 1)[None, None]
    # Kernel 3 reads the rows 2n + 1, kernel 5 also those: any row is the same here.
    assert convolution(rows)[0, 0, 1].tolist() == expected


def test_features_have_the_strides_4_to_32_at_any_size() -> None:
    backbone = EfficientNetLite().eval()
    for height, width in ((64, 96), (37, 70)):
        shapes = [tuple(level.shape[1:]) for level in backbone(torch.zeros(1, 3, height, width))]
        assert shapes == [
            (channels, -(-height // stride), -(-width // stride))
            for channels, stride in zip((24, 40, 112, 192), (4, 8, 16, 32))
        ]


def test_published_weights_land_where_they_belong() -> None:
    source = published()
    state = backbone_state(source)
    assert state["stem.0.weight"].equal(source["_conv_stem.weight"])
    assert state["stages.0.0.spatial.0.weight"].equal(source["_blocks.0._depthwise_conv.weight"])
    assert state["stages.2.1.widen.1.running_var"].equal(source["_blocks.4._bn0.running_var"])
    assert state["stages.5.3.narrow.1.bias"].equal(source["_blocks.14._bn2.bias"])
    used = [name for name in source if not name.startswith(("_blocks.15.", "_conv_head"))]
    assert len(state) == len(used)
    with pytest.raises(ValueError, match=r"_blocks\.7\._bn2\.weight .* got nothing"):
        backbone_state({name: value for name, value in source.items() if name != "_blocks.7._bn2.weight"})


def test_the_published_file_becomes_a_network_to_train_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save(published(), tmp_path / "lite0.pth")
    out = tmp_path / "start.safetensors"
    options = ["--stage", "import", "--architecture", "efficientnet_lite0", "--out", str(out)]
    assert main([*options, str(tmp_path / "lite0.pth")]) == 0
    model, card = read_segmenter(out)
    assert isinstance(model, PyramidSegmenter)
    expected = backbone_state(published())["stages.3.2.narrow.0.weight"]
    assert model.backbone.state_dict()["stages.3.2.narrow.0.weight"].equal(expected.half().float())
    assert "Apache-2.0" in card["origin"]
    torch.save({"weight": torch.zeros(1)}, tmp_path / "other.pth")
    assert main([*options, str(tmp_path / "other.pth")]) == 2
    assert "_conv_stem.weight" in capsys.readouterr().err


def test_training_leaves_the_statistics_and_first_stages_of_the_backbone(tmp_path: Path) -> None:
    model = PyramidSegmenter().train()
    groups = model.parameter_groups(0.3)
    assert [group["lr"] for group in groups] == [0.3, pytest.approx(0.01)]
    before = {name: value.clone() for name, value in model.state_dict().items()}
    optimiser = torch.optim.SGD(groups)
    model(torch.rand(2, 3, 32, 32)).square().mean().backward()
    optimiser.step()
    changed = {name for name, value in model.state_dict().items() if not value.equal(before[name])}
    assert "refine.0.mix_norm.running_mean" in changed
    assert "backbone.stages.2.0.widen.0.weight" in changed
    assert not any(name.startswith(("backbone.stem", "backbone.stages.0", "backbone.stages.1")) for name in changed)
    assert not any("running" in name for name in changed if name.startswith("backbone."))


def test_folded_norms_change_nothing(tmp_path: Path) -> None:
    model = PyramidSegmenter()
    model.backbone.load_state_dict(backbone_state(published()))
    image = np.random.default_rng(0).integers(0, 255, (40, 70, 3)).astype(np.uint8)
    from pipeline.semantics.pictures import image_tensor

    with torch.inference_mode():
        expected = model.eval()(image_tensor(image, model.normalisation)).softmax(dim=1)[0, 13]
    score = NetworkSegmenter(model).scores(image, [(13,)])[0]
    assert not any(isinstance(module, nn.BatchNorm2d) for module in model.backbone.modules())
    # A quarter of the size: enlarged scores lie between their neighbours.
    assert expected.min() - 1e-4 <= score.min()
    assert score.max() <= expected.max() + 1e-4
    assert score.mean() == pytest.approx(float(expected.mean()), abs=0.02)


def test_files_hold_halves_and_stay_below_five_megabytes(tmp_path: Path) -> None:
    model = PyramidSegmenter()
    weights = save_segmenter(model, tmp_path / "lite", {})
    assert weights.stat().st_size < 5e6
    loaded, _ = read_segmenter(weights)
    ours = {
        name: value.half().float() if value.is_floating_point() else value for name, value in model.state_dict().items()
    }
    assert all(value.equal(ours[name]) for name, value in loaded.state_dict().items())


def test_cards_of_unknown_networks_are_refused(tmp_path: Path) -> None:
    weights = save_segmenter(PyramidSegmenter(), tmp_path / "lite", {})
    card = json.loads(weights.with_suffix(".json").read_text())
    weights.with_suffix(".json").write_text(json.dumps(card | {"architecture": "UNet"}))
    with pytest.raises(DataError, match="'UNet' on its card"):
        load_segmenter(weights)


def test_a_group_counts_from_its_threshold_on() -> None:
    """0: car .5 + truck .2 against road .3; 1: person .35, road .65; 2: car .4, bicycle .35, sky .25."""
    probability = torch.full((19, 1, 3), 1e-9)
    probability[[13, 14, 0], 0, 0] = torch.tensor([0.5, 0.2, 0.3])
    probability[[11, 0], 0, 1] = torch.tensor([0.35, 0.65])
    probability[[13, 18, 10], 0, 2] = torch.tensor([0.4, 0.35, 0.25])
    logits = probability.log()

    def labels(**thresholds: float) -> list[list[int]]:
        return _thresholded(logits, thresholds).tolist()

    assert labels(vehicles=0.69, people=0.3) == [[13, 11, 18]]
    assert labels(vehicles=0.71) == [[0, 0, 18]]
    assert labels(vehicles=0.41, people=0.36) == [[13, 0, 10]]


def test_labels_follow_the_scores(tmp_path: Path) -> None:
    torch.manual_seed(1)
    model, image = PyramidSegmenter(), np.random.default_rng(4).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    score = NetworkSegmenter(model).score(image, GROUPS["vehicles"])
    middle = float(np.median(score))
    found = np.isin(NetworkSegmenter(model, {"vehicles": middle}).segment(image), GROUPS["vehicles"])
    # Labels are of half size: only scores close to the threshold may fall to the other side.
    clear = np.abs(score - middle) > 0.1 * np.ptp(score)
    assert clear.any()
    np.testing.assert_array_equal(found[clear], score[clear] > middle)


def test_thresholds_follow_the_name_of_a_source(tmp_path: Path) -> None:
    assert network_choice("") == (DEFAULT_WEIGHTS, {})
    assert network_choice("C:/a.safetensors:people=0.2") == ("C:/a.safetensors", {"people": 0.2})
    assert network_choice("vehicles=0.7:people=0.25") == (DEFAULT_WEIGHTS, {"vehicles": 0.7, "people": 0.25})
    weights = save_segmenter(PyramidSegmenter(), tmp_path / "lite", {})
    card = json.loads(weights.with_suffix(".json").read_text())
    weights.with_suffix(".json").write_text(json.dumps(card | {"thresholds": {"vehicles": 0.6, "people": 0.4}}))
    assert open_semantics(f"network:{weights}:people=0.1").masks.model.thresholds == {"vehicles": 0.6, "people": 0.1}
    with pytest.raises(UsageError, match="vehicles=high"):
        open_semantics(f"network:{weights}:vehicles=high")
    with pytest.raises(UsageError, match=r"vehicles 1\.5"):
        open_semantics(f"network:{weights}:vehicles=1.5")
    with pytest.raises(UsageError, match="soft masks have one threshold"):
        open_semantics(f"soft:{weights}:vehicles=0.5")


def test_training_begins_with_the_network_it_is_given(tmp_path: Path) -> None:
    """A picture of road and car, from weights that know nothing; its even scores are p / weight."""
    start = save_segmenter(PyramidSegmenter(), tmp_path / "start", {})
    image = np.full((64, 64, 3), 90, np.uint8)
    semantics = np.zeros((64, 64), np.uint8)
    image[40:, :16], semantics[40:, :16] = 200, 13
    settings = SegmentationSettings(
        steps=3,
        batch_size=1,
        crop=(64, 64),
        zoom=1.0,
        warm_start=str(start),
        learning_rate=0.03,
        thresholds={"vehicles": 0.3},
    )
    models = {}
    for even in (False, True):
        samples = [Sample(image, semantics)]
        out = tmp_path / str(even)
        weights = train_segmenter(replace(settings, even_scores=even), samples, out)
        models[even], card = read_segmenter(weights)
        assert card["architecture"] == "PyramidSegmenter"
        assert load_segmenter(weights).thresholds == {"vehicles": 0.3}
    first, _ = read_segmenter(start)
    assert models[False].backbone.stem[0].weight.equal(first.backbone.stem[0].weight)
    assert not models[False].classify.weight.equal(first.classify.weight)
    shift = models[False].state_dict()["classify.bias"] - models[True].state_dict()["classify.bias"]
    # Road covers 3712 pixels, the car 384: the car's weight is the root of that ratio times the road's.
    assert float((shift[13] - shift[0]).exp()) == pytest.approx((3712 / 384) ** 0.5, rel=0.01)
    assert float(shift[10]) == 0
