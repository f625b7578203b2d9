"""A run of policies whose wiring is written down, with probes and every intervention, as a user has them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from probe_kit.hooks import Site, capture
from probe_kit.intervene import ImageSwap, Interchange, JointPlaces, UseVerdict
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.intervene.places import ALL
from probe_kit.intervene.results import verdicts_of
from probe_kit.intervene.settings import FORMAT
from probe_kit.runs.run_source import SCENE, RunSource
from probe_kit.train import ArrayRun, train_probes
from tests.intervene.answers import store_outcomes
from tests.intervene.wirings import BLOCKS, IMAGE, WORDS, WiredSession, outcomes_of, replay_inputs

SUITE = "suite@1#0123456789ab"
VIEWS = {"mean": slice(None), "mean:image": IMAGE, "mean:language": WORDS}
ROLES = (ALL, "image", "language", "state")


class WiredRun(ArrayRun):
    """Arrays of a scene: the pictures of every item lie on two sides, and are swapped."""

    @property
    def source(self) -> RunSource:
        return RunSource(SCENE, self.suite, super().source.words)


def wired_run(session: WiredSession, names: Sequence[str], folder: Path) -> ArrayRun:
    """Activations of the clean inferences of these wirings, each a category."""
    inputs = [replay_input for name in names for replay_input in replay_inputs(name)]
    sites = [Site("backbone", layer) for layer in range(BLOCKS + 1)]
    features: dict[tuple[Site, str], list[np.ndarray]] = {(site, view): [] for site in sites for view in VIEWS}
    for replay_input in inputs:
        with capture(session.policy, sites) as cache:
            session.act(replay_input.clean, replay_input.seed)
        for site, view in features:
            features[site, view].append(cache[site][0, VIEWS[view]].mean(0).numpy())
    columns = {"episode_id": "episode", "item_id": "item", "group_id": "group", "side_correct": "side"}
    episodes = pd.DataFrame(
        {name: [getattr(replay_input, field) for replay_input in inputs] for name, field in columns.items()}
    )
    episodes["category"] = [replay_input.category for replay_input in inputs]
    episodes["layout"] = [
        "original" if replay_input.episode.endswith(":o") else "swapped" for replay_input in inputs
    ]
    episodes["outcome"], episodes["side_placed"] = "correct", episodes["side_correct"]
    run = WiredRun(folder, "wired", SUITE, episodes, {key: np.array(rows) for key, rows in features.items()})
    session.run = run  # type: ignore[assignment]
    return run


def intervene(session: WiredSession, run: ArrayRun, planned: Intervention) -> None:
    """Store what `run_intervention` would."""
    names = list(dict.fromkeys(run.episodes["category"]))
    conditions = planned.conditions(session)
    outcomes = outcomes_of(session, names, conditions[2:])
    entries = dict(session.certificate)
    settings = {
        "format": FORMAT, "kind": planned.kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": names, "readout": planned.readout, **planned.parameters(),
    }  # fmt: skip
    check = {"episodes": 0, "compared": 0, "equal": 0, "largest_difference": 0.0}
    store_outcomes(run.location, run.suite, settings, outcomes, {"replay": check, **entries})


def concluded(
    session: WiredSession,
    names: Sequence[str],
    folder: Path,
    view: str = "mean:language",
    permutations: int = 199,
    more_interventions: Sequence[Intervention] = (),
) -> dict[str, UseVerdict]:
    """By wiring the verdict with place and tie, from probes of one view, all interventions and further ones."""
    run = wired_run(session, names, folder)
    train_probes(run, views=(view,), permutations=permutations, controls=())
    role = view.partition(":")[2] or ALL
    sites = tuple(f"backbone.{layer:02d}" for layer in range(1, BLOCKS + 1))
    for intervention in (
        ImageSwap(),
        Interchange(sites=("backbone.*", "kv.*"), roles=ROLES),
        Interchange(sites=sites, roles=(role,), direction="mean-difference", controls=1),
        JointPlaces(roles=ROLES[1:]),
        *more_interventions,
    ):
        intervene(session, run, intervention)
    return verdicts_of(run)
