"""Networks of released sizes have the tensors of lerobot's own classes, as many bytes as published files."""

import gzip
import json
from math import prod
from pathlib import Path

import pytest

from probe_kit.hooks.verification.verify import verify_keys

GOLDEN = Path(__file__).parents[2] / "golden"
BYTES = {"float32": 4, "bfloat16": 2, "int64": 8}


@pytest.mark.parametrize(
    ("family", "folder", "keys"),
    [
        ("pi05", "pi05", 813),
        ("pi0-fast", "pi0_fast", 604),
        ("molmoact2", "molmoact2", 1295),
        ("groot", "groot", 1031),
        ("xvla", "xvla", 903),
    ],
)
def test_released_sizes_have_the_tensors_that_lerobots_classes_have(family: str, folder: str, keys: int) -> None:
    (whole,) = verify_keys(family, GOLDEN / folder / "real_keys.json.gz").comparisons
    assert (whole.status, whole.output) == ("ok", f"{keys} keys")


@pytest.mark.parametrize(
    ("folder", "twice", "share", "published"),
    [
        ("molmoact2", "", 1, 10.9),  # a fine-tune, in bfloat16
        ("groot", "", 0.5, 6.91),  # nvidia/GR00T-N1.7-3B, in bfloat16, with either name of the tied embeddings
        ("xvla", "model.vlm.language_model.shared.weight", 1, 3.52),  # 2toINF/X-VLA-WidowX, in float32
    ],
)
def test_the_tensors_take_as_many_bytes_as_the_published_file(
    folder: str, twice: str, share: float, published: float
) -> None:
    """In GB, as the pages of the hub round it. twice: a name of tied embeddings that a file leaves out."""
    content = json.loads(gzip.decompress((GOLDEN / folder / "real_keys.json.gz").read_bytes()))["keys"]
    assert not twice or twice in content
    held = [prod(own["shape"]) * BYTES[own["dtype"]] for name, own in content.items() if name != twice]
    assert share * sum(held) / 1e9 == pytest.approx(published, abs=0.06 if published > 10 else 0.006)
