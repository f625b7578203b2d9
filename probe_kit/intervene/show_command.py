"""`probe-kit run show`: what a run holds, and what probes and interventions are stored with it."""

from dataclasses import asdict

from probe_kit._terminal.console import out, print_json
from probe_kit._terminal.options import AsJson, RunFolder


def show(
    run: RunFolder,
    as_json: AsJson = False,
) -> None:
    """List the episodes, streams, probes and interventions of a run; the last two by key."""
    from probe_kit.extract import open_run
    from probe_kit.intervene.results.inventory import listed_interventions, unfinished_interventions
    from probe_kit.train.commands import facts_table
    from probe_kit.train.results.inventory import inventory

    opened = open_run(run, allow_partial=True)
    found, interventions = inventory(opened), listed_interventions(opened)
    unfinished = unfinished_interventions(opened.location)
    if as_json:
        listed = [asdict(one) for one in interventions]
        print_json({**asdict(found), "interventions": listed, "unfinished_interventions": unfinished})
        return
    further = {f"intervention {one.key}": one.words for one in interventions}
    further |= {
        f"unfinished {key}": f"an intervention, {items} items so far; the same `probe-kit intervene` continues it"
        for key, items in unfinished.items()
    }
    out.print(facts_table(found, further))
    if not found.probes:
        step = f"`probe-kit train {found.run}` fits them" if found.streams else "a policy without streams has none"
        out.print(f"no probes: {step}", soft_wrap=True)
