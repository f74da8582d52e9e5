"""Image files: RGB uint8 arrays in and out, with damaged files refused by name.

- Pixels come as the sensor stored them: an EXIF rotation is ignored, since it would not turn the camera matrix.
- Grey, palette and CMYK images become RGB; transparency is dropped (a TIFF's is drawn on black by its decoder).
- More than 8 bits are scaled by the white that the file states (a PNM's maximum, a PNG's sBIT, a TIFF's BitsPerSample
  or MaxSampleValue); without one, 16-bit values that use the uppermost bit have 65535 as white, floats up to 1 have 1,
  and other files are refused unless a bit depth is given.
- Bytes after the end of the image are ignored.
- Of a file with several pages or an animation the first page is read.
- More than `MOST_PIXELS` are refused by the header, before memory is taken for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.io.atomic import write_bytes
from gknet.io.image_header import ImageHeader, read_header
from gknet.io.opencv import checked_file, quiet

MOST_PIXELS = 200_000_000
"""200 megapixels, 0.6 GB as RGB; the largest sensors have 150."""

MOST_BYTES = 2**31 - 1
BIT_DEPTHS = range(8, 33)
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True, eq=False)
class ImageFile:
    """What a file holds.

    Attributes:
        image: (h, w, 3) RGB, pixels as the sensor stored them.
        has_more_pages: whether the file holds more images than this one.
    """

    image: UInt8[ndarray, "h w 3"]
    has_more_pages: bool


def read_image(path: str | Path, bit_depth: int | None = None) -> UInt8[ndarray, "h w 3"]:
    """The image as (h, w, 3) RGB, see `read_image_file`."""
    return read_image_file(path, bit_depth).image


def read_image_file(path: str | Path, bit_depth: int | None = None) -> ImageFile:
    """The image of a file.

    Args:
        path: of an image file.
        bit_depth: how many bits white has, for files of more than 8 bits that do not state it. It goes before what a
            file states.

    Raises:
        GknetError: the file cannot be read or decoded, is truncated, too large, or its white is not known.
    """
    if bit_depth is not None and bit_depth not in BIT_DEPTHS:
        raise GknetError(f"bit depth: expected {BIT_DEPTHS[0]} to {BIT_DEPTHS[-1]}, got {bit_depth}")
    path = Path(path)
    pixels, header = _decoded(path)
    eight = _eight_bits(path, pixels, header, bit_depth)
    channels = 1 if eight.ndim == 2 else eight.shape[2]
    return ImageFile(cv2.cvtColor(eight, _TO_RGB[channels]), header.has_pages)


def read_mask(path: str | Path) -> Bool[ndarray, "h w"]:
    """A mask stored as grey levels, 0 for no and anything else for yes."""
    pixels, _ = _decoded(Path(path))
    return pixels > 0 if pixels.ndim == 2 else np.any(pixels[..., :3] > 0, axis=2)


def _file_bytes(path: Path) -> bytes:
    """Read by Python: OpenCV takes no name that is not UTF-8."""
    size = checked_file(path, "image file").st_size
    if size > MOST_BYTES:
        raise GknetError(f"{path}: expected an image of 2 GiB at most, got {size / 2**30:.1f} GiB")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise GknetError(f"{path}: cannot read the image ({error.strerror})") from error
    if not data:
        raise GknetError(f"{path}: expected an image, got an empty file")
    return data


def _decoded(path: Path) -> tuple[ndarray, ImageHeader]:
    """Pixels as the file has them, (h, w) or (h, w, 3 or 4) in OpenCV's order of channels."""
    data = _file_bytes(path)
    header = read_header(data)
    if header is None:
        raise GknetError(f"{path}: expected an image (JPEG, PNG, TIFF ...), got something else or a damaged one")
    if header.width * header.height > MOST_PIXELS:
        raise GknetError(
            f"{path}: expected {MOST_PIXELS} pixels at most, got {header.width} x {header.height}; reduce it first"
        )
    try:
        with quiet():
            pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise GknetError(f"{path}: the image cannot be decoded ({' '.join(str(error.err).split())[:80]})") from error
    if pixels is None:
        size = f"{len(data)} bytes"
        raise GknetError(
            f"{path}: the image is truncated, damaged or of an unknown kind ({size}); copy or render it again"
        )
    return pixels, header


def _eight_bits(path: Path, pixels: ndarray, header: ImageHeader, bit_depth: int | None) -> ndarray:
    """The pixels as uint8, scaled by their white."""
    if pixels.dtype == np.uint8 and header.white in (None, 255):
        return pixels
    low, high = float(pixels.min()), float(pixels.max())
    if not np.isfinite(low + high) or low < 0:
        raise GknetError(f"{path}: expected brightness from 0 up, got {low:g} to {high:g}; convert it to 8 or 16 bits")
    if high == 0:
        return np.zeros(pixels.shape, np.uint8)
    white = header.white if pixels.dtype == np.uint8 else _white(pixels.dtype, header, bit_depth, high)
    if white is None:
        raise GknetError(
            f"{path}: {pixels.dtype} values up to {high:g}, and the file does not state which is white; give the bit "
            f"depth of the camera, --bit-depth {min(max(9, int(high).bit_length()), BIT_DEPTHS[-1])} or what it is"
        )
    if high > white:
        raise GknetError(f"{path}: expected values up to {white:g}, its white, got {high:g}; give another bit depth")
    return cv2.convertScaleAbs(pixels, alpha=255 / white)


def _white(dtype: np.dtype, header: ImageHeader, bit_depth: int | None, high: float) -> float | None:
    """The value of white in an image of more than 8 bits, or None when nothing states it."""
    if bit_depth is not None:
        return float(2**bit_depth - 1)
    if header.white is not None:
        return float(header.white)
    if header.used_bits is not None:  # PNG asks for samples that are scaled to 16 bits; not every writer does that
        return float(2**header.used_bits - 1 if high < 2**header.used_bits else 65535)
    if np.issubdtype(dtype, np.floating):
        return 1.0 if high <= 1 else None
    return 65535.0 if 2**15 <= high < 2**16 else None


def _encoded(path: Path, pixels: ndarray, parameters: list[int]) -> bytes:
    try:
        done, data = cv2.imencode(path.suffix.lower(), pixels, parameters)
    except cv2.error as error:
        raise GknetError(f"{path}: cannot encode the image as '{path.suffix}' ({error.err})") from error
    if not done:
        raise GknetError(f"{path}: cannot encode the image as '{path.suffix}'")
    return data.tobytes()


def write_image(path: str | Path, rgb: UInt8[ndarray, "h w 3"], quality: int = 95) -> None:
    """Write an image.

    Args:
        path: the suffix (.jpg, .png ...) decides the format.
        rgb: (h, w, 3) RGB.
        quality: JPEG's, 1 to 100.

    Raises:
        GknetError: the array is no image, or the format cannot hold it.
    """
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
