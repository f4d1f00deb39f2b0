"""A Hugging Face semantic segmentation model as a source of masks (extra `hf`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError, UsageError
from pipeline.semantics.conventions import CLASSES, NONE


class HuggingFaceSegmenter:
    """A model folder, or a name that is already in the local cache (nothing is downloaded here).

    Its classes are matched by name with Cityscapes' classes; others become 255. Raises UsageError when transformers is
    missing, DataError when there is no such model or none of its classes has a known name.
    """

    def __init__(self, name: str) -> None:
        try:
            from transformers import AutoImageProcessor, AutoModelForSemanticSegmentation
        except ImportError:
            raise UsageError("Hugging Face masks need transformers: pip install 'auglidar[hf]'") from None
        try:
            self.processor = AutoImageProcessor.from_pretrained(name, local_files_only=True)
            model = AutoModelForSemanticSegmentation.from_pretrained(name, local_files_only=True)
        except (OSError, ValueError) as error:
            hint = "download it first with huggingface-cli, or give a folder"
            raise DataError(name, "a semantic segmentation model", str(error).splitlines()[0], hint) from None
        self.model: Any = model.eval()
        self.train_id_of_class = _train_ids(model.config.id2label, name)

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB -> (H, W) uint8 trainIds."""
        import torch

        with torch.inference_mode():
            inputs = self.processor(images=image, return_tensors="pt")
            logits = self.model(**inputs).logits
            full = torch.nn.functional.interpolate(logits, size=image.shape[:2], mode="bilinear", align_corners=False)
        return self.train_id_of_class[full[0].argmax(dim=0).numpy()]


def _train_ids(id2label: dict[int, str], where: str) -> NDArray[np.uint8]:
    """Class number of the model -> trainId, by name."""
    known = {name: train_id for train_id, name in enumerate(CLASSES)}
    table = np.full(max(id2label) + 1, NONE, np.uint8)
    for number, label in id2label.items():
        table[int(number)] = known.get(str(label).lower().replace("_", " "), NONE)
    if (table == NONE).all():
        found = ", ".join(list(id2label.values())[:5])
        raise DataError(where, f"classes named as in Cityscapes ({', '.join(CLASSES[:3])}, ...)", found)
    return table
