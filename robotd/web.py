"""The server that a robot reports to: one HTTP request at a time, each in a thread of its own.

In a thread, because the handshake of TLS takes a Raspberry Pi tens of milliseconds that the control loop does not have;
by http.client, because an asynchronous client costs a second of processor time at the start, and 15 MB. Certificates
are always verified (issuer, dates, host name); `pins` narrow that to certificates that the operator names. Redirects
are not followed, no proxy is used, and no answer may be longer than its limit.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import http.client
import ssl
import threading
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TypeVar
from urllib.parse import urlsplit

from .clock import outside
from .errors import InputError, UploadError

T = TypeVar("T")

ANSWER_LIMIT = 64 << 10  # bytes; our server's acknowledgements have a hundred
PIECE = 64 << 10  # bytes read at once


class WebServer:
    """One server; see the head of this file.

    Parameters
    ----------
    url : str
        e.g. "https://solver.example:8443".
    token : str or None
        Secret shared with the server, sent with each request.
    ca_file : Path or None
        Certificates that may have signed the server's, instead of the system's.
    pins : collection of str
        SHA-256 fingerprints of certificates, in lower-case hexadecimal digits; if there are any, the server must
        show one of these.

    Raises
    ------
    InputError
        If the url is not one.
    """

    def __init__(self, url: str, token: str | None, *, ca_file: Path | None = None, pins: Collection[str] = ()) -> None:
        try:
            parts = urlsplit(url)
            is_wrong = parts.scheme not in ("http", "https") or not parts.hostname or parts.port == 0
        except ValueError:
            is_wrong = True
        if is_wrong or parts.query or parts.fragment or parts.username is not None:
            shown = url if "@" not in url else "one with a user or a password"
            raise InputError(f"upload.url: found '{shown}'; expected an address like https://solver.example:8443")
        self.url = url.rstrip("/")
        self.ca_file = ca_file
        self.pins = frozenset(pins)
        self._host, self._port, self._prefix = parts.hostname or "", parts.port, parts.path.rstrip("/")
        self._is_secure = parts.scheme == "https"
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._context: ssl.SSLContext | None = None

    async def exchange(
        self,
        method: str,
        target: str,
        *,
        body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        timeout_s: float,
        limit: int = ANSWER_LIMIT,
    ) -> tuple[int, bytes]:
        """One request; returns status and body of the answer.

        On a virtual loop it takes no time, so that there is no time limit on it either.

        Parameters
        ----------
        method, target : str
            e.g. "PUT" and "/api/surveys/room", percent-encoded.
        body, headers
            What to send besides the token.
        timeout_s : float
            For all of it, in seconds.
        limit : int
            Bytes of the longest answer.

        Raises
        ------
        UploadError
            There is no answer, it is longer than `limit`, or the server is not the one that it must be.
        """
        request = _Request(self._connection(timeout_s))
        try:
            async with asyncio.timeout(timeout_s):
                return await _in_own_thread(lambda: self._ask(request, method, target, body, headers or {}, limit))
        except TimeoutError as error:
            raise self._late(timeout_s) from error
        finally:
            request.abort()  # ends the thread, too, if it still waits

    def ask(self, method: str, target: str, *, timeout_s: float, limit: int = ANSWER_LIMIT) -> tuple[int, bytes]:
        """As `exchange`, for whoever may block; `timeout_s` is then for each step."""
        request = _Request(self._connection(timeout_s))
        try:
            return self._ask(request, method, target, None, {}, limit)
        except TimeoutError as error:
            raise self._late(timeout_s) from error
        finally:
            request.abort()

    def _connection(self, timeout_s: float) -> http.client.HTTPConnection:
        if not self._is_secure:
            return http.client.HTTPConnection(self._host, self._port, timeout=timeout_s)
        return _SecureConnection(self._host, self._port, timeout_s, self._tls, self.pins)

    def _ask(
        self,
        request: _Request,
        method: str,
        target: str,
        body: bytes | None,
        headers: Mapping[str, str],
        limit: int,
    ) -> tuple[int, bytes]:
        try:
            return request.make(method, self._prefix + target, body, {**self._headers, **headers}, limit)
        except TimeoutError:
            raise
        except _UntrustedError as error:
            raise UploadError(f"{self.url} is not trusted: {error}") from error
        except ssl.SSLCertVerificationError as error:
            why = error.verify_message
            raise UploadError(f"{self.url} is not trusted: {why}; {self._mend(why)}") from error
        except (OSError, http.client.HTTPException, UnicodeError) as error:
            raise UploadError(f"{self.url} cannot be reached: {_words(error)}") from error

    def _late(self, timeout_s: float) -> UploadError:
        return UploadError(f"{self.url} did not answer within {timeout_s:g} s")

    def _tls(self) -> ssl.SSLContext:
        """Made at the first request, in its thread, because reading all the system's certificates takes long."""
        if self._context is None:
            try:
                self._context = ssl.create_default_context(cafile=self.ca_file)
            except (OSError, ssl.SSLError) as error:
                raise _UntrustedError(f"upload.ca_file {self.ca_file} cannot be used ({_words(error)})") from error
        return self._context

    def _mend(self, why: str) -> str:
        if "expired" in why or "not yet valid" in why:
            return "renew its certificate, or see to the robot's clock"
        if "mismatch" in why or "not valid for" in why:
            return "write the name that its certificate is for into upload.url"
        return "give the certificate that signed its own as upload.ca_file"


