"""The model families: what can be loaded by name, and third parties' families through entry points."""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from probe_kit.errors import UnknownModelError

if TYPE_CHECKING:
    from probe_kit.hooks.policy import Policy

ENTRY_POINTS = "probe_kit.policies"


@dataclass(frozen=True)
class Family:
    """A model family by name. `loader` is `module:function`, imported only when a policy is loaded."""

    name: str
    description: str
    default_checkpoint: str | None
    loader: str
    notes: str = ""

    def load(self, checkpoint: str | None, device: str, dtype: str | None, random_weights: bool) -> "Policy":
        """Load a policy; `checkpoint` None means the default one."""
        module, function = self.loader.split(":")
        load: Callable[..., Policy] = getattr(import_module(module), function)
        return load(checkpoint or self.default_checkpoint, device, dtype, random_weights)


_EMBEDDED = (
    Family(
        "pi0-tiny",
        "pi0 at 0.6 million parameters, the embedded default",
        None,
        "probe_kit.hooks.pi0:load_pi0_tiny",
        "random weights; needs no download",
    ),
    Family(
        "pi0",
        "pi0 (PaliGemma 3B + 300M flow-matching expert) through lerobot",
        "lerobot/pi0_base",
        "probe_kit.hooks.pi0:load_pi0",
        "Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated",
    ),
)


def families() -> dict[str, Family]:
    """All families by name. Third parties add theirs as entry points that name a `Family`."""
    found = {family.name: family for family in _EMBEDDED}
    for entry in entry_points(group=ENTRY_POINTS):
        family = entry.load()
        found.setdefault(family.name, family)
    return found


def load_policy(
    name: str,
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
) -> "Policy":
    """Load the policy `name`, from `checkpoint` (folder or hub id) or the family's default.

    Raises UnknownModelError, CheckpointError or WeightsError.
    """
    return find_family(name).load(checkpoint, device, dtype, random_weights)


def find_family(name: str, others: tuple[str, ...] = ()) -> Family:
    """The family called `name`. `others` are further names to suggest if there is none."""
    known = families()
    if name not in known:
        names = [*known, *others]
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UnknownModelError(f"unknown model {name!r}; known: {', '.join(names)}.{hint}")
    return known[name]
