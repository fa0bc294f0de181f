"""The mission's states and every way from one to another: the table that is enforced, and drawn in ARCHITECTURE.md."""

from __future__ import annotations

from collections.abc import Mapping

from .records import MissionState

NEXT: Mapping[MissionState, tuple[MissionState, ...]] = {
    "idle": ("driving", "uploading", "paused", "fault"),
    "driving": ("settling", "uploading", "paused", "fault"),
    "settling": ("observing", "paused", "fault"),
    "observing": ("driving", "uploading", "paused", "fault"),
    "paused": ("idle", "driving", "settling", "observing", "fault"),
    "fault": ("uploading",),
    "uploading": ("done",),
    "done": (),
}


class States:
    """Where one mission is; refuses every change that the table does not have.

    Attributes
    ----------
    now : MissionState
    """

    def __init__(self) -> None:
        self.now: MissionState = "idle"

    def enter(self, state: MissionState) -> None:
        """Go to a state, or stay there; raises RuntimeError if there is no way to it."""
        if state != self.now and state not in NEXT[self.now]:
            raise RuntimeError(f"a mission goes from '{self.now}' to {' or '.join(NEXT[self.now])}, not to '{state}'")
        self.now = state
