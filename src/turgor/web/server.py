"""The server of the viewer: pages, API, live updates, and the playground's WebSocket.

One watcher looks at the folder for all clients. Each of them has a short queue of what is new; one that does not read
is dropped, not waited for, and its page asks for everything anew when it is back.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import sys
import time
import traceback
from collections import OrderedDict
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from turgor.errors import InvalidInput, describe
from turgor.web.guard import Guard, Refused, check_file, inside, is_loopback
from turgor.web.library import Library
from turgor.web.watch import CHAMPION_BYTES, RECORD_BYTES, Event, describe_long

STATIC = Path(__file__).parent / "static"
INTERVAL = 0.7  # [s] between two looks at the folder
QUEUE = 256  # messages that wait for one client
BURST = 100  # changed runs in one look, from which on the page is told to ask for all of them
PATIENCE = 10.0  # [s] that one message may take to be sent
HEARTBEAT = 15.0  # [s]
MOST_CLIENTS = 1_000
REPLAYS, REPLAY_BYTES = 24, 64_000_000  # kept in memory, at most
MOST_REPLAYS_WAITING = 32
# of a run that is simulated for its replay: steps times masses, masses, segments of the ground
MOST_WORK, MOST_MASSES, MOST_SEGMENTS = 5_000_000, 300, 20_000
MESSAGE_BYTES = 65_536  # of the playground's client


def make_app(library: Library, *, host: str, port: int, token: str | None) -> tuple[Starlette, Hub]:
    """The application that shows `library` to those who may ask, and the hub of its live updates."""
    hub, replays = Hub(library), Replays(library)

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "index.html", headers={"cache-control": "no-cache"})

    async def whole(_: Request) -> Response:
        return _json(await asyncio.to_thread(library.whole))

    async def run(request: Request) -> Response:
        return _json(await asyncio.to_thread(library.details, _path(library, request)))

    async def replay(request: Request) -> Response:
        which = request.query_params.get("which", "best")
        if which not in ("best", "solver"):
            raise Refused(400, f"which: expected best or solver; got {describe(which)}")
        data = await replays.get(_path(library, request), which)
        return Response(data, media_type="application/octet-stream", headers={"cache-control": "no-cache"})

    async def campaign(request: Request) -> Response:
        return _json(await asyncio.to_thread(library.grid, _path(library, request)))

    async def events(_: Request) -> Response:
        if len(hub.clients) >= MOST_CLIENTS:
            raise Refused(503, f"expected at most {MOST_CLIENTS} pages at a time")
        return EventStream(hub)

    async def playground(websocket: WebSocket) -> None:
        from turgor.web.playground import play

        await play(websocket)

    def get(path: str, answer: Callable[[Request], Awaitable[Response]]) -> Route:
        return Route(path, _answered(answer), methods=["GET"])

    app = Starlette(
        routes=[
            get("/", index),
            get("/api/library", whole),
            get("/api/events", events),
            get("/api/run/{path:path}", run),
            get("/api/replay/{path:path}", replay),
            get("/api/campaign/{path:path}", campaign),
            WebSocketRoute("/api/play", playground),
            Mount("/static", _Static(directory=STATIC)),
        ],
        middleware=[Middleware(Guard, host=host, port=port, token=token)],
        exception_handlers={HTTPException: _http_error},
        lifespan=hub.lifespan,
    )
    return app, hub


class _Static(StaticFiles):
    """Modules and styles, which a browser asks for anew after an update."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "no-cache"
        return response


