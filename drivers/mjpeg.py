"""A network camera: JPEG images over HTTP (multipart/x-mixed-replace, "MJPEG")."""

from __future__ import annotations

import asyncio
import base64
import ssl
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp

from robotd import jpeg
from robotd.bind import ranged
from robotd.camera_driver import CameraDriver, first_of
from robotd.camera_feed import QUEUE
from robotd.capture_clock import CaptureClock, capture_stamp
from robotd.clock import in_thread, now, outside
from robotd.errors import DriverFault
from robotd.hardware import CameraCounts, CameraMode
from robotd.jpeg import Channel
from robotd.multipart import MultipartParser, Part, Skipped, boundary_of
from robotd.records import Frame
from robotd.secret_file import driver_secret

CONNECT_S = 10.0  # for the connection and the answer to the request
FIRST_RETRY_S, LAST_RETRY_S = 0.2, 5.0
READ_BUFFER = 256 << 10
NO_PICTURE = 50  # parts in a row that are no image: something else is sent


@dataclass(frozen=True, slots=True)
class MjpegConfig:
    """[drivers.<camera>] with driver = "mjpeg"

    The password is the first line of `password_file`, which no other user may read, or the credential of the unit that
    `password_credential` names. A camera that falls silent for `stall_s` is connected to again,
    and is at fault when nothing comes for `patience_s`. `channel` is what detectors get: "red" for the LEDs that roof
    cameras look for. `delay_s` is the time from the exposure to the arrival, of the quickest frames. `fps` is what the
    camera is set to, so that missing frames are told.
    """

    url: str
    user: str | None = None
    password_file: Path | None = None
    password_credential: str | None = None
    ca_file: Path | None = None
    channel: Channel = "gray"
    fps: float | None = ranged(None, minimum=0.1, maximum=1000.0)
    stamp_header: str | None = None
    delay_s: float = ranged(0.0, minimum=0.0, maximum=10.0)
    stall_s: float = ranged(3.0, minimum=0.2, maximum=60.0)
    patience_s: float = ranged(15.0, minimum=0.2, maximum=600.0)

    def __post_init__(self) -> None:
        wanted = "expected an address such as http://192.168.1.30/video.mjpg"
        try:
            parts = urlsplit(self.url)
            host, _ = parts.hostname, parts.port
        except ValueError as error:
            raise ValueError(f"url: {error}; {wanted}") from None
        if "@" in parts.netloc:  # it is not quoted, because it may be a password
            raise ValueError("url: holds a user or a password, which would be shown; use the keys user, password_file")
        if parts.scheme not in ("http", "https") or not host:
            raise ValueError(f"url: found '{parts.scheme}://{parts.netloc}{parts.path}'; {wanted}")
        secrets = [self.password_file, self.password_credential]
        if len(secrets) - secrets.count(None) != (self.user is not None):
            raise ValueError(
                "user and password_file (or password_credential) belong together; expected both or neither"
            )
        if self.ca_file is not None and parts.scheme != "https":
            raise ValueError("ca_file: there is nothing to verify with http; expected https in url")


class _Broken(Exception):
    """The connection failed in a way that another one may mend; says how, as the end of a sentence."""


