"""Any ONNX segmentation model as a source of masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError, UsageError
from pipeline.semantics.conventions import to_train_ids

_MEAN, _STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


class OnnxSegmenter:
    """A model from a float image (1, 3, H, W) to logits (1, C, h, w) or labels (1, h, w) as its first output.

    path        the .onnx file
    convention  what the class numbers (channels or labels) mean: cityscapes_trainIds, cityscapes_labelIds or kitti

    The image is given as RGB in [0, 1], normalised with ImageNet's mean and standard deviation, and scaled to the
    model's size when that is fixed. Raises UsageError when onnxruntime is missing, DataError for other models.
    """

    def __init__(self, path: Path, convention: str | None) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise UsageError("ONNX masks need onnxruntime: pip install 'auglidar[onnx]'") from None
        # Fails now, not at the first frame, when no convention is given.
        to_train_ids(np.zeros((1, 1), np.uint8), convention, path)
        if not path.is_file():
            raise DataError(path, "an ONNX model", "no such file")
        try:
            self.session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base class but this one
            raise DataError(path, "an ONNX model", str(error).splitlines()[0]) from error
        self.path, self.convention = path, convention
        self.input = self.session.get_inputs()[0]
        if len(self.input.shape) != 4 or self.input.shape[1] not in (3, "C", "channels", None):
            raise DataError(path, "an image input (1, 3, H, W)", f"{self.input.name} {self.input.shape}")

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB -> (H, W) uint8 trainIds."""
        height, width = image.shape[:2]
        fixed = [size if isinstance(size, int) else have for size, have in zip(self.input.shape[2:], (height, width))]
        scaled = image if tuple(fixed) == (height, width) else cv2.resize(image, (fixed[1], fixed[0]))
        values = ((scaled.astype(np.float32) / 255 - _MEAN) / _STD).transpose(2, 0, 1)[None]
        labels = self._labels(self.session.run(None, {self.input.name: np.ascontiguousarray(values)})[0])
        if labels.shape != (height, width):
            labels = cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)
        return to_train_ids(labels, self.convention, self.path)

    def _labels(self, output: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Logits or labels -> (h, w) uint8 class numbers."""
        if output.ndim == 4 and output.shape[1] > 1:
            return np.asarray(output[0].argmax(axis=0), dtype=np.uint8)
        if output.size == np.prod(output.shape[-2:]):
            return np.asarray(output.reshape(output.shape[-2:]), dtype=np.uint8)
        raise DataError(self.path, "logits (1, C, h, w) or labels (1, h, w)", f"an output of shape {output.shape}")
