#!/bin/bash
# lerobot 0.6.1 (with torch for the CPU): a fine-tune with a rename map of the state.
# 1. lerobot-train gives the normaliser the statistics under the data set's names, and renames before it
#    normalises: a state that --rename_map renames is never normalised, neither in training nor afterwards.
#    Seen: state [10, 20] with mean [10, 20] stays [10, 20]; expected [0, 0]. The saved file has
#    observation.joints.mean, and nothing of observation.state.
# 2. lerobot-eval overrides the saved map by its own --rename_map, {} by default: the map of the checkpoint, which
#    a plain load follows, is dropped.
#    Seen: keys observation.joints and observation.images.top reach the policy under these names.
# The processors are made with the arguments that lerobot_train.py and lerobot_eval.py pass.
# Exit 0: still so. Exit 1: changed.
set -e
W=$(mktemp -d); trap 'rm -rf "$W"' EXIT; cd "$W"
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 env
    uv pip install --quiet --python env/bin/python "lerobot[dataset]==0.6.1"
else
    python3.12 -m venv env
    env/bin/python -m pip install --quiet "lerobot[dataset]==0.6.1"
fi
cat > show.py <<'P'
import dataclasses
import tempfile
from pathlib import Path

import torch
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file

STATE, PICTURE = "observation.state", "observation.images.base"
config = ACTConfig(
    device="cpu",
    input_features={STATE: PolicyFeature(FeatureType.STATE, (2,)), PICTURE: PolicyFeature(FeatureType.VISUAL, (3, 8, 8))},
    output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
)
statistics = {"mean": torch.tensor([10.0, 20.0]), "std": torch.tensor([2.0, 4.0])}
base, tuned = tempfile.mkdtemp(), tempfile.mkdtemp()
for pipeline in make_act_pre_post_processors(config, dataset_stats={STATE: statistics, "action": statistics}):
    pipeline.save_pretrained(base)
of_data_set = {"observation.joints": statistics, "action": statistics}
norm = config.normalization_mapping
pre, post = make_pre_post_processors(
    config,
    pretrained_path=base,
    dataset_stats=of_data_set,
    preprocessor_overrides={
        "device_processor": {"device": "cpu"},
        "normalizer_processor": {
            "features": {**config.input_features, **config.output_features}, "norm_map": norm, "stats": of_data_set
        },
        "rename_observations_processor": {"rename_map": {"observation.joints": STATE, "observation.images.top": PICTURE}},
    },
    postprocessor_overrides={
        "unnormalizer_processor": {"features": config.output_features, "norm_map": norm, "stats": of_data_set}
    },
)
batch = {"observation.joints": torch.tensor([[10.0, 20.0]]), "observation.images.top": torch.rand(1, 3, 8, 8),
         "action": torch.zeros(1, 2), "task": ["push"]}
state = pre(dict(batch))[STATE]
print("state behind the preprocessor of the fine-tune:", state.tolist())
pre.save_pretrained(tuned)
post.save_pretrained(tuned)
stored = sorted(name for file in Path(tuned).glob("policy_pre*.safetensors") for name in load_file(file))
print("statistics it saves:", stored)
default = next(field for field in dataclasses.fields(EvalPipelineConfig) if field.name == "rename_map").default_factory()
overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": default}}
evaluated, _ = make_pre_post_processors(config, pretrained_path=tuned, preprocessor_overrides=overrides)
names = sorted(name for name in evaluated(dict(batch)) if name.startswith("observation"))
print("names behind the preprocessor of lerobot-eval:", names)
same = torch.equal(state, batch["observation.joints"]) and names == ["observation.images.top", "observation.joints"]
raise SystemExit(0 if same else 1)
P
env/bin/python show.py 2>/dev/null
