"""The playground: agents driven by hand over WebSockets, in real time, through the kernel.

A `Visitor` is a `Session` on a socket, and the `Playground` has them all. In: JSON, a message of `session.py`. Out: a
scene as JSON, then frames; {"type": "error", "message"} for what is no message, {"type": "status", "message", "rate"}
for what the visitor did not ask for. Nothing is queued for a visitor: a frame that cannot leave is not made.
"""

from __future__ import annotations

import asyncio
import math

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from turgor.errors import InvalidInput
from turgor.web.session import Control, Drag, Drop, Message, Pause, Reset, Seen, Session, Start, read

MOST_VISITORS = 250
MOST_MESSAGES = 240  # a second, over two seconds
MOST_BAD_MESSAGES = 50
START_PAUSE = 0.25  # [s] between two starts
CATCH_UP = 4  # steps at most that are made late; what is later is dropped
STALLED = 10.0  # [s] without reading, then the visitor is shown out
UNSEEN = 1.0  # [s] of frames on their way at most
IDLE = 600.0  # [s] without a message, then the agent stands still
ABSENT = 3600.0  # [s] without an agent that moves, then the visitor makes room for others
FRAMES = 2000  # a second, of all visitors together
SLOWEST = 6  # steps per frame at most


class Farewell(Exception):
    """The visitor is shown out, with a code of WebSockets and a reason."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


class Playground:
    """All visitors of a server, each with an agent of their own."""

    def __init__(self, most: int = MOST_VISITORS) -> None:
        self.most = most
        self.visitors = 0

    @property
    def stride(self) -> int:
        """Steps per frame: 1 while there are few visitors, more so that a server with many still answers."""
        return min(max(math.ceil(60 * self.visitors / FRAMES), 1), SLOWEST)

    async def play(self, websocket: WebSocket) -> None:
        """Serves one visitor until they leave."""
        await websocket.accept()
        if self.visitors >= self.most:
            await websocket.send_text(_error(f"the playground is full: {self.most} visitors; try again later"))
            await websocket.close(1013, "full")
            return
        self.visitors += 1
        visitor = Visitor(websocket, self)
        jobs = [asyncio.create_task(visitor.listen()), asyncio.create_task(visitor.run())]
        try:
            await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.visitors -= 1
            for job in jobs:
                job.cancel()
            ends = await asyncio.gather(*jobs, return_exceptions=True)
        for end in ends:
            if isinstance(end, Farewell):
                await visitor.leave(end)
            elif isinstance(end, Exception) and not isinstance(end, WebSocketDisconnect):
                raise end


class Visitor:
    """One visitor: a socket, a session, and what they are owed."""

    def __init__(self, websocket: WebSocket, playground: Playground) -> None:
        self.websocket, self.playground = websocket, playground
        self.session: Session | None = None
        self.paused = False
        self._now = asyncio.get_running_loop().time
        self._said = asyncio.Event()  # something that may end a pause
        self._sending = asyncio.Lock()
        self._heard = self._seen = self._refilled = self._now()
        self._started = -math.inf
        self._unseen = 0  # frames since the last `Seen`
        self._allowance = 2.0 * MOST_MESSAGES
        self._bad = 0

    async def listen(self) -> None:
        """Takes messages until the visitor leaves; raises `Farewell` after too many bad ones."""
        while True:
            event = await self.websocket.receive()
            if event["type"] == "websocket.disconnect":
                return
            try:
                self._spend()
                await self._do(read(event))
            except InvalidInput as refused:
                self._bad += 1
                if self._bad > MOST_BAD_MESSAGES:
                    raise Farewell(1008, f"more than {MOST_BAD_MESSAGES} bad messages") from None
                await self._send(_error(str(refused)))

    def _spend(self) -> None:
        now = self._now()
        self._allowance = min(self._allowance + MOST_MESSAGES * (now - self._refilled), 2.0 * MOST_MESSAGES)
        self._refilled = now
        if self._allowance < 1:
            raise InvalidInput(f"message: expected at most {MOST_MESSAGES} a second", "more")
        self._allowance -= 1

    async def _do(self, message: Message) -> None:
        if isinstance(message, Seen):
            self._seen, self._unseen = self._now(), 0
            return
        self._heard = self._now()
        if isinstance(message, Start):
            await self._begin(message)
        elif self.session is None:
            raise InvalidInput("message: expected a start first")
        elif isinstance(message, Control):
            self.session.tell(message)
        elif isinstance(message, Drag):
            self.session.drag(message)
        elif isinstance(message, Drop):
            self.session.drag(None)
        elif isinstance(message, Reset):
            self.session.restart()
            await self._send(self.session.frame())  # seen in a pause too
        elif isinstance(message, Pause):
            self.paused = message.on
        self._said.set()

    async def _begin(self, start: Start) -> None:
        """A new session, made in a thread; what comes in meanwhile waits."""
        await asyncio.sleep(self._started + START_PAUSE - self._now())
        self._started = self._now()
        session = await asyncio.to_thread(Session, start)
        async with self._sending:
            self.session = session
            await self._give(session.scene().decode())
            await self._give(session.frame())

    async def run(self) -> None:
        """Steps the session in real time and shows it, until the visitor stops reading."""
        due, stride = self._now(), 0
        while True:
            if self.session is None or self.paused or self._idle:
                if self.session is not None and self._idle and not self.paused:
                    await self._send(_status(f"paused: nothing heard for {IDLE / 60:g} minutes", stride))
                await self._wait()
                due, self._seen = self._now(), self._now()
                continue
            if stride != self.playground.stride:
                stride = self.playground.stride
                await self._send(_status("", stride))
            due = await self._keep_time(due, stride)
            if self._now() - self._seen > STALLED:
                raise Farewell(1008, f"nothing seen for {STALLED:g} seconds")
            if self._unseen * stride < UNSEEN * 60:
                async with self._sending:
                    self._unseen += 1
                    await self._give(self.session.frame())

    async def _wait(self) -> None:
        """Waits for a message that may set the agent going."""
        self._said.clear()
        try:
            async with asyncio.timeout(ABSENT):
                await self._said.wait()
        except TimeoutError:
            raise Farewell(1001, f"nothing happened for {ABSENT / 60:g} minutes") from None

    async def _keep_time(self, due: float, stride: int) -> float:
        """Makes `stride` steps at the time `due`, and more if it is late; returns when the next are due."""
        session = self.session
        assert session is not None
        dt = session.task.physics.dt
        await asyncio.sleep(due - self._now())
        late = self._now() - due
        steps = stride + min(int(late / dt), CATCH_UP)
        for _ in range(steps):
            session.step()
        if session.lost:
            session.restart()
            await self._send(_status("the agent left the world, and starts again", stride))
        due += steps * dt
        return max(due, self._now() - dt)  # time that cannot be made up is dropped

    @property
    def _idle(self) -> bool:
        return self._now() - self._heard > IDLE

    async def _send(self, what: str | bytes) -> None:
        async with self._sending:
            await self._give(what)

    async def _give(self, what: str | bytes) -> None:
        """Sends; what a visitor does not take within `STALLED` ends the visit."""
        try:
            async with asyncio.timeout(STALLED):
                if isinstance(what, str):
                    await self.websocket.send_text(what)
                else:
                    await self.websocket.send_bytes(what)
        except TimeoutError:
            raise Farewell(1008, f"nothing read for {STALLED:g} seconds") from None
        except (OSError, RuntimeError):  # a closed socket, as Starlette tells it
            raise WebSocketDisconnect(1006) from None

    async def leave(self, farewell: Farewell) -> None:
        """Says goodbye, without waiting long for an answer."""
        try:
            async with asyncio.timeout(1):
                await self.websocket.close(farewell.code, farewell.reason)
        except (TimeoutError, WebSocketDisconnect, OSError, RuntimeError):
            pass  # gone already


def _error(message: str) -> str:
    return msgspec.json.encode({"type": "error", "message": message}).decode()


def _status(message: str, stride: int) -> str:
    """A change that the visitor did not ask for; `rate` is frames a second."""
    return msgspec.json.encode({"type": "status", "message": message, "rate": 60 / max(stride, 1)}).decode()


_playground = Playground()


async def play(websocket: WebSocket) -> None:
    """Serves one visitor of the playground until they leave."""
    await _playground.play(websocket)
