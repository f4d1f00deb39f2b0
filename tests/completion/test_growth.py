"""A wider network started from a narrower one computes the same, and its added channels learn."""

import pytest
import torch

from completion.growth import grow
from completion.models.selection import Selection


def inputs() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    depth = torch.rand(1, 1, 32, 64, generator=generator) * 40 + 3
    sparse = depth * (torch.rand(1, 1, 32, 64, generator=generator) < 0.1)
    return sparse, torch.randn(1, 3, 32, 64, generator=generator)


def trained_look(width: int) -> Selection:
    """Weights that are zero at the start of training are not zero here."""
    torch.manual_seed(width)
    model = Selection(width=width)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    return model


def test_grown_network_computes_the_same() -> None:
    narrow, wide = trained_look(8), trained_look(16)
    assert len(grow(narrow, wide)) > 50
    with torch.no_grad():
        torch.testing.assert_close(wide(*inputs())[0], narrow(*inputs())[0], rtol=1e-5, atol=1e-5)


def test_added_channels_get_gradients() -> None:
    wide = trained_look(16)
    grow(trained_look(8), wide)
    wide(*inputs())[0].square().mean().backward()
    head = wide.network.head.weight.grad
    assert head is not None
    assert head[:, 8:].abs().max() > 0


def test_narrower_or_other_networks_are_refused() -> None:
    with pytest.raises(ValueError, match="expected at most"):
        grow(trained_look(16), trained_look(8))
    with pytest.raises(ValueError, match="networks differ"):
        grow(trained_look(8), torch.nn.Linear(2, 2))