class _UntrustedError(Exception):
    """The other side is not, or cannot be shown to be, the server that is meant."""


class _SecureConnection(http.client.HTTPSConnection):
    """Sends nothing before the certificate was compared with the pins."""

    def __init__(
        self,
        host: str,
        port: int | None,
        timeout_s: float,
        context: Callable[[], ssl.SSLContext],
        pins: frozenset[str],
    ) -> None:
        self._make_context, self._pins = context, pins
        super().__init__(host, port, timeout=timeout_s, context=ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT))

    def connect(self) -> None:
        self._context = self._make_context()
        super().connect()
        if not self._pins:
            return
        assert isinstance(self.sock, ssl.SSLSocket)
        found = hashlib.sha256(self.sock.getpeercert(binary_form=True) or b"").hexdigest()
        if found not in self._pins:
            self.close()
            raise _UntrustedError(
                f"it shows another certificate than upload.pins, sha256 {found}; add that if it was renewed"
            )


class _Request:
    """One request on a connection of its own, because stops are minutes apart: a kept one would often be dead."""

    def __init__(self, connection: http.client.HTTPConnection) -> None:
        self._connection = connection
        self._is_aborted = False

    def make(
        self, method: str, target: str, body: bytes | None, headers: dict[str, str], limit: int
    ) -> tuple[int, bytes]:
        """Blocks; raises OSError, HTTPException or _UntrustedError."""
        connection = self._connection
        try:
            connection.connect()
            if self._is_aborted:
                raise TimeoutError
            connection.request(method, target, body, {**headers, "Connection": "close"})
            response = connection.getresponse()
            answer = bytearray()
            while piece := response.read(min(PIECE, limit + 1 - len(answer))):
                answer += piece
                if len(answer) > limit:
                    raise http.client.HTTPException(f"its answer has more than {limit} bytes")
            if response.length:
                raise http.client.IncompleteRead(bytes(answer[:0]), response.length)
            return response.status, bytes(answer)
        finally:
            connection.close()

    def abort(self) -> None:
        """End it from another thread, wherever it waits."""
        self._is_aborted = True
        channel = self._connection.sock
        if channel is not None:
            with contextlib.suppress(OSError):
                channel.shutdown(2)  # SHUT_RDWR


async def _in_own_thread(work: Callable[[], T]) -> T:
    """As `clock.in_thread`, in a thread that is not waited for at the end of the program: a name may take minutes."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def tell(result: T | None, error: BaseException | None) -> None:
        if done.done():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, failure = None, None
        try:
            result = work()
        except Exception as error:
            failure = error
        with contextlib.suppress(RuntimeError):  # the loop is gone
            loop.call_soon_threadsafe(tell, result, failure)

    with outside():
        threading.Thread(target=run, name="web", daemon=True).start()
        return await done


def _words(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
