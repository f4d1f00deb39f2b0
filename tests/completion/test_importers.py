"""Published checkpoint files, imitated: every wrapper they use, both file formats, and hostile ones."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save as save_tensors

from completion.checkpoints import (
    Card,
    CheckpointError,
    convert_checkpoint,
    import_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from completion.importers import compare_checkpoint
from completion.models import build_model, default_spec
from completion.models.sparse_to_dense import SparseToDense, TwinSparseToDense, grey_levels
from tests.completion import published_keys

FORMATS = pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])


@pytest.fixture
def result_class(monkeypatch: pytest.MonkeyPatch) -> type:
    """A class that pickles as `metrics.Result`, like the references' own."""

    class Result:
        def __init__(self) -> None:
            self.rmse, self.mae, self.delta1 = np.float64(840.2), 195.6, np.float32(0.99)

    Result.__module__, Result.__qualname__ = "metrics", "Result"
    module = types.ModuleType("metrics")
    module.Result = Result  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "metrics", module)
    return Result


def save(path: Path, content: Any, zipped: bool) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    return path


def example(batch: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return torch.rand(batch, 1, 32, 48, generator=generator), torch.rand(batch, 3, 32, 48, generator=generator)


@FORMATS
@pytest.mark.parametrize(("name", "pooling"), [("twise", "avg"), ("twise_maxpool", "max")])
def test_twise_wrapper(tmp_path: Path, result_class: type, zipped: bool, name: str, pooling: str) -> None:
    model = build_model(default_spec("twise", channels=4, pooling=pooling))
    content = {
        "epoch": 29,
        "model": model.state_dict(),
        "best_result": result_class(),
        "optimizer": torch.optim.Adam(model.parameters()),
        "args": argparse.Namespace(lr=np.float64(1e-3), workers=4),
    }
    imported = import_checkpoint(save(tmp_path / "model_best.pth.tar", content, zipped), name)
    assert not imported.training
    with torch.no_grad():
        for ours, theirs in zip(imported(*example()), model(*example())):
            assert torch.equal(ours, theirs)


@FORMATS
@pytest.mark.parametrize(("name", "extra"), [("msg_chn", True), ("msg_chn_wacv", False)])
def test_msg_chn_wrapper_with_module_prefix(tmp_path: Path, zipped: bool, name: str, extra: bool) -> None:
    model = build_model(default_spec("msg_chn", channels=4, extra_skips=extra))
    optimiser = torch.optim.Adam(model.parameters())
    content = {
        "epoch": 28,
        "net_type": "multiscale",
        "net": {f"module.{key}": value for key, value in model.state_dict().items()},
        "optimizer": optimiser.state_dict(),
        "lr_scheduler": torch.optim.lr_scheduler.StepLR(optimiser, 5).state_dict(),
        "stats": {"val": [0.1, 0.2]},
        "use_gpu": True,
        "training_time": 3.5,
    }
    imported = import_checkpoint(save(tmp_path / "DataParallel_ep0028.pth.tar", content, zipped), name)
    with torch.no_grad():
        assert torch.equal(imported(*example())[0], model(*example())[0])


@pytest.mark.parametrize("arguments", [{"layers": 18}, {"layers": 34}, {"layers": 18, "grey": True}])
def test_sparse_to_dense_wrapper(tmp_path: Path, result_class: type, arguments: dict[str, Any]) -> None:
    model = SparseToDense(**arguments).eval()
    state = {k: v for k, v in model.state_dict().items() if not k.endswith("num_batches_tracked")}
    content = {"epoch": 10, "model": state, "best_result": result_class(), "args": argparse.Namespace()}
    imported = import_checkpoint(save(tmp_path / "model_best.pth.tar", content, False), "sparse_to_dense")
    sparse, rgb = example()
    with torch.no_grad():
        found = imported(sparse * 80, rgb * 255)
        assert torch.equal(found, model(sparse * 80, rgb * 255))
    assert float(found.min()) >= 0.9 - 1e-6


def test_published_sizes_of_sparse_to_dense() -> None:
    def count(**arguments: Any) -> tuple[int, int]:
        model = SparseToDense(**arguments)
        return sum(p.numel() for p in model.parameters()), len(model.state_dict())

    assert count() == (16_000_033, 164)
    assert count(layers=34) == (26_108_193, 260)
    assert count(grey=True) == (15_999_169, 164)


class Command:
    """Runs a shell command when unpickled in the ordinary way."""

    def __init__(self, target: Path, function: Any = os.system) -> None:
        self.target, self.function = target, function

    def __reduce__(self) -> Any:
        return self.function, (f"touch {self.target}",)


@FORMATS
@pytest.mark.parametrize("function", [os.system, eval, argparse.ArgumentParser])
def test_a_file_that_calls_something_is_refused_and_nothing_runs(tmp_path: Path, zipped: bool, function: Any) -> None:
    model = build_model(default_spec("twise", channels=4))
    content = {"model": model.state_dict(), "args": Command(tmp_path / "ran", function)}
    path = save(tmp_path / "evil.pth.tar", content, zipped)
    with pytest.raises(CheckpointError, match="refused"):
        import_checkpoint(path, "twise")
    assert not (tmp_path / "ran").exists()


@FORMATS
def test_a_whole_pickled_module_is_refused(tmp_path: Path, zipped: bool) -> None:
    path = save(tmp_path / "final_model.pth", build_model(default_spec("msg_chn", channels=2)), zipped)
    with pytest.raises(CheckpointError, match=r"refused|cannot be imported"):
        import_checkpoint(path, "msg_chn")


def test_another_architecture_is_refused_and_the_keys_are_reported(tmp_path: Path) -> None:
    state = build_model(default_spec("twise", channels=4)).state_dict()
    path = save(tmp_path / "twise.pth", {"model": state}, True)
    with pytest.raises(CheckpointError, match=r"prdct\.3\.weight is \(3, 4, 3, 3\), the network has \(1, 4, 3, 3\)"):
        import_checkpoint(path, "msg_chn")
    del state["rgb_encoder.enc4.3.bias"]
    state["extra.weight"] = torch.zeros(1)
    path = save(tmp_path / "damaged.pth", {"model": state}, True)
    found = compare_checkpoint(path, "twise")
    assert (found.missing, found.unknown, found.misshapen) == (("rgb_encoder.enc4.3.bias",), ("extra.weight",), ())
    with pytest.raises(CheckpointError, match=r"missing rgb_encoder\.enc4\.3\.bias; unknown extra\.weight"):
        import_checkpoint(path, "twise")


def test_the_same_size_variant_is_told_apart(tmp_path: Path) -> None:
    state = build_model(default_spec("twise", channels=4)).state_dict()
    state["depth_encoder2.init.0.weight"] = torch.zeros(4, 3, 3, 3)
    with pytest.raises(CheckpointError, match="same-size variant"):
        import_checkpoint(save(tmp_path / "same.pth", {"model": state}, True), "twise")


def test_no_pytorch_file(tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_bytes(b"no checkpoint" * 40)
    with pytest.raises(CheckpointError, match=r"expected a PyTorch checkpoint|refused"):
        import_checkpoint(tmp_path / "text.pth", "twise")
    with pytest.raises(ValueError, match="architecture"):
        import_checkpoint(tmp_path / "text.pth", "no_such_network")


def test_conversion_to_our_format(tmp_path: Path) -> None:
    model = build_model(default_spec("twise", channels=4))
    path = save(tmp_path / "model_best.pth.tar", {"model": model.state_dict()}, False)
    converted, card = load_checkpoint(convert_checkpoint(path, "twise", tmp_path / "ours"))
    assert card.model.depth_unit == 80
    assert card.training["gamma"].startswith("2.5")
    assert len(card.training["source_sha256"]) == 64
    with torch.no_grad():
        assert torch.equal(converted(*example())[0], model(*example())[0])


PUBLISHED = {
    "twise": (published_keys.hourglasses(64, 3), 92),
    "twise_maxpool": (published_keys.hourglasses(64, 3), 92),
    "msg_chn": (published_keys.hourglasses(32, 1), 92),
    "msg_chn_wacv": (published_keys.hourglasses(64, 1), 92),
    "sparse_to_dense": (published_keys.sparse_to_dense(), 164),
    "sparse_to_dense 34": (published_keys.sparse_to_dense((3, 4, 6, 3)), 260),
    "sparse_to_dense gd": (published_keys.sparse_to_dense(grey=True), 164),
}


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_files_with_the_published_names_are_taken(tmp_path: Path, name: str) -> None:
    shapes, count = PUBLISHED[name]
    assert len(shapes) == count
    given = published_keys.tensors(shapes)
    imported = import_checkpoint(save(tmp_path / "public.pth.tar", {"model": given}, True), name.split()[0])
    state = imported.state_dict()
    assert {key: tuple(value.shape) for key, value in state.items()} == shapes
    assert all(torch.equal(state[key], value) for key, value in given.items())


def test_a_wrong_architecture_names_those_that_fit(tmp_path: Path) -> None:
    path = save(tmp_path / "public.pth", {"model": published_keys.tensors(published_keys.hourglasses(4, 3))}, True)
    with pytest.raises(CheckpointError, match=r"; it fits twise or twise_maxpool$") as caught:
        import_checkpoint(path, "sparse_to_dense")
    assert str(caught.value).count(str(path)) == 1
    small = save(tmp_path / "other.pth", {"model": {"a.weight": torch.zeros(2)}}, True)
    with pytest.raises(CheckpointError) as caught:
        import_checkpoint(small, "twise")
    assert "it fits" not in str(caught.value)


def test_weights_saved_before_the_container_still_load(tmp_path: Path) -> None:
    spec = default_spec("sparse_to_dense", width=4)
    model = build_model(spec)
    path = save_checkpoint(tmp_path / "ours", model, Card(spec, "fused"))
    old = {name.replace("convtf.0.", "convtf."): value for name, value in model.state_dict().items()}
    path.write_bytes(save_tensors(old))
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    assert torch.equal(load_checkpoint(path)[0].convtf[0].weight, model.convtf[0].weight)


def test_grey_is_pillows() -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    expected = np.asarray(Image.fromarray(rgb).convert("L"), np.float32)
    values = torch.from_numpy(rgb).permute(2, 0, 1)[None].float()
    np.testing.assert_array_equal(grey_levels(values)[0, 0].numpy(), expected)
    raw, unit = SparseToDense(grey=True, width=4), TwinSparseToDense(grey=True, width=4)
    np.testing.assert_array_equal(raw.colours(values)[0, 0].numpy(), expected)
    np.testing.assert_allclose(unit.colours(values / 255)[0, 0].numpy() * 255, expected, atol=1e-4)
