"""Names and shapes of the public Frustum PointNet v1 files, written down by hand from what is published of them."""

from __future__ import annotations

# Module, layer and normalisation of the PyTorch port; scope of the original; inputs and outputs.
LAYERS = (
    ("InsSeg", "conv1", "bn1", "conv1", 4, 64),
    ("InsSeg", "conv2", "bn2", "conv2", 64, 64),
    ("InsSeg", "conv3", "bn3", "conv3", 64, 64),
    ("InsSeg", "conv4", "bn4", "conv4", 64, 128),
    ("InsSeg", "conv5", "bn5", "conv5", 128, 1024),
    ("InsSeg", "dconv1", "dbn1", "conv6", 1091, 512),
    ("InsSeg", "dconv2", "dbn2", "conv7", 512, 256),
    ("InsSeg", "dconv3", "dbn3", "conv8", 256, 128),
    ("InsSeg", "dconv4", "dbn4", "conv9", 128, 128),
    ("InsSeg", "dconv5", "", "conv10", 128, 2),
    ("STN", "conv1", "bn1", "conv-reg1-stage1", 3, 128),
    ("STN", "conv2", "bn2", "conv-reg2-stage1", 128, 128),
    ("STN", "conv3", "bn3", "conv-reg3-stage1", 128, 256),
    ("STN", "fc1", "fcbn1", "fc1-stage1", 259, 256),
    ("STN", "fc2", "fcbn2", "fc2-stage1", 256, 128),
    ("STN", "fc3", "", "fc3-stage1", 128, 3),
    ("est", "conv1", "bn1", "conv-reg1", 3, 128),
    ("est", "conv2", "bn2", "conv-reg2", 128, 128),
    ("est", "conv3", "bn3", "conv-reg3", 128, 256),
    ("est", "conv4", "bn4", "conv-reg4", 256, 512),
    ("est", "fc1", "fcbn1", "fc1", 515, 512),
    ("est", "fc2", "fcbn2", "fc2", 512, 256),
    ("est", "fc3", "", "fc3", 256, 59),
)
NORM = (
    ("weight", "gamma"),
    ("bias", "beta"),
    ("running_mean", "moving_mean"),
    ("running_var", "moving_variance"),
)


def port_shapes() -> dict[str, tuple[int, ...]]:
    """The port's state dict: 146 names."""
    found: dict[str, tuple[int, ...]] = {}
    for module, layer, norm, _, incoming, outgoing in LAYERS:
        found[f"{module}.{layer}.weight"] = (outgoing, incoming, 1) if "conv" in layer else (outgoing, incoming)
        found[f"{module}.{layer}.bias"] = (outgoing,)
        if norm:
            found |= {f"{module}.{norm}.{name}": (outgoing,) for name, _ in NORM}
            found[f"{module}.{norm}.num_batches_tracked"] = ()
    return found


def tensorflow_shapes() -> dict[str, tuple[int, ...]]:
    """The original's 126 variables."""
    found: dict[str, tuple[int, ...]] = {}
    for _, layer, norm, scope, incoming, outgoing in LAYERS:
        ones = (1, 1) if "conv" in layer else ()
        found[f"{scope}/weights"] = (*ones, incoming, outgoing)
        found[f"{scope}/biases"] = (outgoing,)
        if norm:
            found |= {f"{scope}/bn/{name}": (outgoing,) for _, name in NORM}
    return found
