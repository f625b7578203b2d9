#!/usr/bin/env bash
# transformers 5.5.4. Where tokenizer_config.json names a class such as GemmaTokenizer or LlamaTokenizer, AutoTokenizer takes the vocabulary of
# tokenizer.json, but the class's own normalisation and splitting in place of those that the same file declares. The ids of a sentence
# then differ from those of tokenizers.Tokenizer.from_file, although both read one file and nothing is logged.
# Seen: the file's rules and PreTrainedTokenizerFast: put the cube (lower case); GemmaTokenizer: Put, _the, _Cube in pieces (case and spaces kept)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" transformers==5.5.4
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet transformers==5.5.4
fi
export HF_HUB_OFFLINE=1
cd "$folder"
cat >look.py <<'LOOK'
import json
from pathlib import Path

from tokenizers import Tokenizer, models, normalizers, pre_tokenizers
from transformers import AutoTokenizer

folder = Path("saved")
folder.mkdir()
special = ["<pad>", "<eos>", "<bos>", "<unk>"]
vocabulary = {token: number for number, token in enumerate([*special, *"putheb", *"PCc", "▁"])}
written = Tokenizer(models.BPE(vocabulary, [], unk_token="<unk>"))
written.normalizer = normalizers.Lowercase()
written.pre_tokenizer = pre_tokenizers.Whitespace()
written.save(str(folder / "tokenizer.json"))
SENTENCE = "Put the Cube"
pieces = {"tokenizer.json itself": Tokenizer.from_file(str(folder / "tokenizer.json")).encode(SENTENCE).tokens}
for name in ("PreTrainedTokenizerFast", "GemmaTokenizer"):
    tokens = dict(zip(("pad_token", "eos_token", "bos_token", "unk_token"), special, strict=True))
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": name, **tokens}))
    pieces[name] = AutoTokenizer.from_pretrained(folder).tokenize(SENTENCE)
for reader, tokens in pieces.items():
    print(f"{reader}: {' '.join(tokens)}")
of_file, of_fast, of_class = pieces.values()
raise SystemExit(not (of_file == of_fast and "P" not in of_file and {"P", "C", "▁"} <= set(of_class)))
LOOK
env/bin/python look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
