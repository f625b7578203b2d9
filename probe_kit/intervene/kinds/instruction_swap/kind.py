"""The registry's entry of instruction swap."""

from probe_kit.intervene.kinds.kind import Kind

KIND = Kind(
    name="instruction-swap",
    summary="Ask for the other picture: does the action change sides?",
    build="probe_kit.intervene.kinds.instruction_swap.intervention:InstructionSwap.from_options",
    effects="probe_kit.intervene.kinds.instruction_swap.effects:instruction_swap_effects",
    table="probe_kit.intervene.kinds.instruction_swap.table:instruction_swap_table",
    sentences="probe_kit.intervene.kinds.image_swap.words:instruction_swap_sentences",
)
