"""Goal images as files: what any viewer shows of them."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from vrrt_jax.core.pictures import open_picture
from vrrt_jax.splat.pixels import unit_pixels

MOST_PIXELS = 1 << 26  # of a picture, as of one of 8192x8192
STILL = ("JPEG", "MPO")  # formats whose further frames are only previews of the first
EIGHT_BITS = (
    *("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "HSV"),
)  # Pillow's modes that it converts to colors rightly


def read_image(path: str | Path) -> np.ndarray:
    """Read a picture as float32 (H, W, 3) or, with transparency, (H, W, 4), in [0, 1].

    It is turned as its EXIF orientation says. A mask that is 0 and 1 of 255 is scaled.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a picture, or truncated, or animated, or of more than 16 bits.
    """
    try:
        with open_picture(path) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                raise ValueError(
                    f"'{path}' has {picture.width}x{picture.height} pixels; expected at most "
                    f"{MOST_PIXELS}: make it smaller"
                )
            frames = getattr(picture, "n_frames", 1)
            if frames > 1 and picture.format not in STILL:
                raise ValueError(
                    f"'{path}' has {frames} frames; expected one: save the frame that is the goal "
                    "as a PNG"
                )
            pixels = _decoded(ImageOps.exif_transpose(picture), path, picture.format == "PPM")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"no picture: {error}; vrrt render makes goal images") from None
    except (
        UnidentifiedImageError,
        OSError,
        SyntaxError,
        EOFError,
        Image.DecompressionBombError,
        OverflowError,
    ) as error:
        raise ValueError(f"'{path}' is not a readable picture: {error}") from None
    return unit_pixels(pixels, f"'{path}'")


def _decoded(picture: Image.Image, path: str | Path, is_pgm: bool) -> np.ndarray:
    """Pixels (H, W, C) in 8 bits, or (H, W) or (H, W, 2) in 16 bits, of a picture."""
    transparent = picture.info.get("transparency")
    # Pillow widens the 16 bits of a PGM file to 32.
    if picture.mode.startswith("I;16") or (picture.mode == "I" and is_pgm):
        grey = np.asarray(picture).astype(np.uint16)
        if transparent is None:
            return grey
        opaque = np.where(grey == transparent, 0, np.iinfo(np.uint16).max).astype(np.uint16)
        return np.stack([grey, grey, grey, opaque], axis=-1)
    if picture.mode not in EIGHT_BITS:
        raise ValueError(
            f"'{path}' has pixels of the kind '{picture.mode}'; expected 8 or 16 bits a channel: "
            "save it as an RGB or RGBA PNG of 8 bits"
        )
    has_alpha = "A" in picture.getbands() or transparent is not None
    return np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))


def write_image(path: str | Path, rgb: np.ndarray, alpha: np.ndarray) -> None:
    """Write a goal image with its alpha as transparency: a PNG (H, W, 4).

    Args:
        path: of the file.
        rgb: (H, W, 3) the robot over black, in [0, 1].
        alpha: (H, W) share of each pixel that the robot covers, in [0, 1].

    Raises:
        ValueError: something is not finite, or alpha is outside of [0, 1].
    """
    rgb, alpha = np.asarray(rgb), np.asarray(alpha)
    if not (np.isfinite(rgb).all() and ((alpha >= 0) & (alpha <= 1)).all()):
        raise ValueError("the picture has colors or an alpha that are not between 0 and 1")
    # Files hold colors that are not multiplied by alpha.
    straight = rgb / np.maximum(alpha, 1e-3)[..., None]
    pixels = np.concatenate([np.clip(straight, 0, 1), alpha[..., None]], axis=-1)
    Image.fromarray(np.round(255 * pixels).astype(np.uint8), "RGBA").save(path)
