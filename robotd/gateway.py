"""robotd-labels: brings flash requests into the folder that the label system watches.

The label system (thesis section 6.3.6) scans a folder of text files every few seconds and says nothing back. This
program runs beside it, also on Windows, as this one file. It speaks JSON over TCP, one object a line:

    {"id": 1, "token": "...", "method": "flash", "labels": ["4", "7"], "duration": [3, 5], "strength": 1.0, "key": "a"}
    {"id": 1, "ok": true, "refused": {}}           the request lies on the disk and goes into the folder, by itself
    {"id": 1, "ok": false, "error": "..."}         nothing of it will; the text says why
    {"id": 3, "token": "...", "method": "labels", "start": 0}   {"id": 3, "ok": true, "text": "...", "next": 20000}
    {"id": 2, "token": "...", "method": "status"}  answered by {"id": 2, "ok": true, "waiting": 0, "trouble": null}

`duration` is one number of seconds for all labels or a list with one for each. A label that cannot be asked is left out
and named in `refused` with the reason; the others are asked. `trouble` is why a flash would be refused at present.
`labels` sends the list of --labels in pieces: `next` is where the next one begins, null after the last; `date` changes
when the file does.

A request that carries a `key` (any text, unique) may be sent again after a lost connection: it is obeyed once. The
order on the disk makes that hold through a crash: the file is written under a working name, then noted in the log with
its key, then renamed into the folder, with a guard time not before so long after the one before it. At a start, files
that are noted are renamed and the others, which nobody was told about, are deleted. Files go in the order of requests.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import hmac
import json
import math
import os
import re
import signal
import string
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

TEMPLATE = "FLASH;{label};{duration};{strength}"
FIELDS = ("label", "duration", "strength")
LINE_LIMIT = 1 << 16  # bytes of one request
LABEL_LIMIT = 500  # labels of one request
TEXT_PIECE, TEXT_LIMIT = 20_000, 4_000_000  # characters of a list of labels, in one answer and at all
WAITING_LIMIT = 1000  # instruction files that the label system has not fetched
CLIENT_LIMIT = 32  # connections
IDLE_S = 900.0  # after which a silent one is closed: robots that lost their power never say so, and connect anew
LOG_LIMIT = 4 << 20  # bytes; then the log is put aside as log.1
KEYS = 10_000  # keys remembered
RETRY_S = 1.0  # between two looks at files that cannot be moved
TRIES, PAUSE_S = 5, 0.02  # of a rename that Windows refuses while a virus scanner looks at the file
_FILE = re.compile(r"robotd-(\d{12})\.txt")


class RefusedError(Exception):
    """The request cannot be obeyed; the message goes back to whoever sent it."""


class Outbox:
    """The watched folder: writes each instruction file once, with increasing names.

    Parameters
    ----------
    folder : Path
        The one that the label system watches.
    template : str
        One line of an instruction file, in Python's format syntax, with label, duration (s) and strength (0..1).
    guard_s : float
        Time between two files at least; 0: each goes into the folder at once.
    clear_s : float
        Time after which our files are deleted, where the label system leaves them in the folder; 0: it deletes them.
    """

    def __init__(self, folder: Path, template: str = TEMPLATE, guard_s: float = 0.0, clear_s: float = 0.0) -> None:
        self.folder = folder
        self.guard_s = guard_s
        self.clear_s = clear_s
        self._since: dict[str, float] = {}  # when files were first seen in the folder, in the caller's clock
        self.held: deque[str] = deque()  # names of files that wait for their guard time
        self._latest = -math.inf  # when the latest file went into the folder, in the caller's clock
        self._failed = False  # the latest file could not be written
        self._lost: set[str] = set()  # names of files that disappeared before their turn
        self.work = folder / ".robotd-labels"
        self.log = self.work / "log"
        self.template = template
        self.separators = _check_template(template)
        self.number = 0
        self.keys: OrderedDict[str, None] = OrderedDict()

    def open(self) -> None:
        """Finish what a crash left undone; raises OSError if the folder cannot be used."""
        self.work.mkdir(exist_ok=True)
        noted = set()
        for entry in self._entries():
            if entry.get("withdrawn"):
                noted.discard(entry["file"])
                self.keys.pop(str(entry.get("key")), None)
            else:
                noted.add(entry["file"])
                self._remember(entry.get("key"))
        for path in sorted(self.work.glob("robotd-*.txt")):
            if path.name in noted:
                self.held.append(path.name)
            else:
                path.unlink()
        names = [*noted, *(path.name for path in self.folder.iterdir())]
        self.number = max((int(match[1]) for name in names if (match := _FILE.fullmatch(name))), default=0)
        if not self.guard_s:
            self.release(0.0)

    def flash(
        self, labels: list[str], durations: list[int], strength: float, key: str | None, sender: str, now: float = 0.0
    ) -> None:
        """Take one instruction file, and release what is due at time `now`; raises RefusedError."""
        if key is not None and key in self.keys:
            return
        if (trouble := self.trouble()) is not None:
            raise RefusedError(trouble)
        lines = [
            self.template.format(label=label, duration=duration, strength=strength) + "\n"
            for label, duration in zip(labels, durations, strict=True)
        ]
        name = f"robotd-{self.number + 1:012d}.txt"
        path = self.work / name
        try:
            _write(path, "wb", "".join(lines).encode())
            date = path.stat().st_mtime
            entry = {"file": name, "date": date, "key": key, "sender": sender}
            self._note({**entry, "labels": labels, "duration": durations, "strength": strength})
            self.number += 1
            self.held.append(name)
            self.release(now)
            if name in self._lost:
                raise FileNotFoundError(errno.ENOENT, f"{name} was taken away by another program, a virus scanner?")
        except OSError as error:
            if name in self.held:
                self.held.remove(name)
            with suppress(OSError):  # a restart must not obey what is refused now, nor take it for done,
                self._note({"file": name, "key": key, "withdrawn": True})
            with suppress(OSError):  # even where a virus scanner still holds the file
                path.unlink()
            self._failed = True
            raise RefusedError(f"{self.folder} cannot be written: {error.strerror or error}") from error
        self._remember(key)

    def release(self, now: float) -> float | None:
        """Move files whose guard time is over into the folder; seconds until the next one is due, None if none waits.

        One that another program took away is given up. Raises OSError if one cannot be moved; it waits on.
        """
        while self.held:
            due = self._latest + self.guard_s - now
            if due > 0.0:
                return due
            name = self.held[0]
            try:
                _rename(self.work / name, self.folder / name)
                self._latest = now
            except FileNotFoundError:
                if (self.work / name).exists() or not (self.work.is_dir() and self.folder.is_dir()):
                    raise
                self._lost.add(name)
                print(f"robotd-labels: {self.work / name} was taken away; its labels will not flash", file=sys.stderr)
            self.held.popleft()
        return None

    def clear(self, now: float) -> None:
        """Delete files that the label system has had time to read; raises OSError."""
        if not self.clear_s:
            return
        there = [name for name in os.listdir(self.folder) if _FILE.fullmatch(name)]
        self._since = {name: self._since.get(name, now) for name in there}
        failed: OSError | None = None
        for name, since in self._since.items():
            if now >= since + self.clear_s:
                try:
                    (self.folder / name).unlink(missing_ok=True)
                except OSError as error:  # on Windows one that is just being read: the others need not wait for it
                    failed = error
        if failed is not None:
            raise failed

    def waiting(self) -> int:
        """How many of our files the label system has not fetched yet."""
        return len(self.held) + sum(1 for name in os.listdir(self.folder) if _FILE.fullmatch(name))

    def trouble(self) -> str | None:
        """Why no flash can be taken at present."""
        try:
            waiting = self.waiting()
        except OSError as error:
            return f"{self.folder} cannot be read: {error.strerror or error}"
        if waiting >= WAITING_LIMIT:
            return (
                f"{waiting} instruction files wait in {self.folder}; is the label system running and watching it? "
                "If it leaves what it has read, start this program with --clear 60"
            )
        if not self.work.is_dir():
            return f"{self.folder} cannot be written: {self.work.name} in it is gone; start this program again"
        if not os.access(self.folder, os.W_OK) or not os.access(self.work, os.W_OK):
            return f"{self.folder} cannot be written; give this program's user the right to"
        return self._still_failing() if self._failed else None

    def _still_failing(self) -> str | None:
        """Why what could not be written would fail again, by trying."""
        probe = self.work / "probe"
        try:
            _write(probe, "wb", bytes(4096))
        except OSError as error:
            return f"{self.folder} cannot be written: {error.strerror or error}"
        finally:
            with suppress(OSError):
                probe.unlink(missing_ok=True)
        self._failed = False
        return None

    def _note(self, entry: dict[str, Any]) -> None:
        with suppress(OSError):  # there is none yet, or somebody on Windows looks at it: then it grows on
            if self.log.stat().st_size > LOG_LIMIT:
                os.replace(self.log, self.log.with_suffix(".1"))
        begin = b"" if self._log_is_whole() else b"\n"
        _write(self.log, "ab", begin + json.dumps(entry).encode() + b"\n")

    def _log_is_whole(self) -> bool:
        """Whether the last line was not cut off by a crash or a full disk."""
        try:
            with open(self.log, "rb") as file:
                if file.seek(0, os.SEEK_END) == 0:
                    return True
                file.seek(-1, os.SEEK_END)
                return file.read() == b"\n"
        except FileNotFoundError:
            return True

    def _entries(self) -> Iterator[dict[str, Any]]:
        """What the log says, oldest first; a line that a crash cut off was never acted on."""
        for path in (self.log.with_suffix(".1"), self.log):
            with suppress(FileNotFoundError):
                for line in path.read_bytes().split(b"\n"):
                    with suppress(ValueError):
                        entry = json.loads(line)
                        if isinstance(entry, dict) and isinstance(entry.get("file"), str):
                            yield entry

    def _remember(self, key: Any) -> None:
        if isinstance(key, str):
            self.keys[key] = None
            while len(self.keys) > KEYS:
                self.keys.popitem(last=False)


class Gateway:
    """Answers requests, one after the other, on any number of connections."""

    def __init__(self, outbox: Outbox, token: str | None, labels: Path | None = None) -> None:
        self.outbox = outbox
        self.token = token
        self.labels = labels
        self.clients: set[asyncio.Task[None]] = set()
        self.held = asyncio.Event()  # a file waits for its guard time

    async def serve(self, host: str, port: int) -> None:
        """Listen until cancelled; prints the address when it is ready."""
        releasing = asyncio.create_task(self._release())
        server = await asyncio.start_server(self._connected, host, port, limit=LINE_LIMIT)
        address = server.sockets[0].getsockname()
        print(f"robotd-labels: listening on {address[0]}:{address[1]}", flush=True)
        try:
            async with server:
                await _until_told()
                server.close()
                for client in self.clients:
                    client.cancel()
        finally:
            releasing.cancel()
            await asyncio.gather(*self.clients, releasing, return_exceptions=True)

    async def _release(self) -> None:
        """Let held files go when their time has come."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                due = self.outbox.release(loop.time())
                self.outbox.clear(loop.time())
                if due is None and self.outbox.clear_s:
                    due = max(RETRY_S, 0.1 * self.outbox.clear_s)
            except OSError as error:
                print(f"robotd-labels: {self.outbox.folder}: {error.strerror or error}; tried again", file=sys.stderr)
                due = RETRY_S
            self.held.clear()
            with suppress(TimeoutError):
                await asyncio.wait_for(self.held.wait(), due)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self.clients.add(task)
        sender = str((writer.get_extra_info("peername") or ("?",))[0])
        try:
            if len(self.clients) > CLIENT_LIMIT:
                writer.write(_answer(None, f"more than {CLIENT_LIMIT} connections; close one"))
                return
            while line := await asyncio.wait_for(_line(reader), IDLE_S):
                writer.write(self.answer(line, sender, asyncio.get_running_loop().time()))
                if self.outbox.held:
                    self.held.set()
                await writer.drain()
        except ValueError:  # asyncio's word for a line beyond the limit: where the next one begins is unknown
            writer.write(_answer(None, f"a line of more than {LINE_LIMIT} bytes; send less"))
        except (OSError, TimeoutError, asyncio.CancelledError):
            pass
        finally:
            self.clients.discard(task)
            writer.close()
            with suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    def answer(self, line: bytes, sender: str = "?", now: float = 0.0) -> bytes:
        """The answer to one line, whatever is in it; `now` in seconds of the clock that guard times are kept by."""
        number: Any = None
        try:
            try:
                request = json.loads(line)
            except (ValueError, RecursionError):
                raise RefusedError("not JSON; expected one object a line") from None
            if not isinstance(request, dict):
                raise RefusedError(f"found {type(request).__name__}; expected an object in braces")
            number = request.pop("id", None)
            if number is not None and (isinstance(number, bool) or not isinstance(number, int | str)):
                number = None
                raise RefusedError("id: expected a number or a text")
            self._check_token(request.pop("token", None))
            return _answer(number, **self._obey(request, sender, now))
        except RefusedError as error:
            return _answer(number, str(error))

    def _check_token(self, given: Any) -> None:
        if self.token is None:
            return
        if not isinstance(given, str) or not hmac.compare_digest(
            given.encode(errors="replace"), self.token.encode(errors="replace")
        ):
            raise RefusedError("token: missing or wrong; it is in the gateway's --token-file")

    def _obey(self, request: dict[str, Any], sender: str, now: float) -> dict[str, Any]:
        method = request.pop("method", None)
        if method == "status":
            _check_keys(request, set(), set())
            trouble = self.outbox.trouble()
            try:
                waiting = self.outbox.waiting()
            except OSError:  # which is the trouble, or begins just now
                waiting = None
            return {"waiting": waiting, "trouble": trouble}
        if method == "labels":
            _check_keys(request, set(), {"start"})
            return self._listed(request.get("start", 0))
        if method != "flash":
            raise RefusedError(f"method: found {_quote(method)}; expected flash, labels or status")
        _check_keys(request, {"labels", "duration"}, {"strength", "key"})
        labels, strength, key = request["labels"], request.get("strength", 1.0), request.get("key")
        if not isinstance(labels, list) or not 1 <= len(labels) <= LABEL_LIMIT:
            raise RefusedError(f"labels: expected a list of 1 to {LABEL_LIMIT} label ids")
        durations = self._durations(request["duration"], len(labels))
        if not _is_number(strength) or not 0 < strength <= 1:
            raise RefusedError(f"strength: found {_quote(strength)}; expected above 0, at most 1")
        if key is not None and (not isinstance(key, str) or not 1 <= len(key) <= 100):
            raise RefusedError("key: expected a text of 1 to 100 characters")
        refused = {}
        asked: list[tuple[str, int]] = []
        for label, duration in zip(labels, durations, strict=True):
            if not isinstance(label, str):
                raise RefusedError(f"labels: found {_quote(label)}; expected ids of 1 to 64 printable characters")
            if (reason := self._flaw(label)) is not None:
                refused[label] = reason
            else:
                asked.append((label, duration))
        if asked:
            self.outbox.flash(
                [label for label, _ in asked], [length for _, length in asked], float(strength), key, sender, now
            )
        return {"refused": refused}

    def _listed(self, start: Any) -> dict[str, Any]:
        """A piece of the label system's own list."""
        if self.labels is None:
            raise RefusedError("this gateway knows no list of labels; start it with --labels FILE")
        if not isinstance(start, int) or isinstance(start, bool) or start < 0:
            raise RefusedError(f"start: found {_quote(start)}; expected a whole number of 0 or more")
        try:
            date = self.labels.stat().st_mtime_ns
            text = _text(self.labels)
        except (OSError, ValueError) as error:
            raise RefusedError(f"--labels {self.labels}: {error}") from error
        if len(text) > TEXT_LIMIT:
            raise RefusedError(f"--labels {self.labels}: more than {TEXT_LIMIT} characters; is that a list of labels?")
        end = start + TEXT_PIECE
        return {"text": text[start:end], "next": end if end < len(text) else None, "date": date}

    @staticmethod
    def _durations(given: Any, count: int) -> list[int]:
        durations = given if isinstance(given, list) else [given] * count
        if len(durations) != count:
            raise RefusedError(
                f"duration: found {len(durations)} of them; expected one, or one for each label ({count})"
            )
        for duration in durations:
            if not _is_number(duration) or not 1 <= duration <= 255 or duration % 1 != 0:
                raise RefusedError(f"duration: found {_quote(duration)}; expected whole seconds from 1 to 255")
        return [int(duration) for duration in durations]

    def _flaw(self, label: str) -> str | None:
        """Why this label cannot be asked."""
        if not 1 <= len(label) <= 64 or not label.isprintable():
            return "expected an id of 1 to 64 printable characters"
        if clash := sorted(set(label) & self.outbox.separators):
            return f"it has {_quote(clash[0])}, which separates fields in instruction files"
        return None


