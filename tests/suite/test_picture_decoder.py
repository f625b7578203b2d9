"""The one decoder of foreign pictures: what it makes of each kind of file, and what it refuses by name."""

import ast
import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile

from probe_kit.errors import SceneError, SuiteError
from probe_kit.suite.pictures import FORMATS, decode_bytes, decode_picture, picture_size
from tests.support.parsed import package_nodes

ROOT = Path(__file__).parents[2]
LOSSLESS = {"PNG": {}, "GIF": {}, "BMP": {}, "WEBP": {"lossless": True}}
LOSSY = {"JPEG": {"quality": 95}}
ORIENTATION = 0x0112


@pytest.fixture
def picture() -> Image.Image:
    """Four colours, one in each quarter of 80 by 60 pixels."""
    image = Image.new("RGB", (80, 60), (200, 30, 30))
    image.paste((30, 200, 30), (40, 0, 80, 30))
    image.paste((30, 30, 200), (0, 30, 40, 60))
    image.paste((20, 20, 20), (40, 30, 80, 60))
    return image


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def quarters(image: Image.Image) -> list[tuple[int, ...]]:
    """The colours in the middle of the four quarters, upper left first."""
    across, down = (image.width // 4, image.width * 3 // 4), (image.height // 4, image.height * 3 // 4)
    return [image.getpixel((x, y)) for y in down for x in across]  # type: ignore[misc]


@pytest.mark.parametrize("kind", FORMATS)
def test_each_format_gives_its_pixels(kind: str, picture: Image.Image) -> None:
    content = encoded(picture, kind, **{**LOSSLESS, **LOSSY}[kind])  # type: ignore[dict-item]
    decoded = decode_bytes(content, "the picture:")
    assert (decoded.mode, decoded.size, picture_size(content)) == ("RGB", picture.size, picture.size)
    np.testing.assert_allclose(quarters(decoded), quarters(picture), atol=8 if kind in LOSSY else 0)


@pytest.mark.parametrize(
    "kind", ["TIFF", "ICO", "PPM", "TGA", "JPEG2000", "AVIF", "PDF", "EPS", "DDS", "QOI", "PCX", "ICNS"]
)
def test_each_other_format_is_refused_by_name(kind: str, picture: Image.Image) -> None:
    try:
        content = encoded(picture.resize((64, 64)), kind)
    except (KeyError, OSError):
        pytest.skip(f"this Pillow writes no {kind}")
    with pytest.raises(SuiteError, match=r"is [A-Z].*expected one of PNG, JPEG, WEBP, GIF, BMP|not a picture"):
        decode_bytes(content, "the picture:")
    assert picture_size(content) is None


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"\0\0\0\x1cftypheic", "HEIF"),
        (b"\0\0\0\x1cftypavif", "AVIF"),
        (b'<svg xmlns="http://www.w3.org/2000/svg"/>', "SVG"),
        (b'\xef\xbb\xbf<?xml version="1.0"?><svg/>', "SVG or XML"),
        (b"%PDF-1.7", "PDF"),
        (b"II*\0", "TIFF"),
        (b"", "not a picture"),
        (b"<!doctype html>", r"not a picture that Pillow can decode \(unknown format\)\. Restore"),
        (b"version https://git-lfs.github.com/spec/v1", "not a picture"),
    ],
)
def test_files_of_phones_browsers_and_drawing_programs_are_named(content: bytes, name: str) -> None:
    with pytest.raises(SuiteError, match=name):
        decode_bytes(content, "the picture:")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_of_exif_is_applied(kind: str, orientation: int, picture: Image.Image) -> None:
    """The oracle is the definition of the tag: where row 0 and column 0 of the stored pixels lie."""
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    options = {"PNG": {}, "JPEG": {"quality": 95}, "WEBP": {"lossless": True}}[kind]
    decoded = decode_bytes(encoded(picture, kind, exif=exif, **options), "the picture:")  # type: ignore[arg-type]
    pixels = np.asarray(picture)
    upright = {
        1: pixels, 2: pixels[:, ::-1], 3: pixels[::-1, ::-1], 4: pixels[::-1], 5: pixels.transpose(1, 0, 2),
        6: pixels[::-1].transpose(1, 0, 2), 7: pixels[::-1, ::-1].transpose(1, 0, 2),
        8: pixels[:, ::-1].transpose(1, 0, 2),
    }[orientation]  # fmt: skip
    expected = Image.fromarray(np.ascontiguousarray(upright))
    assert decoded.size == expected.size
    np.testing.assert_allclose(quarters(decoded), quarters(expected), atol=8)
    texture = decode_bytes(encoded(picture, kind, exif=exif), "the texture:", upright=False)
    np.testing.assert_allclose(quarters(texture), quarters(picture), atol=40)


@pytest.mark.parametrize(
    ("mode", "hidden"), [("RGBA", (255, 0, 0, 0)), ("LA", (0, 0)), ("P", None), ("RGB", None), ("L", None)]
)
def test_transparency_becomes_white_in_each_way_of_writing_it(mode: str, hidden: tuple[int, ...] | None) -> None:
    opaque = {"RGBA": (10, 20, 30, 255), "LA": (40, 255), "P": 1, "RGB": (10, 20, 30), "L": 40}[mode]
    clear = hidden or {"P": 0, "RGB": (255, 0, 0), "L": 7}[mode]
    image = Image.new(mode, (40, 40), clear)
    if mode == "P":
        image.putpalette([255, 0, 0, 10, 20, 30])
    image.paste(opaque, (0, 0, 20, 40))
    options = {} if hidden else {"transparency": clear}
    decoded = decode_bytes(encoded(image, "PNG", **options), "the picture:")  # type: ignore[arg-type]
    assert decoded.getpixel((30, 10)) == (255, 255, 255)
    assert decoded.getpixel((10, 10)) == ((40, 40, 40) if mode in ("LA", "L") else (10, 20, 30))


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_half_transparency_is_half_white(kind: str) -> None:
    image = Image.new("RGBA", (16, 16), (0, 0, 0, 51))
    options = {"lossless": True, "exact": True} if kind == "WEBP" else {}
    decoded = decode_bytes(encoded(image, kind, **options), "the picture:")
    assert decoded.getpixel((8, 8)) == (204, 204, 204)


