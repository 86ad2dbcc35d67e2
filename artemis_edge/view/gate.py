"""A door before the viewer when it is open to the network: only who knows the token comes in.

The viewer itself listens on this machine only; the gate passes bytes on. ``/?token=...`` sets a cookie, and every
connection must show the cookie in its first request.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import secrets
import threading
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from artemis_edge.errors import RunError

_COOKIE = "artemis_view"
_LONGEST_HEAD = 1 << 16
_PATIENCE_S = 10.0
_CHUNK = 1 << 16


class Gate:
    """Listens on ``host``:``port`` and passes on to ``inner_port`` of this machine; ``token`` opens it."""

    def __init__(self, host: str, port: int, inner_port: int) -> None:
        self.token = secrets.token_urlsafe(16)
        self.port = port
        self._host, self._inner_port = host, inner_port
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._fault: OSError | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="gate")
        self._thread.start()
        self._ready.wait()
        if self._fault is not None:
            raise RunError(
                f"cannot listen on {host}:{port}: {self._fault.strerror}; choose another --host or --port"
            )

    def close(self) -> None:
        """End all connections."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._ready.set()
            self._loop.close()

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        try:
            server = await asyncio.start_server(self._accept, self._host, self.port, limit=_LONGEST_HEAD)
        except OSError as error:
            self._fault = error
            return
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        await self._stop.wait()
        server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _PATIENCE_S)
            refusal = answer(head, self.token)
            if refusal is None:
                await self._pass_on(head, reader, writer)
            else:
                writer.write(refusal)
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # whoever it was has left or speaks no HTTP
        finally:
            self._tasks.discard(task)
            writer.close()

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner_port)
        inner_writer.write(head)
        ways = [
            asyncio.ensure_future(_copy(reader, inner_writer)),
            asyncio.ensure_future(_copy(inner_reader, writer)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            inner_writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()


def answer(head: bytes, token: str) -> bytes | None:
    """What to answer to a request's head: None to let it through, else a whole HTTP response."""
    try:
        lines = head.decode("latin-1").split("\r\n")
        target = lines[0].split(" ")[1]
        fields = dict(line.split(":", 1) for line in lines[1:] if ":" in line)
        given = parse_qs(urlsplit(target).query).get("token", [""])[0]
        cookie = SimpleCookie({k.lower(): v for k, v in fields.items()}.get("cookie", "").strip())
    except (IndexError, ValueError, CookieError):
        return _response("400 Bad Request", "", "this is no HTTP request")
    if given and _same(given, token):
        header = f"Set-Cookie: {_COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/\r\nLocation: /\r\n"
        return _response("302 Found", header, "")
    if _COOKIE in cookie and _same(cookie[_COOKIE].value, token):
        return None
    return _response("403 Forbidden", "", "open the address that artemis-edge view printed, with its token")


def _same(given: str, token: str) -> bool:
    """In constant time, so that the token cannot be guessed letter by letter."""
    return hmac.compare_digest(given.encode(), token.encode())


def _response(status: str, header: str, text: str) -> bytes:
    body = text.encode()
    head = f"HTTP/1.1 {status}\r\n{header}Content-Type: text/plain\r\nContent-Length: {len(body)}\r\n"
    return head.encode() + b"Connection: close\r\n\r\n" + body
