"""What identification must know of the label system and of the cameras, and the words it shares with the mission."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ..bind import ranged
from ..vision.blink import FlashConfig, FlashPattern


@dataclass(frozen=True, slots=True)
class IdentifyConfig:
    """[mission.identify] settings: the label system's habits, the questions, and the cameras as the detector needs
    them."""

    scheme: Literal["adaptive", "code", "one at a time"] = "adaptive"
    poll_s: float = ranged(3.0, minimum=0.0, maximum=60.0, doc="the label system looks for requests this often")
    commands_per_s: float = ranged(
        10.0, minimum=0.01, maximum=1e4, doc="commands that it sends per second, until flashes have shown it"
    )
    in_order: bool = True
    delay_median_s: float = ranged(1.0, minimum=0.01, maximum=60.0, doc="delay of a command, median")
    delay_normal_s: float = ranged(3.0, minimum=0.01, maximum=60.0, doc="and what 95 % of them stay below")
    delay_tail_s: float = ranged(6.0, minimum=0.0, maximum=120.0, doc="delay after which a command counts as lost")
    lost_fraction: float = ranged(0.05, minimum=1e-4, maximum=0.5, doc="fraction of flashes that nobody sees")
    durations_s: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8, 9)
    stop_s: float = ranged(130.0, minimum=10.0, maximum=7200.0, doc="time that the flashes of one stop may take")
    check_digits: int = ranged(2, minimum=0, maximum=30, doc="scheme code: slots beyond those that tell labels apart")
    max_slots: int = ranged(30, minimum=1, maximum=1000, doc="slots of one stop at most")
    repeat_fraction: float = ranged(0.03, minimum=0.0, maximum=1.0, doc="undecided fraction that is worth a slot")
    audit_fraction: float = ranged(0.05, minimum=0.0, maximum=1.0, doc="known labels that are asked twice, as a check")
    min_probability: float = ranged(0.998, minimum=0.5, maximum=1.0, doc="below it a light is undecided")
    surprise: float = ranged(0.01, minimum=1e-6, maximum=0.2, doc="fraction of flashes that nobody asked for")
    none_fraction: float = ranged(0.02, minimum=1e-6, maximum=0.5, doc="fraction of lights that are no label of ours")
    prediction_px: float = ranged(4.0, minimum=0.1, maximum=100.0, doc="error of a predicted position besides odometry")
    strength: float = ranged(1.0, minimum=0.01, maximum=1.0, doc="brightness asked of the labels")
    pattern: FlashPattern = field(default_factory=FlashPattern)
    gamma: float = ranged(2.2, minimum=0.3, maximum=4.0, doc="the cameras' curve: grey = light^(1/gamma)")
    exposure_s: float = ranged(0.010, minimum=0.0, maximum=0.2, doc="exposure time while looking for flashes")
    row_time_s: float = ranged(
        0.0, minimum=0.0, maximum=0.001, doc="time from one image row's exposure to the next one's"
    )

    def __post_init__(self) -> None:
        durations = self.durations_s
        if not durations or durations[0] < 1 or durations[-1] > 255 or list(durations) != sorted(set(durations)):
            raise ValueError(f"durations_s = {list(durations)}: expected whole seconds from 1 to 255 that increase")
        if not self.delay_median_s < self.delay_normal_s <= self.delay_tail_s:
            raise ValueError(
                f"delay_median_s = {self.delay_median_s:g}, delay_normal_s = {self.delay_normal_s:g}, delay_tail_s = "
                f"{self.delay_tail_s:g}; expected that the first is smaller than the second, and that than the third"
            )

    def flash_config(self) -> FlashConfig:
        """Settings of the cameras' detectors."""
        return FlashConfig(
            pattern=self.pattern, gamma=self.gamma, exposure_s=self.exposure_s, row_time_s=self.row_time_s
        )


@dataclass(frozen=True, slots=True)
class FlashRequest:
    """Ask the label system that these labels flash, each for its own whole seconds; send it `after` the slot began."""

    labels: tuple[str, ...]
    durations: tuple[int, ...]
    after: float = 0.0


@dataclass(frozen=True, slots=True)
class Slot:
    """An interval in which chosen labels flash; it ends `timeout` seconds after it began at the latest."""

    number: int
    requests: tuple[FlashRequest, ...]
    timeout: float
