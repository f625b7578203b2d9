"""Names of scenes, arms and renderings. Importing them loads no environment."""

from typing import Literal

SceneName = Literal["bridge", "vl-think", "frontal", "act2answer"]
"""The presets of `SceneSpec.preset`; `probe_kit.env.spec.PRESETS` lists the changes of each."""
ArmName = Literal["panda", "widowx"]
Rendering = Literal["raw", "visual-matching"]
RuleName = Literal["disc", "box", "released-on-tile"]
"""The outcome rules; `probe_kit.env.scoring.RULES` defines each of them."""
