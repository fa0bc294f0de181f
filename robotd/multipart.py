"""multipart/x-mixed-replace, as network cameras send it: bytes in, parts out, without I/O.

    --boundary CRLF  header: value CRLF ...  CRLF  body  CRLF  --boundary CRLF ...

A part's length may be told in its header; where it is not, the body ends at the next delimiter. Cameras deviate from
RFC 2046 in the delimiter: the dashes are left out, or are part of the boundary's name, or the line end before it is
missing. So the first delimiter of a stream, a line of any dashes and the boundary, shows which form this camera uses,
and from then on that form alone counts, at the start of a line or right after the end of a JPEG.

A told length is believed, because waiting for the delimiter would cost a whole frame period. When it proves wrong (a
delimiter within it, or something else than a delimiter after it) lengths are not believed any more.

Every byte that is fed belongs to exactly one event, or is `pending`; what is wrong becomes `Skipped`, never an
exception. Memory is bounded by the limits and by what is fed at once.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from email.message import Message
from typing import Literal, NamedTuple

BODY_LIMIT = 8 << 20  # bytes: a JPEG of 24 megapixels
HEADER_LIMIT = 16 << 10
LONGEST_NAME = 128  # bytes of an unnamed boundary; RFC 2046 allows 70
DASHES = 64  # before it
SPARE = 16  # bytes of a delimiter beyond its form: line ends, closing dashes, blanks
JPEG_END = b"\xff\xd9"
_NEWLINE = 0x0A
_REST = re.compile(rb"(?P<closes>--)?[ \t]{0,8}\r?\n")
_HEADERS_END = re.compile(rb"(?:\A|\n)\r?\n")

State = Literal["seek", "headers", "length", "scan"]
Why = Literal["no delimiter", "headers too long", "body too long", "not what the length said"]


@dataclass(frozen=True, slots=True)
class Part:
    """One part: header names in lower case, the body, and when the end of its headers was fed.

    `size` counts its bytes in the stream: delimiter, headers, body and line ends.
    """

    headers: Mapping[str, str]
    body: bytes
    t: float
    size: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """`size` bytes that belong to no part."""

    size: int
    why: Why


@dataclass(frozen=True, slots=True)
class End:
    """The closing delimiter, `size` bytes; what follows is read all the same."""

    size: int


Event = Part | Skipped | End


def boundary_of(content_type: str) -> str | None:
    """The boundary that a Content-Type names; None if it names none.

    Raises
    ------
    ValueError
        It is not a multipart type; the message says what it is.
    """
    message = Message()
    message["content-type"] = content_type
    if message.get_content_maintype() != "multipart" or "/" not in content_type:
        raise ValueError(f"Content-Type is '{content_type[:60]}'; expected multipart/x-mixed-replace")
    boundary = message.get_param("boundary")
    return boundary.strip() or None if isinstance(boundary, str) else None


class MultipartParser:
    """Cuts one stream into its parts.

    Parameters
    ----------
    boundary : str or None
        As named in the Content-Type, with or without its leading dashes; None: the first line that begins with two
        dashes.
    body_limit, header_limit : int
        Bytes; longer ones are skipped.

    Attributes
    ----------
    believes_lengths : bool
        False once a Content-Length was wrong.
    """

    def __init__(self, boundary: str | None, *, body_limit: int = BODY_LIMIT, header_limit: int = HEADER_LIMIT) -> None:
        self.believes_lengths = True
        self._body_limit = body_limit
        self._header_limit = header_limit
        token = boundary.lstrip("-").encode("latin-1", "replace") if boundary else b""
        name = rb"-{0,%d}%s" % (DASHES, re.escape(token)) if token else rb"--[^\r\n-][^\r\n]{0,%d}?" % LONGEST_NAME
        self._first = re.compile(rb"(?:\A|\n)(?P<form>%s)" % name + _REST.pattern)
        self._form: bytes | None = None  # the delimiter, in the form that this camera uses
        self._longest = DASHES + max(len(token), LONGEST_NAME) + SPARE  # bytes of a delimiter with its line ends
        self._buffer = bytearray()
        self._searched = 0  # no delimiter begins before
        self._state: State = "seek"
        self._at_line_start = True
        self._before = 0  # bytes of the part under way that have left the buffer
        self._headers: dict[str, str] = {}
        self._length = 0
        self._header_t = 0.0
        self._after_length = False

    @property
    def pending(self) -> int:
        """Bytes fed that belong to no event yet."""
        return self._before + len(self._buffer)

    def feed(self, data: bytes, t: float = 0.0) -> list[Event]:
        """Take bytes that arrived at time `t`; returns the events that they complete, in order."""
        self._buffer += data
        events: list[Event] = []
        steps = {"seek": self._seek, "headers": self._read_headers, "length": self._take, "scan": self._scan}
        while steps[self._state](events, t):
            pass
        return events

    # ---- the four states: each returns whether it got on ------------------------------------------------------------

    def _seek(self, events: list[Event], t: float) -> bool:
        """Between parts: find the next delimiter."""
        found = self._search()
        gap = len(self._buffer) - self._longest if found is None else found.form
        is_blank = not bytes(self._buffer[: max(0, gap)]).strip(b"\r\n")
        if self._after_length and not is_blank:
            self.believes_lengths = False
        if found is None or not is_blank:
            if gap > 0:
                self._skip(events, gap, "not what the length said" if self._after_length else "no delimiter")
            if found is None:
                return False
            gap = 0
        self._after_length = False
        self._begin(events, gap + found.end - found.form, closes=found.closes)
        return True

    def _read_headers(self, events: list[Event], t: float) -> bool:
        """After a delimiter: headers up to an empty line."""
        match = _HEADERS_END.search(self._buffer, max(0, self._searched - 3))
        if match is None and len(self._buffer) <= self._header_limit:
            self._searched = len(self._buffer)
            return False
        if match is None or match.end() > self._header_limit:
            self._skip(events, 0, "headers too long")
            self._go("seek")
            return True
        self._headers = _parse_headers(bytes(self._buffer[: match.start()]))
        self._header_t = t
        del self._buffer[: match.end()]
        self._before += match.end()
        text = self._headers.get("content-length", "")
        is_told = self.believes_lengths and text.isascii() and text.isdigit() and 0 < int(text[:18]) <= self._body_limit
        self._length = int(text) if is_told else 0
        self._go("length" if is_told else "scan")
        return True

    def _take(self, events: list[Event], t: float) -> bool:
        """A body whose length was told."""
        if len(self._buffer) < self._length:
            return False
        if self._find(0, self._length) is not None:
            self.believes_lengths = False
            self._go("scan")
            return True
        self._finish(events, self._length)
        self._after_length = self._at_line_start = True
        return True

    def _scan(self, events: list[Event], t: float) -> bool:
        """A body up to the next delimiter."""
        found = self._search()
        if found is None:
            if len(self._buffer) - self._longest <= self._body_limit:
                return False
            self._skip(events, self._body_limit - 2, "body too long")  # the end of a JPEG may precede the delimiter
            self._go("seek")
            return True
        if found.start > self._body_limit:
            self._skip(events, found.start, "body too long")
        else:
            self._finish(events, found.start)
        self._begin(events, found.end - found.start, closes=found.closes)
        return True

    # ---- their parts ------------------------------------------------------------------------------------------------

    def _search(self) -> _Delimiter | None:
        """The first delimiter in the buffer, if it is complete."""
        if self._form is None:
            match = self._first.search(self._buffer, self._searched)
            if match is not None and match.start("form") == 0 and not self._at_line_start:
                match = self._first.search(self._buffer, 1)
            if match is not None:
                self._form = match["form"]
                self._longest = len(self._form) + SPARE
                return _Delimiter(match.start(), match.start("form"), match.end(), match["closes"] is not None)
            found = None
        else:
            found = self._find(self._searched, len(self._buffer))
        if found is None:
            self._searched = max(0, len(self._buffer) - self._longest)
        return found

    def _find(self, start: int, end: int) -> _Delimiter | None:
        """The first delimiter within [start, end) of the buffer."""
        assert self._form is not None
        buffer = self._buffer
        at = buffer.find(self._form, start, end)
        while at >= 0:
            rest = _REST.match(buffer, at + len(self._form), end)
            if rest is not None:
                closes = rest["closes"] is not None
                if at == 0 and self._state == "seek" and self._at_line_start:
                    return _Delimiter(0, 0, rest.end(), closes)
                if at > 0 and buffer[at - 1] == _NEWLINE:
                    return _Delimiter(at - 1 - (buffer[at - 2 : at - 1] == b"\r"), at, rest.end(), closes)
                if buffer[max(0, at - 2) : at] == JPEG_END:
                    return _Delimiter(at, at, rest.end(), closes)
            at = buffer.find(self._form, at + 1, end)
        return None

    def _begin(self, events: list[Event], size: int, *, closes: bool) -> None:
        """A delimiter of `size` bytes stands at the start of the buffer."""
        del self._buffer[:size]
        if closes:
            events.append(End(size))
            self._at_line_start = True
            self._go("seek")
        else:
            self._before = size
            self._go("headers")

    def _finish(self, events: list[Event], size: int) -> None:
        """The first `size` bytes of the buffer are the body."""
        body = bytes(memoryview(self._buffer)[:size])
        del self._buffer[:size]
        events.append(Part(self._headers, body, self._header_t, self._before + size))
        self._before = 0
        self._go("seek")

    def _skip(self, events: list[Event], size: int, why: Why) -> None:
        """Give up the part under way and the first `size` bytes of the buffer."""
        del self._buffer[:size]
        self._searched = max(0, self._searched - size)
        self._at_line_start = False
        size, self._before = size + self._before, 0
        last = events[-1] if events else None
        if isinstance(last, Skipped) and last.why == why:
            events[-1] = Skipped(last.size + size, why)
        else:
            events.append(Skipped(size, why))

    def _go(self, state: State) -> None:
        self._state = state
        self._searched = 0


class _Delimiter(NamedTuple):
    """Where it starts in the buffer with its line end, where its form starts, where it ends; whether it is the last."""

    start: int
    form: int
    end: int
    closes: bool


def _parse_headers(block: bytes) -> dict[str, str]:
    """Names in lower case; the first of several alike counts, and a line without a colon is left out."""
    headers: dict[str, str] = {}
    for line in block.decode("latin-1").split("\n"):
        name, colon, value = line.partition(":")
        if colon and name.strip():
            headers.setdefault(name.strip().lower(), value.strip())
    return headers
