"""VL-Think: boards with signs and coloured shapes, for Color, Public Info and Traffic."""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit.errors import SuiteError
from probe_kit.suite.converters.candidates import (
    Candidate,
    SourceContent,
    SourcePicture,
    VlThinkOptions,
    Wording,
    read_annotations,
    trim,
)
from probe_kit.suite.items import side_words
from probe_kit.suite.pictures import WHITE, decode_bytes

SOURCE = "vl-think"
CATEGORIES = ("color", "public-info", "traffic")

_BOARDS = Path("ManiSkill/mani_skill/assets/carrot")
_SETS_OF = {"color": ("shape",), "public-info": ("public_info",), "traffic": ("traffic",)}
_EXTRA_SETS = {"laundry": "public-info", "weather": "public-info", "arrows": "traffic"}
_LABEL_FIELD = {"traffic": "sign", "public_info": "sign", "weather": "sign", "arrows": "sign", "laundry": "icon"}
_MOST_PIXELS = 600
_GLB_MAGIC = b"glTF"
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_RECOLORS = {"pink": (248, 138, 192), "white": (250, 250, 250), "gray": (128, 128, 128)}
_BEHIND_WHITE = (196, 196, 196)
# Labels that read badly; edit at will.
ALIASES = {"stop give way": "stop", "do not dryclean": "do not dry clean", "dryclean": "dry clean"}


def read(root: Path, categories: Sequence[str], options: VlThinkOptions) -> SourceContent:
    """Read every board of the requested categories.

    Raises:
        SuiteError: If there is no board for them, or for an unknown set or a broken board.
    """
    base = root / _BOARDS if (root / _BOARDS).is_dir() else root
    reading = SourceContent(
        license="MIT",
        attribution="VL-Think boards of BlindVLA (MIT); the sign artwork has no separate statement",
        url="https://github.com/CognitiveAISystems/BlindVLA",
        redistributable=True,
    )
    unknown = [name for name in options.extra_boards if name not in _EXTRA_SETS]
    if unknown:
        raise SuiteError(f"{SOURCE}: no boards called {unknown[0]!r}; expected one of {', '.join(_EXTRA_SETS)}.")
    for category in categories:
        names = [*_SETS_OF[category], *(name for name in options.extra_boards if _EXTRA_SETS[name] == category)]
        present = [name for name in names if (base / f"more_{name}").is_dir()]
        reading.notes += [f"{category}: no boards more_{name}" for name in names if name not in present]
        for name in present:
            _read_set(base / f"more_{name}", name, category, options, reading)
    if not reading.candidates:
        raise SuiteError(
            f"{SOURCE}: no boards for {', '.join(categories)} below {base}; looked for "
            f"{', '.join(f'more_{name}' for slug in categories for name in _SETS_OF[slug])}. "
            f"Name the repository's root or its folder {_BOARDS}."
        )
    return reading


def _read_set(folder: Path, name: str, category: str, options: VlThinkOptions, reading: SourceContent) -> None:
    path = folder / "model_db.json"
    records = read_annotations(path, SOURCE, "Check out the repository with its assets.")
    reading.files.append(path)
    for key in sorted(records):
        reading.pool[category] += 1
        board = folder / "shapes" / key / "textured.glb"
        where = f"board {key} of {path}"
        if not board.is_file():
            raise SuiteError(f"{SOURCE}: image not found for {where}: tried {board}; check out the assets again.")
        reading.candidates += _board(key, name, category, records[key], board, where, options)


def _board(
    key: str, name: str, category: str, record: Any, board: Path, where: str, options: VlThinkOptions
) -> Iterator[Candidate]:
    picture = SourcePicture(
        image_id=f"{SOURCE}/{name}/{key}",
        load=partial(upright_board, board),
        original=f"more_{name}/shapes/{key}/textured.glb",
        operation="transposed to upright, flattened on white, trimmed, padded to a square with 8 % margin",
    )
    label = _label(record, "color" if name == "shape" else _LABEL_FIELD[name], where)
    if name != "shape":
        concept = ALIASES.get(label.lower(), label.lower())
        phrase = f"{concept} sign"
        wording = Wording(phrase, "label")
        side_word = bool(side_words(phrase))
        yield Candidate(key, category, label, picture, wording=wording, concept=concept, construction="cross_item",
                        side_word=side_word)  # fmt: skip
        return
    colors = [(label.lower(), picture, "cross_item")]
    if options.recolor and label.lower() == "black":
        for color in _RECOLORS:
            painted = replace(
                picture,
                image_id=f"{picture.image_id}:{color}",
                load=partial(_repaint, board, color),
                operation=f"{picture.operation}, ink repainted {color}",
            )
            colors.append((color, painted, "recolored"))
    for color, board_picture, construction in colors:
        source_id = key if construction == "cross_item" else f"{key}:{color}"
        wording = Wording(f"{color} shape", "label")
        yield Candidate(
            source_id, category, color, board_picture, wording=wording, concept=color, construction=construction
        )


def _label(record: Any, field: str, where: str) -> str:
    value = record.get(field) if isinstance(record, dict) else None
    if not isinstance(value, str) or not value.strip():
        raise SuiteError(f"{SOURCE}: {where}: field {field!r} is {value!r}; expected a name. Check the release.")
    return value.strip().replace("_", " ")


def _repaint(board: Path, color: str) -> Image.Image:
    """Return the black board with its ink in another colour; white ink lies on grey."""
    opacity = 255 - np.asarray(upright_board(board).convert("L"), np.float64)[..., None]
    paper = np.array(_BEHIND_WHITE if color == "white" else WHITE, np.float64)
    mixed = (opacity * np.array(_RECOLORS[color]) + (255 - opacity) * paper) / 255
    return Image.fromarray(mixed.round().astype(np.uint8))


def upright_board(path: Path) -> Image.Image:
    """Return the art of one board.

    Textures are stored with rows and columns exchanged: without a transposition, STOP reads backwards.

    Raises:
        SuiteError: If the file is not a binary glTF with one embedded picture.
    """
    art = trim(_texture(path).transpose(Image.Transpose.TRANSPOSE))
    art.thumbnail((_MOST_PIXELS, _MOST_PIXELS), Image.Resampling.LANCZOS)
    return art


# -- boards in GLB files -----------------------------------------------------------------------------------------


_UNREADABLE = (
    AttributeError, KeyError, IndexError, TypeError, ValueError, struct.error, OSError,
)  # fmt: skip


def _texture(path: Path) -> Image.Image:
    """Return the first embedded picture of a GLB: a JSON chunk says which bytes of the binary chunk it is."""
    try:
        chunks = dict(_chunks(read_regular(path)))
        scene = parse_json(chunks[_JSON_CHUNK])
        view = scene["bufferViews"][scene["images"][0]["bufferView"]]
        start = view.get("byteOffset", 0)
        encoded = chunks[_BINARY_CHUNK][start : start + view["byteLength"]]
    except _UNREADABLE as problem:
        raise SuiteError(
            f"{SOURCE}: {path} is not a glTF with an embedded picture ({problem!r}). Check out the assets again."
        ) from problem
    return decode_bytes(
        encoded, f"{SOURCE}: {path}, texture:", remedy="Check out the assets again.", upright=False
    )


def _chunks(content: bytes) -> Iterator[tuple[int, bytes]]:
    if content[:4] != _GLB_MAGIC:
        raise ValueError("no glTF header")
    offset = 12
    while offset + 8 <= len(content):
        length, kind = struct.unpack_from("<II", content, offset)
        yield kind, content[offset + 8 : offset + 8 + length]
        offset += 8 + length
