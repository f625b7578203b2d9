"""What one extraction is asked to do, and the part of it that names the result."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError, UsageError
from probe_kit.extract.store.layout import CODECS
from probe_kit.hooks.edits import Edit, Vectors
from probe_kit.identity import sha256_json

TOKENS = ("pooled", "all")
VIDEOS = ("none", "first", "all")
FRAMES = ("ends", "none")
# Named by what they lead to (a weights hash, a list of episodes), not by themselves.
_ELSEWHERE = {
    "checkpoint",
    "options",
    "label",
    "weights_seed",
    "suite",
    "categories",
    "items",
    "scene",
    "edits",
    "vectors",
}
_MACHINE = {"allow_mixed", "device", "video", "frames", "batch", "env_workers", "workers", "ray"}


@dataclass(frozen=True)
class ExtractSettings:
    """Everything `probe-kit extract` can be told; the defaults are the command line's.

    model: a family of `probe-kit models`, or `expert` / `expert-mirrored` / `idle` (scripted, no activations).
    checkpoint: folder or hub id; None for the family's default.
    weights_seed: of a random twin's weights.
    options: what only some families have, such as `unnorm_key`; what they lead to is in the policy's card.
    label: what tables and legends call the run; None for the model and what sets it apart, see `run_label`.
    edits: what is changed in the streams at every inference; vectors: their directions and donors, by hash.
    suite: suite folder; None for the embedded suite.
    categories: slugs; None for all of the suite. items: items per category; None for all.
    tokens: `pooled` stores pooled views only, `all` also every token.
    captured_calls: policy inferences captured per episode, from the first on.
    execute: actions executed per inference; None for the policy's own.

    The rest changes no stored number, only how fast it comes:
    batch: observations per call of the policy. With 1, bytes repeat exactly; with more, up to float rounding.
    frames: `ends` keeps a thumbnail of the first and last frame of every episode, `none` does not.
    env_workers: processes that simulate and draw; None for two per observation of a batch, 0 for this process.
    workers: processes with a model each, one per GPU where there are several; 0 for this process.
    ray: address of a Ray cluster, or `auto`; the workers then run there.
    allow_mixed: continue a run whose episodes were made on another kind of device or with other versions; it is
    then marked as mixed wherever it is shown.
    """

    model: str
    checkpoint: str | None = None
    random_weights: bool = False
    weights_seed: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)
    suite: Path | None = None
    categories: tuple[str, ...] | None = None
    items: int | None = None
    scene: SceneSpec = field(default_factory=SceneSpec)
    seed: int = 0
    tokens: str = "pooled"
    captured_calls: int = 1
    execute: int | None = None
    label: str | None = None
    edits: tuple[Edit, ...] = ()
    vectors: Vectors = field(default_factory=dict)
    codec: str = "zstd"
    device: str = "cpu"
    dtype: str | None = None
    video: str = "none"
    frames: str = "ends"
    batch: int = 1
    env_workers: int | None = None
    workers: int = 0
    ray: str | None = None
    allow_mixed: bool = False

    def __post_init__(self) -> None:
        for name, allowed in (("tokens", TOKENS), ("codec", CODECS), ("video", VIDEOS), ("frames", FRAMES)):
            if getattr(self, name) not in allowed:
                raise UsageError(f"{name} is {getattr(self, name)!r}; expected one of {', '.join(allowed)}")
        least = {"captured_calls": 1, "execute": 1, "items": 1, "batch": 1, "workers": 0, "env_workers": 0}
        for name, bound in least.items():
            value = getattr(self, name)
            if value is not None and value < bound:
                raise UsageError(f"{name} is {value}; expected at least {bound}")

    def choices(self) -> dict[str, Any]:
        """The settings that change the stored numbers by themselves: neither paths nor the machine."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ELSEWHERE | _MACHINE}
        return plain | ({"edits": [edit.to_json() for edit in self.edits]} if self.edits else {})


def run_label(settings: ExtractSettings) -> str:
    """What tables call the run: base, fine-tune, random twins and other options of one family differ in it."""
    if settings.label is not None:
        return settings.label
    parts = [settings.model]
    if settings.checkpoint is not None:
        parts.append(Path(settings.checkpoint).name)
    parts += [f"{name}={value}" for name, value in sorted(settings.options.items())]
    if settings.random_weights and settings.weights_seed:
        parts.append(f"twin {settings.weights_seed}")
    if settings.edits:
        parts.append(f"edited {sha256_json([edit.to_json() for edit in settings.edits])[:6]}")
    return " · ".join(parts)


def refuse_other_settings(stored: dict[str, Any], asked: dict[str, Any], where: str) -> None:
    """Raise SettingsMismatchError naming the settings that differ between a stored run and this request."""
    was, now = _flat(stored), _flat(asked)
    different = [key for key in sorted(was | now) if was.get(key) != now.get(key)]
    if different:
        lines = [f"  {key}: stored {was.get(key)!r}, asked {now.get(key)!r}" for key in different]
        raise SettingsMismatchError(
            f"{where} holds a run with other settings:\n" + "\n".join(lines) + "\n"
            "Choose another --out, or repeat the stored settings to continue it"
        )


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix: value}
    return {
        key: leaf
        for name, child in value.items()
        for key, leaf in _flat(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }
