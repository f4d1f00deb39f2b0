"""Our own weights with their card, and public checkpoints read without running anything in them."""

from __future__ import annotations

import json
import math
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from auglidar_base.torch_pickle import read_torch_pickle
from detection.checkpoints import (
    find_weights,
    import_checkpoint,
    load_checkpoint,
    load_tensors,
    save_checkpoint,
    save_tensors,
)
from detection.importers import import_with_report
from detection.models.presets import small
from tests.reference import public_detector_keys as public


def save_small(folder: Path) -> Path:
    preset = small(points=256, width=0.25)
    torch.manual_seed(1)
    return save_checkpoint(preset.build(), preset, folder / "net.safetensors", {"steps": 3})


def test_save_and_load_return_the_same_network(tmp_path) -> None:
    path = save_small(tmp_path)
    model, preset, card = load_checkpoint(path)
    torch.manual_seed(1)
    fresh = small(points=256, width=0.25).build().state_dict()
    assert all(torch.equal(value, fresh[name]) for name, value in model.state_dict().items())
    assert not model.training
    assert (preset.name, preset.inputs.points, card["steps"]) == ("small", 256, 3)
    assert card["parameters"] == sum(parameter.numel() for parameter in model.parameters())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["net.json", "net.safetensors"]


def test_damage_and_mix_ups_are_named(tmp_path) -> None:
    path = save_small(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match="sha256"):
        load_checkpoint(path)
    path.write_bytes(content)
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps({**card, "preset": "huge"}))
    with pytest.raises(ValueError, match="unknown preset 'huge'; known are small"):
        load_checkpoint(path)
    path.with_suffix(".json").write_text(json.dumps({**card, "options": {"points": 256, "width": 0.5}}))
    with pytest.raises(ValueError, match="weights do not fit the network"):
        load_checkpoint(path)
    path.with_suffix(".json").unlink()
    with pytest.raises(ValueError, match=r"expected its card net\.json"):
        load_checkpoint(path)
    with pytest.raises(ValueError, match=r"expected a \.safetensors file or the name"):
        find_weights("no_such_network")


def test_a_truncated_file_is_named(tmp_path) -> None:
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"x": torch.arange(6.0).view(2, 3).T}, {"k": "v"})
    tensors, metadata = load_tensors(path)
    assert torch.equal(tensors["x"], torch.arange(6.0).view(2, 3).T)
    assert metadata == {"k": "v"}
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(ValueError, match=r"a\.safetensors: expected a safetensors file"):
        load_tensors(path)


@pytest.mark.parametrize("legacy", [True, False])
@pytest.mark.parametrize("codes", [52, 76])
def test_pointrcnn_is_told_apart_by_its_codes(tmp_path, codes, legacy) -> None:
    state = public.filled(public.pointrcnn(codes, 256))
    path = tmp_path / "PointRCNN.pth"
    container = {"epoch": 70, "it": 1000, "model_state": state, "optimizer_state": {"state": {}, "param_groups": []}}
    torch.save(container, path, _use_new_zipfile_serialization=not legacy)
    model, report = import_with_report(path, "pointrcnn")
    assert model.rpn.coder.channels == codes
    assert len(report.consumed) == len(set(report.consumed)) == len(state) == 244
    assert report.unused == report.counters == ()
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert not model.training


@pytest.mark.parametrize(
    ("shapes", "entries", "parameters"),
    [
        (public.pointrcnn(52, 256), 244, 3_884_356),
        (public.pointrcnn(76, 512), 244, 4_555_868),
        (public.openpcdet_pointrcnn(), 309, 4_038_819),
        (public.openpcdet_pointpillar(), 127, 4_834_888),
        (public.openpcdet_second(), 163, 5_325_576),
    ],
)
def test_the_written_key_lists_have_the_published_numbers(shapes, entries, parameters) -> None:
    counted = (name for name in shapes if not name.endswith(("mean", "var", "tracked", "global_step")))
    assert len(shapes) == entries
    assert sum(math.prod(shapes[name]) for name in counted) == parameters


def test_data_parallel_prefix_and_missing_counters(tmp_path) -> None:
    state = public.filled(public.pointrcnn(76, 512, extra=1))
    trimmed = {f"module.{n}": v for n, v in state.items() if not n.endswith("num_batches_tracked")}
    torch.save(trimmed, tmp_path / "a.pth")
    model, report = import_with_report(tmp_path / "a.pth", "epnet")
    assert model.settings.extra_channels == 1
    assert model.settings.head_width == 512
    assert len(report.consumed) == 210
    assert len(report.counters) == 34


