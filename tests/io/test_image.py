"""Image files: exact or close round trips, and damaged files refused by name."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gknet.errors import GknetError
from gknet.io.image import is_whole_jpeg, read_image, read_image_file, read_mask, write_image, write_mask


@pytest.fixture
def rgb() -> np.ndarray:
    y, x = np.mgrid[:40, :60]
    return np.stack([4 * x, 6 * y, 255 - 4 * x], axis=-1).astype(np.uint8)


def test_png_round_trip_is_exact_and_rgb(tmp_path: Path, rgb: np.ndarray) -> None:
    write_image(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), rgb)


def test_jpeg_round_trip_is_close_and_quality_counts(tmp_path: Path, rgb: np.ndarray) -> None:
    write_image(tmp_path / "a.jpg", rgb, quality=95)
    write_image(tmp_path / "b.jpg", rgb, quality=20)
    back = read_image(tmp_path / "a.jpg")
    assert np.abs(back.astype(int) - rgb).mean() < 3
    assert (tmp_path / "b.jpg").stat().st_size < (tmp_path / "a.jpg").stat().st_size
    assert is_whole_jpeg(tmp_path / "a.jpg")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "b.jpg"]


def test_grey_pictures_become_rgb(tmp_path: Path, rgb: np.ndarray) -> None:
    write_mask(tmp_path / "m.png", rgb[..., 0] > 100)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), rgb[..., 0] > 100)
    assert read_image(tmp_path / "m.png").shape == (40, 60, 3)


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
@pytest.mark.parametrize("kept", [0.3, 0.9, 0.99])
def test_truncation_is_found(tmp_path: Path, rgb: np.ndarray, name: str, kept: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    write_image(tmp_path / name, noise)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(kept * len(data))])
    with pytest.raises(GknetError, match=f"{name}.*truncated"):
        read_image(tmp_path / name)
    assert not is_whole_jpeg(tmp_path / name)


def test_missing_empty_and_foreign_files(tmp_path: Path, rgb: np.ndarray) -> None:
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("no image")
    for name in ("missing.jpg", "empty.jpg", "text.jpg", "."):
        with pytest.raises(GknetError, match=str(tmp_path)):
            read_image(tmp_path / name)
    with pytest.raises(GknetError, match="uint8 RGB"):
        write_image(tmp_path / "x.png", rgb[..., 0])
    with pytest.raises(GknetError, match="encode"):
        write_image(tmp_path / "x.nonsense", rgb)


GREY = (np.arange(40 * 60).reshape(40, 60) % 251).astype(np.uint8)


def encoded(path: Path, pixels: np.ndarray) -> Path:
    done, data = cv2.imencode(path.suffix, pixels)
    assert done
    path.write_bytes(data.tobytes())
    return path


def by_pillow(path: Path, image: Image.Image, **options: Any) -> Path:
    image.save(path, **options)
    return path


def chunked(depth: int, rows: bytes, width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """A grey PNG with further chunks in front of its pixels."""
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)),
        *chunks,
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ]
    start = b"\x89PNG\r\n\x1a\n"
    return start + b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)


def tiff(values: bytes, width: int, height: int, bits: int, *tags: tuple[int, int]) -> bytes:
    """A grey little-endian TIFF of one strip."""
    own = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: len(values)}
    entries = sorted({**own, **dict(tags)}.items())
    page = b"".join(struct.pack("<HHII", tag, 3, 1, value) for tag, value in entries)
    start = struct.pack("<2sHI", b"II", 42, 8 + len(values))
    return start + values + struct.pack("<H", len(entries)) + page + struct.pack("<I", 0)


def close_to_grey(path: Path, bit_depth: int | None = None) -> bool:
    image = read_image(path, bit_depth)
    assert image.dtype == np.uint8
    return bool((np.abs(image.astype(int) - GREY[..., None]) <= 1).all())


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("bits", [10, 12, 14])
def test_bits_in_sixteen_are_scaled_by_the_option_or_refused(tmp_path: Path, suffix: str, bits: int) -> None:
    path = encoded(tmp_path / f"a{suffix}", GREY.astype(np.uint16) << (bits - 8))
    assert close_to_grey(path, bits)
    with pytest.raises(GknetError, match=f"does not state which is white.*--bit-depth {bits}"):
        read_image(path)
    with pytest.raises(GknetError, match="another bit depth"):
        read_image(path, bits - 1)
    with pytest.raises(GknetError, match="bit depth: expected 8 to 32"):
        read_image(path, 99)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_full_sixteen_bits_need_no_option(tmp_path: Path, suffix: str) -> None:
    assert close_to_grey(encoded(tmp_path / f"a{suffix}", GREY.astype(np.uint16) * 257))


@pytest.mark.parametrize("white", [15, 200, 255, 1000, 4095, 65535])
@pytest.mark.parametrize("comment", [b"", b"# a comment\n"])
def test_the_maximum_of_a_pgm_is_its_white(tmp_path: Path, white: int, comment: bytes) -> None:
    values = np.rint(np.linspace(0, white, 256)).astype(">u2" if white > 255 else np.uint8)
    (tmp_path / "a.pgm").write_bytes(b"P5\n%s16 16\n%d\n" % (comment, white) + values.tobytes())
    image = read_image(tmp_path / "a.pgm")
    np.testing.assert_allclose(image[..., 0].ravel(), np.rint(values * (255 / white)), atol=1)
    assert image.max() == 255


def test_sbit_of_a_png_is_its_depth_scaled_or_not(tmp_path: Path) -> None:
    """The standard asks for samples scaled to 16 bits; cameras' writers often leave them as they are."""
    for name, values in (("plain", GREY.astype(">u2") << 4), ("scaled", GREY.astype(">u2") << 8)):
        rows = b"".join(b"\0" + row.tobytes() for row in values.astype(">u2"))
        (tmp_path / f"{name}.png").write_bytes(chunked(16, rows, 60, 40, (b"sBIT", b"\x0c")))
        assert close_to_grey(tmp_path / f"{name}.png")


