"""Optional: a language model proposes a wording where no rule matches. A person must accept it."""

import json
import os
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import MOST_BYTES, read_regular_text
from probe_kit._system.bounded_json import parse_json
from probe_kit._system.drafts import write_whole
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.suite.converters.candidates import Candidate, Wording
from probe_kit.suite.converters.options import ConvertOptions
from probe_kit.suite.wording import instruction_for

_TIMEOUT_SECONDS = 60
_PROMPT = """Rewrite a question about two pictures as a command that names the picture that answers it.
Answer with one JSON object: instruction (starts with "Put the cube on"), object (the words after that, without
a leading article), polarity (pos, neg or none), keep (false if choosing one of two pictures is no answer)."""


def propose_wording(candidate: Candidate, options: ConvertOptions) -> Wording | None:
    """Return the wording that the service proposes, None if it proposes nothing usable.

    Replies are kept in `llm_cache`, so that the same conversion needs no network again. Raises UsageError for
    incomplete options, and SuiteError if the service does not answer.
    """
    if options.llm_base is None:
        return None
    if not options.llm_model or not options.llm_cache:
        raise UsageError(
            "llm_base needs llm_model and llm_cache as well. Name the model and a folder for replies."
        )
    question = {"question": candidate.question, "answer": candidate.answer}
    key = sha256_json([options.llm_model, _PROMPT, question])
    cached = Path(options.llm_cache) / f"{key}.json"
    if not cached.is_file():
        reply = _ask(options.llm_base, options.llm_model, json.dumps(question, ensure_ascii=False))
        write_whole(cached, reply)
    return _usable(read_regular_text(cached), options.llm_model)


def _ask(base: str, model: str, question: str) -> str:
    body = {
        "model": model,
        "temperature": 0,
        "response_format": {"type": "json_object"},
        "messages": [{"role": "system", "content": _PROMPT}, {"role": "user", "content": question}],
    }
    request = urllib.request.Request(
        f"{base.rstrip('/')}/chat/completions",
        data=json.dumps(body).encode(),
        headers={
            "Content-Type": "application/json",
            "Authorization": f"Bearer {os.environ.get('PROBE_KIT_LLM_KEY', '')}",
        },
    )
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_SECONDS) as response:
            content = parse_json(response.read(MOST_BYTES))["choices"][0]["message"]["content"]
    except (urllib.error.URLError, TimeoutError, ValueError, KeyError, IndexError, TypeError) as problem:
        raise SuiteError(
            f"{base} gave no usable reply ({problem!r}). Check llm_base, or leave it out."
        ) from problem
    return str(content)


def _usable(reply: str, model: str) -> Wording | None:
    try:
        proposal: Any = parse_json(reply)
    except ValueError:
        return None
    if not isinstance(proposal, dict) or proposal.get("keep") is not True:
        return None
    phrase, instruction = str(proposal.get("object", "")).strip(), str(proposal.get("instruction", "")).strip()
    for article in ("the", "none"):
        if phrase and instruction == instruction_for(phrase, article):
            origin = {"model": model, "prompt_sha256": sha256_text(_PROMPT), "raw": reply}
            return Wording(phrase, "llm", article=article, proposed_by=origin)
    return None
