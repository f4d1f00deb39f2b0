"""The frames of a run: which data set, in which folder, and which of its frames."""

from __future__ import annotations

from pathlib import Path

from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.data import Dataset, open_dataset
from pipeline.run_folder.config import Config


def has_points(dataset: Dataset) -> bool:
    """True when the frames of the data set come with LiDAR points, or with sparse depth and labelled objects."""
    if len(dataset) == 0:
        return True
    frame = dataset[0]
    return frame.has("points") or (frame.has("sparse_depth") and frame.has("labels"))


def data_root(config: Config, run: RunFolder) -> Path:
    """The folder frames are read from. Raises UsageError when a data set needs one and none is given."""
    if config.data.root is not None:
        return Path(config.data.root)
    if config.data.name == "synthetic":
        return run.root / "data"
    raise UsageError(f"data set {config.data.name} needs a folder: give --data DIR or data.root in the configuration")


def reader_name(config: Config) -> str:
    """The reader of the data set; synthetic data is written in a public layout and read by that layout's reader."""
    if config.data.name != "synthetic":
        return config.data.name
    layout = str(config.synth.library.get("layout", "kitti"))
    return {"kitti": "kitti_object"}.get(layout, layout)


def open_frames(config: Config, run: RunFolder) -> Dataset:
    """The frames of the run, selected by `data.frames`.

    A name like `val` finds ROOT/ImageSets/val.txt. Raises UsageError when there is no frame.
    """
    root = data_root(config, run)
    dataset = open_dataset(reader_name(config), root, config.data.columns, config.data.keep_empty)
    if dataset.refusal:
        raise UsageError(dataset.refusal)
    frames = config.data.frames
    if frames is None:
        return dataset
    split = root / "ImageSets" / f"{frames}.txt"
    selected = dataset.select(split if frames.isidentifier() and split.is_file() else frames)
    if not len(selected):
        raise UsageError(f"{root}: no frame is left of {len(dataset)} by the selection {frames!r}")
    return selected
