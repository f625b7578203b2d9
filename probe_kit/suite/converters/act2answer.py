"""Converter of sets in Act2Answer's format: `pairs.json`, `model_db.json` and a GLB per tile.

A tile is the texture of its upper face, as the camera sees it. The converter refuses everything that the release
would misread.
"""

import re
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.imports import require
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.suite.categories import CATEGORIES, check_categories
from probe_kit.suite.converters.candidates import Act2AnswerOptions, field_of, options_from, read_annotations
from probe_kit.suite.items import VERBATIM, Item, Side, side_words, with_groups
from probe_kit.suite.manifest import check_foreign_folder, save_suite
from probe_kit.suite.pictures import rgb_of
from probe_kit.suite.suite import Picture, Suite, make_item, new_suite, squared_picture

RELEASE_YAW = 90
"""Degrees by which Act2Answer turns its tiles: mesh +x lies to the viewer's right, mesh +y away from them."""
YAWS = (0, 90, 180, 270)
_UP = 0.99  # of a unit normal
_LEVEL = 0.05  # of the tile's thickness: what counts as its top
_STRAIGHT = 0.02  # of the picture: how far a texture may be from lying along the tile's sides
_UNREADABLE = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, NotImplementedError, OSError, struct.error,
    Image.DecompressionBombError,
)  # fmt: skip


@dataclass(frozen=True)
class SetTile:
    """A tile of a set in Act2Answer's format.

    Attributes:
        picture: RGB on white, as seen from in front of the tile.
        size: Extent along x, y and z in metres.
    """

    picture: Image.Image
    size: tuple[float, float, float]


Top = tuple[NDArray[np.float64], NDArray[np.float64], Any]
"""Corners of the upper face: (N, 2) in metres, (N, 2) in the texture with v downwards; and their material."""


def read_tile(path: Path, yaw: int = RELEASE_YAW) -> SetTile:
    """Read the tile in a binary glTF.

    Args:
        path: The GLB file.
        yaw: Degrees by which the scene turns the tile about z, one of `YAWS`.

    Raises:
        MissingExtraError: Without trimesh.
        SuiteError: If the file cannot be read, or nothing faces up. Also if the upper face has no picture, more
            than one, or one that is tinted, repeated or askew.
    """
    trimesh = require("trimesh", "act2answer")
    if not path.is_file():
        raise SuiteError(f"{path} not found; check out the assets of the set, GLB files included.")
    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = list(_meshes(scene))
    except _UNREADABLE as problem:
        raise SuiteError(f"{path} is not a binary glTF ({problem!r}). Check out the assets again.") from problem
    if not meshes:
        raise SuiteError(f"{path} holds no mesh. Check out the assets again.")
    every = np.concatenate([points for points, _ in meshes])
    low, high = every.min(axis=0), every.max(axis=0)
    top = _top(meshes, float(low[2]), float(high[2]), path)
    width, depth, height = (float(extent) for extent in high - low)
    return SetTile(_render_top(top, yaw, path), (width, depth, height))