def test_epnet_with_iou_branch(tmp_path) -> None:
    torch.save({"model_state": public.filled(public.pointrcnn(76, 512, iou_branch=True))}, tmp_path / "a.pth")
    assert import_checkpoint(tmp_path / "a.pth", "epnet").rcnn_net.iou_branch is not None


def test_fusion_checkpoint_is_refused_with_the_reason(tmp_path) -> None:
    state = public.filled(public.pointrcnn(76, 512))
    state["rpn.backbone_net.Img_Block.0.conv1.weight"] = torch.zeros(64, 3, 3, 3)
    state["rpn.backbone_net.Fusion_Conv.0.conv1.bias"] = torch.zeros(96)
    torch.save({"model_state": state}, tmp_path / "a.pth")
    with pytest.raises(ValueError, match=r"image fusion \(it holds Fusion_Conv, Img_Block\)"):
        import_checkpoint(tmp_path / "a.pth", "epnet")


def test_openpcdet_with_and_without_singleton_axes(tmp_path) -> None:
    state = public.filled(public.openpcdet_pointrcnn())
    squeezed = {n: v.flatten(1) if n.startswith("backbone_3d") and v.dim() == 4 else v for n, v in state.items()}
    torch.save({"model_state": squeezed, "optimizer_state": None, "version": "pcdet+0.6.0"}, tmp_path / "a.pth")
    model, report = import_with_report(tmp_path / "a.pth", "openpcdet_pointrcnn")
    assert len(report.consumed) == 309
    assert torch.equal(
        model.state_dict()["backbone_3d.FP_modules.0.mlp.0.weight"], state["backbone_3d.FP_modules.0.mlp.0.weight"]
    )


@pytest.mark.parametrize(
    ("architecture", "shapes"), [("pointpillar", public.openpcdet_pointpillar()), ("second", public.openpcdet_second())]
)
def test_openpcdet_by_its_written_keys(tmp_path, architecture, shapes) -> None:
    state = public.filled(shapes)
    torch.save({"model_state": state, "version": "pcdet+0.6.0"}, tmp_path / "a.pth")
    model, report = import_with_report(tmp_path / "a.pth", architecture)
    assert set(report.consumed) == set(state)
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())


def test_what_does_not_fit_is_listed(tmp_path) -> None:
    state = public.filled(public.pointrcnn(52, 256))
    state["rcnn_net.extra"] = state.pop("rcnn_net.cls_layer.3.conv.bias")
    state["rpn.rpn_cls_layer.0.conv.weight"] = torch.zeros(128, 64, 1)
    torch.save(state, tmp_path / "a.pth")
    with pytest.raises(ValueError, match="does not fit") as caught:
        import_checkpoint(tmp_path / "a.pth", "pointrcnn")
    for part in (
        "missing rcnn_net.cls_layer.3.conv.bias",
        "unknown rcnn_net.extra",
        "(128, 64, 1), expected (128, 128, 1)",
    ):
        assert part in str(caught.value)
    with pytest.raises(ValueError, match="unknown architecture 'rcnn'"):
        import_checkpoint(tmp_path / "a.pth", "rcnn")


class Command:
    """Unpickling this in the ordinary way runs a shell command."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (self.command,)


@pytest.mark.parametrize("legacy", [True, False])
def test_a_pickle_that_calls_is_refused_and_not_run(tmp_path, legacy) -> None:
    witness = tmp_path / "ran"
    path = tmp_path / "a.pth"
    content = {"model_state": {"w": torch.zeros(2)}, "extra": Command(f"touch {witness}")}
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(ValueError, match="refused, nothing in it was executed"):
        read_torch_pickle(path)
    path.write_bytes(pickle.dumps(Command(f"touch {witness}")))
    with pytest.raises(ValueError, match=r"a\.pth"):
        read_torch_pickle(path)
    assert not witness.exists()


class Settings(dict):  # type: ignore[type-arg]
    """As the EasyDict some checkpoints hold."""


class Plain:
    def __init__(self) -> None:
        self.rate = 0.1


def test_foreign_classes_become_inert(tmp_path) -> None:
    torch.save({"state_dict": {"w": torch.ones(2)}, "args": Plain(), "best": np.float64(0.5)}, tmp_path / "a.pth")
    content = read_torch_pickle(tmp_path / "a.pth")
    assert torch.equal(content["state_dict"]["w"], torch.ones(2))
    assert not isinstance(content["args"], Plain)
    assert not hasattr(content["args"], "rate")


def test_no_checkpoint_at_all(tmp_path) -> None:
    (tmp_path / "a.pth").write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match=r"a\.pth"):
        read_torch_pickle(tmp_path / "a.pth")
    torch.save({"epoch": 3}, tmp_path / "b.pth")
    with pytest.raises(ValueError, match="found no tensor"):
        import_checkpoint(tmp_path / "b.pth", "pointrcnn")
