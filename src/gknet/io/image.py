"""Image files: RGB uint8 arrays in and out, with damaged files refused by name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.io.atomic import write_bytes

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG", b"IEND"
TAIL_BYTES = 4096


def _file_bytes(path: Path) -> bytes:
    """The bytes of a file whose end is there: decoders fill a truncated picture with grey and say nothing."""
    if not path.is_file():
        raise GknetError(f"{path}: no such image file")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise GknetError(f"{path}: cannot read the image ({error.strerror})") from error
    if not data:
        raise GknetError(f"{path}: expected an image, got an empty file")
    for start, end in ((JPEG_START, JPEG_END), (PNG_START, PNG_END)):
        if data.startswith(start) and end not in data[-TAIL_BYTES:]:
            raise GknetError(f"{path}: the image is truncated after {len(data)} bytes; copy or render it again")
    return data


def _decoded(path: Path, flags: int) -> ndarray:
    data = _file_bytes(path)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise GknetError(f"{path}: the image cannot be decoded ({error.err})") from error
    if pixels is None:
        raise GknetError(f"{path}: expected an image (JPEG, PNG, TIFF ...), got something else")
    return pixels


def read_image(path: str | Path) -> UInt8[ndarray, "h w 3"]:
    """The picture as RGB, pixels as stored (a rotation flag is ignored: it would not turn the camera matrix)."""
    return _decoded(Path(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)


def read_mask(path: str | Path) -> Bool[ndarray, "h w"]:
    """A mask stored as grey levels, 0 for no and anything else for yes."""
    return _decoded(Path(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) > 0


def _encoded(path: Path, pixels: ndarray, parameters: list[int]) -> bytes:
    try:
        done, data = cv2.imencode(path.suffix.lower(), pixels, parameters)
    except cv2.error as error:
        raise GknetError(f"{path}: cannot encode the image as '{path.suffix}' ({error.err})") from error
    if not done:
        raise GknetError(f"{path}: cannot encode the image as '{path.suffix}'")
    return data.tobytes()


def write_image(path: str | Path, rgb: UInt8[ndarray, "h w 3"], quality: int = 95) -> None:
    """Write by the suffix (.jpg, .png ...); `quality` is JPEG's, 1 to 100."""
    path = Path(path)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise GknetError(f"{path}: expected uint8 RGB of shape (h, w, 3), got {rgb.dtype} {rgb.shape}")
    bgr = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, int(quality)] if path.suffix.lower() in (".jpg", ".jpeg") else []
    write_bytes(path, _encoded(path, bgr, parameters))


def write_mask(path: str | Path, mask: Bool[ndarray, "h w"]) -> None:
    """Write a mask as a PNG of 0 and 255."""
    path = Path(path)
    write_bytes(path, _encoded(path, mask.astype(np.uint8) * 255, []))


def is_whole_jpeg(path: str | Path) -> bool:
    """Whether the file is there with a JPEG's first and last bytes; nothing is decoded."""
    try:
        with open(path, "rb") as file:
            start = file.read(2)
            file.seek(-2, 2)
            return start == JPEG_START and file.read(2) == JPEG_END
    except OSError:
        return False
