"""The registry's entry of joint places."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="joint",
    summary="Patch sets of places: each alone, all but it, smallest set.",
    build="probe_kit.intervene.kinds.joint.intervention:JointPlaces.from_options",
    effects="probe_kit.intervene.kinds.joint.effects:measured_joint_places",
    table="probe_kit.intervene.kinds.joint.table:joint_table",
    sentences="probe_kit.intervene.kinds.joint.table:joint_sentences",
    notes="probe_kit.intervene.kinds.joint.table:few_groups_notes",
    options={
        "sites": "of cells that run in parallel: several blocks of kv, or one layer; default kv.*",
        "roles": "of the cells' tokens; default image,language,state",
        "seed": "of the halves of the groups; default 0",
    },
    keys_in_use="probe_kit.intervene.kinds.joint.effects:joint_keys_in_use",
)
