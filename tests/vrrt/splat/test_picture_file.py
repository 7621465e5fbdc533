"""Files are read as any viewer shows them, or refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

import vrrt_jax

TURNS = Image.Transpose
STORED = {  # how a picture is stored that its EXIF orientation turns upright
    1: None,
    2: TURNS.FLIP_LEFT_RIGHT,
    3: TURNS.ROTATE_180,
    4: TURNS.FLIP_TOP_BOTTOM,
    5: TURNS.TRANSPOSE,
    6: TURNS.ROTATE_90,
    7: TURNS.TRANSVERSE,
    8: TURNS.ROTATE_270,
}


@pytest.fixture
def picture():
    """Smooth, not symmetric, and wider than high."""
    y, x = np.mgrid[:24, :32] / 32.0
    pixels = np.stack([0.2 + 0.8 * x, y, 0.5 * x + 0.3 * y], axis=-1)
    return Image.fromarray(np.round(255 * pixels).astype(np.uint8))


def unit(picture):
    return np.asarray(picture, np.float32) / 255.0


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("kind", ["png", "jpg", "tif", "webp"])
def test_pictures_are_turned_upright(tmp_path, picture, orientation, kind):
    how = STORED[orientation]
    stored = picture if how is None else picture.transpose(how)
    exif = Image.Exif()
    exif[0x112] = orientation
    lossy = {"quality": 100, "subsampling": 0} if kind == "jpg" else {}
    lossless = {"lossless": True} if kind == "webp" else {}
    stored.save(tmp_path / f"a.{kind}", exif=exif, **lossy, **lossless)
    read = vrrt_jax.read_image(tmp_path / f"a.{kind}")
    np.testing.assert_allclose(read, unit(picture), atol=0.02)


def test_kinds_of_pixels(tmp_path, picture):
    grey, file = picture.convert("L"), tmp_path / "a.png"
    as_rgb = unit(grey.convert("RGB"))
    sixteen = np.asarray(grey).astype(np.uint16) * 257
    for path in (file, tmp_path / "a.tif"):
        Image.fromarray(sixteen).save(path)
        np.testing.assert_allclose(vrrt_jax.read_image(path), as_rgb, atol=1e-6)
    netpbm = tmp_path / "a.pgm"
    netpbm.write_bytes(b"P5 32 24 65535\n" + sixteen.astype(">u2").tobytes())
    np.testing.assert_allclose(vrrt_jax.read_image(netpbm), as_rgb, atol=1e-6)
    twelve = (sixteen.astype(np.float64) / 65535 * 4095).round().astype(">u2")
    netpbm.write_bytes(b"P5 32 24 4095\n" + twelve.tobytes())
    np.testing.assert_allclose(vrrt_jax.read_image(netpbm), as_rgb, atol=1e-3)
    write_16_bit_rgb(file, np.asarray(picture))
    np.testing.assert_allclose(vrrt_jax.read_image(file), unit(picture), atol=1e-6)
    for mode, kind in (("L", "png"), ("P", "png"), ("P", "gif"), ("CMYK", "tif"), ("1", "png")):
        saved = picture.convert(mode)
        saved.save(tmp_path / f"b.{kind}")
        read = vrrt_jax.read_image(tmp_path / f"b.{kind}")
        np.testing.assert_allclose(read, unit(saved.convert("RGB")), atol=1e-6)


def test_kinds_of_transparency(tmp_path, picture):
    alpha = Image.fromarray(
        np.where(np.arange(32) < 10, 255, 0).astype(np.uint8)[None].repeat(24, 0)
    )
    masked, file = picture.copy(), tmp_path / "a.png"
    masked.putalpha(alpha)
    Image.merge("LA", (picture.convert("L"), alpha)).save(file)
    np.testing.assert_allclose(vrrt_jax.read_image(file)[..., 3], unit(alpha))
    indexed = masked.quantize(64)
    indexed.save(file)
    np.testing.assert_allclose(vrrt_jax.read_image(file), unit(indexed.convert("RGBA")))
    ones = np.asarray(masked).copy()
    ones[..., 3] //= 255
    Image.fromarray(ones).save(file)
    np.testing.assert_allclose(vrrt_jax.read_image(file), unit(masked))
    sixteen = np.asarray(picture.convert("L")).astype(np.uint16) * 257
    Image.fromarray(sixteen).save(file, transparency=int(sixteen[0, 0]))
    read = vrrt_jax.read_image(file)
    np.testing.assert_array_equal(read[..., 3], sixteen != sixteen[0, 0])


def write_16_bit_rgb(path, pixels):
    """A PNG of 16 bits a channel, which Pillow cannot write."""
    rows = (257 * pixels.astype(np.uint16)).astype(">u2")
    height, width = pixels.shape[:2]

    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    chunks = (chunk(b"IHDR", header), chunk(b"IDAT", data), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def test_what_cannot_be_read_rightly_is_refused(tmp_path, picture):
    frames = {"save_all": True, "append_images": [picture.rotate(180)]}
    for kind in ("gif", "png", "webp", "tif"):
        picture.save(tmp_path / f"a.{kind}", **frames)
        with pytest.raises(ValueError, match="has 2 frames; expected one"):
            vrrt_jax.read_image(tmp_path / f"a.{kind}")
    picture.save(tmp_path / "a.mpo", **frames)  # a photo and its preview
    assert vrrt_jax.read_image(tmp_path / "a.mpo").shape == (24, 32, 3)
    file = tmp_path / "b.tif"
    for wide in (np.float32, np.int32):
        Image.fromarray(np.ones((24, 32), wide)).save(file)
        with pytest.raises(ValueError, match="has pixels of the kind"):
            vrrt_jax.read_image(file)
    Image.fromarray(np.full((24, 32), 4095, np.uint16)).save(file)
    with pytest.raises(ValueError, match="16 bits, but its largest value is 4095 of 65535"):
        vrrt_jax.read_image(file)
    file.write_bytes(b"")
    with pytest.raises(ValueError, match="not a readable picture"):
        vrrt_jax.read_image(file)


def test_pictures_that_would_fill_the_memory_are_not_read(tmp_path):
    Image.new("1", (9000, 8000)).save(tmp_path / "large.png")
    with pytest.raises(ValueError, match="large.png' has 9000x8000 pixels; expected at most"):
        vrrt_jax.read_image(tmp_path / "large.png")