def _meshes(scene: Any) -> Iterator[tuple[NDArray[np.float64], Any]]:
    """Yield the corners in the scene's frame, with the scale and turn of their node, and the mesh."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if len(getattr(mesh, "faces", ())):
            points = np.asarray(mesh.vertices, np.float64)
            yield points @ transform[:3, :3].T + transform[:3, 3], mesh


def _top(meshes: list[tuple[NDArray[np.float64], Any]], low: float, high: float, path: Path) -> Top:
    upward = []
    for points, mesh in meshes:
        corners = points[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        steep = np.divide(normals[:, 2], lengths, out=np.zeros_like(lengths), where=lengths > 0)
        level = corners[:, :, 2].mean(axis=1) >= high - _LEVEL * max(high - low, 1e-9)
        if (vertices := np.unique(mesh.faces[(steep > _UP) & level])).size:
            upward.append((points[vertices, :2], vertices, mesh))
    if len(upward) != 1:
        what = f"{len(upward)} meshes face up at its top" if upward else "nothing faces up at its top"
        raise SuiteError(f"{path}: {what}; expected one with one picture.")
    xy, vertices, mesh = upward[0]
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or getattr(mesh.visual, "material", None) is None:
        raise SuiteError(f"{path}: what faces up has no texture; expected a picture as baseColorTexture.")
    return xy, np.asarray(uv, np.float64)[vertices] * (1, -1) + (0, 1), mesh.visual.material


def _render_top(top: Top, yaw: int, path: Path) -> Image.Image:
    xy, uv, material = top
    texture = _texture(material, path)
    slope = _slope(xy, uv, path)
    pixels = np.asarray(_cut(texture, uv, path))
    if abs(slope[0, 0]) < abs(slope[0, 1]):  # u runs along y
        pixels, slope = np.swapaxes(pixels, 0, 1), slope[::-1]
    if slope[0, 0] < 0:
        pixels = pixels[:, ::-1]
    if slope[1, 1] > 0:  # rows run downwards, y away
        pixels = pixels[::-1]
    turns = (RELEASE_YAW - yaw) // 90
    picture = Image.fromarray(np.ascontiguousarray(np.rot90(pixels, -turns)))
    across, away = np.ptp(xy, axis=0)[:: 1 if turns % 2 == 0 else -1]
    longer = max(picture.size)
    size = (round(longer * across / max(across, away)), round(longer * away / max(across, away)))
    return picture if picture.size == size else picture.resize(size, Image.Resampling.BICUBIC)


def _texture(material: Any, path: Path) -> Image.Image:
    texture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if texture is None:
        raise SuiteError(f"{path}: what faces up has no texture; expected a picture as baseColorTexture.")
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None and (np.asarray(factor)[:3] != 255).any():
        raise SuiteError(f"{path}: its texture is tinted by baseColorFactor {list(factor)}; expected white.")
    return rgb_of(texture, f"{path}, texture:", "Check out the assets again.")


def _slope(xy: NDArray[np.float64], uv: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Return (2, 2) how much of the picture's width and height (u, v) passes along the tile's x and y."""
    design = np.column_stack([xy, np.ones(len(xy))])
    fitted, _, rank, _ = np.linalg.lstsq(design, uv, rcond=None)
    off = float(np.abs(design @ fitted - uv).max())
    slope: NDArray[np.float64] = (fitted[:2] * np.ptp(xy, axis=0)[:, None]).T
    # Along the sides, every row has one large entry, and not the same column.
    small, large = np.sort(np.abs(slope), axis=1).T
    of_width, of_height = np.abs(slope).argmax(axis=1)
    if rank < design.shape[1] or off > _STRAIGHT or (small > _STRAIGHT * large).any() or of_width == of_height:
        raise SuiteError(
            f"{path}: the picture does not lie along the sides of what faces up (texture coordinates per side "
            f"{slope.round(3).tolist()}, off by {off:.3f}); expected one picture, upright or turned by quarters."
        )
    return slope


def _cut(texture: Image.Image, uv: NDArray[np.float64], path: Path) -> Image.Image:
    low, high = uv.min(axis=0), uv.max(axis=0)
    if (low < -_STRAIGHT).any() or (high > 1 + _STRAIGHT).any():
        raise SuiteError(
            f"{path}: texture coordinates run from {low.round(3).tolist()} to {high.round(3).tolist()}; expected "
            "0 to 1: a picture that is not repeated."
        )
    size = np.array(texture.size)
    left, upper = np.round(low.clip(0, 1) * size).astype(int)
    right, lower = np.round(high.clip(0, 1) * size).astype(int)
    return texture.crop((int(left), int(upper), int(right), int(lower)))


# -- pairs and objects -------------------------------------------------------------------------------------------


SOURCE = "act2answer"
PAIRS = "pairs.json"
REMEDY = "Name the folder of one set, such as carrot/test_colors, with its shapes."
_SIDES: dict[str, Side] = {"left": "left", "right": "right"}


@dataclass(frozen=True)
class SetQuestion:
    """One question of a set.

    Attributes:
        index: Position of the question in its set.
        left: Name of the left tile.
        right: Name of the right tile.
        concepts: Names of the left and the right picture's content.
    """

    index: int
    left: str
    right: str
    question: str
    answer: Side
    concepts: tuple[str, str]


def read_pairs(root: Path) -> list[SetQuestion]:
    """Read every question in the order of its index.

    Raises:
        SuiteError: For an answer that is no side (the release takes it for left), or for one tile on both sides
            (the release has one body per name). Also for indices that are not 0, 1, 2 … (the release asks for them
            one by one).
    """
    path = root / PAIRS
    records = read_annotations(path, SOURCE, REMEDY, list)
    if not records:
        raise SuiteError(f"{SOURCE}: {path} holds no question. {REMEDY}")
    read = (_pair(record, position, path) for position, record in enumerate(records))
    pairs = sorted(read, key=attrgetter("index"))
    gap = next((expected for expected, pair in enumerate(pairs) if pair.index != expected), None)
    if gap is not None:
        raise SuiteError(
            f"{SOURCE}: {path} has {len(pairs)} questions, and index {pairs[gap].index} where {gap} was "
            "expected; the release asks for 0, 1, 2 … without a gap. Correct the file."
        )
    return pairs


