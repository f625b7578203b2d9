#!/usr/bin/env bash
# openpi-client 0.1.2. ActionChunkBroker keeps the answer of a policy for several steps, and gives each step one entry along the first axis of EVERY
# array in it, not of the actions alone. An array beside the actions that is about the whole answer, such as the state that was read, reaches step 0
# as its first number, step 1 as its second one. Nothing says so.
# Seen: state that was sent [10. 11. 12. 13. 14. 15. 16. 17.]; state by step: [10.0, 11.0, 12.0, 13.0, 14.0]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# The client imports typing_extensions, and its package does not require it.
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" openpi-client==0.1.2 'numpy<2' typing_extensions==4.15.0
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet openpi-client==0.1.2 'numpy<2' typing_extensions==4.15.0
fi
cd "$folder"
cat >look.py <<'LOOK'
import sys

import numpy as np
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.base_policy import BasePolicy


class Arm(BasePolicy):
    """Answers five actions, and the state that it read."""

    def infer(self, obs):
        return {"actions": np.arange(35.0).reshape(5, 7), "state": obs["state"]}

    def reset(self):
        pass


state = np.arange(10.0, 18.0)
broker = ActionChunkBroker(Arm(), action_horizon=5)
answers = [broker.infer({"state": state}) for _ in range(5)]
by_step = [answer["state"] for answer in answers]
print("state that was sent", state)
print("state by step:", [np.asarray(entry).tolist() for entry in by_step])
print("actions by step:", [answer["actions"].shape for answer in answers])
sys.exit(0 if [np.ndim(entry) for entry in by_step] == [0] * 5 else 1)
LOOK
"$folder/env/bin/python" look.py
