from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from detection.frustum.checkpoints import (
    import_frustum_pointnet,
    load_frustum_checkpoint,
    save_frustum_checkpoint,
)
from detection.frustum.network import FrustumPointNet
from pipeline.cli import main
from tests.detection.frustum.public_keys import LAYERS, NORM, port_shapes, tensorflow_shapes


def port_file(path: Path, **changes: Tensor | None) -> Path:
    """A checkpoint as the port writes it; a change of None takes a tensor away."""
    torch.manual_seed(0)
    tensors: dict[str, Tensor | None] = {
        name: torch.rand(shape) if shape else torch.tensor(7) for name, shape in port_shapes().items()
    }
    state = {name: value for name, value in (tensors | changes).items() if value is not None}
    record = {"epoch": 3, "train_iou3d_acc": 0.5, "test_iou3d_acc": 0.4, "model_state_dict": state}
    torch.save({**record, "optimizer_state_dict": {"state": {}, "param_groups": []}}, path)
    return path


def tensorflow_file(path: Path) -> Path:
    rng = np.random.default_rng(0)
    values = {name: rng.random(shape, np.float32) for name, shape in tensorflow_shapes().items()}
    # What the optimiser keeps beside them.
    extra = {"conv1/weights/Adam": values["conv1/weights"], "beta1_power": np.zeros((), np.float32)}
    np.savez(path, **values, **extra)  # type: ignore[arg-type]
    return path


def test_lists_are_those_of_the_published_files() -> None:
    assert (len(port_shapes()), len(tensorflow_shapes())) == (146, 126)
    own = {name: tuple(value.shape) for name, value in FrustumPointNet("port").state_dict().items()}
    assert own == port_shapes()


def test_port_checkpoint_is_imported(tmp_path: Path) -> None:
    path = port_file(tmp_path / "port.pth")
    model = import_frustum_pointnet(path, "port")
    state = torch.load(path, weights_only=True)["model_state_dict"]
    assert (model.variant, model.training) == ("port", False)
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())


def test_original_variables_are_imported(tmp_path: Path) -> None:
    path = tensorflow_file(tmp_path / "tf.npz")
    model = import_frustum_pointnet(path, "tf")
    state, variables = model.state_dict(), np.load(path)
    for module, layer, norm, scope, incoming, outgoing in LAYERS:
        weights = variables[f"{scope}/weights"].reshape(incoming, outgoing)
        assert np.array_equal(state[f"{module}.{layer}.weight"].numpy().reshape(outgoing, incoming), weights.T)
        assert np.array_equal(state[f"{module}.{layer}.bias"], variables[f"{scope}/biases"])
        for name, theirs in NORM if norm else ():
            assert np.array_equal(state[f"{module}.{norm}.{name}"], variables[f"{scope}/bn/{theirs}"])


def test_three_channels_are_told_by_the_first_layer(tmp_path: Path) -> None:
    path = port_file(tmp_path / "xyz.pth", **{"InsSeg.conv1.weight": torch.rand(64, 3, 1)})
    assert import_frustum_pointnet(path, "port").channels == 3


def test_misfits_are_named(tmp_path: Path) -> None:
    short = port_file(tmp_path / "short.pth", **{"est.fc3.weight": torch.rand(39, 256), "STN.fc1.bias": None})
    with pytest.raises(ValueError, match=r"short.pth.*missing STN.fc1.bias; est.fc3.weight is \(39, 256\)"):
        import_frustum_pointnet(short, "port")
    with pytest.raises(ValueError, match="variant: expected one of tf, port, got 'caffe'"):
        import_frustum_pointnet(short, "caffe")
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"torn.npz: expected an .npz"):
        import_frustum_pointnet(tmp_path / "torn.npz", "tf")


def test_own_files_keep_variant_and_channels(tmp_path: Path) -> None:
    model = FrustumPointNet("port", 3).eval()
    path = save_frustum_checkpoint(model, tmp_path / "own.safetensors", {"steps": 1})
    again = load_frustum_checkpoint(path)
    assert (again.variant, again.channels, again.training) == ("port", 3, False)
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in again.state_dict().items())


def test_damaged_own_files_are_refused(tmp_path: Path) -> None:
    path = save_frustum_checkpoint(FrustumPointNet("tf", 3), tmp_path / "own.safetensors", {})
    with pytest.raises(ValueError, match="no such file"):
        load_frustum_checkpoint(tmp_path / "none.safetensors")
    card = path.with_suffix(".json")
    written = card.read_text()
    card.write_text(json.dumps({**json.loads(written), "preset": "small"}))
    with pytest.raises(ValueError, match="weights of 'small'; expected Frustum PointNet"):
        load_frustum_checkpoint(path)
    card.write_text(json.dumps({**json.loads(written), "options": {"variant": "keras"}}))
    with pytest.raises(ValueError, match=r"own.json: variant: expected one of tf, port"):
        load_frustum_checkpoint(path)
    card.write_text(written)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match="damaged or mixed up"):
        load_frustum_checkpoint(path)


def test_import_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = port_file(tmp_path / "port.pth")
    out = tmp_path / "weights" / "frustum.safetensors"
    command = ["--stage", "import", str(source), "--architecture", "frustum_pointnet", "--out", str(out)]
    assert main(command) == 2
    assert "variant=tf" in capsys.readouterr().err
    command += ["--choose", "variant=port"]
    assert main(command) == 0
    assert load_frustum_checkpoint(out).variant == "port"
    source.write_bytes(source.read_bytes()[:5000])
    capsys.readouterr()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "port.pth" in error
