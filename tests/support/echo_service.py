"""A service for tests of process pools: it answers with what it is sent, unless that is a command below."""

import os
import signal
from multiprocessing.connection import Connection

from probe_kit.errors import UsageError

DIE, FAIL, LEAVE = "die", "fail", "leave"


def serve(connection: Connection) -> None:
    setup = connection.recv()
    while True:
        message = connection.recv()
        if message == DIE:
            os.kill(os.getpid(), signal.SIGKILL)
        if message == LEAVE:
            return
        if message == FAIL:
            connection.send(UsageError("asked to fail"))
        else:
            connection.send((setup, os.environ.get("ECHO_SLOT"), message))
