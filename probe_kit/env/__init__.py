"""The Act2Answer environment: the robot answers a question by placing a cube on one of two pictures.

`gymnasium.make("probe_kit.env:probe_kit/Act2Answer-v0", spec=SceneSpec())`, which needs no import of ours, and
`Act2AnswerEnv(SceneSpec())` are the same.

Importing this module loads neither the simulator nor torch.
"""

from gymnasium.envs.registration import register, registry

from probe_kit.env.act2answer import Act2AnswerEnv
from probe_kit.env.scoring import Behaviour, Outcome, Trajectory, success_by_radius
from probe_kit.env.scripted import Idle, ScriptedExpert, save_gif, to_lerobot, to_openpi
from probe_kit.env.spec import CameraSpec, LightSpec, LimitSpec, PhysicsSpec, SceneSpec

ENV_ID = "probe_kit/Act2Answer-v0"

if ENV_ID not in registry:
    register(ENV_ID, entry_point="probe_kit.env.act2answer:Act2AnswerEnv")

__all__ = [
    "ENV_ID",
    "Act2AnswerEnv",
    "Behaviour",
    "CameraSpec",
    "Idle",
    "LightSpec",
    "LimitSpec",
    "Outcome",
    "PhysicsSpec",
    "SceneSpec",
    "ScriptedExpert",
    "Trajectory",
    "save_gif",
    "success_by_radius",
    "to_lerobot",
    "to_openpi",
]
