"""Pictures: hashes, encoding, and conversion of foreign files to square RGB tiles."""

import hashlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

from PIL import Image, ImageOps, UnidentifiedImageError

from probe_kit.errors import SuiteError

RESTORE = "Restore the suite's files or build it again."
"""What to do about a picture of a suite."""
WHITE = (255, 255, 255)
LARGEST_PICTURE = 8192
"""Pixels of the longer side: a few kilobytes can claim to be a picture that fills all memory once decoded."""

# What Pillow raises for bytes that are no picture or only part of one; PNG reports bad chunks as SyntaxError.
_DECODING_ERRORS = (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError)


def pixels_sha256(image: Image.Image) -> str:
    """Hex sha256 of `W,H,RGB;` and the raw RGB bytes: the same for every lossless encoding."""
    rgb = image.convert("RGB")
    digest = hashlib.sha256(f"{rgb.width},{rgb.height},RGB;".encode())
    digest.update(rgb.tobytes())
    return digest.hexdigest()


def picture_file_name(pixels_sha256: str) -> str:
    """Where a picture lies inside `items/`; its name gives away nothing but its content."""
    return f"images/{pixels_sha256[:2]}/{pixels_sha256[:16]}.png"


def encode_png(image: Image.Image) -> bytes:
    """The picture as PNG bytes that depend on its RGB pixels alone; no metadata is kept."""
    rgb = image.convert("RGB")
    bare = Image.frombytes("RGB", rgb.size, rgb.tobytes())
    buffer = BytesIO()
    bare.save(buffer, format="PNG")
    return buffer.getvalue()


def picture_size(encoded: bytes) -> tuple[int, int] | None:
    """Width and height in pixels as the file's header states them, None if it is not a picture."""
    try:
        with _headers_of_bombs(), Image.open(BytesIO(encoded)) as image:
            return image.size
    except _DECODING_ERRORS:
        return None


def load_picture(path: Path, pixels: str | None = None) -> Image.Image:
    """A square RGB picture, upright, on white; the shorter side is padded with white.

    pixels: the hash its pixels must have. Raises SuiteError as `decode_picture` does, and for other pixels.
    """
    picture = decode_picture(path)
    if pixels is not None and (found := pixels_sha256(picture)) != pixels:
        raise SuiteError(
            f"{path}: has other pixels than its suite says (expected {pixels[:12]}, found {found[:12]}). {RESTORE}"
        )
    return letterboxed(picture)


def decode_picture(path: Path) -> Image.Image:
    """An RGB picture in its own size: EXIF rotation is applied and transparency becomes white.

    Raises SuiteError naming the file if it is missing, is not a picture, is damaged, is larger than
    `LARGEST_PICTURE`, or has more than 8 bits per channel.
    """
    if not path.is_file():
        raise SuiteError(f"{path}: there is no such picture. {RESTORE}")
    try:
        with _headers_of_bombs(), Image.open(path) as image:
            _check_huge(image, path)
            image.verify()  # decoding alone does not compare the checksums
        with Image.open(path) as image:
            _check_deep(image, path)
            return on_white(ImageOps.exif_transpose(image))
    except _DECODING_ERRORS as error:
        raise SuiteError(f"{path}: not a picture that Pillow can decode ({error}). {RESTORE}") from error


@contextmanager
def _headers_of_bombs() -> Iterator[None]:
    """Pillow warns of a huge picture when it is opened; we refuse it, and need its size to say so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        yield


def _check_huge(image: Image.Image, path: Path) -> None:
    if max(image.size) > LARGEST_PICTURE:
        width, height = image.size
        raise SuiteError(
            f"{path}: claims to be {width}×{height} pixels; at most {LARGEST_PICTURE} are read. Make it smaller."
        )


def _check_deep(image: Image.Image, path: Path) -> None:
    if image.mode.startswith(("I", "F")):  # Pillow would clip these at 255
        raise SuiteError(f"{path}: has more than 8 bits per channel ({image.mode}). Convert it to 8-bit RGB.")


def on_white(image: Image.Image) -> Image.Image:
    """An RGB picture: transparency becomes white."""
    if not image.has_transparency_data:
        return image.convert("RGB")
    rgba = image.convert("RGBA")
    flat = Image.new("RGB", rgba.size, WHITE)
    flat.paste(rgba, mask=rgba.getchannel("A"))
    return flat


def letterboxed(image: Image.Image) -> Image.Image:
    """The picture in the middle of a white square as large as its longer side."""
    side = max(image.size)
    if image.size == (side, side):
        return image
    square = Image.new("RGB", (side, side), WHITE)
    square.paste(image, ((side - image.width) // 2, (side - image.height) // 2))
    return square


def difference_hash(image: Image.Image) -> int:
    """64 bits that say where brightness falls from left to right; nearly equal for nearly equal pictures."""
    small = image.convert("L").resize((9, 8), Image.Resampling.LANCZOS).tobytes()
    bits = 0
    for row in range(8):
        for column in range(8):
            bits = bits << 1 | (small[9 * row + column] > small[9 * row + column + 1])
    return bits
