"""Our network, an ONNX model and a Hugging Face model; the last two are tiny and built here."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from completion.train import TrainProgress
from pipeline.base.errors import DataError
from pipeline.semantics.checkpoints import load_segmenter, save_segmenter
from pipeline.semantics.inference import NetworkSegmenter
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.onnx_model import OnnxSegmenter
from pipeline.semantics.training import SegmentationSettings, train_segmenter


@dataclass(frozen=True)
class Sample:
    image: np.ndarray
    semantics: np.ndarray


def picture(rng: np.random.Generator, size: tuple[int, int] = (96, 128)) -> Sample:
    """A grey road, a blue sky, and a red car somewhere on the road."""
    image, semantics = np.full((*size, 3), 90, np.uint8), np.zeros(size, np.uint8)
    image[: size[0] // 2], semantics[: size[0] // 2] = (120, 160, 230), 10
    top, left = int(rng.integers(50, 66)), int(rng.integers(5, 85))
    image[top : top + 24, left : left + 36], semantics[top : top + 24, left : left + 36] = (200, 30, 30), 13
    noise = rng.normal(0, 8, image.shape)
    return Sample(np.clip(image + noise, 0, 255).astype(np.uint8), semantics)


def test_network_is_small_and_keeps_any_size() -> None:
    model = StreetSegmenter()
    assert sum(value.numel() * 4 for value in model.state_dict().values()) < 1_500_000
    for size in ((41, 57), (40, 56), (9, 8)):
        labels = NetworkSegmenter(model).segment(np.zeros((*size, 3), np.uint8))
        assert labels.shape == size
        assert labels.dtype == np.uint8


@pytest.mark.slow
def test_training_learns_and_weights_survive_the_file(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    samples = [picture(random) for _ in range(8)]
    seen: list[TrainProgress] = []
    settings = SegmentationSettings(steps=60, batch_size=4, crop=(96, 128), zoom=1.1, jitter=0.2, gamma=0, grey=0)
    path = train_segmenter(settings, samples, tmp_path, progress=seen.append)
    assert [(told.step, told.steps, told.eta > 0) for told in seen] == [(50, 60, True), (60, 60, False)]
    segmenter = load_segmenter(path)
    fresh = picture(np.random.default_rng(99))
    assert (segmenter.segment(fresh.image) == fresh.semantics).mean() > 0.9
    score = segmenter.score(fresh.image, (13,))
    assert score.dtype == np.float32
    assert score[fresh.semantics == 13].mean() > score[fresh.semantics != 13].mean() + 0.3
    assert '"StreetSegmenter"' in path.with_suffix(".json").read_text()


def test_soft_source_gives_scores_and_network_source_labels(tmp_path: Path) -> None:
    from pipeline.data.frame import Frame
    from pipeline.semantics.sources import open_semantics

    torch.manual_seed(0)
    weights = save_segmenter(StreetSegmenter(), tmp_path / "random", {})
    image = picture(np.random.default_rng(2)).image
    frame = Frame("1", {"image": lambda: image})
    score = open_semantics(f"soft:{weights}").semantics(frame)
    assert score.dtype == np.float32
    assert score.shape == image.shape[:2]
    assert 0 <= score.min() < score.max() <= 1
    assert open_semantics(f"network:{weights}").semantics(frame).dtype == np.uint8


def test_training_is_repeatable(tmp_path: Path) -> None:
    samples = [picture(np.random.default_rng(1))]
    settings = SegmentationSettings(steps=2, batch_size=1, crop=(64, 64), seed=3)
    paths = [train_segmenter(settings, samples, tmp_path / name) for name in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()


class Failing(list[Sample]):
    """Fails when sample number `last` is read."""

    last = 0

    def __getitem__(self, index: Any) -> Any:
        self.last -= 1
        if self.last == 0:
            raise KeyboardInterrupt
        return super().__getitem__(index)


def test_stopped_and_continued_equals_uninterrupted(tmp_path: Path) -> None:
    samples = Failing([picture(np.random.default_rng(seed)) for seed in range(3)])
    settings = SegmentationSettings(steps=5, batch_size=2, crop=(64, 64), seed=3, save_every=2, log_every=2)
    whole = train_segmenter(settings, samples, tmp_path / "whole")
    samples.last = 3 + 4  # three for the class weights, one per step: in the fourth step
    with pytest.raises(KeyboardInterrupt):
        train_segmenter(settings, samples, tmp_path / "parts")
    assert json.loads((tmp_path / "parts" / "last.json").read_text())["training"]["step"] == 2
    parts = train_segmenter(settings, samples, tmp_path / "parts")
    assert parts.read_bytes() == whole.read_bytes()
    logs = [path.with_name("log.csv").read_text() for path in (parts, whole)]
    assert logs[0] == logs[1]
    assert [row.split(",")[0] for row in logs[0].splitlines()] == ["step", "2", "4", "5"]
    assert json.loads(parts.with_suffix(".json").read_text())["training"]["hours"] >= 0
    with pytest.raises(ValueError, match="other settings"):
        train_segmenter(replace(settings, seed=4), samples, tmp_path / "parts")


def test_weights_that_are_not_their_cards_are_refused(tmp_path: Path) -> None:
    weights = save_segmenter(StreetSegmenter(), tmp_path / "one", {})
    assert load_segmenter(weights).model.training is False
    changed = bytearray(weights.read_bytes())
    changed[-1] ^= 1
    weights.write_bytes(bytes(changed))
    with pytest.raises(DataError, match="as its card says"):
        load_segmenter(weights)
    weights.with_suffix(".json").unlink()
    with pytest.raises(DataError, match="card of the weights"):
        load_segmenter(weights)


def test_missing_and_foreign_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        load_segmenter("no-such-weights")
    from safetensors.torch import save_file

    foreign = tmp_path / "x.safetensors"
    save_file({"a": torch.zeros(1)}, str(foreign))
    digest = hashlib.sha256(foreign.read_bytes()).hexdigest()
    foreign.with_suffix(".json").write_text(json.dumps({"sha256": digest}))
    with pytest.raises(DataError, match="weights of StreetSegmenter"):
        load_segmenter(tmp_path / "x.safetensors")


def onnx_model(path: Path, logits: bool) -> Path:
    """Red pixels are class 13 (logits: channel 13 grows with red), others class 0; input of free size."""
    onnx = pytest.importorskip("onnx", reason="onnx is not installed (extra onnx)")
    from onnx import TensorProto, helper

    weight = np.zeros((19, 3, 1, 1), np.float32)
    weight[13, 0] = 1.0
    nodes = [helper.make_node("Conv", ["image", "weight"], ["logits"], strides=[2, 2])]
    if not logits:
        nodes.append(helper.make_node("ArgMax", ["logits"], ["labels"], axis=1, keepdims=0))
    name, kind = ("logits", TensorProto.FLOAT) if logits else ("labels", TensorProto.INT64)
    graph = helper.make_graph(
        nodes,
        "segment",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "H", "W"])],
        [helper.make_tensor_value_info(name, kind, None)],
        [helper.make_tensor("weight", TensorProto.FLOAT, weight.shape, weight.reshape(-1))],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("logits", [True, False])
def test_onnx_model(tmp_path: Path, logits: bool) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra onnx)")
    image = np.zeros((8, 12, 3), np.uint8)
    image[:, 6:, 0] = 255
    segmenter = OnnxSegmenter(onnx_model(tmp_path / "m.onnx", logits), "cityscapes_trainIds")
    labels = segmenter.segment(image)
    assert labels.shape == (8, 12)
    assert (labels[:, 6:] == 13).all()
    assert (labels[:, :6] == 0).all()
    fences = OnnxSegmenter(tmp_path / "m.onnx", "cityscapes_labelIds").segment(image)
    assert (fences[:, 6:] == 4).all()


def test_onnx_model_needs_a_convention_and_a_real_file(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra onnx)")
    with pytest.raises(DataError, match="never guessed"):
        OnnxSegmenter(onnx_model(tmp_path / "m.onnx", True), None)
    with pytest.raises(DataError, match="no such file"):
        OnnxSegmenter(tmp_path / "none.onnx", "kitti")
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(DataError, match="an ONNX model"):
        OnnxSegmenter(tmp_path / "bad.onnx", "kitti")


@pytest.fixture(scope="module")
def segformer_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SegFormer of a few thousand random weights with three classes, saved like a downloaded model."""
    transformers = pytest.importorskip("transformers", reason="transformers is not installed (extra hf)")
    folder = tmp_path_factory.mktemp("segformer")
    config = transformers.SegformerConfig(
        num_encoder_blocks=2,
        depths=[1, 1],
        sr_ratios=[4, 2],
        hidden_sizes=[8, 16],
        patch_sizes=[7, 3],
        strides=[4, 2],
        num_attention_heads=[1, 1],
        mlp_ratios=[2, 2],
        decoder_hidden_size=16,
        id2label={0: "road", 1: "Traffic_Light", 2: "unicorn"},
        label2id={"road": 0, "Traffic_Light": 1, "unicorn": 2},
    )
    torch.manual_seed(0)
    transformers.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(
        '{"image_processor_type": "SegformerImageProcessor", "size": {"height": 32, "width": 48}, "do_resize": true}'
    )
    return folder


def test_hugging_face_model_by_class_names(segformer_folder: Path) -> None:
    from pipeline.semantics.huggingface import HuggingFaceSegmenter

    segmenter = HuggingFaceSegmenter(str(segformer_folder))
    assert segmenter.train_id_of_class.tolist() == [0, 6, 255]
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    labels = segmenter.segment(image)
    assert labels.shape == (40, 60)
    assert set(np.unique(labels)) <= {0, 6, 255}


def test_hugging_face_model_missing_or_with_other_classes(segformer_folder: Path, tmp_path: Path) -> None:
    from pipeline.semantics.huggingface import HuggingFaceSegmenter, _train_ids

    with pytest.raises(DataError, match="segmentation model"):
        HuggingFaceSegmenter(str(tmp_path / "nothing"))
    with pytest.raises(DataError, match="named as in Cityscapes"):
        _train_ids({0: "cat", 1: "dog"}, "pets")
