"""A policy server from settings to a run: checks, model, socket, and the end that commits and seals."""

import asyncio
import json
import os
import secrets
import signal
import socket
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.imports import require
from probe_kit.errors import EpisodesFailedError, ProbeKitError, SettingsMismatchError, UsageError
from probe_kit.extract.extraction import open_checked
from probe_kit.extract.rollout.capturing import stored_streams
from probe_kit.extract.rollout.tasks import Act
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sizes import planned_sizes
from probe_kit.extract.sources.served import Wire
from probe_kit.extract.sources.served_source import ServedSource
from probe_kit.extract.sources.source import raise_together
from probe_kit.extract.states import Decided, Fitted, count_calls
from probe_kit.hashing import canonical_json
from probe_kit.runs.layout import DATASET, StoredStream
from probe_kit.runs.root import Root, find_continuable
from probe_kit.runs.run import Run, read_run
from probe_kit.runs.store import Location, locate
from probe_kit.runs.writer import check_other_settings
from probe_kit.serve.session import EXAMPLE, Line, Session

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.serve.wire import WireServer

PACKAGES: Mapping[Wire, tuple[str, tuple[str, ...]]] = {
    "openpi": ("serve", ("websockets", "msgpack")),
    "vla-eval": ("vla-eval", ("websockets", "msgpack", "vla_eval")),
}
"""The extra and the packages of a wire."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_NOT_YET = ("dtype", "execute")
"""The settings whose value the loaded model decides."""
_LONGEST_TOKEN, _TOKEN_BYTES = 4096, 32
_ENDING = (signal.SIGINT, signal.SIGTERM)


@dataclass
class ServerPlan:
    """A server that is planned and not started.

    Attributes:
        fitted: The settings of the run.
        source: What is served.
        streams: The streams that are captured.
        origin: Where the sizes of the streams come from, in words.
        chunk: The shape of an answer, as far as it is known.
    """

    fitted: Fitted[ExtractSettings]
    source: ServedSource
    location: Location
    streams: tuple[StoredStream, ...] = ()
    origin: str = ""
    chunk: tuple[int | None, int | None] = (None, None)
    cameras: tuple[str, ...] = ()
    stored: Root | None = None


@dataclass
class Server:
    """A server with its model loaded and its socket bound.

    Attributes:
        session: The session of its clients.
        listener: The bound socket.
        token: The token that clients send; empty where none is needed.
        token_file: The file that holds a token that was drawn; None for none.
    """

    plan: ServerPlan
    session: Session
    listener: socket.socket
    token: str = ""
    token_file: Path | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stop = asyncio.Event()
        """Set to end the server, on the thread of its loop."""

    @property
    def address(self) -> str:
        """The address that clients connect to."""
        host, port = self.listener.getsockname()[:2]
        return f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"

    def serve(self, stop_after: int | None, ready: Callable[[], None], note: Callable[[str], None]) -> None:
        """Answer until Ctrl-C, SIGTERM, an error that ends the server, or so many stored episodes."""
        asyncio.run(self._serve(stop_after, ready, note))

    async def _serve(self, stop_after: int | None, ready: Callable[[], None], note: Callable[[str], None]) -> None:
        loop, stop = asyncio.get_running_loop(), self.stop
        before = {number: signal.getsignal(number) for number in _ENDING}

        def end() -> None:
            stop.set()
            for number in _ENDING:  # a second Ctrl-C ends at once
                loop.remove_signal_handler(number)
                signal.signal(number, before[number])

        for number in _ENDING:
            with suppress(RuntimeError, ValueError):  # another thread, as in a notebook
                loop.add_signal_handler(number, end)
        wire = self._wire(stop.set, note)
        try:
            server = await wire.start()
        except OSError as error:  # another server was bound to the port while both loaded their models
            raise UsageError(
                f"{self.address} cannot be used: {error.strerror or error}. Give another --port (0 draws one)"
            ) from error
        ready()
        while not stop.is_set() and (stop_after is None or self.session.committed < stop_after):
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), 0.1 if stop_after else 3600)
        await wire.drain()
        server.close()
        await server.wait_closed()
        await wire.close()

    def _wire(self, stop: Callable[[], None], note: Callable[[str], None]) -> "WireServer":
        from probe_kit.serve.openpi import OpenpiServer
        from probe_kit.serve.vla_eval import VlaEvalServer

        parts = self.session, self.listener, self.token, self.metadata, stop, note
        if self.session.source.settings.wire == "openpi":
            return OpenpiServer(*parts)
        execute = self.plan.fitted.settings.task.execute
        assert execute is not None, "it was decided with the model"
        return VlaEvalServer(*parts, execute=execute)

    def close(self) -> Run | None:
        """Commit what was played, seal the run and return it; None where nothing was played.

        Raises:
            EpisodesFailedError: If episodes were given up; all others are kept.
            ProbeKitError: The error that ended the server.
        """
        run = self.session.close()
        if self.session.fatal is not None:
            raise self.session.fatal
        return run

    def check_failed(self) -> None:
        """Raise EpisodesFailedError if episodes were given up or could not be stored."""
        if failed := self.session.failed:
            raise EpisodesFailedError(
                f"{failed} episode{'s' * (failed > 1)} could not be kept; {self.session.committed} others were "
                f"committed. {self.plan.location}/failed has the reasons; --partial reads the run without them"
            )


def plan_server(settings: ExtractSettings, out: str) -> ServerPlan:
    """Check all that needs no model, and return the plan of a server.

    Reads no weights, unless the family declares no streams, as embedded ones.

    Raises:
        SettingsMismatchError: If the place holds a run with other settings.
        UsageError: For settings that cannot be served.
    """
    location = locate(out)
    root = find_continuable(location)
    settings = _with_source_name(settings, root, location)
    decided, source = _open_source(settings, location, root, fetch=False)
    sizes = planned_sizes(decided.settings, source.instructions)
    plan = ServerPlan(count_calls(decided.settings, execute=1), source, location, stored=root)
    if sizes is None:
        policy = Act().load(decided.settings)
        assert policy is not None, "scripts are refused before"
        source, policy = source.check(policy, accept_units=True)
        plan.cameras, plan.chunk = policy.card.cameras, _answer_shape(policy, source)
        plan.streams = tuple(stored_streams(policy, policy.roles([source.example(EXAMPLE)])))
    else:
        model = None if sizes.outline is None else sizes.outline.model
        plan.streams, plan.origin = sizes.streams, sizes.source
        if model is not None:
            plan.cameras = model.card.cameras
            plan.chunk = model.card.chunk, None
    return plan


def open_server(
    settings: ExtractSettings,
    out: str,
    host: str,
    port: int,
    token_file: Path | None,
    metadata: Mapping[str, Any],
    report: Callable[[Line], None],
    policy: "Policy | None" = None,
) -> Server:
    """Load the model and bind the socket. All that needs no model is checked first.

    Args:
        settings: The settings of the run, whose source is a `ServedSettings`.
        out: The folder or URL of the run.
        host: The address of the server; another one than this machine's own needs a token.
        port: The port; 0 for any free one.
        token_file: The file with the token; None for none, or one that is drawn.
        metadata: Entries of the first message to a client.
        report: Called with a line per episode.
        policy: The policy of these settings, if it is loaded already.

    Raises:
        MissingExtraError: Without the packages of the wire.
        UsageError: For a port in use, and for settings that cannot be served.
        SettingsMismatchError: If the place holds a run with other settings.
        ProbeKitError: For a model that cannot be loaded.
    """
    wire: Wire = dict(settings.source)["wire"]
    _check_network(wire, host, token_file, metadata)
    extra, packages = PACKAGES[wire]
    for package in packages:
        require(package, extra)
    location = locate(out)
    root = find_continuable(location)
    settings = _with_source_name(settings, root, location)
    token, drawn = _token(host, token_file)
    listener = _bound(host, port)
    try:
        decided, source = _open_source(settings, location, root, loaded=policy is not None)
        stored = None if root is None or not root.plan else read_run(location)
        policy = policy or Act().load(decided.settings)
        assert policy is not None, "scripts are refused before"
        source, policy = source.check(policy, decided.settings.machine.accept_units)
        fitted = _fit(decided, policy)
        versions = {package: version(package) for package in packages}
        session = Session(fitted, source, policy, location, report, versions)
        session.open_stored(stored)
        plan = ServerPlan(fitted, source, location, stored=root, cameras=policy.card.cameras)
        plan.streams, plan.chunk = session.streams, _answer_shape(policy, source)
    except BaseException:
        listener.close()
        raise
    return Server(plan, session, listener, token, drawn, metadata)


def _answer_shape(policy: "Policy", source: ServedSource) -> tuple[int | None, int | None]:
    """Return the shape of an answer; as far as the card says it, where the model refuses words of ours."""
    from probe_kit.extract.sources.source import predicted_once

    try:
        example = source.example((*source.instructions, EXAMPLE)[0])
        cameras = [camera for camera, _ in source.cameras] or list(policy.card.cameras[:1])
        rows, width = predicted_once(policy.with_cameras(cameras), example).shape
    except ProbeKitError:
        return policy.card.chunk or None, None
    return rows, width


def _with_source_name(settings: ExtractSettings, root: Root | None, location: Location) -> ExtractSettings:
    """Return the settings with the name of what is served: typed, that of the run, or one that is drawn.

    Raises:
        SettingsMismatchError: If the run there was not served.
    """
    source = settings.source
    if root is not None and root.own_settings.get(DATASET, {}).get("kind") != "served":
        raise SettingsMismatchError(f"{location} holds a run that was not served; choose another --out")
    if dict(source)["source_name"] is not None:
        return settings
    drawn = f"session-{secrets.token_hex(4)}" if root is None else str(root.own_settings[DATASET]["source"])
    return settings.changed(source=source.changed(source_name=drawn))


def _open_source(
    settings: ExtractSettings, location: Location, root: Root | None, loaded: bool = False, fetch: bool = True
) -> tuple[Decided[ExtractSettings], ServedSource]:
    """Return the settings and the open source, checked as far as needs no model; arguments as of `open_checked`.

    Raises:
        SettingsMismatchError: If the place holds a run with other settings.
        UsageError: For settings that cannot be served.
    """
    decided, source = open_checked(settings, location, loaded, fetch)
    assert isinstance(source, ServedSource)
    decides_execution(decided.settings)
    _check_stored(decided, source, root, location)
    if not loaded:
        _check_before_weights(decided, source)
    return decided, source


def _check_before_weights(decided: Decided[ExtractSettings], source: ServedSource) -> None:
    """Compare cameras, state and edits with what the checkpoint's files say, before its weights are read.

    Raises:
        UsageError: For what does not fit.
    """
    settings = decided.settings
    checkpoint = settings.model.checkpoint or settings.model.family
    if (inputs := Act().declared_inputs(decided)) is not None:
        raise_together(source.early_checks(inputs, checkpoint))
    if conditions := [condition for condition in source.settings.conditions if condition.edits]:
        sizes = planned_sizes(settings, source.instructions)
        outlined = None if sizes is None or sizes.outline is None else sizes.outline.model
        for condition in conditions:
            if outlined is not None:
                condition.check(outlined, None)


def _check_stored(
    decided: Decided[ExtractSettings], source: ServedSource, root: Root | None, location: Location
) -> None:
    """Raise SettingsMismatchError for a run whose settings differ in what is known before the model is loaded."""
    if root is None:
        return
    settings = decided.settings
    comparable = {name: value for name, value in settings.identity().items() if name not in _NOT_YET}
    requested = json.loads(canonical_json({**comparable, DATASET: source.early_identity()}))
    stored = {name: root.own_settings.get(name) for name in requested}
    stored[DATASET] = {name: root.own_settings[DATASET].get(name) for name in requested[DATASET]}
    if settings.model.dtype is not None:
        requested["dtype"], stored["dtype"] = settings.model.dtype, root.own_settings.get("dtype")
    check_other_settings(stored, requested, str(location))


def _check_network(wire: Wire, host: str, token_file: Path | None, metadata: Mapping[str, Any]) -> None:
    """Raise UsageError for an address or a token of a wire whose clients can send none."""
    if wire == "openpi":
        return
    if host not in LOOPBACK or token_file is not None:
        raise UsageError(
            f"clients of {wire} send no token, so that this wire stands at 127.0.0.1 alone. Leave --host and "
            "--token-file out; from another machine use a tunnel, such as ssh -L 8000:127.0.0.1:8000 HOST"
        )
    if metadata:
        raise UsageError(f"--metadata is for clients of openpi; {wire} has no first message. Leave it out")


def _fit(decided: Decided[ExtractSettings], policy: "Policy") -> Fitted[ExtractSettings]:
    """Return the settings with the number of actions that are sent of a chunk, where that is ours to decide.

    Raises:
        UsageError: For another number than a chunk has.
    """
    settings = decided.settings
    if not decides_execution(settings):
        return count_calls(settings, execute=1)
    execute, chunk = settings.task.execute or policy.card.execute, policy.card.chunk
    if not 1 <= execute <= chunk:
        raise UsageError(f"--execute {execute}: a chunk of {policy.card.checkpoint} has {chunk} actions")
    return count_calls(settings.changed(execute=execute), execute=1)


def decides_execution(settings: ExtractSettings) -> bool:
    """Whether the server decides how many actions of a chunk are executed.

    Raises:
        UsageError: For `--execute` on a wire whose clients decide it.
    """
    if (wire := dict(settings.source)["wire"]) == "vla-eval":
        return True
    if settings.task.execute is not None:
        raise UsageError(
            f"--execute does not apply with --wire {wire}: the client decides how many actions of a chunk it "
            "executes. Remove it"
        )
    return False


def _bound(host: str, port: int) -> socket.socket:
    """Return a bound socket that accepts no client yet: each is refused until the model is loaded."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        raise UsageError(
            f"{host}:{port} cannot be used: {error.strerror or error}. Give another --port (0 draws one) or --host"
        ) from error
    return listener


def _token(host: str, file: Path | None) -> tuple[str, Path | None]:
    """Return the token, and the file of one that was drawn. Raises UsageError for a file without any."""
    if file is not None:
        try:
            text = read_regular(file, _LONGEST_TOKEN).decode().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"--token-file {file} cannot be read: {getattr(error, 'strerror', error)}") from error
        if not text.isascii() or not text.isprintable() or not text:
            raise UsageError(f"--token-file {file} holds no token; write one line of plain characters")
        return text, None
    if host in LOOPBACK:
        return "", None
    drawn = secrets.token_urlsafe(_TOKEN_BYTES)
    handle, name = tempfile.mkstemp(prefix="probe-kit-", suffix="-token")  # which only its owner can read
    with os.fdopen(handle, "w", encoding="ascii") as stream:
        stream.write(f"{drawn}\n")
    return drawn, Path(name)