async def _line(reader: asyncio.StreamReader) -> bytes:
    """The next line, or b"" at the end; what comes after the last line break is noise of a broken connection."""
    while True:
        line = await reader.readline()
        if not line.endswith(b"\n"):
            return b""
        if line.strip():
            return line


async def _until_told() -> None:
    """Return at SIGTERM or Ctrl-C."""
    told = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        try:
            loop.add_signal_handler(number, told.set)
        except NotImplementedError:  # Windows
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(told.set))
    await told.wait()


def _answer(number: Any, error: str | None = None, **more: Any) -> bytes:
    reply = {"id": number, "ok": True, **more} if error is None else {"id": number, "ok": False, "error": error}
    return json.dumps(reply).encode() + b"\n"


def _check_keys(request: dict[str, Any], needed: set[str], optional: set[str]) -> None:
    missing, unknown = sorted(needed - request.keys()), sorted(request.keys() - needed - optional)
    problems = [f"missing key '{key}'" for key in missing] + [f"unknown key {_quote(key)}" for key in unknown[:5]]
    if problems:
        raise RefusedError(f"{', '.join(problems)}; known are {', '.join(sorted(needed | optional)) or 'none'}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _quote(value: Any) -> str:
    try:
        text = json.dumps(value)
    except (ValueError, RecursionError):
        return "something else"
    return text if len(text) <= 60 else text[:57] + "..."


def _check_template(template: str) -> set[str]:
    """The characters that separate fields in a line; raises ValueError if the template makes no such line."""
    names: list[str] = []
    separators = {"\n", "\r"}
    for literal, name, _, _ in string.Formatter().parse(template):
        separators |= {char for char in literal if not char.isalnum()}
        if name is not None:
            if names and not literal:
                raise ValueError(f"nothing between {{{names[-1]}}} and {{{name}}}")
            names.append(name)
    if unknown := sorted(set(names) - set(FIELDS)):
        raise ValueError(f"unknown field {{{unknown[0]}}}; known are {', '.join(FIELDS)}")
    if "label" not in names:
        raise ValueError("no field {label}")
    if "\n" in template:
        raise ValueError("more than one line")
    template.format(label="A1", duration=3, strength=1.0)
    return separators


def _write(path: Path, mode: str, data: bytes) -> None:
    with open(path, mode) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _text(path: Path) -> str:
    """The text of a file that a person wrote; raises OSError, and ValueError if it is no UTF-8."""
    try:
        return path.read_text(encoding="utf-8-sig")  # Notepad begins its files with a mark
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 at byte {error.start}; save it as UTF-8 (PowerShell: -Encoding utf8)") from error


@contextmanager
def _alone(work: Path) -> Iterator[None]:
    """Keep other gateways from the folder: two would give their files the same names.

    Raises BlockingIOError if one runs. The lock ends with the process, however that ends.
    """
    with open(work / "lock", "a+b") as file:
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                raise OSError(error.errno, f"no file can be locked there ({error.strerror})", str(work)) from error
            raise BlockingIOError(error.errno, "another robotd-labels serves this folder", str(work.parent)) from None
        yield


def _rename(old: Path, new: Path) -> None:
    for left in reversed(range(TRIES)):
        try:
            os.replace(old, new)
            return
        except PermissionError:
            if not left:
                raise
            time.sleep(PAUSE_S)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        "robotd-labels", description="Bring flash requests into the label system's folder."
    )
    parser.add_argument("--folder", type=Path, required=True, help="the folder that the label system watches")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this computer only)")
    parser.add_argument("--port", type=int, default=0, help="port to listen on (default: a free one, which is printed)")
    parser.add_argument("--token-file", type=Path, help="file with the secret that requests must carry")
    parser.add_argument("--template", default=TEMPLATE, help=f"one line of an instruction file (default: {TEMPLATE})")
    parser.add_argument("--guard", type=float, default=0.0, help="seconds between two instruction files (default: 0)")
    parser.add_argument(
        "--clear",
        type=float,
        default=0.0,
        help="delete our files after so many seconds, where the label "
        "system leaves them (default: 0, it deletes them itself)",
    )
    parser.add_argument("--labels", type=Path, help="the label system's list of its labels, for robots that ask")
    options = parser.parse_args(arguments)
    if not 0.0 <= options.guard <= 3600.0:
        parser.error(f"--guard {options.guard:g}: expected seconds from 0 to 3600")
    if not (options.clear == 0.0 or 5.0 <= options.clear <= 1e6):
        parser.error(
            f"--clear {options.clear:g}: expected 0, or seconds from 5 to 1000000, several scans of the folder"
        )
    if not 0 <= options.port <= 65535:
        parser.error(f"--port {options.port}: expected a number from 1 to 65535, or 0 for a free one")
    if not options.folder.is_dir():
        print(
            f"robotd-labels: {options.folder} is no folder; --folder is what the label system watches", file=sys.stderr
        )
        return 1
    token = None
    if options.token_file is not None:
        try:
            token = _text(options.token_file).strip()
        except (OSError, ValueError) as error:
            parser.error(f"--token-file {options.token_file}: {getattr(error, 'strerror', None) or error}")
        if not token:
            parser.error(f"--token-file: {options.token_file} is empty")
    elif options.host not in ("127.0.0.1", "::1", "localhost"):
        parser.error(f"--host {options.host}: without --token-file only 127.0.0.1 may be served")
    try:
        outbox = Outbox(options.folder, options.template, options.guard, options.clear)
    except (ValueError, IndexError, KeyError) as error:
        parser.error(f"--template '{options.template}': {error}; expected for example '{TEMPLATE}'")
    if "{duration" not in options.template:
        print("robotd-labels: the template has no {duration}: set durations_s on the robot to the one that labels have")
    try:
        outbox.work.mkdir(exist_ok=True)
        with _alone(outbox.work):
            outbox.open()
            asyncio.run(Gateway(outbox, token, options.labels).serve(options.host, options.port))
    except OSError as error:
        print(
            f"robotd-labels: {error.filename or f'{options.host} port {options.port}'}: {error.strerror}",
            file=sys.stderr,
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
