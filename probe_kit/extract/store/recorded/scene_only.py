"""Refusal of what only runs of scenes have: sides, outcomes, and a scene that can be played again."""

from probe_kit.errors import UsageError


def check_scene_run(run: object, wanted: str) -> None:
    """Raise UsageError for a run on recordings. wanted: what is not possible with it, in a word."""
    if getattr(run, "recorded", False):
        where, shown = getattr(run, "location", run), getattr(run, "suite", "")
        raise UsageError(
            f"{where} shows recordings ({shown}), and its model did not act. There are no sides and no success "
            f"rate, so {wanted} is not possible. Decode labels of your own: `probe-kit train RUN --labels FILE "
            "--target COLUMN`"
        )
