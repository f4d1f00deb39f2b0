"""NYU Depth v2: reader of the labelled .mat file, of h5 trees and of plain folders.

    labelled  nyu_depth_v2_labeled.mat (HDF5): images (N, 3, 640, 480), depths (N, 640, 480) in metres, both transposed
    h5        {train,val,...}/SCENE/*.h5 with rgb (3, H, W) uint8 and depth (H, W) float32 metres
    folders   .../FRAME/{rgb.jpg|png, depth*.png} with 16-bit depth in millimetres, one folder per frame, at any depth

`open_nyuv2` gives the protocol of the thesis: 640 x 480 halved, centre crop 304 x 208 (width x height), and 500 samples
of the depth as input. `open_nyuv2_full` gives the frames as they are stored. Sources: Silberman et al. 2012; Ma and
Karaman 2018 (500 samples).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError, UsageError
from pipeline.data.dataset import Dataset
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image, read_unchanged
from pipeline.data.kitti_depth import camera_only
from pipeline.geometry.calibration import Calibration

Loaders = dict[str, Callable[[], Any]]

# Depth camera registered to colour, 640 x 480 (toolbox of the data set).
K_FULL = np.array([[518.857901, 0.0, 325.582449], [0.0, 519.469611, 253.736166], [0.0, 0.0, 1.0]])
CROP = (208, 304)
SAMPLES = 500
_LABELLED = "nyu_depth_v2_labeled.mat"


def open_nyuv2(root: str | Path, samples: int = SAMPLES, seed: int = 0) -> Dataset:
    """Frames by the 304 x 208 protocol: half size, centre crop, `samples` random depth values as `sparse_depth`.

    The samples of a frame depend on (seed, id) only. Raises UsageError when no frame is found.
    """
    full = open_nyuv2_full(root)
    opener = partial(_open_protocol, full.open, samples, seed)
    return Dataset(full.ids, opener, "nyuv2", full.root)


def open_nyuv2_full(root: str | Path) -> Dataset:
    """Frames as stored (image, target_depth, calibration), sorted by id: .mat, h5 tree or one folder per frame."""
    folder = Path(root)
    labelled = folder if folder.suffix == ".mat" else folder / _LABELLED
    if labelled.is_file():
        ids = [f"{index:04d}" for index in range(_labelled_count(labelled))]
        return Dataset(tuple(ids), partial(_open_labelled, labelled), "nyuv2", str(folder))
    trees = sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.rglob("*.h5"))
    if trees:
        return Dataset(tuple(trees), partial(_open_h5, folder), "nyuv2", str(folder))
    plain = sorted({path.parent.relative_to(folder).as_posix() for path in folder.glob("*/**/rgb.*")})
    if plain:
        return Dataset(tuple(plain), partial(_open_plain, folder), "nyuv2", str(folder))
    raise UsageError(f"{folder}: no NYU Depth v2 frame found (expected {_LABELLED}, SCENE/*.h5 or FRAME/rgb.jpg)")


def _frame(frame_id: str, where: Path, image: Callable[[], Any], depth: Callable[[], Any]) -> Frame:
    loaders: Loaders = {"image": image, "target_depth": depth, "calibration": partial(camera_only, K_FULL)}
    return Frame(frame_id, loaders, str(where))


def _h5_read(path: Path, name: str, read: Callable[[Any], Any]) -> Any:
    """What `read` takes from one array of an HDF5 file. UsageError without h5py, DataError on damage."""
    try:
        import h5py
    except ModuleNotFoundError:
        raise UsageError("reading NYU Depth v2 .mat and .h5 files needs h5py: pip install 'auglidar[nyu]'") from None
    try:
        with h5py.File(path, "r") as file:
            if name not in file:
                raise DataError(path, f"an array '{name}'", ", ".join(file) or "an empty file")
            return read(file[name])
    except OSError as error:
        raise DataError(path, "an HDF5 file", str(error)) from None


def _h5_array(path: Path, name: str, index: int | None) -> NDArray[Any]:
    """One array of an HDF5 file (one row of it with `index`)."""
    return np.asarray(_h5_read(path, name, lambda array: array[() if index is None else index]))


def _labelled_count(path: Path) -> int:
    return int(_h5_read(path, "images", lambda array: array.shape[0]))


def _open_labelled(path: Path, frame_id: str) -> Frame:
    index = int(frame_id)
    # MATLAB stores column by column: (3, W, H) and (W, H) become (H, W, 3) and (H, W).
    return _frame(
        frame_id,
        path,
        lambda: np.ascontiguousarray(_h5_array(path, "images", index).transpose(2, 1, 0)),
        lambda: np.ascontiguousarray(_h5_array(path, "depths", index).T, dtype=np.float32),
    )


def _open_h5(root: Path, frame_id: str) -> Frame:
    path = root / f"{frame_id}.h5"
    return _frame(
        frame_id,
        root,
        lambda: np.ascontiguousarray(_h5_array(path, "rgb", None).transpose(1, 2, 0)),
        lambda: np.ascontiguousarray(_h5_array(path, "depth", None), dtype=np.float32),
    )


def _open_plain(root: Path, frame_id: str) -> Frame:
    folder = root / frame_id
    image = next(iter(sorted(folder.glob("rgb.*"))), folder / "rgb.png")
    depth = next(iter(sorted(folder.glob("depth*.png"))), folder / "depth.png")
    frame = _frame(frame_id, root, partial(read_image, image), partial(read_millimetres, depth))
    loaders: Loaders = {**frame.loaders, "image_size": partial(image_size, image)}
    return Frame(frame_id, loaders, str(root))


def read_millimetres(path: str | Path) -> NDArray[np.float32]:
    """(H, W) float32 metres from a 16-bit PNG in millimetres, 0 = none."""
    code = read_unchanged(path, "a 16-bit depth PNG in millimetres")
    if code.dtype != np.uint16 or code.ndim != 2:
        raise DataError(path, "a one-channel 16-bit PNG in millimetres", f"shape {code.shape} {code.dtype}")
    return code.astype(np.float32) / np.float32(1000)


# ---- protocol -----------------------------------------------------------------------------------------------------


def _open_protocol(open_full: Callable[[str], Frame], samples: int, seed: int, frame_id: str) -> Frame:
    full = open_full(frame_id)

    def target() -> NDArray[np.float32]:
        return centre_crop(full.target_depth[::2, ::2])

    def sparse() -> NDArray[np.float32]:
        return sample_depth(target(), samples, seed, frame_id)

    loaders: Loaders = {
        "image": lambda: centre_crop(halve_image(full.image)),
        "image_size": lambda: CROP,
        "target_depth": target,
        "sparse_depth": sparse,
        "calibration": lambda: protocol_calibration(full.image_size),
    }
    return Frame(frame_id, loaders, full.where)


def halve_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(2H, 2W, 3) -> (H, W, 3), each pixel the mean of four. Depth is not averaged: that would invent points."""
    import cv2

    height, width = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def centre_crop(array: NDArray[Any]) -> NDArray[Any]:
    """(H, W, ...) -> (208, 304, ...), the middle. Raises DataError when the array is smaller."""
    top, left = (array.shape[0] - CROP[0]) // 2, (array.shape[1] - CROP[1]) // 2
    if top < 0 or left < 0:
        raise DataError("NYU Depth v2 protocol", "a half-size frame of 304 x 208 or more", f"shape {array.shape}")
    return np.ascontiguousarray(array[top : top + CROP[0], left : left + CROP[1]])


def protocol_calibration(full_size: tuple[int, int]) -> Calibration:
    """Camera matrix of the protocol: halved, then moved by the crop's corner (8 columns and 16 rows at 640 x 480)."""
    K = K_FULL.copy()
    K[:2] /= 2
    top, left = (full_size[0] // 2 - CROP[0]) // 2, (full_size[1] // 2 - CROP[1]) // 2
    return camera_only(K).cropped(top, left)


def sample_depth(target: NDArray[np.float32], samples: int, seed: int, frame_id: str) -> NDArray[np.float32]:
    """`samples` values of a depth map, drawn without replacement from its valid pixels (all when there are fewer).

    Seeded by (seed, crc32 of the frame id): the same for every run, worker and machine.
    """
    rng = np.random.default_rng([seed, zlib.crc32(frame_id.encode("utf-8"))])
    valid = np.flatnonzero(target)
    chosen = rng.choice(valid, size=min(samples, len(valid)), replace=False)
    sparse = np.zeros_like(target)
    sparse.flat[chosen] = target.flat[chosen]
    return sparse
