from pathlib import Path

from PIL import Image

from probe_kit.suite import Suite, contact_sheets

GREEN = (16, 148, 66)


def test_there_is_one_sheet_per_category(small_suite: Suite, tmp_path: Path) -> None:
    paths = contact_sheets(small_suite, tmp_path / "sheets")
    assert paths == [tmp_path / "sheets" / "color.png", tmp_path / "sheets" / "shape.png"]


def test_the_green_frame_is_around_the_correct_picture(small_suite: Suite, tmp_path: Path) -> None:
    suite = small_suite.select(["color"], 2)
    (path,) = contact_sheets(suite, tmp_path)
    with Image.open(path) as sheet:
        bottom = sheet.height - 15  # inside the lower edge of the frame
        cell = (sheet.width - 12) // 4
        for column, item in enumerate(suite.items):
            centre = 12 + column * cell + (cell - 12) // 2
            x = centre - 20 if item.correct_side == "left" else centre + 20
            other = centre + 20 if item.correct_side == "left" else centre - 20
            assert sheet.getpixel((x, bottom)) == GREEN
            assert sheet.getpixel((other, bottom)) == (255, 255, 255)


def test_a_sheet_shows_at_most_24_items(embedded: Suite, tmp_path: Path) -> None:
    many, few = embedded.select(["color"]), embedded.select(["color"], 24)
    (sheet_of_many,) = contact_sheets(many, tmp_path / "many")
    (sheet_of_few,) = contact_sheets(few, tmp_path / "few")
    with Image.open(sheet_of_many) as one, Image.open(sheet_of_few) as other:
        below_the_head = (0, 60, *one.size)
        assert one.crop(below_the_head) == other.crop(below_the_head)
