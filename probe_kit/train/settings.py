"""What decides the numbers of a sweep."""

from dataclasses import asdict, dataclass

from probe_kit.identity import sha256_json
from probe_kit.train.targets import Target

FORMAT = 3  # raise when settings have other fields or would give other numbers


@dataclass(frozen=True)
class ProbeSettings:
    """Everything that decides the numbers; its hash is the results' key."""

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    run_settings: str
    episodes: str  # sha256 of the episode ids, so that a run that grew is probed again
    categories: tuple[str, ...]
    views: tuple[str, ...]
    target: Target
    permutations: int
    seed: int
    token_permutations: int = 0  # 0 where no token view is probed
    format: int = FORMAT

    @property
    def key(self) -> str:
        """First 12 hex digits of the settings' sha256: the name of the results' folder."""
        return sha256_json(asdict(self))[:12]
