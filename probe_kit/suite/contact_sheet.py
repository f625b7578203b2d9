"""Contact sheets: the items of a suite as one image per category."""

from pathlib import Path
from textwrap import wrap

from PIL import Image, ImageDraw, ImageFont

from probe_kit.suite.categories import CATEGORIES, category_of
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import load_picture
from probe_kit.suite.suite import Suite, missing_categories

_ITEMS_PER_SHEET = 24
_COLUMNS = 4
_TILE = 132
_FRAME = 4
_LINE_LENGTH = 44
_HEADER_LINE_LENGTH = 150
_LINE_HEIGHT = 16
_TEXT_HEIGHT = 34  # two lines
_GAP = 12
_CELL_WIDTH = 2 * _TILE + 4 * _FRAME
_CELL_HEIGHT = _TEXT_HEIGHT + _TILE + 2 * _FRAME
_GREEN = (16, 148, 66)


def contact_sheets(suite: Suite, out_folder: Path | str) -> list[Path]:
    """One PNG per category in `out_folder`: up to 24 items, the correct picture framed in green.

    Pictures lie as in the original layout; the head names the suite and the categories it lacks. Raises SuiteError
    for a picture that cannot be read.
    """
    folder = Path(out_folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for category in suite.categories:
        items = [item for item in suite.items if item.category == category]
        path = folder / f"{category}.png"
        _sheet(_header(suite, category, len(items)), items[:_ITEMS_PER_SHEET]).save(path)
        paths.append(path)
    return paths


def _header(suite: Suite, category: str, count: int) -> list[str]:
    missing = [category_of(slug).title for slug in missing_categories(suite.items)]
    have = f"{len(CATEGORIES) - len(missing)} of {len(CATEGORIES)} categories"
    lines = [
        f"{category_of(category).title}: {count} items of {suite.identity}, {have}",
        f"Curation: {', '.join(suite.card.get('curation', [])) or 'not stated'}."
        + (f" Not in this suite: {', '.join(missing)}." if missing else ""),
    ]
    return [part for line in lines for part in wrap(line, _HEADER_LINE_LENGTH)]


def _sheet(header: list[str], items: list[Item]) -> Image.Image:
    rows = -(-len(items) // _COLUMNS)
    top = _GAP + _LINE_HEIGHT * len(header)
    size = (_COLUMNS * (_CELL_WIDTH + _GAP) + _GAP, top + rows * (_CELL_HEIGHT + _GAP))
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for number, line in enumerate(header):
        draw.text((_GAP, _GAP // 2 + number * _LINE_HEIGHT), line, fill="black", font=font)
    for number, item in enumerate(items):
        row, column = divmod(number, _COLUMNS)
        corner = (_GAP + column * (_CELL_WIDTH + _GAP), top + row * (_CELL_HEIGHT + _GAP))
        sheet.paste(_cell(item), corner)
    return sheet


def _cell(item: Item) -> Image.Image:
    cell = Image.new("RGB", (_CELL_WIDTH, _CELL_HEIGHT), "white")
    draw = ImageDraw.Draw(cell)
    text = "\n".join(wrap(item.instruction, _LINE_LENGTH))
    draw.text((0, _TEXT_HEIGHT), text, fill="black", font=ImageFont.load_default(size=12), anchor="ld")
    side: Side
    for side, x in (("left", 0), ("right", _TILE + 2 * _FRAME)):
        if side == item.correct_side:
            draw.rectangle((x, _TEXT_HEIGHT, x + _TILE + 2 * _FRAME - 1, _CELL_HEIGHT - 1), fill=_GREEN)
        picture = load_picture(item.picture(side)).resize((_TILE, _TILE), Image.Resampling.LANCZOS)
        cell.paste(picture, (x + _FRAME, _TEXT_HEIGHT + _FRAME))
    return cell
