"""A network camera: HTTP, multipart/x-mixed-replace, on a real socket.

It serves whatever `render` draws, on the loop's clock, be that virtual or real. In virtual time nothing may jump while
bytes are under way, so each write holds time until they have left.

What cameras do wrong is done by `wire`: it turns the bytes of a part into what is really sent, pieces and pauses.
"""

from __future__ import annotations

import asyncio
import base64
import fcntl
import hashlib
import re
import socket
import ssl
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..clock import in_thread, now, outside

_ESTABLISHED = 1  # tcp_states.h
_SIOCOUTQNSD = 0x894B  # <linux/sockios.h>: bytes not sent yet
REALM, NONCE = "camera", "5ca1ab1e0ddba11"

Image = NDArray[np.uint8]
Render = Callable[[float], Image | Callable[[], Image]]
Wire = Callable[[int, bytes], Sequence[bytes | float | None]]


@dataclass(frozen=True, slots=True)
class NetworkCameraSettings:
    """What a network camera is like.

    `delay_min` and `delay_max` bound the time from the exposure to sending, in seconds. Its own clock shows
    `clock_offset` at loop time 0 and gains `clock_skew` seconds a second; it is sent in the header `stamps` if that is
    named. `delimiter` is what stands on the wire, `boundary` what the Content-Type names. A frame is drawn `exposed`
    seconds after its exposure began, when that is over; the share `drop` of the frames is never sent.
    """

    path: str = "/video"
    fps: float = 25.0
    quality: int = 80
    boundary: str = "frame"
    delimiter: str = "--frame"
    line_end: bytes = b"\r\n"
    lengths: bool = True
    chunked: bool = False
    stamps: str | None = "X-Timestamp"
    clock_offset: float = 1.7e9
    clock_skew: float = 0.0
    delay_min: float = 0.040
    delay_max: float = 0.060
    exposed: float = 0.0
    drop: float = 0.0
    login: Literal["none", "basic", "digest"] = "none"
    user: str = "viewer"
    password: str = "secret"
    content_type: str | None = None  # instead of multipart
    status: str = "200 OK"
    location: str | None = None


class MjpegServer:
    """One camera; serves any number of clients.

    Parameters
    ----------
    render : callable
        From loop time in seconds to the (H, W) grey or (H, W, 3) BGR image whose exposure began then, or to a function
        that draws it in a thread.
    settings : NetworkCameraSettings
        May be replaced while it runs: the next connection obeys it.
    seed : int
        Of the delays.
    wire : callable, optional
        From a part's number and bytes to what is sent: bytes, pauses in seconds, or None for a closed connection.
    """

    def __init__(
        self, render: Render, settings: NetworkCameraSettings, *, seed: int = 1, wire: Wire | None = None
    ) -> None:
        self.settings = settings
        self.requests: list[str] = []  # heads, as they came
        self.connections = 0
        self._render = render
        self._rng = np.random.default_rng(seed)
        self._wire: Wire = wire or (lambda number, part: (part,))
        self._clients: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def start(self, port: int = 0, tls: ssl.SSLContext | None = None) -> str:
        """Listen on loopback; returns the address of the stream."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", port, ssl=tls)
        port = self._server.sockets[0].getsockname()[1]
        return f"http{'s' if tls else ''}://127.0.0.1:{port}{self.settings.path}"

    async def close(self) -> None:
        """End every connection and stop listening."""
        if self._server is not None:
            self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        self.connections += 1
        try:
            while await self._answer(reader, writer):
                pass
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # the client went away, or is none, or the camera is switched off
        finally:
            self._clients.discard(task)
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer one request; returns whether the connection stays open for another one."""
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        self.requests.append(head)
        settings = self.settings
        method, path, _ = head.split("\r\n", 1)[0].split(" ", 2)
        if settings.login != "none" and not _is_allowed(settings, method, path, head):
            challenge = (
                f'Basic realm="{REALM}"'
                if settings.login == "basic"
                else f'Digest realm="{REALM}", nonce="{NONCE}", qop="auth", algorithm=MD5'
            )
            await _send(writer, _head("401 Unauthorized", ("WWW-Authenticate", challenge), ("Content-Length", "0")))
            return True
        if path.split("?")[0] != settings.path:
            await _send(writer, _head("404 Not Found", ("Content-Length", "0")))
            return True
        fields = [("Content-Type", settings.content_type or f"multipart/x-mixed-replace; boundary={settings.boundary}")]
        if settings.location is not None:
            fields.append(("Location", settings.location))
        if settings.status != "200 OK" or settings.content_type is not None:
            await _send(writer, _head(settings.status, *fields, ("Content-Length", "0")))
            return True
        fields.append(("Transfer-Encoding", "chunked") if settings.chunked else ("Connection", "close"))
        await _send(writer, _head("200 OK", *fields))
        await self._stream(settings, writer)
        return False

    async def _stream(self, settings: NetworkCameraSettings, writer: asyncio.StreamWriter) -> None:
        start, number = now(), 0
        while True:
            t = start + number / settings.fps
            delay = self._rng.uniform(settings.delay_min, settings.delay_max)
            number += 1
            is_lost = settings.drop > 0.0 and self._rng.random() < settings.drop
            await asyncio.sleep(max(0.0, t + settings.exposed - now()))
            if is_lost:
                continue
            part = _part(settings, t, await in_thread(_encode, self._render(t), settings.quality))
            await asyncio.sleep(max(0.0, t + delay - now()))
            for piece in self._wire(number - 1, part):
                if piece is None:
                    return
                if isinstance(piece, bytes):
                    await _send(writer, b"%x\r\n%s\r\n" % (len(piece), piece) if settings.chunked else piece)
                else:
                    await asyncio.sleep(piece)


