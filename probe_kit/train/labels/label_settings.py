"""Settings that determine the numbers of probes of a label."""

from dataclasses import asdict, dataclass

from probe_kit.train.choices import Task
from probe_kit.train.settings import LABEL_FORMAT, key_of


@dataclass(frozen=True)
class LabelSettings:
    """Everything that decides the numbers; its hash is the results' key, in one namespace with other probes.

    seed_text: of the run, see `seed_text_of`; scores on equal groups of one are paired.
    label: sha256 of the label column. grouping: sha256 of the groups and strata of its samples. episodes: sha256
    of the ids of the run's episodes. categories: those whose episodes are probed together; empty for all.
    align_to: column of the event where windows begin, `#` and a part of its hash; empty for the first inference.
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
    task: Task
    label: str
    group_by: str
    exchange_within: str
    grouping: str
    window: int
    call: int
    permutations: int
    seed: int
    align_to: str = ""
    format: str = LABEL_FORMAT

    @property
    def key(self) -> str:
        """First 12 hex digits of the settings' sha256: the name of the results' folder."""
        return key_of(asdict(self))
