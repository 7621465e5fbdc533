"""Pictures from anywhere are opened in one way: few formats, none of which runs a program."""

import warnings
from pathlib import Path

from PIL import Image

from vrrt_jax.core.data_file import check_file

# Pillow would read others too; of EPS it runs Ghostscript.
FORMATS = ("PNG", "JPEG", "BMP", "GIF", "TIFF", "WEBP", "PPM", "TGA", "PCX")


def open_picture(path: str | Path) -> Image.Image:
    """A picture whose pixels are not read yet, to be closed by the caller.

    Raises:
        FileNotFoundError: no such file.
        PIL.UnidentifiedImageError: it is none of :data:`FORMATS`.
        OSError: it is damaged.
    """
    with warnings.catch_warnings():  # who reads the pixels checks how many there are
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(check_file(path), formats=FORMATS)
