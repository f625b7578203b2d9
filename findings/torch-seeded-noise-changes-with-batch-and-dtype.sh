#!/usr/bin/env bash
# torch 2.11.0, CPU. A flow policy draws its noise with torch.randn and a seeded generator. That noise belongs to shape and dtype, not to the
# seed alone: the first row of a batch of two is other noise than a batch of one where a row has not a multiple of 16 numbers, and bfloat16
# noise has nothing in common with float32 noise of the same seed. Of a seed only 32 bits count. "Same seed" therefore does not mean "same
# noise" between batch sizes, chunk lengths, dtypes, or between the CPU and CUDA, whose generator uses all 64 bits.
# Seen: row 0 of (2, 10, 7) equal to (1, 10, 7): False; of (2, 50, 32): True; correlation of bfloat16 and float32 noise: 0.0; seeds 1 and 1 + 2**32: equal
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
import torch


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


small = bool(torch.equal(noise(2, 10, 7)[0], noise(1, 10, 7)[0]))
large = bool(torch.equal(noise(2, 50, 32)[0], noise(1, 50, 32)[0]))
both = torch.stack([noise(50, 32).flatten(), noise(50, 32, dtype=torch.bfloat16).float().flatten()])
correlation = float(torch.corrcoef(both)[0, 1])
high_bits = bool(torch.equal(noise(64, seed=1), noise(64, seed=1 + 2**32)))
print(f"row 0 of a batch of two equals a batch of one: (10, 7) {small}, (50, 32) {large}")
print(f"correlation of bfloat16 and float32 noise of one seed: {correlation:.2f}")
print(f"seeds 1 and 1 + 2**32 draw equal noise: {high_bits}")
raise SystemExit(not (not small and large and abs(correlation) < 0.2 and high_bits))
LOOK
env/bin/python look.py
