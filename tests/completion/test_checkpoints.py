"""Weights with cards: what is written is what is read, and everything else is refused with its reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from completion.checkpoints import Card, CheckpointError, load_checkpoint, save_checkpoint
from completion.models import MODELS, ModelSpec, build_model, default_spec
from completion.resume import load_state


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    spec = default_spec("selection", width=8)
    return save_checkpoint(tmp_path / "net.safetensors", build_model(spec), Card(spec, "hard", {"seed": 3}))


def test_round_trip(saved: Path) -> None:
    model, card = load_checkpoint(saved)
    assert (card.decoding, card.training, card.model.arguments) == ("hard", {"seed": 3}, {"width": 8})
    assert not model.training
    for name, value in load_file(saved).items():
        assert torch.equal(model.state_dict()[name], value)
    assert load_checkpoint(saved.with_suffix(""))[1] == card


@pytest.mark.parametrize("architecture", sorted(MODELS))
def test_every_architecture_can_be_saved_and_rebuilt(tmp_path: Path, architecture: str) -> None:
    spec = default_spec(architecture, **({"width": 4} if architecture in ("enet", "penet") else {}))
    model, card = load_checkpoint(save_checkpoint(tmp_path / "any", build_model(spec), Card(spec)))
    assert card.model == spec
    assert sum(p.numel() for p in model.parameters()) > 0


def test_a_changed_file_is_refused(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[-3] ^= 1
    saved.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="SHA-256"):
        load_checkpoint(saved)


def test_a_missing_or_foreign_card_is_refused(saved: Path) -> None:
    card = saved.with_suffix(".json")
    content = json.loads(card.read_text())
    card.write_text(json.dumps(content | {"format": "other"}))
    with pytest.raises(CheckpointError, match="format"):
        load_checkpoint(saved)
    card.write_text("{")
    with pytest.raises(CheckpointError, match="not a card"):
        load_checkpoint(saved)
    card.unlink()
    with pytest.raises(CheckpointError, match=r"card net\.json is missing"):
        load_checkpoint(saved)


def rewrite(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Other tensors under a card with the right hash."""
    import hashlib

    save_file(tensors, path)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))


def test_incomplete_and_misshapen_tensors_are_refused(saved: Path) -> None:
    tensors = load_file(saved)
    name = next(iter(tensors))
    rewrite(saved, {k: v for k, v in tensors.items() if k != name})
    with pytest.raises(CheckpointError, match=f"missing {name}"):
        load_checkpoint(saved)
    rewrite(saved, tensors | {name: torch.zeros(3)})
    with pytest.raises(CheckpointError, match=rf"{name} is \(3,\)"):
        load_checkpoint(saved)
    rewrite(saved, tensors | {"more": torch.zeros(3)})
    with pytest.raises(CheckpointError, match="unknown more"):
        load_checkpoint(saved)


def test_unknown_names_list_what_there_is() -> None:
    with pytest.raises(CheckpointError, match="classical"):
        load_checkpoint("no-such-network")


def test_wrong_specifications_are_named() -> None:
    with pytest.raises(ValueError, match="architecture"):
        default_spec("unet")
    with pytest.raises(ValueError, match="rgb"):
        ModelSpec("twise", rgb="bgr")
    with pytest.raises(ValueError, match="cannot be built"):
        build_model(default_spec("twise", width=3))


def test_a_checkpoint_is_no_training_state(saved: Path) -> None:
    model = build_model(default_spec("selection", width=8))
    optimiser = torch.optim.Adam(model.parameters())
    with pytest.raises(CheckpointError, match="state of a training run"):
        load_state(saved, model, optimiser, torch.amp.GradScaler("cpu", enabled=False))
