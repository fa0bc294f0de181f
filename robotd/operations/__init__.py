"""What operators can ask of the running daemon over its control socket, one module a subject."""

from . import devices, missions, motion, telemetry
from .table import METHODS, Operations

__all__ = ["METHODS", "Operations", "devices", "missions", "motion", "telemetry"]
