"""The model families: what can be loaded by name, and third parties' families through entry points."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from probe_kit.errors import UnknownModelError, UsageError

if TYPE_CHECKING:
    from probe_kit.hooks.policy import Policy

ENTRY_POINTS = "probe_kit.policies"
DTYPES = ("float32", "bfloat16")


@dataclass(frozen=True)
class Family:
    """A model family by name.

    default_checkpoint: hub id, or None for the embedded one. streams: layers and iterations at full size.
    loader, verifier, full_size: `module:function`, imported only when used. loader(checkpoint, device, dtype,
    random_weights) gives a Policy; verifier(folder, recorded arrays) gives comparisons; full_size() gives the
    network of the released size on the meta device. options: names of further keyword arguments of the loader.
    """

    name: str
    description: str
    default_checkpoint: str | None
    loader: str
    streams: str = ""
    embodiment: str = "7-DoF end-effector delta"
    notes: str = ""
    verifier: str | None = None
    full_size: str | None = None
    options: tuple[str, ...] = ()

    def load(
        self,
        checkpoint: str | None,
        device: str,
        dtype: str | None,
        random_weights: bool,
        options: Mapping[str, Any] = MappingProxyType({}),
    ) -> "Policy":
        """Load a policy; `checkpoint` None means the default one.

        Raises UsageError for an option it lacks, and for a device or dtype that cannot be used.
        """
        if unknown := sorted(options.keys() - set(self.options)):
            known = f"only {', '.join(self.options)}" if self.options else "none"
            raise UsageError(f"{self.name} has no option {', '.join(unknown)}; of those options it has {known}")
        _check_machine(device, dtype)
        load = _import(self.loader)
        policy: Policy = load(checkpoint or self.default_checkpoint, device, dtype, random_weights, **options)
        return policy

    def function(self, purpose: Literal["verifier", "full_size"]) -> Callable[..., Any]:
        """The family's function for `purpose`. Raises UsageError if it has none."""
        path = getattr(self, purpose)
        if path is None:
            raise UsageError(f"{self.name} has no {purpose.replace('_', '-')}; it cannot be verified this way")
        return _import(path)

    def missing(self) -> str:
        """What this machine lacks to load the default checkpoint; empty if it is ready."""
        if self.default_checkpoint is None:
            return ""
        from huggingface_hub import try_to_load_from_cache

        here = isinstance(try_to_load_from_cache(self.default_checkpoint, "config.json"), str)
        return "" if here else f"download of {self.default_checkpoint}"


def _check_machine(device: str, dtype: str | None) -> None:
    import torch

    if dtype not in (None, *DTYPES):
        raise UsageError(f"dtype is {dtype!r}; expected one of {', '.join(DTYPES)}")
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # what torch raises: unknown, absent
        reason = str(error).partition("\n")[0]
        raise UsageError(f"device {device!r} cannot be used: {reason}. Try 'cpu'") from error


def _import(path: str) -> Callable[..., Any]:
    module, function = path.split(":")
    imported: Callable[..., Any] = getattr(import_module(module), function)
    return imported


_EMBEDDED = (
    Family(
        "pi0-tiny",
        "pi0 at 0.82 million parameters, the embedded default: trained on Color and Shape",
        None,
        "probe_kit.hooks.families.pi0.adapter:load_pi0_tiny",
        streams="backbone 4 layers, expert 4 layers x 10 iterations",
        notes="State is readable in its backbone by training, and not acted on; nothing else was trained",
        verifier="probe_kit.hooks.families.lerobot_verify:verify_pi0",
    ),
    Family(
        "pi0-tiny-early",
        "the embedded default early in its training",
        None,
        "probe_kit.hooks.families.pi0.adapter:load_pi0_tiny_early",
        streams="backbone 4 layers, expert 4 layers x 10 iterations",
        notes="a model organism: see `probe-kit demo --compare`",
        verifier="probe_kit.hooks.families.lerobot_verify:verify_pi0",
    ),
    Family(
        "pi0",
        "pi0 (PaliGemma 3B + 300M flow-matching expert) through lerobot",
        "lerobot/pi0_base",
        "probe_kit.hooks.families.pi0.adapter:load_pi0",
        streams="backbone 19 layers, expert 19 layers x 10 iterations",
        embodiment="as fine-tuned; the base model acts in 32 unnamed dimensions",
        notes="Gemma licence; tokenizer google/paligemma-3b-pt-224 is gated",
        verifier="probe_kit.hooks.families.lerobot_verify:verify_pi0",
        full_size="probe_kit.models.pi0:full_size_pi0",
    ),
    Family(
        "smolvla",
        "SmolVLA (SmolVLM2 500M, 16 layers, + flow-matching expert) through lerobot",
        "lerobot/smolvla_base",
        "probe_kit.hooks.families.smolvla.adapter:load_smolvla",
        streams="backbone 17 layers, expert 17 layers x 10 iterations",
        embodiment="as fine-tuned; the base model acts in SO-100 joint positions",
        notes="Apache-2.0; configuration and tokenizer of HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
        verifier="probe_kit.hooks.families.lerobot_verify:verify_smolvla",
        full_size="probe_kit.models.smolvla:full_size_smolvla",
    ),
    Family(
        "openvla",
        "OpenVLA (DINOv2 + SigLIP, Llama 2 7B, actions as tokens), native; fine-tunes and LoRA as --checkpoint",
        "openvla/openvla-7b",
        "probe_kit.hooks.families.openvla.adapter:load_openvla",
        streams="backbone 33 layers, action 33 layers x 7 action tokens; no action expert",
        embodiment="as the data set of --unnorm-key; bridge_orig: WidowX end-effector delta at 5 Hz",
        notes="MIT, Llama 2 licence; extra openvla; about 16 GB in bfloat16",
        verifier="probe_kit.hooks.families.prismatic.verify:verify_openvla",
        full_size="probe_kit.models.prismatic:full_size_openvla",
        options=("unnorm_key", "prompt", "centre_crop", "tokenizer", "bits"),
    ),
    Family(
        "prismatic",
        "Prismatic vision-language models, OpenVLA's source (one or two towers; Llama 2, Vicuna, Mistral, Phi-2)",
        None,
        "probe_kit.hooks.families.prismatic.adapter:load_prismatic",
        streams="backbone 33 layers, answer 33 layers (7B)",
        embodiment="none: answers, does not act",
        notes="pass --checkpoint in the layout of PrismaticForConditionalGeneration; extra openvla",
        verifier="probe_kit.hooks.families.prismatic.verify:verify_prismatic",
        full_size="probe_kit.models.prismatic:full_size_prismatic",
        options=("tokenizer", "bits", "steps"),
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
    **options: Any,
) -> "Policy":
    """Load the policy `name`, from `checkpoint` (folder or hub id) or the family's default.

    options: what only some families have, such as `unnorm_key`; see `Family.options`.
    Raises UnknownModelError, UsageError, CheckpointError or WeightsError.
    """
    return find_family(name).load(checkpoint, device, dtype, random_weights, options)


def find_family(name: str, others: tuple[str, ...] = ()) -> Family:
    """The family called `name`. `others` are further names to suggest if there is none."""
    known = families()
    if name not in known:
        names = [*known, *others]
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UnknownModelError(f"unknown model {name!r}; known: {', '.join(names)}.{hint}")
    return known[name]
