"""The states of settings on their way from a request to a run. Each has a type, which is made in one place.

| state | type | made by | adds |
|---|---|---|---|
| requested | `ExtractSettings`, `AskSettings` | a user | what was typed |
| decided | `Decided` | `open_checked` of `extraction.py` | what the protocol and the open source decide |
| fitted | `Fitted` | `count_calls` | what the model decides: a number of captured inferences |

A function that takes `Settings` themselves reads nothing that a later state decides.
"""

from dataclasses import dataclass

from probe_kit.extract.settings import Settings


@dataclass(frozen=True)
class Decided[Chosen: Settings]:
    """Settings with what their protocol and the open source decide.

    They have no number of captured inferences: `captured_calls` may still be `all`.

    Attributes:
        settings: The settings by part.
    """

    settings: Chosen


@dataclass(frozen=True)
class Fitted[Chosen: Settings]:
    """Settings with what the model decides too, of which a run is planned.

    Attributes:
        settings: The settings by part; `captured_calls` is a number.
        calls: The number of inferences captured per episode.
    """

    settings: Chosen
    calls: int


def count_calls[Chosen: Settings](settings: Chosen, execute: int) -> Fitted[Chosen]:
    """Return the settings with a number of captured inferences, which is counted where `all` are.

    Args:
        settings: The settings, with the source as the model is shown it.
        execute: The number of executed actions of an inference.
    """
    calls = settings.capture.captured_calls
    if calls != "all":
        return Fitted(settings, calls)
    counted = settings.most_inferences(execute)
    return Fitted(settings.changed(captured_calls=counted), counted)
