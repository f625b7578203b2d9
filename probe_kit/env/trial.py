"""One episode in progress: executes actions, counts steps, and decides when and how the episode ends."""

import numpy as np

from probe_kit.env.question import Question
from probe_kit.env.robot.controller import DeltaController
from probe_kit.env.rotations import Array
from probe_kit.env.scene import Scene
from probe_kit.env.scoring.outcome import REST_SPEED, Ending, Outcome, distance, zone
from probe_kit.env.spec import XY
from probe_kit.suite.items import other_side

FALLEN_BELOW = -0.05
"""Height of the cube, metres, at which it has left the table."""
REST_STEPS = 5
"""Actions it must lie still, once released, for an early stop."""


class Trial:
    """An episode of one question, started in a scene that was just reset.

    executed: the last action (7,) as executed: after the limits, no motion where the arm could
    not follow, and the gripper that was really commanded. None before the first.
    """

    def __init__(self, scene: Scene, question: Question) -> None:
        self.scene = scene
        self.question = question
        self.controller = DeltaController(scene.arm, scene.spec.limits, scene.home_q, scene.spec.euler)
        self.executed: Array | None = None
        self.steps = 0
        self.clipped = 0
        self.ik_error = 0.0
        self.ending: Ending | None = None
        self.stopped_early = False
        self._start = self._cube_xy()
        self._was_grasped = scene.spec.start_grasped
        self._steps_at_rest = 0

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.stopped_early or self.ending is not None

    def advance(self, action: Array) -> None:
        """Carry out one checked action (7,)."""
        move = self.controller.command(action)
        opening = 0.0 if self.steps < self.scene.spec.forced_closed else move.opening
        finite = self.scene.advance(move.q_from, move.q_to, opening)
        self.executed = np.concatenate([move.shift, move.turn, [opening]])
        self.steps += 1
        self.clipped += move.clipped
        self.ik_error = move.ik_error
        self.ending = self._find_ending(finite)
        self.stopped_early = self.scene.spec.early_stop and self.ending is None and self._came_to_rest()

    def outcome(self) -> Outcome:
        """The record of the episode as it stands."""
        scene, question = self.scene, self.question
        xy = self._cube_xy()
        to_correct = distance(xy, scene.tile_xy(question.side_correct))
        to_wrong = distance(xy, scene.tile_xy(other_side(question.side_correct)))
        return Outcome(
            zone=zone(to_correct, to_wrong, scene.spec.zone_radius),
            layout=question.layout,
            side_correct=question.side_correct,
            cube_xy=xy,
            cube_z=float(scene.cube_state().position[2]),
            distance_correct=to_correct,
            distance_wrong=to_wrong,
            epsilon=scene.spec.zone_radius,
            cube_moved=distance(xy, self._start) > scene.spec.moved,
            on_tile=scene.is_on_tile(),
            is_grasped=scene.is_grasped(),
            steps=self.steps,
            clipped=self.clipped,
            truncation_reason=self.ending,
        )

    def _find_ending(self, finite: bool) -> Ending | None:
        if not finite:
            return "non_finite"
        if self.scene.cube_state().position[2] < FALLEN_BELOW:
            return "cube_fell"
        return "max_steps" if self.steps >= self.scene.spec.max_steps else None

    def _came_to_rest(self) -> bool:
        """Whether the cube has been in the hand, was let go and has lain still since for long enough."""
        grasped = self.scene.is_grasped()
        self._was_grasped |= grasped
        still = not grasped and self.scene.cube_state().speed < REST_SPEED
        self._steps_at_rest = self._steps_at_rest + 1 if self._was_grasped and still else 0
        return self._steps_at_rest >= REST_STEPS

    def _cube_xy(self) -> XY:
        x, y, _ = self.scene.cube_state().position
        return (float(x), float(y))
