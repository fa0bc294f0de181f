"""Exposure, gain and whatever else changes the brightness of a Video4Linux camera: set, locked, and read back.

A detector of flashes takes any change of them for light. Lamps on the mains flicker at twice its frequency; an exposure
of whole flicker periods averages that out. The control counts in 100 us, which is near enough: 8.3 ms instead of
1/120 s leave 0.4 % of the flicker.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

from . import v4l2_api as api
from .hardware import CameraMode, is_flicker_free
from .v4l2_api import VideoNode

_LOCKS = {
    api.EXPOSURE_AUTO_PRIORITY: "frame rate",
    api.EXPOSURE_AUTO: "exposure",
    api.AUTO_GAIN: "gain",
    api.AUTO_WHITE_BALANCE: "white balance",
    api.FOCUS_AUTO: "focus",
}
_MAINS = {50.0: 1, 60.0: 2}  # V4L2_CID_POWER_LINE_FREQUENCY_50HZ, _60HZ


def lock(node: VideoNode, mode: CameraMode) -> tuple[CameraMode, list[str]]:
    """Set exposure and gain, turn off all that adjusts itself, and see what came of it.

    Returns
    -------
    mode : CameraMode
        With the exposure and the gain that the camera says it has now.
    remarks : list of str
        In words, what it does otherwise than asked.
    """
    remarks: list[str] = []
    for control, value in (
        (api.EXPOSURE_AUTO_PRIORITY, 0),  # because it trades the frame rate for brightness
        (api.EXPOSURE_AUTO, api.EXPOSURE_MANUAL),
        (api.AUTO_GAIN, 0),
        (api.AUTO_WHITE_BALANCE, 0),
        (api.BACKLIGHT_COMPENSATION, 0),
        (api.FOCUS_AUTO, 0),
        (api.POWER_LINE_FREQUENCY, _MAINS.get(mode.mains_hz, 0)),  # some cameras adapt a locked exposure to it
    ):
        query = _query(node, control)
        if query is not None and _set(node, query, value) != value and control in _LOCKS:
            remarks.append(f"does not turn off its automatic {_LOCKS[control]}; use a camera that can be locked")
    exposure = _expose(node, mode, remarks)
    gain = _amplify(node, mode.gain, remarks)
    return replace(mode, exposure=exposure, gain=gain), remarks


def _expose(node: VideoNode, mode: CameraMode, remarks: list[str]) -> float:
    """Set the exposure; returns that which the camera has now."""
    query = _query(node, api.EXPOSURE_ABSOLUTE)
    if query is None:
        remarks.append("has no manual exposure; flashes and lamps cannot be told apart well, use another camera")
        return mode.exposure
    exposure = _set(node, query, round(mode.exposure / api.EXPOSURE_UNIT)) * api.EXPOSURE_UNIT
    if abs(exposure / mode.exposure - 1.0) > 0.02:
        remarks.append(
            f"exposes for {1e3 * exposure:g} ms instead of {1e3 * mode.exposure:g} ms; it offers "
            f"{1e3 * query.minimum * api.EXPOSURE_UNIT:g} to {1e3 * query.maximum * api.EXPOSURE_UNIT:g} ms"
        )
        if is_flicker_free(mode.exposure, mode.mains_hz) and not is_flicker_free(exposure, mode.mains_hz):
            period = 500.0 / mode.mains_hz
            remarks.append(
                f"exposes for no multiple of {period:.3g} ms: lamps on {mode.mains_hz:g} Hz mains flicker in its images"
            )
    return exposure


def _amplify(node: VideoNode, gain: float | None, remarks: list[str]) -> float | None:
    """Set the gain, by default the camera's own default; returns what it has now."""
    query = _query(node, api.GAIN)
    if query is None:
        if gain is not None:
            remarks.append("has no gain that can be set")
        return gain
    wanted = query.default_value if gain is None else round(gain)
    given = _set(node, query, wanted)
    if given != wanted:
        remarks.append(f"has a gain of {given:g} instead of {wanted}; it offers {query.minimum} to {query.maximum}")
    return given


def _query(node: VideoNode, control: int) -> api.QueryControl | None:
    query = api.QueryControl(id=control)
    try:
        node.ioctl(api.QUERYCTRL, query)
    except OSError:
        return None
    return None if query.flags & (api.DISABLED | api.READ_ONLY) else query


def _set(node: VideoNode, query: api.QueryControl, value: int) -> int:
    """Set a control to the nearest value that it allows; returns what it then says."""
    step = max(1, query.step)
    value = min(max(value, query.minimum), query.maximum)
    value = min(query.minimum + round((value - query.minimum) / step) * step, query.maximum)
    control = api.Control(id=query.id, value=value)
    with contextlib.suppress(OSError):  # reading it back shows it
        node.ioctl(api.S_CTRL, control)
    control = api.Control(id=query.id)
    node.ioctl(api.G_CTRL, control)
    return int(control.value)
