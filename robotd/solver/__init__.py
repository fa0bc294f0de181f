"""The solver: a survey in, a map out. Runs off the robot."""

from .evaluate import Evaluation, evaluate
from .growing import GrowingMap
from .mapping import solve

__all__ = ["Evaluation", "GrowingMap", "evaluate", "solve"]
