"""Published files of ENet and PENet, imitated from their keys; what is dropped, what is chosen, what is refused."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from auglidar_base.errors import CheckpointError, SettingsError
from completion.checkpoints import import_checkpoint, load_checkpoint
from completion.importers import fitting_architectures
from completion.infer import load_completer
from completion.models.enet import ENet
from completion.models.penet import PENet
from completion.windows import WindowCompleter
from pipeline.cli import main
from tests.completion.scenes import street
from tests.pipeline.tiny_kitti import write_tiny_kitti

Shapes = dict[str, tuple[int, ...]]
EXTRA = {"xyz": 3, "uv": 2, "z": 1, "std": 0}


def normed(name: str, convolution: tuple[int, ...], channels: int) -> Shapes:
    """A Sequential of convolution and normalisation."""
    return {f"{name}.0.weight": convolution, **normalisation(f"{name}.1", channels)}


def normalisation(name: str, channels: int) -> Shapes:
    values = {f"{name}.{part}": (channels,) for part in ("weight", "bias", "running_mean", "running_var")}
    return {**values, f"{name}.num_batches_tracked": ()}


def block(name: str, inputs: int, outputs: int, extra: int, downsample: bool) -> Shapes:
    shapes: Shapes = {
        f"{name}.conv1.weight": (outputs, inputs + extra, 3, 3),
        f"{name}.conv2.weight": (outputs, outputs + extra, 3, 3),
    }
    shapes |= normalisation(f"{name}.bn1", outputs) | normalisation(f"{name}.bn2", outputs)
    if downsample:
        shapes |= normed(f"{name}.downsample", (outputs, inputs + extra, 1, 1), outputs)
    return shapes


def enet_keys(encoding: str = "xyz", w: int = 32) -> Shapes:
    """Names and shapes of ENet's state dictionary, written down from the files' description."""
    e = EXTRA[encoding]
    shapes = normed("rgb_conv_init", (w, 4, 5, 5), w) | normed("depth_conv_init", (w, 2, 5, 5), w)
    for number, before, joined, after in (
        (1, w, w, 2 * w),
        (3, 2 * w, 4 * w, 4 * w),
        (5, 4 * w, 8 * w, 8 * w),
        (7, 8 * w, 16 * w, 16 * w),
        (9, 16 * w, 32 * w, 32 * w),
    ):
        shapes |= block(f"rgb_encoder_layer{number}", before, after, e, True)
        shapes |= block(f"rgb_encoder_layer{number + 1}", after, after, e, False)
        shapes |= block(f"depth_layer{number}", joined, after, e, True)
        shapes |= block(f"depth_layer{number + 1}", after, after, e, False)
    for name, inputs in (("8", 32 * w), ("6", 16 * w), ("4", 8 * w), ("2", 4 * w), ("0", 2 * w)):
        shapes |= normed(f"rgb_decoder_layer{name}", (inputs, inputs // 2, 5, 5), inputs // 2)
    for name, inputs in (("1", 32 * w), ("2", 16 * w), ("3", 8 * w), ("4", 4 * w), ("5", 2 * w)):
        shapes |= normed(f"decoder_layer{name}", (inputs, inputs // 2, 5, 5), inputs // 2)
    shapes |= normed("rgb_decoder_output", (w, 2, 3, 3), 2) | normed("decoder_layer6", (2, w, 3, 3), 2)
    return shapes


def head_keys(dilation: int, w: int = 32) -> Shapes:
    """Names and shapes of DA-CSPN++ beside the backbone."""
    shapes: Shapes = {}
    levels = {1: ("",), 2: ("", "_s2"), 4: ("", "_s2", "_s3")}[dilation]
    for level, inputs in zip(levels, (2 * w, 4 * w, 8 * w)):
        for kernel, neighbours in ((3, 8), (5, 24), (7, 48)):
            name = f"iter_guide_layer{kernel}{level}.generate"
            shapes |= normed(name, (neighbours, inputs, 3, 3), neighbours)
        shapes |= normed(f"kernel_conf_layer{level}", (3, inputs, 3, 3), 3)
        masks = 3 if dilation == 1 else 1
        shapes |= normed(f"mask_layer{level}", (masks, inputs, 3, 3), masks)
        if dilation == 4:
            shapes |= normed(f"prop_mask_layer{level}", (1, inputs, 3, 3), 1)
        if dilation == 1:
            shapes |= normed("iter_conf_layer", (12, inputs, 3, 3), 12)
    return shapes


def penet_keys(dilation: int, w: int = 32) -> Shapes:
    return {f"backbone.{name}": shape for name, shape in enet_keys(w=w).items()} | head_keys(dilation, w)


def state(shapes: Shapes) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    tensors = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            tensors[name] = torch.tensor(7)
        elif name.endswith(("running_var", "running_mean")) or len(shape) == 1:
            tensors[name] = 0.5 + torch.rand(shape, generator=generator)
        else:
            tensors[name] = torch.randn(shape, generator=generator) * 0.1
    return tensors


def save(folder: Path, tensors: dict[str, torch.Tensor], name: str = "pe.pth.tar", prefix: str = "") -> Path:
    content = {f"{prefix}{key}": value for key, value in tensors.items()}
    options = argparse.Namespace(network_model="pe", dilation_rate=2, convolutional_layer_encoding="xyz")
    torch.save({"epoch": 9, "model": content, "optimizer": {"state": {}}, "args": options}, folder / name)
    return folder / name


def parameters(shapes: Shapes) -> int:
    counted = ("running_mean", "running_var", "num_batches_tracked")
    return sum(math.prod(shape) for name, shape in shapes.items() if not name.endswith(counted))


def test_the_lists_of_keys_are_as_long_as_published() -> None:
    found = [(len(keys), parameters(keys)) for keys in (enet_keys(), penet_keys(1), penet_keys(2), penet_keys(4))]
    # The published tensors of PENet count three constant kernels more.
    assert found == [(384, 131_762_888), (420, 131_819_532), (444, 131_908_376), (492, 132_106_118)]


@pytest.mark.parametrize("encoding", ["xyz", "uv", "z", "std"])
def test_every_tensor_of_enet_finds_its_place(tmp_path: Path, encoding: str) -> None:
    tensors = state(enet_keys(encoding, 2))
    model = import_checkpoint(save(tmp_path, tensors), "enet")
    assert isinstance(model, ENet)
    assert (model.encoding, model.crop, model.camera, model.training) == (encoding, "bottom", "published", False)
    own = model.state_dict()
    assert own.keys() == tensors.keys()
    assert all(torch.equal(own[name], value) for name, value in tensors.items())


@pytest.mark.parametrize(("dilation", "prefix"), [(1, ""), (2, ""), (2, "module."), (4, "module.")])
def test_every_tensor_of_penet_finds_its_place(tmp_path: Path, dilation: int, prefix: str) -> None:
    tensors = state(penet_keys(dilation, 2))
    # The training class' attention has no effect; the other classes keep constant kernels that only shift.
    unused: Shapes = {"encoder3": (9, 9, 3, 3), "encoder5": (25, 25, 5, 5), "encoder7": (49, 49, 7, 7)}
    if dilation == 2:
        unused = normed("dimhalf_s2", (4, 8, 1, 1), 4) | normed("att_12", (2, 8, 3, 3), 2)
    model = import_checkpoint(save(tmp_path, tensors | state(unused), prefix=prefix), "penet")
    assert isinstance(model, PENet)
    assert model.dilation == dilation
    own = model.state_dict()
    assert own.keys() == tensors.keys()
    assert all(torch.equal(own[name], value) for name, value in tensors.items())


def test_a_file_that_does_not_fit_is_one_clear_line(tmp_path: Path) -> None:
    penet, enet = state(penet_keys(2, 1)), state(enet_keys(w=1))
    with pytest.raises(CheckpointError, match="weights of penet, not of enet; import them as 'penet'"):
        import_checkpoint(save(tmp_path, penet), "enet")
    with pytest.raises(CheckpointError, match="weights of enet, not of penet; import them as 'enet'"):
        import_checkpoint(save(tmp_path, enet), "penet")
    with pytest.raises(CheckpointError, match="penet"):
        import_checkpoint(save(tmp_path, penet), "twise")
    assert (fitting_architectures(enet), fitting_architectures(penet)) == (("enet",), ("penet",))
    del penet["mask_layer_s2.0.weight"]
    penet["kernel_conf_layer.0.weight"] = torch.zeros(3, 5, 3, 3)
    with pytest.raises(
        CheckpointError, match=r"missing mask_layer_s2\.0\.weight; kernel_conf_layer\.0\.weight is \(3, 5"
    ):
        import_checkpoint(save(tmp_path, penet), "penet")
    with pytest.raises(SettingsError, match="penet: crop: expected one of bottom, top_left, got 'centre'"):
        import_checkpoint(save(tmp_path, penet), "penet", crop="centre")
    with pytest.raises(SettingsError, match="enet: expected choices among crop, camera, got legacy"):
        import_checkpoint(save(tmp_path, enet), "enet", legacy=True)
    torch.save({"model": {"backbone.rgb_conv_init.0.weight": torch.zeros(0, 4, 5, 5)}}, tmp_path / "odd.pt")
    with pytest.raises(CheckpointError, match="does not fit this network"):
        import_checkpoint(tmp_path / "odd.pt", "penet")


def test_from_the_published_file_to_virtual_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Import, complete and export through the command line, on a CPU."""
    tensors = state(penet_keys(2, 1))
    tensors["backbone.decoder_layer6.1.bias"] = torch.tensor([12.0, 5.0])
    tensors["backbone.rgb_decoder_output.1.bias"] = torch.tensor([12.0, 5.0])
    weights, data, run = tmp_path / "penet.safetensors", write_tiny_kitti(tmp_path / "KITTI", 1), tmp_path / "run"
    imported = ["--stage", "import", str(save(tmp_path, tensors)), "--architecture", "penet", "--out", str(weights)]
    assert main([*imported, "--choose", "crop=left"]) == 2
    assert "crop: expected one of bottom, top_left, got 'left'" in capsys.readouterr().err
    assert main([*imported, "--choose", "crop=top_left"]) == 0
    arguments = json.loads(weights.with_suffix(".json").read_text())["model"]["arguments"]
    assert arguments == {"encoding": "xyz", "width": 1, "crop": "top_left", "dilation": 2}
    completer = load_completer(weights, backend="auto")
    assert isinstance(completer, WindowCompleter)
    with pytest.raises(ValueError, match="backend 'numba' does not run penet; use backend 'torch'"):
        load_completer(weights, backend="numba")
    frame = street(0, 40, 72)
    assert completer.complete(frame.sparse, frame.image).depth.any()
    command = [
        "--config",
        "configs/kitti.yaml",
        "--data",
        str(data),
        "--out",
        str(run),
        "--workers",
        "1",
        "--set",
        f"completion.model={weights}",
    ]
    assert main([*command, "--stage", "complete"]) == 0
    out = tmp_path / "virconv"
    exported = ["--stage", "export", "--format", "virconv", "--compat", "window352,lowest_z"]
    assert main([*exported, "--data", str(data), "--run", str(run), "--out", str(out)]) == 0
    rows = np.load(out / "training" / "velodyne_depth" / "000000.npy")
    assert rows.shape[1] == 8
    assert set(np.unique(rows[:, 7])) == {1, 2}
    assert load_checkpoint(weights)[1].training["choices"] == {"crop": "top_left"}