def _pair(record: Any, position: int, path: Path) -> SetQuestion:
    where = f"question {position} of {path}"
    index = record.get("index", position) if isinstance(record, dict) else position
    if not isinstance(index, int) or isinstance(index, bool):
        raise SuiteError(f"{SOURCE}: {where}: index is {index!r}; expected a whole number.")
    left, right, question, answer = (
        field_of(record, name, str, SOURCE, where) for name in ("left", "right", "question", "answer")
    )
    side = answer.strip().lower()
    if side not in _SIDES:
        raise SuiteError(
            f"{SOURCE}: {where}: answer is {answer!r}; expected Left or Right. The release would take it for left."
        )
    if left == right:
        raise SuiteError(
            f"{SOURCE}: {where}: the tile {left!r} lies on both sides; the release has one body per name."
        )
    if not question.strip() or len(question.splitlines()) != 1:
        raise SuiteError(f"{SOURCE}: {where}: question is {question!r}; expected one line of words.")
    labels = tuple(str(record.get(f"{side}_label") or "").strip() for side in _SIDES)
    concepts = (labels[0], labels[1]) if all(labels) and labels[0] != labels[1] else (left, right)
    return SetQuestion(index, left, right, question, _SIDES[side], concepts)


def object_of(question: str) -> tuple[str, str]:
    """Return the object of a question and its article: the words behind "on", or all words without an "on"."""
    _, preposition, behind = question.partition(" on ")
    phrase = (behind if preposition else question).strip().rstrip(".").strip()
    article, space, noun = phrase.partition(" ")
    return (noun.strip(), "the") if space and article.lower() == "the" else (phrase, "none")


# -- conversion --------------------------------------------------------------------------------------------------


VERSION = "1.0.0"
TILES = "model_db.json"
_URL = "https://github.com/CognitiveAISystems/Act2Answer"
_SAME_SIZE = 0.001
"""Metres by which a tile's mesh may differ from the box that its set scores."""


class BoundingBoxWarning(UserWarning):
    """A warning that a set scores its tiles as smaller or larger than they are drawn."""


def convert_set(
    root: Path, out: Path, categories: Sequence[str] | None, n: int, values: Mapping[str, Any]
) -> Suite:
    """Write the first `n` questions of the set in `root` as a suite in `out`; sides, words and pictures stay.

    Args:
        root: Folder of one set, with `pairs.json`, `model_db.json` and the tiles.
        out: Folder to write; new or empty, or with this very suite.
        categories: The one category under which the questions are counted; None for the one in the folder's name.
        n: Most questions.
        values: Fields of Act2AnswerOptions by name.

    Raises:
        MissingExtraError: Without trimesh.
        UsageError: For an unknown option or turn of the tiles, a folder that does not exist, or other than one
            category.
        SuiteError: For a set that cannot be converted; the message names the file and the record.
    """
    options = options_from(Act2AnswerOptions, dict(values))
    if options.tile_yaw not in YAWS:
        raise UsageError(f"tile_yaw is {options.tile_yaw}; expected one of {', '.join(map(str, YAWS))} degrees")
    if not root.is_dir():
        raise UsageError(f"{SOURCE}: {root} is not a folder. {REMEDY}")
    category = _category(root, categories)
    check_foreign_folder(out)
    pairs = read_pairs(root)
    assets = _Assets(root, options)
    items = [assets.item(category, pair) for pair in pairs[:n]]
    assets.compare_sizes()
    card = {
        "annotation_files": {name: sha256(read_regular(root / name)).hexdigest() for name in (PAIRS, TILES)},
        "source_url": _URL,
    }
    settings = asdict(options) | {"items_per_category": n, "source": SOURCE}
    suite = new_suite(f"a2a-{SOURCE}-{root.resolve().name}", VERSION, with_groups(items), settings, card)
    stats = {category: {"pool": len(pairs), "emitted": len(items)}, "notes": assets.notes}
    return save_suite(suite, assets.files, stats, out)


def _category(root: Path, categories: Sequence[str] | None) -> str:
    """Return the requested category, or the only one that the folder's name contains."""
    if categories is not None:
        if len(categories) != 1:
            raise UsageError(f"{SOURCE}: a set has one category; {', '.join(categories) or 'none'} given.")
        return check_categories(categories, list(CATEGORIES))[0]
    words = set(re.findall(r"[a-z]+", root.resolve().name.lower()))
    words |= {word.removesuffix("s") for word in words}
    matching = [slug for slug in CATEGORIES if set(slug.split("-")) <= words]
    if len(matching) != 1:
        raise UsageError(
            f"{SOURCE}: folder name {root.resolve().name!r} contains {' and '.join(matching) or 'no category'}; "
            f"name the category of its questions: --categories with one of {', '.join(CATEGORIES)}"
        )
    return matching[0]


