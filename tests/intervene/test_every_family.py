"""The same analysis on a tiny checkpoint of every family that acts: every kind runs, or is refused by name."""

from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import UnsupportedInterventionError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Policy
from probe_kit.hooks.registry import find_family, own_families
from probe_kit.intervene import (
    AttentionReadout,
    AttributionPatching,
    ClosedLoop,
    ConceptErasure,
    ImageSwap,
    InstructionSwap,
    Interchange,
    InterventionResult,
    JointPlaces,
    Knockout,
    ReplayFiles,
    Steering,
    run_intervention,
)
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.runs import Run
from probe_kit.suite import Suite
from tests.support.acting_checkpoints import FAMILIES

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:the model put out tokens")]
ITEMS = 6
COMMON: dict[str, Any] = {"categories": ("color",), "items": ITEMS}


def test_every_family_that_acts_is_here() -> None:
    acting = {name for name, family in own_families().items() if family.abilities.acts}
    assert acting - {"pi0-tiny-early", "pi0-tiny-state"} == FAMILIES.keys()


@pytest.fixture(scope="module", params=FAMILIES)
def measured_run(
    request: pytest.FixtureRequest, small_suite: Suite, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Run, ReplayFiles]:
    tiny = FAMILIES[request.param]
    checkpoint = tiny.prepare_checkpoint(small_suite, tmp_path_factory.mktemp("checkpoint"))
    settings = ExtractSettings(
        request.param, checkpoint, suite=small_suite.folder, items=ITEMS, categories=("color",), frames="none",
        scene=SceneSpec(max_steps=2), options=tiny.options, env_workers=0,
    )  # fmt: skip
    run = extract_run(settings, tmp_path_factory.mktemp("families") / request.param)
    return run, ReplayFiles(small_suite.folder, options=tiny.options)  # it loads the folder that the run names


def asked_of(run: Run, kind: str) -> Intervention:
    last = f"backbone.{run.streams['backbone'].layers - 1:02d}"
    acting = next(stream for stream in run.streams.values() if stream.part == "action")
    late = f"{acting.name}.01@0-{(acting.iterations or 1) - 1}"
    role = "action"
    return {
        "image-swap": lambda: ImageSwap(**COMMON),
        "instruction-swap": lambda: InstructionSwap(**COMMON),
        "interchange": lambda: Interchange(
            **COMMON, sites=("backbone.00", last, late), roles=("all", "image", "language", role)
        ),
        "direction": lambda: Interchange(
            **COMMON, sites=("backbone.01",), roles=("all",), direction="mean-difference", controls=1
        ),
        "kv": lambda: Interchange(**COMMON, sites=("kv.*",), roles=("all", "image")),
        "per-step": lambda: Interchange(**COMMON | {"items": 2}, sites=("backbone.00", last), readout="per-step"),
        "tiles": lambda: Interchange(**COMMON, sites=("backbone.00",), roles=("image.left", "image.right")),
        "steer": lambda: Steering(**COMMON, sites=("backbone.01",), role="all", coefficients=(2.0,), controls=1),
        "erase": lambda: ConceptErasure(**COMMON, sites=("backbone.01",), roles=("all",), controls=1),
        "joint": lambda: JointPlaces(**COMMON | {"items": 2}, sites=("backbone.01",), roles=("image", "language")),
        "attribution": lambda: AttributionPatching(
            **COMMON | {"items": 2},
            sites=("backbone.01", late),
            roles=("image", "language", role),
            top=1,
            controls=1,
        ),
        "knockout": lambda: Knockout(**COMMON | {"items": 2}, roles=("image", "language"), window="2", controls=1),
        "attention": lambda: AttentionReadout(**COMMON | {"items": 2}),
        "attention-shadow": lambda: AttentionReadout(**COMMON | {"items": 1}, readout="per-step"),
        "closed-loop": lambda: ClosedLoop(
            **COMMON | {"items": 2}, targets=tuple(dict.fromkeys(("backbone.01|all", f"{last}|all")))
        ),
    }[kind]()


@pytest.mark.parametrize(
    "kind",
    [
        "image-swap",
        "instruction-swap",
        "interchange",
        "direction",
        "kv",
        "tiles",
        "per-step",
        "steer",
        "erase",
        "joint",
        "attribution",
        "knockout",
        "attention",
        "attention-shadow",
        "closed-loop",
    ],
)
def test_every_kind_runs_or_is_refused_by_name(measured_run: tuple[Run, ReplayFiles], kind: str) -> None:
    run, source = measured_run
    intervention, supported = asked_of(run, kind), find_family(run.model).abilities.interventions
    if any(not supported.supports(needed) for needed in intervention.required_capabilities):
        with pytest.raises(UnsupportedInterventionError, match=f"{run.model} does not support"):
            run_intervention(run, intervention, source, load=not_loaded)
        return
    effects = run_intervention(run, intervention, source)
    check = effects.certificate["replay"]
    assert check["equal"] == check["compared"] > 0
    assert np.isfinite(effects.outcomes.displacement).all()
    assert effects.to_csv().count("\n") > 1
    assert effects.to_rich() is not None
    _check_ledger(run, effects)


def not_loaded(run: Run, _: ReplayFiles) -> Policy:
    raise AssertionError(f"{run.model} was loaded before it was refused")


def _check_ledger(run: Run, effects: InterventionResult) -> None:
    """Every change fired; what writes back what is there, or is read by nothing, changes nothing."""
    supported = find_family(run.model).abilities.interventions
    last = f"backbone.{run.streams['backbone'].layers - 1:02d}|"
    for name, counts in effects.certificate["edits"].items():
        assert counts["fires"] > 0, name
        if name == "clean" or name.endswith("|0"):
            assert counts["max_action_change"] == 0.0
            assert counts["no_op_fires"] == counts["fires"]
        if name.startswith(last) and "backbone" in supported.unread:
            assert counts["max_action_change"] == 0.0, name
