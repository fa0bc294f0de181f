"""JSON-RPC 2.0, one object a line: the words of the control socket, without any socket.

    {"jsonrpc": "2.0", "id": 1, "method": "mission.pause", "params": {}}       a request; without `id` nobody answers it
    {"jsonrpc": "2.0", "id": 1, "result": {...}}                               its answer
    {"jsonrpc": "2.0", "id": 1, "error": {"code": 1, "message": "...", "data": {"problems": ["..."]}}}
    {"jsonrpc": "2.0", "method": "event", "params": {...}}                     from the daemon, to whoever subscribed

What comes in is untrusted: at most LINE_LIMIT bytes, UTF-8, no number that is not finite, no batches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

VERSION = 1  # of the methods and what they take and give; a client refuses another one
LINE_LIMIT = 64 << 10  # bytes of a request
METHOD_LIMIT = 64  # characters
DEPTH_LIMIT = 16  # of nested lists and objects in the parameters

PARSE_ERROR, INVALID_REQUEST, UNKNOWN_METHOD, INVALID_PARAMS = (
    -32700,
    -32600,
    -32601,
    -32602,
)  # JSON-RPC 2.0, section 5.1
REFUSED = 1  # the robot is in a state in which this is not done; the message says which, and what to do first
FAILED = 2  # it was tried and failed


class RpcError(Exception):
    """What is answered instead of a result.

    Attributes
    ----------
    code : int
    problems : tuple of str
        One sentence per mistake.
    id : str, int or None
        Of the request, as far as it could be read.
    """

    def __init__(self, code: int, *problems: str, id: str | int | None = None) -> None:
        super().__init__("; ".join(problems))
        self.code = code
        self.problems = problems
        self.id = id


@dataclass(frozen=True, slots=True)
class Request:
    """One call; `id` None: nobody waits for an answer."""

    method: str
    params: Mapping[str, Any] = field(default_factory=dict)
    id: str | int | None = None


def parse(line: bytes) -> Request:
    """Read one line; raises RpcError with what is answered to it."""
    if len(line) > LINE_LIMIT:
        raise RpcError(INVALID_REQUEST, f"a request has more than {LINE_LIMIT} bytes")
    try:
        data = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RpcError(PARSE_ERROR, f"not JSON: {error}") from None
    if not isinstance(data, dict):
        raise RpcError(INVALID_REQUEST, "expected one object a line, e.g. " + EXAMPLE)
    number = data.get("id")
    if isinstance(number, bool) or not isinstance(number, str | int | None) or len(str(number)) > METHOD_LIMIT:
        raise RpcError(INVALID_REQUEST, f"id: expected a short text or a whole number, e.g. {EXAMPLE}")
    problems = []
    if unknown := data.keys() - {"jsonrpc", "id", "method", "params"}:
        problems.append(f"unknown key {_quoted(min(unknown))}")
    if data.get("jsonrpc") != "2.0":
        problems.append('jsonrpc: expected "2.0"')
    method, params = data.get("method"), data.get("params", {})
    if not isinstance(method, str) or not 0 < len(method) <= METHOD_LIMIT:
        problems.append("method: expected the name of a method")
    if not isinstance(params, dict) or not _is_shallow(params, DEPTH_LIMIT):
        problems.append("params: expected an object, not nested deeply")
    if problems:
        raise RpcError(INVALID_REQUEST, *problems, id=number)
    return Request(str(method), params, number)


EXAMPLE = '{"jsonrpc": "2.0", "id": 1, "method": "status"}'


def result(id: str | int, value: Any) -> bytes:
    """The line that answers a request."""
    return msgspec.json.encode({"jsonrpc": "2.0", "id": id, "result": value}) + b"\n"


def failure(error: RpcError) -> bytes:
    """The line that answers a request with an error."""
    body = {"code": error.code, "message": str(error), "data": {"problems": error.problems}}
    return msgspec.json.encode({"jsonrpc": "2.0", "id": error.id, "error": body}) + b"\n"


def notification(method: str, params: Any) -> bytes:
    """A line that nobody answers."""
    return msgspec.json.encode({"jsonrpc": "2.0", "method": method, "params": params}) + b"\n"


def _is_shallow(value: Any, depth: int) -> bool:
    if not isinstance(value, dict | list):
        return True
    inner = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(_is_shallow(item, depth - 1) for item in inner)


def _quoted(text: str) -> str:
    return repr(text[:METHOD_LIMIT])
