"""Who may ask: token, Host and Origin of a request; and which paths lie in the served folder."""

from __future__ import annotations

import hmac
import ipaddress
import os
import stat
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from turgor.errors import InvalidInput

HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Refused(Exception):
    """A request that is not answered: HTTP status and one line."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status, self.message = status, message


# --- requests -----------------------------------------------------------------------------------------------------


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach `host`."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Lets through to `app` what this server's own page asks, and adds the headers that keep a page to itself.

    Without a token (loopback alone) the Host must be this machine's, or else a name that is made to point here could
    read along (DNS rebinding). With one, it must come along: as ?token= once, then as a cookie.
    """

    def __init__(self, app: ASGIApp, *, host: str, port: int, token: str | None) -> None:
        self._app, self._token = app, token
        names = {"localhost", "127.0.0.1", "[::1]", f"[{host}]" if ":" in host else host}
        self._hosts = {f"{name}:{port}" for name in names} | (names if port == 80 else set())
        self._cookie = f"turgor-{port}"  # cookies do not tell ports apart

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        try:
            fresh = self._check(scope)
        except Refused as error:
            await _refuse(error, scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(HEADERS)
                if fresh:
                    headers.append("set-cookie", f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/")
            await send(message)

        await self._app(scope, receive, send_with_headers)

    def _check(self, scope: Scope) -> bool:
        """Whether the token came in the address, and is to be remembered; raises `Refused`."""
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._token is None and host.lower() not in self._hosts:
            raise Refused(403, "Host: expected localhost, 127.0.0.1 or [::1] and this server's port")
        if origin is not None and _netloc(origin) != host.lower():
            raise Refused(403, "Origin: expected this server's own page")
        if scope["path"].startswith("/api/") and headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            raise Refused(403, "expected this server's own page to ask")
        if self._token is None:
            return False
        given = parse_qs(scope.get("query_string", b"").decode("ascii", "replace")).get("token", [""])[0]
        if _same(given, self._token):
            return True
        if not _same(cookie_parser(headers.get("cookie", "")).get(self._cookie, ""), self._token):
            raise Refused(403, "expected the token: open the address that turgor view printed")
        return False


def _netloc(origin: str) -> str:
    try:
        parts = urlsplit(origin)
    except ValueError:
        return ""
    return parts.netloc.lower() if parts.scheme in ("http", "https") else ""


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode())


async def _refuse(error: Refused, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await WebSocketClose(1008, error.message)(scope, receive, send)
        return
    if scope["path"].startswith("/api/"):
        response = JSONResponse({"error": error.message}, error.status, HEADERS)
    else:
        response = PlainTextResponse(f"turgor: {error.message}\n", error.status, HEADERS)
    await response(scope, receive, send)


# --- files --------------------------------------------------------------------------------------------------------


def inside(folder: Path, path: str) -> Path:
    """The folder or file `path` (with "/") in `folder`, a resolved path; raises `Refused` for one that leads out."""
    parts = path.split("/") if path else []
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part or ":" in part[1:2] for part in parts):
        raise Refused(403, "path: expected one inside the folder")
    target = folder.joinpath(*parts)
    try:
        resolved = target.resolve(strict=True)
    except (OSError, ValueError, RuntimeError):
        raise Refused(404, "path: expected one that exists") from None
    if not resolved.is_relative_to(folder):
        raise Refused(403, "path: expected one inside the folder, not a link that leads out")
    return resolved


def check_file(path: Path, largest: int) -> os.stat_result | None:
    """What the system tells of a file that may be read, None where there is none.

    Raises `InvalidInput` for what is no plain file (a link, a pipe, ...) and for one of more than `largest` bytes.
    """
    try:
        found = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise InvalidInput(f"{path.name}: expected a file that can be read", error.strerror) from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a link" if stat.S_ISLNK(found.st_mode) else "something else"
        raise InvalidInput(f"{path.name}: expected a plain file", kind)
    if found.st_size > largest:
        raise InvalidInput(f"{path.name}: expected at most {largest / 1e6:.0f} MB", f"{found.st_size / 1e6:.1f} MB")
    return found
