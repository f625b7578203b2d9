"""Settings that determine the numbers of a sweep."""

from dataclasses import asdict, dataclass

from probe_kit.hashing import sha256_json
from probe_kit.statistics.folds import FoldUnit
from probe_kit.train.choices import SIDES, Incomplete, Task

FORMAT = 8  # raise when settings have other fields or would give other numbers


@dataclass(frozen=True)
class ProbeSettings:
    """Everything that decides the numbers; its hash is the results' key.

    seed_text: of the run, see `RunReader`; scores on equal groups of one are paired. episodes: sha256 of the ids
    of the run's episodes, so that a run that grew is probed again. label: sha256 of the labels of the target.
    token_permutations: 0 where no token view is probed. call: captured inference that a label of a whole episode
    is decoded from. window: inferences per episode. group_by: column of the groups. exchange_within: column of the
    strata, empty for exchanges everywhere. grouping: sha256 of groups and strata, empty for a side. align_to:
    column of the event where windows begin, `#` and a part of its hash; empty for the first inference.
    """

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    seed_text: str
    run_settings: str
    episodes: str
    categories: tuple[str, ...]
    views: tuple[str, ...]
    target: str
    permutations: int
    seed: int
    token_permutations: int = 0
    folds: FoldUnit = "groups"
    incomplete: Incomplete = "keep"
    call: int = 0
    task: Task = "binary"
    label: str = ""
    group_by: str = "group_id"
    exchange_within: str = ""
    grouping: str = ""
    window: int = 1
    align_to: str = ""
    format: int = FORMAT

    @property
    def key(self) -> str:
        """First 12 hex digits of the settings' sha256: the name of the results' folder."""
        return sha256_json(asdict(self))[:12]

    @property
    def is_side(self) -> bool:
        """Whether the target is the side of a picture."""
        return self.target in SIDES