def _answered(answer: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """`answer`, with every error as JSON of one line."""

    async def respond(request: Request) -> Response:
        try:
            return await answer(request)
        except Refused as error:
            return _json({"error": error.message}, error.status)
        except InvalidInput as error:
            return _json({"error": describe_long(str(error))}, 422)
        except FileNotFoundError:
            return _json({"error": "expected files that exist: the run is gone"}, 404)
        except Exception as error:  # whatever a stranger's files bring about: the rest goes on
            traceback.print_exc()
            return _json({"error": describe_long(f"cannot be read; got {type(error).__name__}: {error}")}, 422)

    return respond


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _json({"error": describe_long(f"{request.url.path}: {error.detail.lower()}")}, error.status_code)


def _json(value: Any, status: int = 200) -> Response:
    data = msgspec.json.encode(value)  # NaN and infinity as null
    return Response(data, status, {"cache-control": "no-store"}, "application/json")


def _path(library: Library, request: Request) -> str:
    """The path asked for, which lies in the folder; raises `Refused`."""
    path = request.path_params["path"]
    inside(library.folder, path)
    return path


# --- live updates -------------------------------------------------------------------------------------------------


class Hub:
    """Looks at the folder, and tells every client what is new."""

    def __init__(self, library: Library) -> None:
        self.clients: set[Client] = set()
        self._library = library

    @contextlib.asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncGenerator[None]:
        await asyncio.to_thread(self._library.look)
        watcher = asyncio.create_task(self._watch())
        yield
        watcher.cancel()

    async def _watch(self) -> None:
        while True:
            began = time.perf_counter()
            try:
                self.publish(await asyncio.to_thread(self._library.look))
            except Exception:  # the next look may go better
                traceback.print_exc()
            await asyncio.sleep(max(INTERVAL, 12 * (time.perf_counter() - began)))  # at most 8 % of a core

    def publish(self, events: list[Event]) -> None:
        """Tells every client."""
        if len(events) > BURST:
            events = [Event("library", {})]
        for event in events:
            message = f"event: {event.kind}\ndata: ".encode() + msgspec.json.encode(event.data) + b"\n\n"
            for client in list(self.clients):
                if not client.tell(message):
                    self.clients.discard(client)

    def close(self) -> None:
        """Sends every client away."""
        for client in list(self.clients):
            client.drop()


class Client:
    """One page that listens."""

    def __init__(self) -> None:
        self.messages: asyncio.Queue[bytes | None] = asyncio.Queue(QUEUE)  # None: the end
        self.dropped = False

    def tell(self, message: bytes) -> bool:
        """Has `message` sent; drops a client for which too many wait, and returns False."""
        try:
            self.messages.put_nowait(message)
        except asyncio.QueueFull:
            self.drop()
        return not self.dropped

    def drop(self) -> None:
        """Ends it, whatever waits."""
        self.dropped = True
        while not self.messages.empty():
            self.messages.get_nowait()
        self.messages.put_nowait(None)


class EventStream(Response):
    """Server-sent events, until the client is gone or does not read."""

    def __init__(self, hub: Hub) -> None:
        super().__init__(media_type="text/event-stream", headers={"cache-control": "no-store"})
        del self.headers["content-length"]
        self._hub = hub

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        client = Client()
        self._hub.clients.add(client)
        gone = asyncio.create_task(_until_gone(receive, client))
        try:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            await self._send(send, b"retry: 1000\n: hello\n\n")
            while not client.dropped:
                try:
                    message = await asyncio.wait_for(client.messages.get(), HEARTBEAT)
                except TimeoutError:
                    message = b": still here\n\n"
                if message is None:
                    break
                await self._send(send, message)
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        except TimeoutError:
            pass  # it does not read: the server closes the connection
        finally:
            self._hub.clients.discard(client)
            gone.cancel()

    async def _send(self, send: Send, data: bytes) -> None:
        async with asyncio.timeout(PATIENCE):
            await send({"type": "http.response.body", "body": data, "more_body": True})


async def _until_gone(receive: Receive, client: Client) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    client.drop()


# --- replays ------------------------------------------------------------------------------------------------------


class Replays:
    """Replays of champions, each made once, one at a time; the latest are kept."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._made: OrderedDict[tuple[Any, ...], asyncio.Task[bytes]] = OrderedDict()
        self._turn = asyncio.Semaphore(1)  # the simulator has the other cores

    async def get(self, path: str, which: str) -> bytes:
        """The replay of a run's champion or best solver. Raises `Refused`, `InvalidInput`."""
        folder = await asyncio.to_thread(self._library.checked, path)
        key = (path, which, _mark(folder / "run.json", RECORD_BYTES), _mark(folder / "champion.npz", CHAMPION_BYTES))
        task = self._made.get(key)
        if task is None:
            if sum(not task.done() for task in self._made.values()) >= MOST_REPLAYS_WAITING:
                raise Refused(503, "too many replays are being made; try again soon")
            task = self._made[key] = asyncio.create_task(self._make(folder, which))
            task.add_done_callback(lambda done: self._keep(key, done))
        self._made.move_to_end(key)
        return await asyncio.shield(task)

    async def _make(self, folder: Path, which: str) -> bytes:
        async with self._turn:
            return await asyncio.to_thread(_replay, folder, which)

    def _keep(self, key: tuple[Any, ...], task: asyncio.Task[bytes]) -> None:
        if task.cancelled() or task.exception() is not None:
            self._made.pop(key, None)
            return
        done = [k for k, t in self._made.items() if t.done() and not t.cancelled() and t.exception() is None]
        size = sum(len(self._made[k].result()) for k in done)
        while len(done) > REPLAYS or (size > REPLAY_BYTES and len(done) > 1):
            size -= len(self._made.pop(done.pop(0)).result())


def _replay(folder: Path, which: str) -> bytes:
    from turgor.runs import Run
    from turgor.web.replay import replay_of_run

    task = Run.open(folder).task
    masses, segments = task.body.mass_count, len(task.scene.segments)
    if task.steps * masses > MOST_WORK or masses > MOST_MASSES or segments > MOST_SEGMENTS:
        found = f"{masses} masses, {segments} segments, {task.steps} steps"
        raise Refused(413, f"replay: expected a run that is quick to simulate; got {found}")
    return replay_of_run(folder, which)


def _mark(path: Path, largest: int) -> tuple[int, int] | None:
    found = check_file(path, largest)
    return None if found is None else (found.st_mtime_ns, found.st_size)


# --- serving ------------------------------------------------------------------------------------------------------


class Server(uvicorn.Server):
    """Calls `ready` once it serves, and sends its listeners away before it waits for connections to end."""

    def __init__(self, app: Starlette, hub: Hub, ready: Callable[[], None]) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                log_level="critical",
                access_log=False,
                server_header=False,
                ws="websockets-sansio",
                ws_max_size=MESSAGE_BYTES,
                ws_per_message_deflate=False,  # frames of the playground are short
                limit_concurrency=2 * MOST_CLIENTS,
                timeout_graceful_shutdown=2,
                lifespan="on",
            )
        )
        self._hub, self._ready = hub, ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            await asyncio.get_running_loop().run_in_executor(None, self._ready)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._hub.close()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        self._captured_signals.clear()  # Ctrl-C is how a viewer ends: no error


