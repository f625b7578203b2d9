#!/usr/bin/env bash
# torch 2.11.0, CPU. torch.manual_seed formats the stack of its caller several times, for GPUs that are not there or were not used yet. So the
# cost of a seed grows with the depth of the program: who seeds every inference of a small policy pays it each time. The generator of the CPU
# alone, torch.default_generator.manual_seed, gives the same numbers and looks at no stack.
# Seen: 3 stacks formatted per seed; at a depth of 60 calls 0.5 ms, with the generator's own method 0.001 ms; equal numbers: True
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" torch==2.11.0 numpy==2.2.6
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet torch==2.11.0 numpy==2.2.6
fi
cd "$folder"
cat >look.py <<'LOOK'
import traceback
from time import process_time

import torch


def at_depth(calls, function):
    return function() if calls == 0 else at_depth(calls - 1, function)


def milliseconds(seed):
    def repeat():
        started = process_time()
        for number in range(200):
            seed(number)
        return 1000 * (process_time() - started) / 200

    return at_depth(60, repeat)


slow, quick = milliseconds(torch.manual_seed), milliseconds(torch.default_generator.manual_seed)
formatted, format_stack = [], traceback.format_stack
traceback.format_stack = lambda *arguments, **options: formatted.append(1) or format_stack(*arguments, **options)
torch.manual_seed(1)
traceback.format_stack = format_stack
drawn = torch.rand(4)
torch.default_generator.manual_seed(1)
equal = bool(torch.equal(drawn, torch.rand(4)))
print(f"stacks formatted by one torch.manual_seed: {len(formatted)}; equal numbers: {equal}")
print(f"at a depth of 60 calls: {slow:.3f} ms, with the generator's own method {quick:.3f} ms")
raise SystemExit(not (formatted and equal))
LOOK
env/bin/python look.py
