"""Refusal of what only runs of scenes have: sides, outcomes by rule, and a scene that can be played again."""

from probe_kit.errors import UsageError


def check_scene_run(run: object, purpose: str) -> None:
    """Raise UsageError for a run on recordings or pictures, or in an environment of the user's own.

    purpose: what is not possible with it, in a word.
    """
    if getattr(run, "recorded", False):
        subject = getattr(run, "subject", "recordings")
        reason = f"shows {subject} ({{}}), and its model did not act. There are no sides and no success rate"
    elif getattr(run, "in_own_environment", False):
        reason = "plays an environment of your own ({}). There are no sides and no scene of the protocol"
    else:
        return
    where, source = getattr(run, "location", run), getattr(run, "suite", "")
    raise UsageError(
        f"{where} {reason.format(source)}, so {purpose} is not possible. `probe-kit targets {where}` lists what "
        f"can be decoded, `probe-kit labels {where}` writes a table for labels of your own"
    )
