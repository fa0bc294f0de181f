"""Detectors as the workbench sees them: a name, settings, frames in, flashes and explanations out."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..bind import bind
from ..errors import InputError
from ..records import Flash
from ..vision.blink import FlashConfig, FlashDetector
from ..vision.explain_flash import FlashExplanation, explain_blink, explain_thesis
from ..vision.thesis_blink import ThesisFlashConfig, ThesisFlashDetector

Grey = NDArray[np.uint8]


class Detector(Protocol):
    """One detector on one stream."""

    knows_phase: bool  # whether its flashes say when their pattern begins

    @property
    def settings(self) -> Any:
        """Its configuration, a dataclass."""

    def feed(self, image: Grey, t: float) -> bool:
        """Take one frame (H, W) at `t` seconds; returns whether that led to a decision."""

    def flashes(self) -> list[Flash]:
        """Those accepted so far, best first."""

    def explain(self) -> FlashExplanation:
        """What it makes of the frames so far."""


class _Ours:
    """robotd.vision.blink."""

    Config = FlashConfig
    knows_phase = True

    def __init__(self, config: FlashConfig) -> None:
        self.settings = config
        self._detector = FlashDetector(config)
        self._shape = 0, 0

    def feed(self, image: Grey, t: float) -> bool:
        self._shape = image.shape[0], image.shape[1]
        return self._detector.update(image, t)

    def flashes(self) -> list[Flash]:
        return self._detector.flashes()

    def explain(self) -> FlashExplanation:
        return explain_blink(self._detector, self._shape)


class _Thesis:
    """robotd.vision.thesis_blink: the baseline."""

    Config = ThesisFlashConfig
    knows_phase = False

    def __init__(self, config: ThesisFlashConfig) -> None:
        self.settings = config
        self._detector = ThesisFlashDetector(config)
        self._image: Grey = np.zeros((0, 0), np.uint8)
        self._before: NDArray[np.int16] | None = None

    def feed(self, image: Grey, t: float) -> bool:
        self._image, self._before = image, self._detector._before
        return self._detector.update(image, t)

    def flashes(self) -> list[Flash]:
        return self._detector.flashes()

    def explain(self) -> FlashExplanation:
        return explain_thesis(self._detector, self._image, self._before)


DETECTORS: dict[str, type[_Ours] | type[_Thesis]] = {"robotd": _Ours, "thesis": _Thesis}


def make_detector(name: str, settings: Mapping[str, Any], taken: Mapping[str, Any] | None = None) -> Detector:
    """A fresh detector.

    Parameters
    ----------
    name : str
        One of DETECTORS.
    settings : mapping
        Fields of its configuration, which replace those of `taken`.
    taken : mapping, optional
        What the footage says about how it was taken (`recorded_settings`); fields that this detector has not are left
        out.

    Raises
    ------
    InputError
        Names an unknown detector, and every wrong setting.
    """
    if name not in DETECTORS:
        raise InputError(f"unknown detector '{name}'; expected one of {', '.join(DETECTORS)}")
    kind = DETECTORS[name]
    known = {item.name for item in fields(kind.Config)}
    merged = {key: value for key, value in (taken or {}).items() if key in known} | dict(settings)
    config = bind(kind.Config, merged, f"settings of detector '{name}'")
    made: Detector = kind(config)  # type: ignore[arg-type]
    return made


def recorded_settings(about: Mapping[str, str], camera: Mapping[str, str]) -> dict[str, Any]:
    """What a recording's texts say of the settings that belong to the camera and the labels, not to the detector."""
    found: dict[str, Any] = {}
    for key in ("gamma", "row_time_s"):
        if key in about:
            found[key] = float(about[key])
    if "pattern" in about:
        found["pattern"] = json.loads(about["pattern"])
    if "mode" in camera:
        found["exposure_s"] = json.loads(camera["mode"])["exposure"]
    return found


def read_settings(texts: Sequence[str], file: Path | None) -> dict[str, Any]:
    """Settings from a TOML file and from texts such as "min_margin=4", which win; raises InputError."""
    settings: dict[str, Any] = {}
    if file is not None:
        try:
            settings = tomllib.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
        except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise InputError(f"{file}: not valid TOML: {error}") from error
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip().isidentifier():
            raise InputError(f"setting {text!r}: expected KEY=VALUE, such as min_margin=4")
        try:
            settings |= tomllib.loads(f"{key.strip()} = {value}")
        except tomllib.TOMLDecodeError:
            raise InputError(
                f"setting {text!r}: {value!r} is no value; expected a number, true, false or [..]"
            ) from None
    return settings


def plain_settings(detector: Detector) -> dict[str, Any]:
    """Its configuration in plain values, ready for JSON."""
    return asdict(detector.settings)
