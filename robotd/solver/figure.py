"""Figures without a screen, for the pictures that people look at: matplotlib is loaded only when one is drawn."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ..errors import InputError

INK, MUTED, FAINT = "#1c2127", "#6b7480", "#e3e6ea"
ARROW, RING = "#c2410c", "#15803d"


def new_figure(path: Path, width: float, height: float, dpi: float) -> Any:
    """A white matplotlib figure of so many inches that is to become the file `path`.

    Raises
    ------
    InputError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(f"{path}: pictures need matplotlib; install robotd[solver]") from error
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(path: Path, figure: Any) -> None:
    """Write it as PNG; raises InputError if that cannot be written."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    save_picture(path, buffer.getvalue())


def save_picture(path: str | Path, data: bytes) -> None:
    """Write a picture or page, whole or not at all; raises InputError if that fails."""
    path = Path(path)
    part = path.with_name(f".{path.name}.new")
    try:
        if path.exists() and not path.is_file():  # a pipe has nothing to be replaced
            path.write_bytes(data)
            return
        try:
            part.write_bytes(data)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def plain(name: str) -> str:
    """Text as it stands: matplotlib would read dollar signs as mathematics."""
    return name.replace("$", r"\$")