def test_a_tiff_states_its_depth(tmp_path: Path) -> None:
    values = GREY.astype("<u2") << 4
    (tmp_path / "max.tif").write_bytes(tiff(values.tobytes(), 60, 40, 16, (281, 4095)))
    assert close_to_grey(tmp_path / "max.tif")
    packed = int("".join(f"{value:012b}" for value in values.ravel()), 2).to_bytes(60 * 40 * 12 // 8, "big")
    (tmp_path / "packed.tif").write_bytes(tiff(packed, 60, 40, 12))
    assert close_to_grey(tmp_path / "packed.tif")


def test_floats_have_one_as_white_or_the_option(tmp_path: Path) -> None:
    assert close_to_grey(encoded(tmp_path / "unit.tif", (GREY / 255).astype(np.float32)))
    counts = encoded(tmp_path / "counts.tif", (GREY * 16.0).astype(np.float32))
    assert close_to_grey(counts, 12)
    with pytest.raises(GknetError, match="--bit-depth 12"):
        read_image(counts)
    for bad in (np.nan, -1, np.inf):
        with pytest.raises(GknetError, match="expected brightness"):
            read_image(encoded(tmp_path / "bad.tif", np.full((4, 4), bad, dtype=np.float32)))


def test_a_black_picture_needs_no_white(tmp_path: Path) -> None:
    assert read_image(encoded(tmp_path / "a.png", np.zeros((4, 6), np.uint16))).shape == (4, 6, 3)


def test_palette_grey_alpha_and_cmyk(tmp_path: Path, rgb: np.ndarray) -> None:
    picture = Image.fromarray(rgb)
    palette = picture.quantize(16)
    for suffix in ("png", "gif", "bmp", "tif"):
        path = by_pillow(tmp_path / f"p.{suffix}", palette)
        np.testing.assert_array_equal(read_image(path), np.array(palette.convert("RGB")))
    alpha = Image.fromarray(np.dstack([rgb, rgb[..., 0]]))
    np.testing.assert_array_equal(read_image(by_pillow(tmp_path / "a.png", alpha)), rgb)
    np.testing.assert_array_equal(read_image(by_pillow(tmp_path / "g.png", Image.fromarray(GREY)))[..., 1], GREY)
    one_bit = by_pillow(tmp_path / "b.tif", Image.fromarray(GREY > 100))
    np.testing.assert_array_equal(read_image(one_bit)[..., 0], (GREY > 100) * 255)
    cmyk = by_pillow(tmp_path / "c.jpg", picture.convert("CMYK"), quality=95)
    assert np.abs(read_image(cmyk).astype(int) - np.array(Image.open(cmyk).convert("RGB"))).max() <= 2


def test_the_sensors_own_orientation(tmp_path: Path, rgb: np.ndarray) -> None:
    """A rotation flag would turn the pixels and not the camera matrix."""
    exif = Image.Exif()
    exif[0x112] = 6
    path = by_pillow(tmp_path / "a.jpg", Image.fromarray(rgb), exif=exif)
    assert read_image(path).shape == rgb.shape


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.bmp", "a.tif", "a.gif"])
def test_bytes_after_the_end_are_ignored(tmp_path: Path, rgb: np.ndarray, name: str) -> None:
    path = by_pillow(tmp_path / name, Image.fromarray(rgb))
    before = read_image(path)
    path.write_bytes(path.read_bytes() + bytes(20000) + b"more")
    np.testing.assert_array_equal(read_image(path), before)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.bmp", "a.tif", "a.gif", "a.ppm", "a.jp2"])
@pytest.mark.parametrize("kept", [0.0005, 0.3, 0.99])
def test_every_kind_of_truncated_file_is_refused_in_silence(
    tmp_path: Path, name: str, kept: float, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    path = by_pillow(tmp_path / name, Image.fromarray(noise))
    data = path.read_bytes()
    path.write_bytes(data[: max(3, int(kept * len(data)))])
    with pytest.raises(GknetError, match=name):
        read_image(path)
    assert "ERROR" not in capfd.readouterr().err


@pytest.mark.parametrize("name", ["a.tif", "a.gif", "a.webp", "a.png"])
def test_the_first_of_several_pages(tmp_path: Path, rgb: np.ndarray, name: str) -> None:
    first, others = Image.fromarray(rgb), [Image.fromarray(255 - rgb), Image.fromarray(rgb // 2)]
    options: dict[str, Any] = {"lossless": True} if name == "a.webp" else {}
    file = read_image_file(by_pillow(tmp_path / name, first, save_all=True, append_images=others, **options))
    assert file.has_more_pages
    assert np.abs(file.image.astype(int) - rgb).mean() < 20
    assert not read_image_file(by_pillow(tmp_path / f"one-{name}", first)).has_more_pages


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif", "a.pgm", "a.webp", "a.jpg", "a.gif", "a.jp2"])
def test_too_many_pixels_are_refused_by_the_header(
    tmp_path: Path, rgb: np.ndarray, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = by_pillow(tmp_path / name, Image.fromarray(rgb if name != "a.pgm" else GREY))
    monkeypatch.setattr("gknet.io.image.MOST_PIXELS", 40 * 60)
    assert read_image(path).shape == (40, 60, 3)
    monkeypatch.setattr("gknet.io.image.MOST_PIXELS", 40 * 60 - 1)
    monkeypatch.setattr("gknet.io.image.cv2.imdecode", None)
    with pytest.raises(GknetError, match="expected 2399 pixels at most, got 60 x 40"):
        read_image(path)


def test_a_bomb_takes_no_memory(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.png"
    bomb.write_bytes(chunked(8, b"\0", 30000, 30000) + bytes(10**6))
    with pytest.raises(GknetError, match="30000 x 30000"):
        read_image(bomb)
    bomb.write_bytes(chunked(16, b"\0", 10000, 10000))
    with pytest.raises(GknetError, match="damaged"):
        read_image(bomb)


def test_the_best_compression_of_a_png_is_read(tmp_path: Path) -> None:
    rows = zlib.compress(bytes(4001 * 4000), 9)
    assert 4000 * 4000 / len(rows) > 1000
    (tmp_path / "a.png").write_bytes(chunked(8, bytes(4001 * 4000), 4000, 4000))
    assert read_image(tmp_path / "a.png").shape == (4000, 4000, 3)


@pytest.mark.parametrize("name", ["a:b.png", "c%03d.png", "é ü.png", os.fsdecode(b"caf\xe9.png"), "[1].png"])
def test_every_name(tmp_path: Path, rgb: np.ndarray, name: str) -> None:
    write_image(tmp_path / name, rgb)
    np.testing.assert_array_equal(read_image(tmp_path / name), rgb)


def test_one_pixel_and_a_pipe(tmp_path: Path, rgb: np.ndarray) -> None:
    write_image(tmp_path / "a.png", rgb[:1, :1])
    assert read_image(tmp_path / "a.png").shape == (1, 1, 3)
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(GknetError, match="a pipe or a device"):
        read_image(tmp_path / "pipe.png")


def test_masks_of_sixteen_bits_keep_small_numbers(tmp_path: Path) -> None:
    ids = np.array([[0, 1], [2, 300]], np.uint16)
    np.testing.assert_array_equal(read_mask(encoded(tmp_path / "m.png", ids)), ids > 0)


@given(st.data())
def test_a_mutated_file_is_a_picture_or_one_line(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["a.jpg", "a.png", "a.webp", "a.bmp", "a.tif", "a.gif", "a.ppm"]))
    path = by_pillow(tmp_path_factory.mktemp("mutated") / name, Image.fromarray(GREY).convert("RGB"))
    body = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, min(len(body) - 1, data.draw(st.sampled_from([40, 10**6])))))
        body[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    path.write_bytes(body)
    try:
        assert read_image(path).dtype == np.uint8
    except GknetError as error:
        assert str(path) in str(error)  # noqa: PT017  (both ends are right)
