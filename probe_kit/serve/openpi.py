"""The protocol of openpi: a websocket on which each observation is followed by one answer."""

from time import monotonic, perf_counter
from typing import Any

import numpy as np
from websockets.asyncio.server import ServerConnection

from probe_kit.errors import UsageError
from probe_kit.serve.codec import MessageError, pack, unpack
from probe_kit.serve.marks import KEY, read_mark
from probe_kit.serve.session import Client
from probe_kit.serve.wire import BAD_DATA, WireServer, one_line
from probe_kit.version import __version__


class OpenpiServer(WireServer):
    """A server of openpi's wire, of one session."""

    async def _converse(self, connection: ServerConnection, client: Client) -> None:
        """Send the metadata, then answer observations and marks by turns."""
        await connection.send(pack({**self.metadata, "probe_kit": {"version": __version__, "mark": KEY}}))
        took = 0.0
        async for message in connection:
            if self.ends:
                return
            began = perf_counter()
            self.busy += 1
            try:
                answer = await self._answer(client, message)
            except MessageError as error:
                await connection.close(BAD_DATA, one_line(error)[:120])
                return
            except Exception as error:  # noqa: BLE001 - a bug costs its request, and ends the server by its name
                await connection.send(one_line(error))
                self.stop_if_fatal()
                continue
            else:
                if took:
                    answer["server_timing"]["prev_total_ms"] = took
                await connection.send(pack(answer))
            finally:
                self.busy -= 1
            took = 1000 * (perf_counter() - began)
            await self.finish_check()

    async def _answer(self, client: Client, message: str | bytes) -> dict[str, Any]:
        if isinstance(message, str):
            raise MessageError("the message is a text; expected a binary frame of msgpack")
        sent = unpack(message)
        mark = read_mark(sent.pop(KEY)) if KEY in sent else None
        began = perf_counter()
        if mark is not None and mark.end:
            if sent:
                raise UsageError(f"{KEY} says an end beside an observation; send the end alone")
            await self.on_model_thread(self.session.end, client, mark)
            actions = np.zeros((0, *self.session.width), np.float32)
        else:
            actions = await self.on_model_thread(self.session.answer, client, sent, mark, monotonic())
        return {"actions": actions, "server_timing": {"infer_ms": 1000 * (perf_counter() - began)}}
