"""Settings that determine the numbers of a sweep."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from probe_kit.hashing import sha256_json
from probe_kit.statistics.folds import FoldUnit
from probe_kit.train.choices import Incomplete, Target

LABEL_FORMAT = "labels-3"  # of probes of a label of one's own, which are stored beside the others
FORMAT = 6  # raise when settings have other fields or would give other numbers


@dataclass(frozen=True)
class ProbeSettings:
    """Everything that decides the numbers; its hash is the results' key.

    seed_text: of the run, see `seed_text_of`; scores on equal groups of one are paired.
    """

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    seed_text: str
    run_settings: str
    episodes: str  # sha256 of the episode ids, so that a run that grew is probed again
    categories: tuple[str, ...]
    views: tuple[str, ...]
    target: Target
    permutations: int
    seed: int
    token_permutations: int = 0  # 0 where no token view is probed
    folds: FoldUnit = "groups"
    incomplete: Incomplete = "keep"
    format: int = FORMAT
    call: int = 0  # captured inference, counted from 0

    @property
    def key(self) -> str:
        """First 12 hex digits of the settings' sha256: the name of the results' folder."""
        return key_of(asdict(self))


def key_of(settings: Mapping[str, Any]) -> str:
    """The same of settings as they are stored, those of other formats included.

    What was added later is left out at its default, so that older results keep their name: the first inference,
    and windows that begin there.
    """
    defaults = {"call": 0, "align_to": ""}
    return sha256_json({n: value for n, value in settings.items() if n not in defaults or value != defaults[n]})[
        :12
    ]
