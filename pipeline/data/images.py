"""Images from disk, with the checks that OpenCV leaves out: it fills the missing rows of a truncated file silently."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.base.files import read_bytes

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8"
# Larger than any camera of the field; a header that claims more is damage, and is refused before memory is taken.
MAX_PIXELS = 64_000_000
# JPEG markers that hold the frame size (SOF0-SOF15 without DHT, JPG, DAC); ITU-T T.81 table B.1.
_END_OF_IMAGE = 0xD9
_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of a PNG or JPEG file of any size; grey images are repeated over the three channels.

    Raises DataError when the file is missing, empty, truncated, too large or no image.
    """
    import cv2

    path = Path(path)
    data = read_bytes(path, "a PNG or JPEG image")
    check_complete(data, path)
    # Pixels belong to the calibration as they are stored: an EXIF orientation is for viewers.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise DataError(path, "a PNG or JPEG image", "data that cannot be decoded")
    if image.dtype == np.uint16:
        image = _eight_bits(image, path)
    return _with_red_first(image)


def _with_red_first(image: NDArray[Any]) -> NDArray[np.uint8]:
    """OpenCV's blue, green, red exchanged where they lie."""
    blue = image[:, :, 0].copy()
    image[:, :, 0] = image[:, :, 2]
    image[:, :, 2] = blue
    return image


def _eight_bits(image: NDArray[Any], path: Path) -> NDArray[np.uint8]:
    """The upper 8 of 16 bits. Raises DataError when nothing uses them: sensors give 10 to 14 bits."""
    largest = int(image.max())
    if 255 < largest < 2**14:
        bits = largest.bit_length()
        hint = f"multiply by {2 ** (16 - max(bits, 10))}, or store 8-bit pixels"
        raise DataError(path, "pixels of 8 or 16 bits", f"{bits}-bit data in a 16-bit file (largest {largest})", hint)
    return np.asarray(image >> 8 if largest > 255 else image, dtype=np.uint8)


def read_unchanged(path: str | Path, what: str) -> NDArray[Any]:
    """The pixels of a PNG file as stored (uint8 or uint16, (H, W) or (H, W, C) in OpenCV's channel order).

    Raises DataError when the file is missing, empty, truncated, too large or no PNG.
    """
    import cv2

    path = Path(path)
    data = read_bytes(path, what)
    if not data.startswith(PNG_SIGNATURE):
        raise DataError(path, what, f"a file starting with {data[:4]!r}")
    check_complete(data, path)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise DataError(path, what, "data that cannot be decoded")
    return np.asarray(pixels)


def image_size(path: str | Path) -> tuple[int, int]:
    """(height, width) in pixels from the header of a PNG or JPEG file; the pixels are not decoded."""
    path = Path(path)
    data = read_bytes(path, "a PNG or JPEG image")
    return _png_size(data, path) if data.startswith(PNG_SIGNATURE) else _jpeg_size(data, path)


def check_complete(data: bytes, path: Path) -> None:
    """Raises DataError unless `data` is a whole PNG (chunks, checksums, IEND) or JPEG (end marker) of sane size."""
    if data.startswith(PNG_SIGNATURE):
        _png_size(data, path)
        kinds = [kind for kind, _ in _png_chunks(data, path)]
        if not kinds or kinds[-1] != b"IEND":
            raise DataError(path, "a complete PNG image", f"a file that ends after {len(data)} bytes", _TRUNCATED)
    elif data.startswith(JPEG_SIGNATURE):
        _jpeg_size(data, path)
        if not _jpeg_ends(data):
            raise DataError(path, "a complete JPEG image", f"a file that ends after {len(data)} bytes", _TRUNCATED)
    else:
        raise DataError(path, "a PNG or JPEG image", f"a file starting with {data[:4]!r}")


_TRUNCATED = "it is truncated: copy or download it again"


def _png_chunks(data: bytes, path: Path) -> Iterator[tuple[bytes, int]]:
    """(kind, offset of its data) of each whole chunk of a PNG; stops at the first that runs over the end."""
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            return
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != checksum:
            raise DataError(path, "a PNG whose checksums agree", f"a damaged {kind!r} chunk at byte {position}")
        yield kind, position + 8
        if kind == b"IEND":
            return
        position = end


def _png_size(data: bytes, path: Path) -> tuple[int, int]:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise DataError(path, "a PNG with a header", f"{len(data)} bytes", _TRUNCATED)
    width, height = struct.unpack_from(">II", data, 16)
    return _sane_size(height, width, path)


def _jpeg_size(data: bytes, path: Path) -> tuple[int, int]:
    position = 2
    while data.startswith(JPEG_SIGNATURE) and position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return _sane_size(height, width, path)
        if marker == 0xFF or 0xD0 <= marker <= 0xD7:  # fill byte or restart marker: no length follows
            position += 1 if marker == 0xFF else 2
            continue
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    raise DataError(path, "a PNG or JPEG image", f"a file starting with {data[:4]!r} without an image size")


def _jpeg_ends(data: bytes) -> bool:
    """True when the image has its end marker; what cameras append behind it does not matter (ITU-T T.81 B.1.1)."""
    position, length = 2, len(data)
    while position + 1 < length:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= length:
            return False
        marker = data[position + 1]
        if marker == _END_OF_IMAGE:
            return True
        # Fill bytes, stuffed zeros and restart markers are followed by no length; segments (thumbnails in them) are.
        if marker == 0xFF:
            position += 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:
            position += 2
        elif position + 4 > length:
            return False
        else:
            position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return False


def _sane_size(height: int, width: int, path: Path) -> tuple[int, int]:
    if not 0 < height * width <= MAX_PIXELS:
        raise DataError(path, f"an image of 1 to {MAX_PIXELS:,} pixels", f"a header of {width} x {height}")
    return height, width
