"""Published files of NLSPN, imitated from their keys; what they leave open is asked for and kept in the card."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest
import torch

from auglidar_base.errors import CheckpointError, SettingsError
from completion.checkpoints import convert_checkpoint, import_checkpoint, load_checkpoint
from completion.importers import compare_checkpoint
from completion.models.nlspn import NLSPN
from pipeline.cli import main

RELEASED = {"legacy": True, "preserve_input": True}


def normalisation(name: str, channels: int) -> dict[str, tuple[int, ...]]:
    values = {f"{name}.{part}": (channels,) for part in ("weight", "bias", "running_mean", "running_var")}
    return {**values, f"{name}.num_batches_tracked": ()}


def published(layers: int, confidence: bool = True) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the state dictionary, written down from the files' description."""
    shapes: dict[str, tuple[int, ...]] = {
        "conv1_rgb.0.weight": (48, 3, 3, 3),
        "conv1_rgb.0.bias": (48,),
        "conv1_dep.0.weight": (16, 1, 3, 3),
        "conv1_dep.0.bias": (16,),
        "conv6.0.weight": (512, 512, 3, 3),
        "dec5.0.weight": (512, 256, 3, 3),
        "dec4.0.weight": (768, 128, 3, 3),
        "dec3.0.weight": (384, 64, 3, 3),
        "dec2.0.weight": (192, 64, 3, 3),
        "id_dec1.0.weight": (64, 128, 3, 3),
        "id_dec0.0.weight": (1, 128, 3, 3),
        "id_dec0.0.bias": (1,),
        "gd_dec1.0.weight": (64, 128, 3, 3),
        "gd_dec0.0.weight": (8, 128, 3, 3),
        "gd_dec0.0.bias": (8,),
        "prop_layer.aff_scale_const": (1,),
        "prop_layer.w": (1, 1, 3, 3),
        "prop_layer.b": (1,),
        "prop_layer.w_conf": (1, 1, 1, 1),
        "prop_layer.conv_offset_aff.weight": (24, 8, 3, 3),
        "prop_layer.conv_offset_aff.bias": (24,),
    }
    for name, channels in {"conv6": 512, "dec5": 256, "dec4": 128, "dec3": 64, "dec2": 64}.items():
        shapes |= normalisation(f"{name}.1", channels)
    shapes |= normalisation("id_dec1.1", 64) | normalisation("gd_dec1.1", 64)
    if confidence:
        shapes |= {"cf_dec1.0.weight": (32, 128, 3, 3), "cf_dec0.0.weight": (1, 96, 3, 3), "cf_dec0.0.bias": (1,)}
        shapes |= normalisation("cf_dec1.1", 32)
    before = 64
    for name, channels, blocks34 in (("conv2", 64, 3), ("conv3", 128, 4), ("conv4", 256, 6), ("conv5", 512, 3)):
        for block in range(blocks34 if layers == 34 else 2):
            shapes[f"{name}.{block}.conv1.weight"] = (channels, channels if block else before, 3, 3)
            shapes[f"{name}.{block}.conv2.weight"] = (channels, channels, 3, 3)
            shapes |= normalisation(f"{name}.{block}.bn1", channels) | normalisation(f"{name}.{block}.bn2", channels)
        if name != "conv2":
            shapes[f"{name}.0.downsample.0.weight"] = (channels, before, 1, 1)
            shapes |= normalisation(f"{name}.0.downsample.1", channels)
        before = channels
    return shapes


def state(layers: int = 18, confidence: bool = True, scale: float = 5.5) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    tensors = {}
    for name, shape in published(layers, confidence).items():
        if name.endswith("num_batches_tracked"):
            tensors[name] = torch.tensor(7)
        elif len(shape) <= 1:
            tensors[name] = 0.5 + torch.rand(shape, generator=generator)
        else:
            tensors[name] = torch.randn(1, generator=generator).mul(0.01).expand(shape)  # one number in the file
    tensors["prop_layer.w"], tensors["prop_layer.b"] = torch.ones(1, 1, 3, 3), torch.zeros(1)
    tensors["prop_layer.aff_scale_const"] = torch.tensor([scale])
    return tensors


def save(folder: Path, tensors: dict[str, torch.Tensor], name: str = "NLSPN_KITTI_DC.pt") -> Path:
    options = argparse.Namespace(network="resnet18", affinity="TGASS", prop_time=18, lr=1e-3)
    torch.save({"net": tensors, "optimizer": {"state": {}}, "args": options}, folder / name)
    return folder / name


def test_the_list_of_keys_is_as_long_as_published() -> None:
    assert (len(published(34)), len(published(18))) == (274, 178)


