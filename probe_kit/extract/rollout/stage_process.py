"""Stages in child processes, so that simulation, rendering and inference overlap."""

from multiprocessing.connection import Connection
from typing import Any

from probe_kit._execution.child_process import Child
from probe_kit.errors import ProbeKitError, StageDiedError
from probe_kit.extract.rollout.events import add_traceback
from probe_kit.extract.rollout.stage import Answer, Ending, Stage, StageKind, StageRequest, TimedStage
from probe_kit.runs.layout import FrameChoice


class ProcessStage:
    """A stage in a child process; a child that dies costs its episode and is replaced."""

    def __init__(
        self, source: Any, script: str | None, frames: FrameChoice = "none", kind: StageKind = Stage
    ) -> None:
        """source: where observations come from, for `kind`; see `LocalStage`."""
        self._settings = kind, (source, script, frames)
        self._start()

    def _start(self) -> None:
        self._child = Child("probe_kit.extract.rollout.stage_process:serve")
        self._child.connection.send(self._settings)

    def ask(self, method: str, *arguments: Any, then: StageRequest | None = None) -> None:
        """Send the request; the child works while this process continues."""
        try:
            self._child.connection.send(((method, arguments), then))
        except (BrokenPipeError, ConnectionResetError):
            return  # `answer` finds out and says so

    def answer(self) -> Answer:
        """Wait for the answer."""
        try:
            answer = self._child.connection.recv()
        except (EOFError, ConnectionResetError):
            code = self._child.close()
            self._start()
            raise StageDiedError(
                f"the process that simulates the episode ended with code {code}; look above for its last words"
            ) from None
        if isinstance(answer, ProbeKitError):
            raise answer
        result: Answer = answer
        return result

    def close(self) -> None:
        """End the child."""
        self._child.close()


def serve(connection: Connection) -> None:
    """The child's side: answer questions until the parent hangs up."""
    try:
        kind, settings = connection.recv()
        stage = kind(*settings)
    except ProbeKitError as error:
        connection.recv()
        connection.send(error)
        return
    try:
        while True:
            question, then = connection.recv()
            answer = _answered(stage, question)
            connection.send(answer)
            if then is not None and isinstance(answer, Ending):
                connection.send(_answered(stage, then))
    finally:
        stage.close()


def _answered(stage: TimedStage, question: StageRequest) -> Answer | ProbeKitError:
    method, arguments = question
    try:
        return stage.timed(method, arguments)
    except ProbeKitError as error:  # what it costs, an episode or the run, is decided by the parent
        add_traceback(error)
        return error
