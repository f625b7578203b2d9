from contextlib import suppress
from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from probe_kit.errors import SuiteError
from probe_kit.suite import load_picture
from probe_kit.suite.pictures import encode_png, picture_size, pixels_sha256


@pytest.fixture
def picture() -> Image.Image:
    """A 100 by 60 gradient, different in every corner."""
    gradient = Image.linear_gradient("L").resize((100, 60))
    return Image.merge("RGB", (gradient, gradient.transpose(Image.Transpose.ROTATE_180), gradient))


def test_pixels_hash_is_the_documented_one() -> None:
    # printf '2,1,RGB;\xff\0\0\xff\0\0' | sha256sum
    expected = "3260521f81b9a934c2c936606a1fcdb6a3f023064f82506733398f636ed21f25"
    assert pixels_sha256(Image.new("RGB", (2, 1), "red")) == expected


def test_pixels_hash_survives_re_encoding(picture: Image.Image) -> None:
    bitmap = BytesIO()
    picture.save(bitmap, format="BMP")
    assert pixels_sha256(Image.open(bitmap)) == pixels_sha256(picture)


def test_pixels_hash_tells_a_picture_from_its_transpose() -> None:
    assert pixels_sha256(Image.new("RGB", (2, 3))) != pixels_sha256(Image.new("RGB", (3, 2)))


def test_a_png_depends_on_pixels_alone(picture: Image.Image) -> None:
    notes, buffer = PngInfo(), BytesIO()
    notes.add_text("answer", "left")
    picture.save(buffer, format="PNG", pnginfo=notes, dpi=(72, 72), icc_profile=b"profile")
    assert encode_png(Image.open(buffer)) == encode_png(picture)
    assert Image.open(BytesIO(encode_png(picture))).info == {}


def test_picture_size_reads_the_header_and_knows_what_is_no_picture(picture: Image.Image) -> None:
    assert picture_size(encode_png(picture)) == (100, 60)
    assert picture_size(b"not a picture") is None


def test_a_wide_picture_is_padded_to_a_white_square(picture: Image.Image, tmp_path: Path) -> None:
    picture.save(tmp_path / "wide.png")
    loaded = load_picture(tmp_path / "wide.png")
    assert loaded.size == (100, 100)
    assert loaded.getpixel((50, 19)) == loaded.getpixel((50, 80)) == (255, 255, 255)
    assert loaded.crop((0, 20, 100, 80)).tobytes() == picture.tobytes()


def test_transparency_becomes_white(tmp_path: Path) -> None:
    clear = Image.new("RGBA", (64, 64), (255, 0, 0, 0))
    clear.paste((0, 0, 255, 255), (0, 0, 32, 64))
    clear.save(tmp_path / "clear.png")
    loaded = load_picture(tmp_path / "clear.png")
    assert loaded.getpixel((10, 10)) == (0, 0, 255)
    assert loaded.getpixel((50, 10)) == (255, 255, 255)


def test_a_transparent_palette_colour_becomes_white(tmp_path: Path) -> None:
    palette = Image.new("P", (64, 64), 0)
    palette.putpalette([255, 0, 0, 0, 0, 255])
    palette.save(tmp_path / "palette.png", transparency=0)
    assert load_picture(tmp_path / "palette.png").getpixel((5, 5)) == (255, 255, 255)


def test_a_photo_taken_sideways_is_turned_upright(tmp_path: Path) -> None:
    photo = Image.new("RGB", (64, 64), "white")
    photo.paste((0, 0, 0), (0, 0, 64, 16))
    exif = Image.Exif()
    exif[0x0112] = 3  # orientation: upside down
    photo.save(tmp_path / "photo.png", exif=exif)
    loaded = load_picture(tmp_path / "photo.png")
    assert loaded.getpixel((32, 4)) == (255, 255, 255)
    assert loaded.getpixel((32, 60)) == (0, 0, 0)


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"gone\.png: there is no such picture"):
        load_picture(tmp_path / "gone.png")


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("hello", encoding="utf-8")
    with pytest.raises(SuiteError, match=r"text\.png: not a picture"):
        load_picture(tmp_path / "text.png")


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_half_a_picture_is_refused(picture: Image.Image, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"half.{ending}"
    picture.resize((400, 400)).save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SuiteError, match=f"half.{ending}: not a picture"):
        load_picture(path)


def test_a_flipped_bit_never_gives_another_picture(picture: Image.Image, tmp_path: Path) -> None:
    """Decoding alone accepts many of these, some of them as other pixels."""
    sound, path = encode_png(picture), tmp_path / "flipped.png"
    path.write_bytes(sound)
    expected = load_picture(path)
    for position in range(8, len(sound), 5):
        damaged = bytearray(sound)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        with suppress(SuiteError):
            assert load_picture(path) == expected


def test_sixteen_bits_per_channel_are_refused_rather_than_clipped(tmp_path: Path) -> None:
    Image.new("I;16", (64, 64), 20_000).save(tmp_path / "deep.png")
    with pytest.raises(SuiteError, match=r"deep\.png: has more than 8 bits per channel"):
        load_picture(tmp_path / "deep.png")
