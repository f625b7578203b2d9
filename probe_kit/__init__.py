"""probe_kit: which answers a Vision-Language-Action model encodes, at which layers, and where they are lost.

    import probe_kit as pk
    run = pk.extract_run(pk.ExtractSettings("pi0-tiny", categories=("color",), items=20), "run")
    results = pk.train_probes(run)
    print(pk.retention_table([run]).to_markdown())

Data flows one way: suite → env → hooks → runs → extract → train → intervene → retention.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names
from probe_kit._terminal.notebook import ignore_absent_widgets
from probe_kit.version import __version__ as __version__

if TYPE_CHECKING:
    from probe_kit.diagnose import diagnose_run
    from probe_kit.env import Act2AnswerEnv, SceneSpec
    from probe_kit.errors import ProbeKitError
    from probe_kit.extract import EnvironmentSettings, ExtractSettings, LeRobotSource, PictureFolder, extract_run
    from probe_kit.hooks import Site, capture, load_policy
    from probe_kit.intervene import (
        AttentionReadout,
        AttributionPatching,
        ClosedLoop,
        ConceptErasure,
        ImageSwap,
        Interchange,
        JointPlaces,
        ReplayFiles,
        Steering,
        load_effects,
        patching,
        run_intervention,
    )
    from probe_kit.retention import retention_table
    from probe_kit.retention.displays import (
        FinalPositionsDisplay,
        IterationMapDisplay,
        KnowledgeActionDisplay,
        LayerCurveDisplay,
        ModelDepthDisplay,
        layer_curve,
    )
    from probe_kit.retention.report import write_report
    from probe_kit.runs import Run, open_run
    from probe_kit.suite import Suite, build_suite, default_suite, load_suite
    from probe_kit.train import Target, load_results, probe, train_probes

__all__ = [
    "Act2AnswerEnv",
    "AttentionReadout",
    "AttributionPatching",
    "ClosedLoop",
    "ConceptErasure",
    "EnvironmentSettings",
    "ExtractSettings",
    "FinalPositionsDisplay",
    "ImageSwap",
    "Interchange",
    "IterationMapDisplay",
    "JointPlaces",
    "KnowledgeActionDisplay",
    "LayerCurveDisplay",
    "LeRobotSource",
    "ModelDepthDisplay",
    "PictureFolder",
    "ProbeKitError",
    "ReplayFiles",
    "Run",
    "SceneSpec",
    "Site",
    "Steering",
    "Suite",
    "Target",
    "build_suite",
    "capture",
    "default_suite",
    "diagnose_run",
    "extract_run",
    "layer_curve",
    "load_effects",
    "load_policy",
    "load_results",
    "load_suite",
    "open_run",
    "patching",
    "probe",
    "retention_table",
    "run_intervention",
    "train_probes",
    "write_report",
]

ignore_absent_widgets()

# `import probe_kit` must not load torch.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Steering": "intervene",
        "ConceptErasure": "intervene",
        "Interchange": "intervene",
        "AttributionPatching": "intervene",
        "JointPlaces": "intervene",
        "AttentionReadout": "intervene",
        "ClosedLoop": "intervene",
        "Act2AnswerEnv": "env",
        "EnvironmentSettings": "extract",
        "ExtractSettings": "extract",
        "FinalPositionsDisplay": "retention.displays",
        "ImageSwap": "intervene",
        "IterationMapDisplay": "retention.displays",
        "KnowledgeActionDisplay": "retention.displays",
        "LayerCurveDisplay": "retention.displays",
        "LeRobotSource": "extract",
        "PictureFolder": "extract",
        "ModelDepthDisplay": "retention.displays",
        "ProbeKitError": "errors",
        "Run": "runs",
        "SceneSpec": "env",
        "Site": "hooks",
        "ReplayFiles": "intervene",
        "Suite": "suite",
        "Target": "train",
        "diagnose_run": "diagnose",
        "build_suite": "suite",
        "capture": "hooks",
        "default_suite": "suite",
        "extract_run": "extract",
        "run_intervention": "intervene",
        "layer_curve": "retention.displays",
        "load_effects": "intervene",
        "load_policy": "hooks",
        "load_results": "train",
        "load_suite": "suite",
        "open_run": "runs",
        "patching": "intervene.patching:",
        "probe": "train",
        "retention_table": "retention",
        "train_probes": "train",
        "write_report": "retention.report",
    },
)