class MjpegDriver(CameraDriver):
    """Publishes the frames of one network camera while it is started.

    Size and exposure are the camera's own: a frame must have the size that is asked for, or two, four or eight times
    that.
    """

    Config = MjpegConfig
    config: MjpegConfig

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        parts = urlsplit(self.config.url)
        self._shown = f"{parts.scheme}://{parts.netloc}{parts.path}"  # without a query, which may hold a password
        self._login: dict[str, Any] = {}  # how requests prove who we are, once the camera has said what it wants

    async def open(self) -> None:
        """Connect once, and see that the camera streams; raises DriverFault."""
        config = self.config
        self._password = driver_secret(config.password_file, config.password_credential, f"{self.name} password_file")
        self._login = {}
        session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(ssl=self._tls(), force_close=True),
            timeout=aiohttp.ClientTimeout(total=None),
            cookie_jar=aiohttp.DummyCookieJar(),
            read_bufsize=READ_BUFFER,
            auto_decompress=False,
        )
        self._session = await self.resources.enter_async_context(session)
        try:
            (await self._request()).close()
        except _Broken as broken:
            raise DriverFault(f"{self._shown} {broken}") from broken

    async def _stream(self, mode: CameraMode) -> None:
        counts = CameraCounts()
        self._begin(counts, self.config.fps)
        waiting = _Waiting(counts)
        await first_of(self._receive(waiting), self._decode(waiting, mode))

    # ---- from the network -------------------------------------------------------------------------------------------

    async def _receive(self, waiting: _Waiting) -> None:
        """Collect parts over as many connections as it takes."""
        clock = CaptureClock(self.config.delay_s)
        retry = FIRST_RETRY_S
        self._part_at = now()  # when the last one came
        is_told = False
        while True:
            begun = now()
            try:
                await self._receive_once(waiting, clock)
            except _Broken as broken:
                why = str(broken)
            if self._part_at > begun:
                retry, is_told = FIRST_RETRY_S, False
            silent = now() - self._part_at
            if silent >= self.config.patience_s:
                raise DriverFault(f"{self._shown} {why}; no frame for {silent:.0f} s")
            if not is_told:
                self.report(f"{self._shown} {why}; connecting again", "warning")
                is_told = True
            await asyncio.sleep(retry)
            retry = min(2.0 * retry, LAST_RETRY_S)

    async def _receive_once(self, waiting: _Waiting, clock: CaptureClock) -> None:
        """Collect the parts of one connection until it breaks; raises _Broken."""
        response = await self._request()
        clock.restart()
        try:
            parser = MultipartParser(self._boundary(response))
            heard = now()
            while True:
                try:
                    async with asyncio.timeout_at(heard + self.config.stall_s):
                        data = await response.content.readany()
                except TimeoutError:
                    raise _Broken(f"has sent no whole frame for {self.config.stall_s:g} s") from None
                except (aiohttp.ClientError, OSError) as error:
                    raise _Broken(f"broke off ({_words(error)})") from error
                if not data:
                    raise _Broken("closed the connection")
                t = now()
                for event in parser.feed(data, t):
                    if isinstance(event, Part):
                        stamp = capture_stamp(event.headers, self.config.stamp_header)
                        waiting.put(event.body, clock.date(event.t, stamp))
                        self._part_at = heard = t
                    elif isinstance(event, Skipped) and event.why == "body too long":
                        waiting.counts.damaged += 1
        finally:
            response.close()

    async def _request(self) -> aiohttp.ClientResponse:
        """Ask for the stream, logging in if the camera wants it; raises DriverFault or _Broken."""
        response = await self._get()
        if response.status == 401 and self._password is not None:
            self._choose_login(response)
            response.close()
            response = await self._get()
        try:
            self._check_status(response)
            self._boundary(response)
        except BaseException:
            response.close()
            raise
        return response

    async def _get(self) -> aiohttp.ClientResponse:
        try:
            with outside():
                async with asyncio.timeout(CONNECT_S):
                    return await self._session.get(self.config.url, allow_redirects=False, **self._login)
        except aiohttp.ClientSSLError as error:
            raise DriverFault(
                f"{self._shown} is not trusted ({_words(error)}); give the certificate that signed it as ca_file"
            ) from error
        except TimeoutError as error:
            raise _Broken(f"does not answer within {CONNECT_S:g} s; check address, network and power") from error
        except (aiohttp.ClientError, OSError) as error:
            raise _Broken(f"cannot be reached ({_words(error)}); check address, network and power") from error

    def _choose_login(self, response: aiohttp.ClientResponse) -> None:
        """Digest where the camera knows it, because basic shows the password to everybody on the way."""
        user, password = self.config.user or "", self._password or ""
        offered = " ".join(response.headers.getall("WWW-Authenticate", [])).lower()
        if "digest" in offered:
            self._login = {"middlewares": (aiohttp.DigestAuthMiddleware(user, password),)}
        elif "basic" in offered:
            if not self._login and self._shown.startswith("http:"):
                self.report(f"{self._shown} takes the password unencrypted; use https or digest login", "warning")
            login = base64.b64encode(f"{user}:{password}".encode()).decode()
            self._login = {"headers": {"Authorization": f"Basic {login}"}}
        else:
            raise DriverFault(f"{self._shown} offers neither digest nor basic login")

    def _check_status(self, response: aiohttp.ClientResponse) -> None:
        status = response.status
        if status == 200:
            return
        if 300 <= status < 400:
            place = urlsplit(response.headers.get("Location", "nowhere"))
            target = f"{place.scheme}://{place.hostname}{place.path}" if place.hostname else place.path
            raise DriverFault(f"{self._shown} redirects to {target}; if that is the camera, write it as url")
        if status in (401, 403):
            mend = "check user and password_file" if self._password else "give user and password_file"
            raise DriverFault(f"{self._shown} refuses us ({status}); {mend}")
        if status >= 500:
            raise _Broken(f"has an error of its own ({status} {response.reason})")
        raise DriverFault(f"{self._shown} answers {status} {response.reason}; check the path in url")

    def _boundary(self, response: aiohttp.ClientResponse) -> str | None:
        try:
            return boundary_of(response.headers.get("Content-Type", ""))
        except ValueError as error:
            hint = "; url gives single pictures, look for the camera's MJPEG stream" if "image/" in str(error) else ""
            raise DriverFault(f"{self._shown}: {error}{hint}") from error

    # ---- to the bus -------------------------------------------------------------------------------------------------

    async def _decode(self, waiting: _Waiting, mode: CameraMode) -> None:
        """Turn the newest parts into frames."""
        loop = asyncio.get_running_loop()
        bad = 0
        while True:
            sequence, t, data = await waiting.get()
            header = jpeg.read_header(data)
            if header is not None and jpeg.reduction(header[:2], mode.size) is None:
                raise DriverFault(
                    f"{self._shown} gives {header.width}x{header.height} pixels instead of "
                    f"{mode.size[0]}x{mode.size[1]} or 2, 4 or 8 times that; set its size, or calibrate it anew"
                )
            begun = loop.time()
            image = await in_thread(jpeg.decode, data, mode.size, self.config.channel)
            if image is None:
                waiting.counts.damaged += 1
                bad += 1
                if bad >= NO_PICTURE:
                    raise DriverFault(f"{self._shown} sends something else than JPEG images; check the path in url")
                continue
            bad = 0
            waiting.counts.decoded += 1
            waiting.counts.decode_s += loop.time() - begun
            self._publish(Frame(self.name, t, image, sequence, data), mode)

    # ---- secrets ----------------------------------------------------------------------------------------------------

    def _tls(self) -> ssl.SSLContext | bool:
        if not self.config.url.startswith("https:"):
            return True
        try:
            return ssl.create_default_context(cafile=self.config.ca_file)
        except (OSError, ssl.SSLError) as error:
            raise DriverFault(f"ca_file {self.config.ca_file} cannot be used: {_words(error)}") from error


class _Waiting:
    """Parts that wait for their decoding; a full queue gives up its oldest one."""

    def __init__(self, counts: CameraCounts) -> None:
        self.counts = counts
        self._parts: deque[tuple[int, float, bytes]] = deque()
        self._number = 0
        self._wake = asyncio.Event()

    def put(self, data: bytes, t: float) -> None:
        if len(self._parts) >= QUEUE:
            self._parts.popleft()
            self.counts.dropped += 1
        self._parts.append((self._number, t, data))
        self._number += 1
        self._wake.set()

    async def get(self) -> tuple[int, float, bytes]:
        """Wait for the oldest part: its number, its time, its bytes."""
        while not self._parts:
            self._wake.clear()
            await self._wake.wait()
        return self._parts.popleft()


def _words(error: BaseException) -> str:
    """What went wrong, without addresses or secrets."""
    cause = getattr(error, "os_error", None) or getattr(error, "certificate_error", None) or error
    text = getattr(cause, "verify_message", None) or getattr(cause, "strerror", None) or str(cause)
    return str(text) or type(cause).__name__
