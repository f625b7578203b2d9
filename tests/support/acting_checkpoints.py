"""How each family that acts gets a tiny checkpoint that knows a suite's words."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from probe_kit.suite import Suite
from tests.support.every_checkpoint import WRITERS

GOLDEN = Path(__file__).parents[1] / "golden"


@dataclass(frozen=True)
class Tiny:
    """How a family's tiny checkpoint is prepare_checkpoint: written, or a golden reference, or the embedded one.

    golden: name of the reference. options: of loading.
    """

    write: Callable[[Path], Path] | None = None
    golden: str = ""
    options: dict[str, Any] = field(default_factory=dict)

    def prepare_checkpoint(self, suite: Suite, folder: Path) -> str | None:
        """The checkpoint, in `folder`; None for the embedded one."""
        if self.golden:
            return str(knowing(GOLDEN / self.golden, suite, folder) / "checkpoint")
        return None if self.write is None else str(self.write(folder))


_WRITTEN = ("pi05", "pi0-fast", "molmoact2", "groot", "xvla", "eo1", "openvla", "spatialvla", "magma", "xiaomi-r0",
            "internvla-m1")  # fmt: skip
FAMILIES = {
    "pi0-tiny": Tiny(),
    "pi0": Tiny(golden="pi0"),
    "smolvla": Tiny(golden="smolvla"),
    **{name: Tiny(WRITERS[name][0], options=WRITERS[name][1]) for name in _WRITTEN},
}


def knowing(golden: Path, suite: Suite, copy: Path) -> Path:
    """A reference whose tokenizer has the suite's words in the place of others."""
    shutil.copytree(golden, copy, dirs_exist_ok=True)
    (file,) = copy.rglob("tokenizer.json")
    tokenizer = json.loads(file.read_text(encoding="utf-8"))
    vocabulary, special = tokenizer["model"]["vocab"], {token["content"] for token in tokenizer["added_tokens"]}
    intervention = dict.fromkeys(word for item in suite.items for word in item.instruction.split())
    spare = [word for word in vocabulary if word not in special | {"\n", *intervention}]
    missing = [word for word in intervention if word not in vocabulary]
    assert len(missing) <= len(spare)
    for word, other in zip(missing, spare, strict=False):
        vocabulary[word] = vocabulary.pop(other)
    file.write_text(json.dumps(tokenizer), encoding="utf-8")
    return copy