def serve(
    folder: Path, *, host: str, port: int | None, say: Callable[[str], None], open_page: Callable[[str], Any] | None
) -> None:
    """Shows `folder` until Ctrl-C. `port` None: 8417, or the next free one. `open_page` is called with the address.

    Raises `InvalidInput` for a folder, host or port that cannot be used.
    """
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: expected a folder of runs", "a file" if folder.exists() else "nothing there")
    listener, token = listen(host, port), None if is_loopback(host) else secrets.token_urlsafe(24)
    port = listener.getsockname()[1]
    app, hub = make_app(Library(folder), host=host, port=port, token=token)
    page = address(host, port, token)

    def ready() -> None:
        say(f"serving {folder} at {page}")
        say("Ctrl-C ends it")
        if open_page is not None:
            open_page(page)

    with listener:
        server = Server(app, hub, ready)
        server.run(sockets=[listener])
    if not server.started:
        raise InvalidInput(f"{folder}: expected a folder that can be served")


def listen(host: str, port: int | None) -> socket.socket:
    """A socket that listens at `host`; `port` None: 8417 or the next free one. Raises `InvalidInput`."""
    tried = range(8417, 8437) if port is None else (port,)
    try:
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
    except (OSError, UnicodeError):
        raise InvalidInput("--host: expected a name or an address of this machine", describe(host)) from None
    reason = ""
    for number in tried:
        listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # named, or asyncio leaves Nagle on
        try:
            if sys.platform != "win32":
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # [ms] after which a client that takes nothing is cut off
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 30_000)
            listener.bind((host, number))
            listener.listen(512)
            return listener
        except (OSError, OverflowError) as error:
            listener.close()
            reason = getattr(error, "strerror", None) or str(error)
    span = f"{tried[0]} to {tried[-1]}" if len(tried) > 1 else f"{tried[0]}"
    raise InvalidInput(f"{host}: expected a free port, {span}", reason)


def address(host: str, port: int, token: str | None) -> str:
    """The page's address, as others reach it where the server listens to all."""
    if host in ("0.0.0.0", "::", ""):
        host = _own_address() or socket.gethostname()
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def _own_address() -> str | None:
    """The address by which this machine reaches others; nothing is sent."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        return probe.getsockname()[0]
    return None
