"""Pictures: the one decoder of foreign files, hashes, encoding, and conversion to square RGB tiles."""

import hashlib
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageFile, ImageOps, UnidentifiedImageError

from probe_kit._system.bounded_files import read_regular
from probe_kit.errors import ProbeKitError, SuiteError

RESTORE = "Restore the suite's files or build it again."
"""Advice on a broken picture of a suite, for messages."""
WHITE = (255, 255, 255)
LARGEST_PICTURE = 8192
"""Most pixels of the longer side: a few kilobytes can claim to be a picture that fills all memory once decoded."""

JPEG_QUALITY = 95
"""Quality of the JPEG round trip that controls use."""
FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP")
"""Formats that are decoded, as Pillow names them."""

# What Pillow raises for bytes that are no picture or only part of one; PNG reports bad chunks as SyntaxError.
_DECODING_ERRORS = (
    UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError, struct.error, EOFError,
    KeyError, IndexError, TypeError, OverflowError,
)  # fmt: skip
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_DEPTH = 24
"""Position of the byte with the bits per channel of a PNG."""
_REFUSED = (
    (b"II*\0", "TIFF"), (b"MM\0*", "TIFF"), (b"II+\0", "TIFF"), (b"MM\0+", "TIFF"), (b"%PDF", "PDF"),
    (b"8BPS", "Photoshop"), (b"\0\0\1\0", "ICO"), (b"\0\0\2\0", "CUR"), (b"<svg", "SVG"), (b"<?xml", "SVG or XML"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"), (b"\0\0\0\x0cjP", "JPEG 2000"), (b"\xff\x0a", "JPEG XL"),
    (b"\0\0\0\x0cJXL", "JPEG XL"), (b"v/1\1", "OpenEXR"), (b"#?RADIANCE", "Radiance HDR"), (b"DDS ", "DDS"),
    (b"qoif", "QOI"), (b"icns", "ICNS"), (b"%!PS", "PostScript"), (b"\x0a\x05\1\x08", "PCX"), (b"BPG\xfb", "BPG"),
    *((f"P{number}{end}".encode(), "PNM") for number in range(1, 8) for end in " \n\t\r"),
    (b"Pf\n", "PFM"), (b"PF\n", "PFM"),
)  # fmt: skip
"""Beginnings of files in other formats, so that they are refused by name."""


def pixels_sha256(image: Image.Image) -> str:
    """Return the hex sha256 of `W,H,RGB;` and the raw RGB bytes: the same for every lossless encoding."""
    rgb = image.convert("RGB")
    digest = hashlib.sha256(f"{rgb.width},{rgb.height},RGB;".encode())
    digest.update(rgb.tobytes())
    return digest.hexdigest()


def picture_file_name(pixels_sha256: str) -> str:
    """Return the file name of a picture inside `items/`; the name identifies nothing but its content."""
    return f"images/{pixels_sha256[:2]}/{pixels_sha256[:16]}.png"


def encode_png(image: Image.Image) -> bytes:
    """Return the picture as PNG bytes that depend on its RGB pixels alone; no metadata is kept."""
    rgb = image.convert("RGB")
    bare = Image.frombytes("RGB", rgb.size, rgb.tobytes())
    buffer = BytesIO()
    bare.save(buffer, format="PNG")
    return buffer.getvalue()


def picture_size(encoded: bytes) -> tuple[int, int] | None:
    """Return width and height in pixels from the file's header; None if it is no picture of `FORMATS`."""
    try:
        with _open_picture(encoded) as image:
            return image.size
    except _DECODING_ERRORS:
        return None


def load_picture(path: Path, pixels: str | None = None) -> Image.Image:
    """Read a square RGB picture, upright, on white; the shorter side is padded with white.

    Args:
        path: File of the picture.
        pixels: Hash that its pixels must have; None for no check.

    Raises:
        SuiteError: For pixels with another hash, and as `decode_picture`.
    """
    picture = decode_picture(path)
    if pixels is not None and (other := pixels_sha256(picture)) != pixels:
        raise SuiteError(
            f"{path}: has other pixels than its suite says (expected {pixels[:12]}, found {other[:12]}). {RESTORE}"
        )
    return letterbox(picture)


def decode_picture(path: Path) -> Image.Image:
    """Read the RGB picture in a file, see `decode_bytes`.

    Raises:
        SuiteError: If the file is missing or cannot be decoded; the message names it.
    """
    try:
        encoded = read_regular(path)
    except OSError as error:
        reason = "there is no such picture" if not path.exists() else f"cannot be read ({error.strerror})"
        raise SuiteError(f"{path}: {reason}. {RESTORE}") from error
    return decode_bytes(encoded, f"{path}:")


def decode_bytes(
    encoded: bytes,
    name: str,
    error: type[ProbeKitError] = SuiteError,
    remedy: str = RESTORE,
    upright: bool = True,
    largest: int = LARGEST_PICTURE,
) -> Image.Image:
    """Return an RGB picture in its own size from the bytes of a file of `FORMATS`.

    The orientation of EXIF is applied, and transparency becomes white. Palettes and grey become RGB. CMYK becomes
    RGB by Pillow's formula, without a colour profile.

    Raises `error` for another format, damaged or incomplete bytes, a larger picture, several frames, and more than
    8 bits per channel.

    Args:
        encoded: Bytes of the file.
        name: Description of the picture, at the beginning of messages.
        error: Class of the exceptions.
        remedy: Advice at the end of messages.
        upright: Whether to apply the orientation of EXIF; False for textures, whose orientation belongs to their
            mesh.
        largest: Most pixels of the longer side.
    """
    if refused := _refused_format(encoded):
        raise error(
            f"{name} is {refused}; expected one of {', '.join(FORMATS)}. Convert it, or give another file."
        )
    try:
        with _open_picture(encoded) as image:
            _check_still(image, name, error, largest)
            _check_deep(image, encoded, name, error)
            image.verify()  # decoding alone does not compare the checksums
        with _open_picture(encoded) as image:
            return on_white(ImageOps.exif_transpose(image) if upright else image)
    except UnidentifiedImageError as problem:  # its own message names an address in memory
        raise error(f"{name} not a picture that Pillow can decode (unknown format). {remedy}") from problem
    except _DECODING_ERRORS as problem:
        raise error(f"{name} not a picture that Pillow can decode ({problem}). {remedy}") from problem


def rgb_of(image: Image.Image, name: str, remedy: str) -> Image.Image:
    """Return the RGB pixels of a picture that another library opened: transparency becomes white.

    Raises:
        SuiteError: For a format outside `FORMATS`, a picture that is too large or has several frames, more than 8
            bits per channel, or damaged bytes.
    """
    if image.format not in (None, *FORMATS):
        raise SuiteError(f"{name} is {image.format}; expected one of {', '.join(FORMATS)}. {remedy}")
    _check_still(image, name, SuiteError, LARGEST_PICTURE)
    _check_deep(image, b"", name, SuiteError)
    try:
        return on_white(image)
    except _DECODING_ERRORS as problem:
        raise SuiteError(f"{name} not a picture that Pillow can decode ({problem}). {remedy}") from problem


def through_jpeg(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return pixels (H, W, 3) uint8 as they are after JPEG of `JPEG_QUALITY`: a change without meaning."""
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return np.asarray(decode_bytes(buffer.getvalue(), "a JPEG round trip:", largest=max(pixels.shape))).copy()


def stored_picture(path: Path, mode: str) -> Image.Image:
    """Read a picture of this package, whose transparency is part of it, in a `mode` of Pillow such as RGBA."""
    with _open_picture(path.read_bytes()) as image:
        return image.convert(mode)


@contextmanager
def _open_picture(encoded: bytes) -> Iterator[Image.Image]:
    """Open a picture of `FORMATS` that is decoded wholly or not at all, whatever other libraries set for Pillow.

    Pillow warns of a huge picture when it is opened. Here it is refused instead, and its size is needed for the
    message.
    """
    incomplete, ImageFile.LOAD_TRUNCATED_IMAGES = ImageFile.LOAD_TRUNCATED_IMAGES, False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(BytesIO(encoded), formats=FORMATS)
        with image:
            yield image
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = incomplete


def _refused_format(encoded: bytes) -> str | None:
    """Return the name of a known format that is not decoded; None for other bytes."""
    start = encoded[:64].lstrip(b"\xef\xbb\xbf \t\r\n") if encoded[:1] in b"\xef <\t\r\n" else encoded[:64]
    if encoded[4:8] == b"ftyp":
        return "AVIF" if encoded[8:12] in (b"avif", b"avis") else "HEIF"
    return next((name for beginning, name in _REFUSED if start.startswith(beginning)), None)


def _check_still(image: Image.Image, name: str, error: type[ProbeKitError], largest: int) -> None:
    """Raise `error` for a huge picture, and for several frames; a photo's second view (MPO) is not one."""
    if max(image.size) > largest:
        width, height = image.size
        raise error(f"{name} claims to be {width}×{height} pixels; at most {largest} are read. Make it smaller.")
    # Not `n_frames`, for which Pillow walks through all frames of a GIF.
    if getattr(image, "is_animated", False) and image.format in FORMATS:
        raise error(f"{name} has several frames; expected a still picture. Give the frame that is meant.")


def _check_deep(image: Image.Image, encoded: bytes, name: str, error: type[ProbeKitError]) -> None:
    """Raise `error` for a picture that Pillow would clip at 255, or cut to its upper 8 bits."""
    png = encoded.startswith(_PNG)
    if image.mode.startswith(("I", "F")) or (png and encoded[_PNG_DEPTH] > 8):
        depth = f"{encoded[_PNG_DEPTH]} bits" if png else image.mode
        raise error(f"{name} has more than 8 bits per channel ({depth}). Convert it to 8-bit RGB.")


def on_white(image: Image.Image) -> Image.Image:
    """Return an RGB picture: transparency becomes white."""
    if not image.has_transparency_data:
        return image.convert("RGB")
    rgba = image.convert("RGBA")
    flat = Image.new("RGB", rgba.size, WHITE)
    flat.paste(rgba, mask=rgba.getchannel("A"))
    return flat


def letterbox(image: Image.Image) -> Image.Image:
    """Return the picture in the middle of a white square as large as its longer side."""
    side = max(image.size)
    if image.size == (side, side):
        return image
    square = Image.new("RGB", (side, side), WHITE)
    square.paste(image, ((side - image.width) // 2, (side - image.height) // 2))
    return square


def difference_hash(image: Image.Image) -> int:
    """Return 64 bits that say where brightness falls from left to right; similar for similar pictures."""
    small = image.convert("L").resize((9, 8), Image.Resampling.LANCZOS).tobytes()
    bits = 0
    for row in range(8):
        for column in range(8):
            bits = bits << 1 | (small[9 * row + column] > small[9 * row + column + 1])
    return bits


NEAR_DUPLICATE_BITS = 4
"""Most bits, of the 64 of a difference hash, in which nearly equal pictures differ."""
_BLOCKS = 8
_SAME_COLOUR = 24.0  # levels, mean over channels, in every one of 8 × 8 blocks


@dataclass(frozen=True)
class Look:
    """The look of a picture: pixels, brightness and, as one shape comes in several colours, colour.

    Attributes:
        pixels_sha256: Hash of the pixels.
        brightness: Difference hash of the brightness.
        colours: (8, 8, 3) float64, the mean colour of every block, 0 to 255.
    """

    pixels_sha256: str
    brightness: int
    colours: npt.NDArray[np.float64]

    def same_as(self, other: "Look") -> bool:
        """Whether two pictures are, or nearly are, the same."""
        if self.pixels_sha256 == other.pixels_sha256:
            return True
        if (self.brightness ^ other.brightness).bit_count() > NEAR_DUPLICATE_BITS:
            return False
        return float(np.abs(self.colours - other.colours).mean(axis=2).max()) < _SAME_COLOUR


def look_of(image: Image.Image) -> Look:
    """Compute the look of one picture."""
    blocks = image.convert("RGB").resize((_BLOCKS, _BLOCKS), Image.Resampling.BOX)
    return Look(pixels_sha256(image), difference_hash(image), np.asarray(blocks, np.float64))