@pytest.mark.parametrize(("layers", "confidence"), [(34, True), (18, True), (18, False)])
def test_every_tensor_finds_its_place(tmp_path: Path, layers: int, confidence: bool) -> None:
    tensors = state(layers, confidence)
    model = import_checkpoint(save(tmp_path, tensors), "nlspn", **RELEASED)
    assert isinstance(model, NLSPN)
    assert not model.training
    own = model.state_dict()
    assert own.keys() == tensors.keys()
    assert all(torch.equal(own[name], value) for name, value in tensors.items())
    layer = model.prop_layer
    assert (layer.legacy, layer.preserve_input, layer.affinity, layer.iterations) == (True, True, "TGASS", 18)
    with torch.no_grad():
        assert model(torch.ones(1, 1, 9, 12), torch.zeros(1, 3, 9, 12)).shape == (1, 1, 9, 12)


def test_what_the_file_leaves_open_is_asked_for_and_the_card_says(tmp_path: Path) -> None:
    path = save(tmp_path, state())
    with pytest.raises(SettingsError, match=r"legacy and preserve_input not given: .* choose legacy=true and preserve"):
        import_checkpoint(path, "nlspn")
    with pytest.raises(SettingsError, match="preserve_input not given"):
        import_checkpoint(path, "nlspn", legacy=True)
    with pytest.raises(SettingsError, match="legacy: expected true or false, got 'yes'"):
        import_checkpoint(path, "nlspn", legacy="yes", preserve_input=True)
    with pytest.raises(SettingsError, match=r"expected choices among legacy, .*, got crop"):
        import_checkpoint(path, "nlspn", **RELEASED, crop=1)
    with pytest.raises(SettingsError, match="twise leaves nothing to choose, got legacy"):
        import_checkpoint(path, "twise", legacy=True)
    written = convert_checkpoint(path, "nlspn", tmp_path / "ours", legacy=False, preserve_input=True, iterations=6)
    model, card = load_checkpoint(written)
    assert card.training["choices"] == {"legacy": False, "preserve_input": True, "iterations": 6}
    assert card.model.arguments["affinity"] == "TGASS"
    assert isinstance(model, NLSPN)
    assert (model.prop_layer.legacy, model.prop_layer.iterations) == (False, 6)


def test_the_stored_scale_tells_the_affinity_as_far_as_it_can(tmp_path: Path) -> None:
    fixed = save(tmp_path, state(scale=8.0), "tc.pt")
    model = import_checkpoint(fixed, "nlspn", **RELEASED)
    assert isinstance(model, NLSPN)
    assert model.prop_layer.affinity == "TC"
    unscaled = save(tmp_path, state(scale=1.0), "as.pt")
    with pytest.raises(SettingsError, match="choose affinity=AS or ASS"):
        import_checkpoint(unscaled, "nlspn", **RELEASED)
    model = import_checkpoint(unscaled, "nlspn", **RELEASED, affinity="ASS")
    assert isinstance(model, NLSPN)
    assert model.prop_layer.affinity == "ASS"
    with pytest.raises(CheckpointError, match="TC has the scale 8, the file stores 1"):
        import_checkpoint(unscaled, "nlspn", **RELEASED, affinity="TC")
    with pytest.raises(SettingsError, match="affinity: expected one of AS, ASS, TC, TGASS, got 'mean'"):
        import_checkpoint(unscaled, "nlspn", **RELEASED, affinity="mean")


def test_a_file_that_does_not_fit_is_one_clear_line(tmp_path: Path) -> None:
    damaged = state()
    del damaged["dec4.0.weight"]
    damaged["conv6.0.weight"] = torch.zeros(512, 256, 3, 3)
    path = save(tmp_path, damaged)
    found = compare_checkpoint(path, "nlspn", **RELEASED)
    assert (found.missing, found.unknown, len(found.misshapen)) == (("dec4.0.weight",), (), 1)
    with pytest.raises(CheckpointError, match=r"missing dec4\.0\.weight; conv6\.0\.weight is \(512, 256, 3, 3\), the"):
        import_checkpoint(path, "nlspn", **RELEASED)
    torch.save({"net": {"conv1_dep.0.weight": torch.zeros(0, 1, 3, 3)}}, tmp_path / "odd.pt")
    with pytest.raises(CheckpointError, match="does not fit this network"):
        import_checkpoint(tmp_path / "odd.pt", "nlspn", **RELEASED)


def test_the_command_line_asks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = save(tmp_path, state()), tmp_path / "nlspn.safetensors"
    command = ["--stage", "import", str(path), "--architecture", "nlspn", "--out", str(out)]
    assert main(command) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "choose legacy=true and preserve_input=true for the authors' released weights" in told[0]
    assert main([*command, "--choose", "legacy"]) == 2
    assert "expected NAME=VALUE" in capsys.readouterr().err
    assert main([*command, "--choose", "legacy=true", "--choose", "preserve_input=true"]) == 0
    arguments = json.loads(out.with_suffix(".json").read_text())["model"]["arguments"]
    assert (arguments["legacy"], arguments["preserve_input"], arguments["iterations"]) == (True, True, 18)
