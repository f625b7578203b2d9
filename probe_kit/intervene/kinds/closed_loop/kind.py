"""The registry's entry of closed loop."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="closed-loop",
    summary="Interchange at every inference; whole episodes are played.",
    build="probe_kit.intervene.results.best_targets:build_closed_loop",
    effects="probe_kit.intervene.kinds.closed_loop.effects:measured_closed_loop",
    table="probe_kit.intervene.kinds.closed_loop.table:closed_loop_table",
    sentences="probe_kit.intervene.kinds.closed_loop.table:closed_loop_sentences",
    notes="probe_kit.intervene.kinds.closed_loop.effects:disruption_notes",
    options={
        "sites": "default the last place, of each category, that the newest interchange localised",
        "roles": "with --sites; default all",
        "direction": "patch within it as well: as of interchange, or none; default mean-difference:1",
        "controls": "random directions; default 1",
        "seed": "of controls and folds; default 0",
    },
)