class _Assets:
    """The tiles of a set, each read once.

    `files` are the pictures that the suite stores, by file name; `notes` are for its statistics.
    """

    def __init__(self, root: Path, options: Act2AnswerOptions) -> None:
        self._root, self._options = root, options
        self._tiles: dict[str, tuple[SetTile, Picture]] = {}
        self.files: dict[str, bytes] = {}
        self.notes: list[str] = []

    @cached_property
    def _records(self) -> dict[str, Any]:
        records: dict[str, Any] = read_annotations(self._root / TILES, SOURCE, REMEDY)
        return records

    def item(self, category: str, pair: SetQuestion) -> Item:
        """Make the item of one question.

        Raises:
            SuiteError: For a tile that is not described, cannot be read, or is equal to the other one.
        """
        left, right = (self._store_picture(name, pair) for name in (pair.left, pair.right))
        if left.pixels_sha256 == right.pixels_sha256:
            raise SuiteError(
                f"{SOURCE}: question {pair.index}: tiles {pair.left!r} and {pair.right!r} show the same picture."
            )
        right_side = int(pair.answer == "right")
        content = {
            "set": self._root.resolve().name,
            "index": pair.index,
            "question": pair.question,
            "answer": pair.answer,
            "left": left.pixels_sha256,
            "right": right.pixels_sha256,
        }
        phrase, article = object_of(pair.question)
        return make_item(
            f"{SOURCE}-{category}-{sha256_json(content)[:10]}",
            category,
            pair.answer,
            (left, right),
            construction="native_pair",
            instruction=pair.question,
            object_phrase=phrase,
            object_article=article,
            target_concept=pair.concepts[right_side],
            distractor_concept=pair.concepts[1 - right_side],
            pair_id=f"{SOURCE}-{category}-{sha256_json(sorted([left.pixels_sha256, right.pixels_sha256]))[:12]}",
            rule_id=VERBATIM,
            license=self._options.license,
            attribution=f"tiles of the set {self._root.resolve().name}; no licence is stated with them",
            redistributable=False,
            contains_real_face=self._options.contains_real_face or category == "celebrity",
            source={
                "benchmark": SOURCE,
                "version": "unknown",
                "split": "unknown",
                "source_id": f"{self._root.resolve().name}#{pair.index}",
                "url": _URL,
                "question": pair.question,
                "left_tile": pair.left,
                "right_tile": pair.right,
                "left_original_pixels_sha256": left.original_pixels,
                "right_original_pixels_sha256": right.original_pixels,
                "picture_operation": left.operation,
            },
            side_word=bool(side_words(pair.question)),
        )

    def _store_picture(self, name: str, pair: SetQuestion) -> Picture:
        if name not in self._tiles:
            if name not in self._records:
                raise SuiteError(
                    f"{SOURCE}: question {pair.index} of {self._root / PAIRS} names the tile {name!r}, which "
                    f"{self._root / TILES} does not describe. Correct one of the files."
                )
            tile = read_tile(self._root / "shapes" / name / "textured.glb", self._options.tile_yaw)
            operation = (
                "texture of the face that looks up, turned as it lies before the viewer, flattened on white"
            )
            stored = squared_picture("", tile.picture, operation)
            # Tile names repeat from set to set; what ties questions together is the picture.
            stored = replace(stored, image_id=f"{SOURCE}/{stored.original_pixels[:16]}")
            self._tiles[name] = tile, stored
            self.files[stored.file_name] = stored.png
        return self._tiles[name][1]

    def compare_sizes(self) -> None:
        """Warn, and note in the statistics, where the scored box differs from the drawn tile."""
        differing = []
        for name, (tile, _) in self._tiles.items():
            where = f"tile {name} of {self._root / TILES}"
            box = field_of(self._records[name], "bbox", dict, SOURCE, where)
            low, high = (field_of(box, end, list, SOURCE, where) for end in ("min", "max"))
            scale = (self._records[name].get("scales") or [1])[0]
            try:
                scored = [float(upper) * float(scale) - float(lower) * float(scale)
                          for lower, upper in zip(low, high, strict=True)]  # fmt: skip
            except (TypeError, ValueError) as problem:
                raise SuiteError(f"{SOURCE}: {where}: bbox or scales hold no numbers ({problem}).") from problem
            drawn = [extent * float(scale) for extent in tile.size]
            if any(abs(side - drawn_side) > _SAME_SIZE for side, drawn_side in zip(scored, drawn, strict=False)):
                differing.append((name, scored[0], drawn[0]))
        if differing:
            name, scored_width, drawn_width = differing[0]
            note = (
                f"{len(differing)} of {len(self._tiles)} tiles are drawn larger or smaller than the box that is "
                f"scored: {name} is {drawn_width:.4f} m wide and scored as {scored_width:.4f} m. Choose "
                "--tile-side for what is drawn; outcome rules have their own size"
            )
            self.notes.append(note)
            warnings.warn(f"{SOURCE}: {note}", BoundingBoxWarning, stacklevel=4)
