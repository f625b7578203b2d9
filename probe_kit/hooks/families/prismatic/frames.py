"""Prompt templates of Prismatic models, by language model, as in prismatic-vlms.

Without the space behind it, which the original strips from every prompt before it is read.
"""

from dataclasses import dataclass

VICUNA_SYSTEM = (
    "A chat between a curious user and an artificial intelligence assistant. "
    "The assistant gives helpful, detailed, and polite answers to the user's questions."
)
_LLAMA_SYSTEM = (
    "You are a helpful language and vision assistant. You are able to understand the visual content that the user "
    "provides, and assist the user with a variety of tasks using natural language."
)


@dataclass(frozen=True)
class TextFrame:
    """Before and behind a question."""

    before: str
    behind: str

    def around(self, question: str) -> str:
        """The whole text; the original strips white space from both ends of a question."""
        return f"{self.before}{question.strip()}{self.behind}"

    def question_span(self, question: str) -> tuple[int, int]:
        """The beginning and end of the question in the text."""
        return len(self.before), len(self.before) + len(question.strip())


_PURE = TextFrame("In: ", "\nOut:")
_INSTRUCT = TextFrame("[INST] ", " [/INST]")
# The bracket that is missing behind <<SYS> is missing in the original, too.
_CHAT = TextFrame(f"[INST] <<SYS>\n{_LLAMA_SYSTEM}\n<</SYS>>\n\n", " [/INST]")
_VICUNA = TextFrame(f"{VICUNA_SYSTEM} USER: ", " ASSISTANT:")
_PHI = TextFrame("Input: ", "\nOutput:")


def frame_of(language_id: str) -> TextFrame:
    """The frame of a `llm_backbone_id`; all ids of the configuration's table have one."""
    if language_id.startswith("vicuna"):
        return _VICUNA
    if language_id.startswith("phi"):
        return _PHI
    if language_id.endswith("-chat"):
        return _CHAT
    return _INSTRUCT if language_id.endswith("-instruct") else _PURE
