"""Magma's prompts in the template of Llama 3's chat.

The wording is that of the authors' evaluation client, microsoft/Magma at 0483f87,
`tools/simplerenv-magma/simpler_env/policies/magma/magma_model.py`.
"""

from collections.abc import Sequence
from typing import NamedTuple

from transformers.utils.chat_template_utils import render_jinja_template

SYSTEM = "You are agent that can see, talk and act."
ACTION_QUESTION = "What action should the robot take to {instruction}?"
IMAGE, IMAGE_START, IMAGE_END = "<image>", "<image_start>", "<image_end>"
BEGINNING, END_OF_TURN = "<|begin_of_text|>", "<|eot_id|>"
_HEADER = "<|start_header_id|>{role}<|end_header_id|>\n\n"


class Message(NamedTuple):
    """One turn: `system`, `user` or `assistant`, and what it says."""

    role: str
    content: str


def picture_question(text: str, image_start_end: bool) -> str:
    """A user's turn: the picture's placeholder, then `text`."""
    picture = IMAGE_START + IMAGE + IMAGE_END if image_start_end else IMAGE
    return f"{picture}\n{text}"


def conversation(question: str, user_first: bool = False) -> tuple[Message, ...]:
    """The system's and the user's turn.

    user_first: in the order in which Act2Answer's release puts them when it asks for several actions at once.
    """
    turns = (Message("system", SYSTEM), Message("user", question))
    return turns[::-1] if user_first else turns


def chat_text(messages: Sequence[Message], template: str | None = None, beginning: str = BEGINNING) -> str:
    """The text of a conversation, open for the assistant's turn.

    template: the checkpoint's own, in Jinja; without one the frames of Llama 3. beginning: the tokenizer's first
    token, which is written out here; the released tokenizer adds another in front, as for the original.
    """
    if template is not None:
        rendered, _ = render_jinja_template(
            [[message._asdict() for message in messages]],
            chat_template=template,
            add_generation_prompt=True,
            bos_token=beginning,
        )
        return str(rendered[0])
    turns = "".join(_HEADER.format(role=role) + content.strip() + END_OF_TURN for role, content in messages)
    return beginning + turns + _HEADER.format(role="assistant")
