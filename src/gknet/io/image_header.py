"""What an image file states before it is decoded: format, size, bit depth and number of pages.

An image is refused by its size before memory is taken for it, and its bit depth is not lost in the decoder.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
DEFLATE_RATIO = 1040
"""Deflate makes data 1032 times smaller at most: a PNG that is smaller than its size allows has a damaged header."""

_PNM = re.compile(rb"P([1-6])" + rb"(?:(?:\s|#[^\n]*\n)+(\d{1,10}))" * 2 + rb"(?:(?:\s|#[^\n]*\n)+(\d{1,5}))?")
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


@dataclass(frozen=True)
class ImageHeader:
    """The beginning of an image file.

    Attributes:
        width: in pixels.
        height: in pixels.
        white: the stored value of white, where the file states one that its decoder does not apply; else None.
        used_bits: how many bits of 16 are used, where the file states it but not whether they are the upper ones.
        has_pages: whether the file holds more images than one.
    """

    width: int
    height: int
    white: int | None = None
    used_bits: int | None = None
    has_pages: bool = False


def read_header(data: bytes) -> ImageHeader | None:
    """Of a JPEG, PNG, TIFF, BMP, WebP, GIF, PNM, JPEG 2000 or AVIF; None for anything else, or a damaged header."""
    try:
        for start, read in _READERS:
            if data.startswith(start):
                return read(data)
        if data[8:12] == b"WEBP":
            return _webp(data)
        return _boxed(data)
    except (struct.error, IndexError):
        return None


def _jpeg(data: bytes) -> ImageHeader | None:
    at = 2
    while data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:  # a filler, or a marker without a length
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_SIZES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return ImageHeader(width, height)
        at += 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    return None


def _png(data: bytes) -> ImageHeader | None:
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    if width * height * depth * _PNG_CHANNELS.get(colour, 1) > 8 * DEFLATE_RATIO * len(data):
        return None
    at, used_bits, has_pages = 8, None, False
    while data[at + 4 : at + 8] not in (b"IDAT", b""):
        length, name = struct.unpack_from(">I4s", data, at)
        if name == b"sBIT":
            used_bits = max(data[at + 8 : at + 8 + length], default=None)
        elif name == b"acTL":
            has_pages = struct.unpack_from(">I", data, at + 8)[0] > 1
        at += 12 + length
    return ImageHeader(width, height, used_bits=used_bits, has_pages=has_pages)


def _pnm(data: bytes) -> ImageHeader | None:
    found = _PNM.match(data)
    if found is None:
        return None
    bitmap = found[1] in b"14"
    return ImageHeader(int(found[2]), int(found[3]), None if bitmap or not found[4] else int(found[4]))


def _bmp(data: bytes) -> ImageHeader | None:
    old = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
    return ImageHeader(abs(width), abs(height))


def _gif(data: bytes) -> ImageHeader | None:
    """Blocks are walked until the second image; the first alone may have no end, as of a truncated file."""
    width, height = struct.unpack_from("<HH", data, 6)
    at, images = 13 + _colours(data[10]), 0
    while at < len(data) and images < 2:
        if data[at] == 0x2C:
            images += 1
            at += 11 + _colours(data[at + 9])
        elif data[at] == 0x21:
            at += 2
        else:
            break
        while at < len(data) and data[at]:
            at += 1 + data[at]
        at += 1
    return ImageHeader(width, height, has_pages=images > 1)


def _colours(flags: int) -> int:
    """Bytes of a GIF's table of colours."""
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


def _webp(data: bytes) -> ImageHeader | None:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return ImageHeader(width, height, has_pages=bool(data[20] & 2))
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return ImageHeader((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    width, height = struct.unpack_from("<HH", data, 26)
    return ImageHeader(width & 0x3FFF, height & 0x3FFF)


def _tiff(data: bytes) -> ImageHeader | None:
    order = "<" if data.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    at = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    tags, following = _tiff_page(data, order, big, at)
    if 256 not in tags or 257 not in tags:
        return None
    bits, white = tags.get(258, 1), tags.get(281)
    if 8 < bits < 16:  # OpenCV shifts them to the upper bits
        white = (2**bits - 1) << 16 - bits
    has_pages = False
    if following:
        has_pages = not _tiff_page(data, order, big, following)[0].get(254, 0) & 1  # bit 0: a smaller copy
    return ImageHeader(tags[256], tags[257], white, has_pages=has_pages)


def _tiff_page(data: bytes, order: str, big: bool, at: int) -> tuple[dict[int, int], int]:
    """The first value of each tag that is a short or long number, and where the next page is."""
    count_form, count_bytes, entry_bytes = ("Q", 8, 20) if big else ("H", 2, 12)
    count = min(struct.unpack_from(order + count_form, data, at)[0], 4096)
    tags: dict[int, int] = {}
    for entry in range(at + count_bytes, at + count_bytes + count * entry_bytes, entry_bytes):
        tag, form, values = struct.unpack_from(order + ("HHQ" if big else "HHI"), data, entry)
        if form in (3, 4) and values:
            letter = "H" if form == 3 else "I"
            place = entry + (12 if big else 8)
            if values * (2 if form == 3 else 4) > (8 if big else 4):  # the values are elsewhere
                place = struct.unpack_from(order + ("Q" if big else "I"), data, place)[0]
            tags[tag] = struct.unpack_from(order + letter, data, place)[0]
    after = at + count_bytes + count * entry_bytes
    following = struct.unpack_from(order + ("Q" if big else "I"), data, after)[0]
    return tags, following


def _boxed(data: bytes) -> ImageHeader | None:
    """JPEG 2000's ihdr box (height, width) and AVIF's ispe box (version and flags, width, height)."""
    if data[4:8] == b"jP  " and (at := data.find(b"ihdr", 0, 4096)) > 0:
        height, width = struct.unpack_from(">II", data, at + 4)
        return ImageHeader(width, height)
    if data[4:8] == b"ftyp" and (at := data.find(b"ispe", 0, 4096)) > 0:
        width, height = struct.unpack_from(">II", data, at + 8)
        return ImageHeader(width, height)
    return None


_READERS = (
    (b"\xff\xd8", _jpeg),
    (PNG_START, _png),
    (b"II\x2a\x00", _tiff),
    (b"MM\x00\x2a", _tiff),
    (b"II\x2b\x00", _tiff),
    (b"MM\x00\x2b", _tiff),
    (b"BM", _bmp),
    (b"GIF8", _gif),
    *((b"P%d" % kind, _pnm) for kind in range(1, 7)),
)
