"""The window of 352 x 1216 that ENet and PENet see of a frame, and the completer that cuts it out.

Both networks know where a pixel lies in that window, and take intrinsics in its pixels.

crop    "bottom"    the bottom of the frame, centred: how the networks were trained (KITTI benchmark)
        "top_left"  rows 0 to 351 and columns 0 to 1215: what the generator of VirConv and TED feeds
camera  "published" the constant that the published weights were trained with, whatever the frame and crop: with
                    "bottom" PENet's own evaluation, with "top_left" the data published for VirConv and TED
        "frame"     the frame's own K, shifted into the window: geometrically right, for networks trained so
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from completion.decoding import decode_output, require_decoding
from completion.inputs import scale_rgb
from completion.models import ModelSpec
from completion.models.geometric import WINDOW, position_map, published_intrinsics
from completion.types import CompletedDepth, DepthFrame, FloatMap

ARCHITECTURES = ("enet", "penet")


def window_corner(size: tuple[int, int], crop: str) -> tuple[int, int]:
    """Row and column in a frame of (height, width) of the window's top left pixel; below 0 for a smaller frame."""
    height, width = size
    return (height - WINDOW[0], round((width - WINDOW[1]) / 2)) if crop == "bottom" else (0, 0)


def window_intrinsics(K: NDArray[np.float64] | None, corner: tuple[int, int], camera: str) -> NDArray[np.float64]:
    """(3, 3) in pixels of the window. ValueError when the camera is the frame's and its K is missing."""
    if camera == "published":
        return published_intrinsics().numpy().astype(np.float64)
    if K is None:
        raise ValueError(
            "K: this network was set up with camera=frame, so it needs the camera matrix of every frame and this one "
            "has none; pass K, or set the network up with camera=published"
        )
    shifted = np.array(K, dtype=np.float64)
    shifted[:2, 2] -= corner[1], corner[0]
    return shifted


def batch_view(spec: ModelSpec, sparse: Tensor, places: Tensor, K: Tensor) -> tuple[Tensor, ...]:
    """What a network takes beside sparse (B, 1, h, w) and colours in training: (position, K), or nothing.

    places  (B, 2) row and column in the window; K (B, 3, 3) in pixels of the window, NaN where a frame has none
    ValueError as `window_intrinsics`.
    """
    if spec.architecture not in ARCHITECTURES:
        return ()
    if spec.arguments.get("camera", "published") == "published":
        K = published_intrinsics().to(sparse.device).expand(len(sparse), 3, 3)
    elif bool(torch.isnan(K).any()):
        window_intrinsics(None, (0, 0), "frame")
    return position_map(places, *sparse.shape[-2:]), K


class WindowCompleter:
    """Completes the window of a frame and leaves 0 (no depth) outside it; smaller frames are padded inside it.

    ValueError for a decoding that the network does not offer.
    """

    def __init__(self, model: nn.Module, spec: ModelSpec, device: str | torch.device, decoding: str) -> None:
        require_decoding(spec, decoding)
        self.device = torch.device(device)
        self.model = model.to(device=self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        self.spec, self.decoding = spec, decoding
        self.crop = str(spec.arguments.get("crop", "bottom"))
        self.camera = str(spec.arguments.get("camera", "published"))

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """One frame; see `infer.Completer`. ValueError for maps that are no DepthFrame and for a missing K."""
        frame = DepthFrame(image, sparse, None, K)
        corner = window_corner(frame.size, self.crop)
        rows, columns = (
            slice(max(0, first), min(size, first + extent)) for first, size, extent in zip(corner, frame.size, WINDOW)
        )
        place = rows.start - corner[0], columns.start - corner[1]
        intrinsics = torch.tensor(window_intrinsics(frame.K, corner, self.camera), dtype=torch.float32)
        depth = np.zeros(frame.size, np.float32)
        depth[rows, columns] = self._run(frame.sparse[rows, columns], frame.image[rows, columns], place, intrinsics)
        return CompletedDepth(depth)

    def _run(self, sparse: FloatMap, image: NDArray[np.uint8], place: tuple[int, int], K: Tensor) -> FloatMap:
        """The network on a part of the window at `place`, padded inside the window to multiples of 32."""
        height, width = sparse.shape
        missing = -height % self.spec.multiple_of, -width % self.spec.multiple_of
        top, left = min(missing[0], place[0]), min(missing[1], place[1])
        padding = (left, missing[1] - left, top, missing[0] - top)
        depths = F.pad(torch.tensor(sparse, device=self.device)[None, None], padding)
        colours = torch.tensor(image, device=self.device)[None].permute(0, 3, 1, 2)
        colours = F.pad(scale_rgb(colours, self.spec.rgb), padding, mode="replicate")
        places = torch.tensor([(place[0] - top, place[1] - left)], device=self.device)
        position = position_map(places, *depths.shape[-2:])
        with torch.inference_mode():
            outputs = self.model(
                depths / self.spec.depth_unit,
                colours.contiguous(memory_format=torch.channels_last),
                position,
                K.to(self.device)[None],
            )
            cut = outputs[0][:, :, top : top + height, left : left + width]
            found: FloatMap = decode_output(cut, self.spec, self.decoding)[0][0].cpu().numpy()
        return found
