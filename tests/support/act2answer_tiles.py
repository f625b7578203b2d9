"""Tiles as Act2Answer's tools write them: binary glTF, a box with one picture, its attributes interleaved."""

import json
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, THICKNESS = 0.1452, 0.006
FLOAT, SHORT = 5126, 5123
# Corners of the top face as multiples of its half side: nearer left, nearer right, farther right, farther left.
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def write_tile(
    path: Path,
    picture: Image.Image,
    along_u: tuple[int, int] = (1, 0),
    down_v: tuple[int, int] = (0, -1),
    *,
    width: float = WIDTH,
    scale: tuple[float, float, float] = (1.0, 1.0, 0.6),
    decoy: Image.Image | None = None,
    factor: list[float] | None = None,
    repeat: float = 1.0,
) -> Path:
    """A tile whose top shows `picture`, with its width (u) along `along_u` and its height (v) along `down_v`.

    The defaults are the upright convention. decoy: a picture that comes first in the file and that the sides show.
    scale: of the node; the corners are divided by it.
    """
    half = np.array([width / 2, width / 2, THICKNESS / 2]) / scale
    rows: list[tuple[float, ...]] = []
    for level in (1, -1):
        for x, y in CORNERS:
            u, v = (((x * d[0] + y * d[1]) + 1) / 2 * repeat for d in (along_u, down_v))
            rows.append((x * half[0], y * half[1], level * half[2], 0.0, 0.0, float(level), u, v))
    top, other_faces = [0, 1, 2, 0, 2, 3], [4, 6, 5, 4, 7, 6]
    for near, far in ((0, 1), (1, 2), (2, 3), (3, 0)):
        other_faces += [near, near + 4, far, far, near + 4, far + 4]
    images = [decoy, picture] if decoy is not None else [picture]
    blocks = [
        np.array(rows, "<f4").tobytes(),
        np.array(top, "<u2").tobytes(),
        np.array(other_faces, "<u2").tobytes(),
        *map(_png, images),
    ]
    offsets = np.cumsum([0] + [-(-len(block) // 4) * 4 for block in blocks]).tolist()
    views = [{"buffer": 0, "byteOffset": offset, "byteLength": len(block)}
             for offset, block in zip(offsets, blocks, strict=False)]  # fmt: skip
    views[0]["byteStride"] = 32
    corner_kinds = [("VEC3", 0), ("VEC3", 12), ("VEC2", 24)]
    accessors: list[dict[str, object]] = [
        {"bufferView": 0, "byteOffset": start, "componentType": FLOAT, "count": len(rows), "type": kind}
        for kind, start in corner_kinds
    ]
    positions = np.array(rows)[:, :3]
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    accessors += [
        {"bufferView": view, "componentType": SHORT, "count": len(part), "type": "SCALAR"}
        for view, part in ((1, top), (2, other_faces))
    ]
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}} for index in range(len(images))]
    if factor is not None:
        materials[-1]["pbrMetallicRoughness"]["baseColorFactor"] = factor  # type: ignore[assignment]
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": list(scale)}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": attributes, "indices": 3, "material": len(images) - 1},
                    {"attributes": attributes, "indices": 4, "material": 0},
                ]
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1]}],
        "images": [{"bufferView": 3 + index, "mimeType": "image/png"} for index in range(len(images))],
        "textures": [{"source": index} for index in range(len(images))],
        "materials": materials,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_glb(scene, b"".join(block.ljust(-(-len(block) // 4) * 4, b"\0") for block in blocks)))
    return path


def _png(image: Image.Image) -> bytes:
    buffer = BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def _glb(scene: dict[str, object], binary: bytes) -> bytes:
    text = json.dumps(scene).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    chunks = b"".join(
        struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in ((b"JSON", text), (b"BIN\0", binary))
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def art(seed: int, side: int = 256) -> Image.Image:
    """A picture without any symmetry: four corners of different grey, and noise."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 60, (side, side, 3), np.uint8)
    half = side // 2
    for corner, level in (((0, 0), 10), ((0, half), 80), ((half, 0), 130), ((half, half), 190)):
        pixels[corner[0] : corner[0] + half, corner[1] : corner[1] + half] += np.uint8(level)
    return Image.fromarray(pixels)
