"""How noisy the simulated world is: every figure with its default and meaning, loadable from a `[world]` table."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from ..bind import bind, ranged
from ..config import read_toml
from .camera import SensorSettings
from .labels import LabelSystemSettings
from .roof import RoofCameraSettings


@dataclass(frozen=True, slots=True)
class FloorSettings:
    """[world.floor]: the floor camera's sensor and light."""

    noise: float = ranged(2.0, minimum=0.0, maximum=50.0, doc="shot and read noise, one sigma in grey levels")
    blur: float = ranged(1.0, minimum=0.0, maximum=10.0, doc="optical blur, one sigma in pixels")
    gamma: float = ranged(2.2, minimum=0.5, maximum=4.0, doc="grey level = 255 (light)^(1/gamma)")
    readout: float = ranged(0.030, minimum=0.0, maximum=0.2, doc="rolling shutter: s from the first row to the last")
    vignetting: float = ranged(1.0, minimum=0.0, maximum=1.0, doc="share of the natural cos^4 fall-off of light")
    unevenness: float = ranged(
        0.25, minimum=0.0, maximum=0.9, doc="blotches of light on the floor, relative, one sigma"
    )
    dirt: float = ranged(0.25, minimum=0.0, maximum=1.0, doc="how much of the floor shows through worn tape, at most")


@dataclass(frozen=True, slots=True)
class WorldSettings:
    """[world]: design.md section 9, SI units; angles in radians."""

    travel_noise: float = ranged(0.003, minimum=0.0, maximum=0.1, doc="m per sqrt(m), each wheel's random walk")
    slip_length: float = ranged(0.03, minimum=0.0, maximum=1.0, doc="m of rim that turn without moving in one slip")
    slip_distance: float = ranged(20.0, minimum=0.0, maximum=1e6, doc="m between slips on average; 0: no slips")
    wheel_scale_error: float = ranged(0.003, minimum=0.0, maximum=0.2, doc="of the wheels' size, relative, one sigma")
    wheel_base_error: float = ranged(0.003, minimum=0.0, maximum=0.2, doc="of the wheel base, relative, one sigma")
    wheel_base: float = ranged(0.235, minimum=0.05, maximum=1.0, doc="m, nominal")
    robot_radius: float = ranged(0.17, minimum=0.05, maximum=1.0, doc="m")
    tilt: float = ranged(math.radians(0.3), minimum=0.0, maximum=0.1, doc="roll and pitch of the floor, one sigma")
    tilt_correlation: float = ranged(0.5, minimum=0.01, maximum=100.0, doc="m over which the tilt's correlation is 1/e")

    stamp_jitter: float = ranged(0.002, minimum=0.0, maximum=0.1, doc="s, one sigma of a frame's time stamp")
    camera_offset: float = ranged(
        0.050, minimum=0.0, maximum=1.0, doc="s, each camera's constant stamp error is at most"
    )
    delay_min: float = ranged(0.060, minimum=0.0, maximum=5.0, doc="s from a frame's first light to its delivery")
    delay_max: float = ranged(0.120, minimum=0.0, maximum=5.0, doc="s from a frame's first light to its delivery")
    drop: float = ranged(0.005, minimum=0.0, maximum=1.0, doc="share of frames that never arrive")

    hang_interval: float = ranged(
        0.0, minimum=0.0, maximum=1e6, doc="s between hangs of the robot's computer on average; 0: none"
    )
    hang_longest: float = ranged(0.4, minimum=0.0, maximum=10.0, doc="s for which nothing runs there, at most")

    camera_rotation_error: float = ranged(math.radians(0.05), minimum=0.0, maximum=0.1, doc="per axis, one sigma")
    camera_translation_error: float = ranged(0.001, minimum=0.0, maximum=0.1, doc="m per axis, one sigma")
    focal_error: float = ranged(0.2, minimum=0.0, maximum=20.0, doc="px in fx and fy, one sigma")
    centre_error: float = ranged(0.2, minimum=0.0, maximum=20.0, doc="px in cx and cy, one sigma")

    sensor: SensorSettings = field(default_factory=SensorSettings)
    floor: FloorSettings = field(default_factory=FloorSettings)
    labels: LabelSystemSettings = field(default_factory=LabelSystemSettings)
    roof: RoofCameraSettings = field(default_factory=RoofCameraSettings)

    def __post_init__(self) -> None:
        if self.delay_min > self.delay_max:
            raise ValueError(f"delay_min = {self.delay_min:g}; expected at most delay_max = {self.delay_max:g}")


@dataclass(frozen=True, slots=True)
class _SettingsFile:
    world: WorldSettings


def load_settings(path: Path) -> WorldSettings:
    """Read the `[world]` table of a TOML file; keys that it leaves out keep their defaults.

    Raises
    ------
    ConfigError
        Lists every mistake.
    """
    return bind(_SettingsFile, read_toml(path), str(path)).world
