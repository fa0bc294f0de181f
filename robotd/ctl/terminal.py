"""The terminal: single keys without Enter, a screen of one's own, and drawing with dots."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import select
import shutil
import sys
import termios
import tty

from .errors import USAGE, CtlError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

KEYS = {
    b"\x1b[A": "up",
    b"\x1b[B": "down",
    b"\x1b[C": "right",
    b"\x1b[D": "left",
    b"\x1bOA": "up",
    b"\x1bOB": "down",
    b"\x1bOC": "right",
    b"\x1bOD": "left",
    b"\x1b[H": "home",
    b"\x1b[1~": "home",
    b"\x1b[5~": "page up",
    b"\x03": "quit",
    b"\x04": "quit",
    b"\x1b": "escape",
}
ESCAPE_S = 0.03  # within which the rest of a key's bytes comes, also over a slow line
HOME, CLEAR_LINE, CLEAR_REST = "\x1b[H", "\x1b[K", "\x1b[J"
OWN_SCREEN, OLD_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
BRAILLE = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))  # Unicode's bits of the 4 x 2 dots of a cell
ARROWS = "\N{RIGHTWARDS ARROW}\N{NORTH EAST ARROW}\N{UPWARDS ARROW}\N{NORTH WEST ARROW}\N{LEFTWARDS ARROW}"
ARROWS += "\N{SOUTH WEST ARROW}\N{DOWNWARDS ARROW}\N{SOUTH EAST ARROW}"
PLAIN_ARROWS = ">/^\\</v\\"


class Screen:
    """The whole terminal, while it is entered; it is as before afterwards, whatever happens."""

    def __enter__(self) -> Screen:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise CtlError(USAGE, "this needs a terminal; robotctl status --json is for scripts")
        self._fd = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._fd)
        self.is_plain = "utf" not in (sys.stdout.encoding or "").lower()
        tty.setraw(self._fd, termios.TCSANOW)
        self._write(OWN_SCREEN)
        return self

    def __exit__(self, *_: object) -> None:
        self._write(OLD_SCREEN)
        termios.tcsetattr(self._fd, termios.TCSANOW, self._before)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines."""
        size = shutil.get_terminal_size()
        return max(20, size.columns), max(8, size.lines)

    def show(self, lines: Sequence[str]) -> None:
        """Draw all lines; what does not fit is cut off."""
        width, height = self.size
        cut = [line[:width] for line in lines[:height]]
        self._write(HOME + "\r\n".join(line + CLEAR_LINE for line in cut) + CLEAR_REST)

    def keys(self, fd: int, seconds: float) -> tuple[list[str], bool]:
        """What was pressed within so long, and whether `fd` became readable, which ends the wait."""
        ready, _, _ = select.select([self._fd, fd], [], [], max(0.0, seconds))
        pressed = list(self._pressed()) if self._fd in ready else []
        return pressed, fd in ready

    def _pressed(self) -> Iterator[str]:
        data = os.read(self._fd, 1024)
        if not data:
            yield "quit"  # the terminal has gone
        while data:
            if data[:1] == b"\x1b" and len(data) < 3 and select.select([self._fd], [], [], ESCAPE_S)[0]:
                data += os.read(self._fd, 1024)
            known = next((key for key in sorted(KEYS, key=len, reverse=True) if data.startswith(key)), None)
            if known is not None:
                yield KEYS[known]
                data = data[len(known) :]
            else:
                yield data[:1].decode("latin-1")
                data = data[1:]

    def _write(self, text: str) -> None:
        data = text.encode(sys.stdout.encoding or "ascii", errors="replace")
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(sys.stdout.fileno(), data) :]


class Plan:
    """A map drawn with dots, x to the right and y upwards, as large as it fits.

    Parameters
    ----------
    width, height : int
        Cells of the terminal.
    points : sequence of (x, y)
        Metres: all that shall be in view.
    is_plain : bool
        Only ASCII.
    """

    def __init__(self, width: int, height: int, points: Sequence[tuple[float, float]], *, is_plain: bool) -> None:
        self.width, self.height, self._is_plain = width, height, is_plain
        xs, ys = [x for x, _ in points] or [0.0], [y for _, y in points] or [0.0]
        span_x, span_y = max(max(xs) - min(xs), 1.0), max(max(ys) - min(ys), 1.0)
        self.scale = min((2 * width - 4) / span_x, (4 * height - 8) / span_y)  # dots a metre; a cell is 2 x 4 of them
        self._x0 = 0.5 * (max(xs) + min(xs)) - width / self.scale
        self._y0 = 0.5 * (max(ys) + min(ys)) - 2 * height / self.scale
        self._dots = [[0] * width for _ in range(height)]
        self._marks: dict[tuple[int, int], str] = {}

    def dot(self, x: float, y: float) -> None:
        """One dot."""
        column, row = self._place(x, y)
        if 0 <= column < 2 * self.width and 0 <= row < 4 * self.height:
            self._dots[row // 4][column // 2] |= BRAILLE[row % 4][column % 2]

    def path(self, points: Sequence[tuple[float, float]]) -> None:
        """Dots along a way, without gaps."""
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            steps = max(1, math.ceil(self.scale * math.hypot(x1 - x0, y1 - y0)))
            for k in range(min(steps, 1000) + 1):
                self.dot(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps)

    def mark(self, x: float, y: float, text: str) -> None:
        """A word that begins there."""
        column, row = self._place(x, y)
        for k, letter in enumerate(text):
            self._marks[column // 2 + k, row // 4] = letter

    def arrow(self, x: float, y: float, heading: float) -> None:
        """Where the robot is, and where it looks."""
        arrows = PLAIN_ARROWS if self._is_plain else ARROWS
        self.mark(x, y, arrows[round(heading / (math.pi / 4)) % 8])

    def lines(self) -> list[str]:
        """The drawing."""
        return ["".join(self._cell(column, row) for column in range(self.width)) for row in range(self.height)]

    def _place(self, x: float, y: float) -> tuple[int, int]:
        return int((x - self._x0) * self.scale), 4 * self.height - 1 - int((y - self._y0) * self.scale)

    def _cell(self, column: int, row: int) -> str:
        if (column, row) in self._marks:
            return self._marks[column, row]
        dots = self._dots[row][column]
        if not dots:
            return " "
        return "." if self._is_plain else chr(0x2800 + dots)