def test_a_gif_with_a_transparent_colour_is_on_white() -> None:
    image = Image.new("P", (16, 16), 0)
    image.putpalette([255, 0, 0, 0, 0, 255])
    image.paste(1, (0, 0, 8, 16))
    decoded = decode_bytes(encoded(image, "GIF", transparency=0), "the picture:")
    assert (decoded.getpixel((12, 8)), decoded.getpixel((4, 8))) == ((255, 255, 255), (0, 0, 255))


@pytest.mark.parametrize(("mode", "value"), [("1", 255), ("L", 90), ("P", 1), ("CMYK", (0, 255, 255, 0))])
def test_other_colours_become_rgb(mode: str, value: int | tuple[int, ...]) -> None:
    image = Image.new(mode, (16, 16), value)
    if mode == "P":
        image.putpalette([0, 0, 0, 250, 10, 20])
    decoded = decode_bytes(encoded(image, "JPEG" if mode == "CMYK" else "PNG"), "the picture:")
    expected = {"1": (255,) * 3, "L": (90,) * 3, "P": (250, 10, 20), "CMYK": (255, 0, 0)}[mode]
    np.testing.assert_allclose(decoded.getpixel((8, 8)), expected, atol=3)


@pytest.mark.parametrize(("colour", "samples"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_sixteen_bits_per_channel_are_refused_in_each_colour_type(colour: int, samples: int) -> None:
    """Pillow keeps the upper 8 bits of most of them without a word."""
    row = b"\0" + b"\x12\x34" * samples * 8
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", 8, 8, 16, colour, 0, 0, 0)),
        (b"IDAT", zlib.compress(row * 8)),
        (b"IEND", b""),
    ]
    chunks = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts
    ]
    with pytest.raises(SuiteError, match=r"the picture: has more than 8 bits per channel \(16 bits\)"):
        decode_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks), "the picture:")


@pytest.mark.parametrize("kind", ["GIF", "PNG", "WEBP"])
def test_an_animation_is_refused_because_one_frame_is_meant(kind: str, picture: Image.Image) -> None:
    other = picture.transpose(Image.Transpose.ROTATE_180)
    content = encoded(picture, kind, save_all=True, append_images=[other])
    with pytest.raises(SuiteError, match="has several frames; expected a still picture"):
        decode_bytes(content, "the picture:")


def test_a_photo_with_a_second_view_is_its_first(picture: Image.Image) -> None:
    """Telephones write such files (MPO) with the ending of JPEG."""
    content = encoded(picture, "MPO", save_all=True, append_images=[picture.resize((20, 15))], quality=95)
    decoded = decode_bytes(content, "the picture:")
    np.testing.assert_allclose(quarters(decoded), quarters(picture), atol=8)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_half_a_file_is_refused_whatever_other_libraries_set(
    kind: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    content = encoded(Image.fromarray(noise), kind)
    with pytest.raises(SuiteError, match="not a picture that Pillow can decode"):
        decode_bytes(content[: int(len(content) * share)], "the picture:")
    assert ImageFile.LOAD_TRUNCATED_IMAGES


def test_a_huge_picture_is_refused_by_its_header(picture: Image.Image) -> None:
    with pytest.raises(SceneError, match="background: claims to be 80×60 pixels; at most 79 are read"):
        decode_bytes(encoded(picture, "PNG"), "background:", SceneError, largest=79)


def test_the_content_decides_and_not_the_ending(picture: Image.Image, tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(encoded(picture, "PNG"))
    assert decode_picture(tmp_path / "photo.jpg").tobytes() == picture.tobytes()
    (tmp_path / "scan.png").write_bytes(encoded(picture, "TIFF"))
    with pytest.raises(SuiteError, match=r"scan\.png: is TIFF; expected one of PNG"):
        decode_picture(tmp_path / "scan.png")


def test_every_picture_is_decoded_by_one_module() -> None:
    """Another call of Pillow's or OpenCV's decoder would have rules of its own."""
    decoder = ROOT / "probe_kit" / "suite" / "pictures.py"
    other_calls = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, call in package_nodes(ast.Call)
        if path != decoder and _decodes(call.func)
    ]
    assert other_calls == []
    assert any(path == decoder and _decodes(call.func) for path, call in package_nodes(ast.Call))


def _decodes(function: ast.expr) -> bool:
    if isinstance(function, ast.Name):
        return function.id in ("imread", "imdecode", "decode_image", "read_image")
    if not isinstance(function, ast.Attribute):
        return False
    names = ("imread", "imdecode", "decode_image", "decode_jpeg", "decode_png", "read_image")
    of = function.value
    module = of.id if isinstance(of, ast.Name) else of.attr if isinstance(of, ast.Attribute) else ""
    return function.attr in names or (function.attr == "open" and module in ("Image", "PIL", "PILImage"))
