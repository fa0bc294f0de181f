"""At which rates the two beacons flash, and what a roof camera sees of them.

Both LEDs are on half of the time, so an LED at f Hz is a square wave: f and its odd multiples, the h-th with 1/h of the
strength. A camera of n frames a second sees a frequency only up to n / 2; what is above is folded back to
|f - k n|. Close to n / 2 the amplitude depends on the phase and can vanish. So both rates stay well below that limit,
and no strong harmonic of one LED may be seen at the rate of the other: front and rear are told apart by their rates.

Both LEDs are switched by one clock, at whole multiples of its tick: they keep their phase and never drift apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm

SAMPLES = 2.5  # frames a period, at least: clear of the Nyquist limit of 2
SEPARATION = 0.5  # Hz between two lines of the spectrum that an observation of some seconds tells apart
HARMONICS = (3, 5, 7)  # the next one has a ninth of the strength: no brighter than noise
MOST_TICKS = 16  # in half a period
SHORTEST_TICK = 0.020  # s
TOLERANCE = 1e-4  # by which a written rate may differ from the exact one, relative


@dataclass(frozen=True, slots=True)
class BeaconRates:
    """A pair of rates: each LED changes every `front_ticks` or `rear_ticks` ticks of `tick` seconds."""

    tick: float
    front_ticks: int
    rear_ticks: int

    @property
    def front_hz(self) -> float:
        """Flashes a second of the front LED."""
        return 0.5 / (self.tick * self.front_ticks)

    @property
    def rear_hz(self) -> float:
        """Flashes a second of the rear LED."""
        return 0.5 / (self.tick * self.rear_ticks)

    @property
    def cycle(self) -> int:
        """Ticks after which both begin again together."""
        return 2 * lcm(self.front_ticks, self.rear_ticks)

    def levels(self, tick: int) -> tuple[bool, bool]:
        """Whether front and rear are lit in a tick; at tick 0 both are switched on."""
        return tick // self.front_ticks % 2 == 0, tick // self.rear_ticks % 2 == 0


def rates(front_hz: float, rear_hz: float) -> BeaconRates:
    """The slowest common tick of two rates.

    Raises
    ------
    ValueError
        Half periods of the two are not whole multiples of one tick of at least 20 ms.
    """
    ratio = Fraction(rear_hz / front_hz).limit_denominator(MOST_TICKS)
    front_ticks, rear_ticks = ratio.numerator, ratio.denominator
    off = abs(rear_hz * rear_ticks - front_hz * front_ticks) if front_ticks else rear_hz
    if off <= TOLERANCE * rear_hz * rear_ticks and rear_ticks <= MOST_TICKS and front_ticks <= MOST_TICKS:
        tick = 0.25 * (1.0 / (front_hz * front_ticks) + 1.0 / (rear_hz * rear_ticks))
        if tick >= SHORTEST_TICK * (1.0 - TOLERANCE):
            return BeaconRates(tick, front_ticks, rear_ticks)
    raise ValueError(
        f"front_hz = {front_hz:g}, rear_hz = {rear_hz:g}: one tick of {1e3 * SHORTEST_TICK:g} ms or more does not "
        f"divide both half periods; take rates like 1 : 2 or 2 : 3, e.g. {describe(good_pairs(()))}"
    )


def seen(hz: float, fps: float) -> float:
    """At which frequency a camera of `fps` frames a second sees a light of `hz`, in Hz from 0 to fps / 2."""
    return abs(hz - fps * round(hz / fps))


def conflicts(pair: BeaconRates, fps: Sequence[float]) -> list[str]:
    """What speaks against a pair of rates, by itself and at each camera's rate (Hz); empty if nothing does."""
    named = (("front", pair.front_hz, "rear", pair.rear_hz), ("rear", pair.rear_hz, "front", pair.front_hz))
    found = []
    if abs(pair.front_hz - pair.rear_hz) < SEPARATION:
        found.append(f"front_hz = {pair.front_hz:.4g} and rear_hz = {pair.rear_hz:.4g} are not {SEPARATION:g} Hz apart")
    for name, hz, other, other_hz in named:
        found += [
            f"{harmonic} times {name}_hz = {hz:.4g} is within {SEPARATION:g} Hz of {other}_hz = {other_hz:.4g}"
            for harmonic in HARMONICS
            if abs(harmonic * hz - other_hz) < SEPARATION
        ]
    for rate in fps:
        at = f"at {rate:g} frames a second"
        found += [
            f"{name}_hz = {hz:.4g} {at} is above {rate / SAMPLES:.4g} ({SAMPLES:g} frames a period)"
            for name, hz, _, _ in named
            if hz * SAMPLES > rate * (1.0 + TOLERANCE)
        ]
        found += [
            f"{at} {harmonic} times {name}_hz = {hz:.4g} looks like {seen(harmonic * hz, rate):.4g} Hz, as the {other} "
            "beacon does"
            for name, hz, other, other_hz in named
            for harmonic in HARMONICS
            if harmonic * hz > 0.5 * rate and abs(seen(harmonic * hz, rate) - other_hz) < SEPARATION
        ]
    return found


def good_pairs(fps: Sequence[float], count: int = 3) -> list[BeaconRates]:
    """The fastest pairs that nothing speaks against at these frame rates; front faster than rear by 1 : 2 or 2 : 3.

    Faster is better because a flash more is seen in the same time; empty if every camera is too slow.
    """
    fits = [
        pair
        for milliseconds in range(40, 401, 5)
        for front, rear in ((1, 2), (2, 3))
        if not conflicts(pair := BeaconRates(1e-3 * milliseconds, front, rear), fps) and pair.front_hz <= 6.25
    ]
    return sorted(fits, key=lambda pair: -pair.front_hz - pair.rear_hz)[:count]


def describe(pairs: Sequence[BeaconRates]) -> str:
    """Pairs as an operator would write them."""
    return " or ".join(f"front_hz = {pair.front_hz:.6g}, rear_hz = {pair.rear_hz:.6g}" for pair in pairs)