def _encode(image: Image | Callable[[], Image], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", image() if callable(image) else image, (cv2.IMWRITE_JPEG_QUALITY, quality))
    assert done
    return data.tobytes()


def _part(settings: NetworkCameraSettings, t: float, jpeg: bytes) -> bytes:
    lines = [settings.delimiter, "Content-Type: image/jpeg"]
    if settings.lengths:
        lines.append(f"Content-Length: {len(jpeg)}")
    if settings.stamps is not None:
        lines.append(f"{settings.stamps}: {settings.clock_offset + (1.0 + settings.clock_skew) * t:.6f}")
    end = settings.line_end
    return end.join(line.encode() for line in lines) + end + end + jpeg + end


def _head(status: str, *fields: tuple[str, str]) -> bytes:
    lines = [f"HTTP/1.1 {status}", *(f"{name}: {value}" for name, value in fields)]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Write, and hold virtual time until everything has left for the other side, which on loopback is its arrival."""
    writer.write(data)
    with outside():
        await writer.drain()
        sock: Any = writer.get_extra_info("socket")
        while not writer.transport.is_closing() and (writer.transport.get_write_buffer_size() or _unsent(sock)):
            await asyncio.sleep(0)


def _unsent(sock: Any) -> int:
    """Bytes that wait in this side's kernel; 0 on a connection that is down."""
    try:
        state = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
        waiting = struct.unpack("i", fcntl.ioctl(sock.fileno(), _SIOCOUTQNSD, bytes(4)))[0]
    except (OSError, ValueError):
        return 0
    return int(waiting) if state == _ESTABLISHED else 0


def _is_allowed(settings: NetworkCameraSettings, method: str, path: str, head: str) -> bool:
    """Whether a request's Authorization is right (RFC 7617, RFC 7616 with MD5 and qop auth)."""
    found = re.search(r"^authorization: (\w+) (.*)$", head, re.IGNORECASE | re.MULTILINE)
    if found is None:
        return False
    scheme, text = found[1].lower(), found[2].strip()
    if scheme != settings.login:
        return False
    if scheme == "basic":
        return base64.b64decode(text).decode() == f"{settings.user}:{settings.password}"
    values = {key: quoted or plain for key, quoted, plain in re.findall(r'(\w+)=(?:"([^"]*)"|([^\s,]+))', text)}
    secret = _md5(f"{settings.user}:{REALM}:{settings.password}")
    request = _md5(f"{method}:{path}")
    middle = ":".join(values.get(key, "") for key in ("nonce", "nc", "cnonce", "qop"))
    return values.get("nonce") == NONCE and values.get("response") == _md5(f"{secret}:{middle}:{request}")


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
