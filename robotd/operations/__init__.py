"""What operators can ask of the running daemon over its control socket, one module a subject."""

from . import calibrations, devices, missions, motion, prompts, settings, telemetry, trials
from .table import METHODS, Operations

__all__ = [
    "METHODS",
    "Operations",
    "calibrations",
    "devices",
    "missions",
    "motion",
    "prompts",
    "settings",
    "telemetry",
    "trials",
]
