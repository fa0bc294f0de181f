"""Films of a roof camera for tests: another renderer than the simulator's, small, with colour and JPEG."""

from dataclasses import dataclass

import cv2
import numpy as np

FRONT_HZ, REAR_HZ = 6.25, 3.125
RATES = {"front": FRONT_HZ, "rear": REAR_HZ}


def ramp(speed, acceleration, begin, end):
    """Distance driven at time t by a robot that speeds up at `begin` and has slowed down again by `end`."""
    rise = speed / acceleration

    def travelled(t):
        t = np.asarray(t, float) - begin
        up = np.clip(t, 0.0, rise)
        down = np.clip(t - (end - begin - rise), 0.0, rise)
        cruise = np.clip(t - rise, 0.0, end - begin - 2.0 * rise)
        return 0.5 * acceleration * up**2 + speed * cruise + speed * down - 0.5 * acceleration * down**2

    return travelled


@dataclass
class Film:
    """A robot with two LEDs, seen from above: `travelled(t)` px along `direction` radians, turned by `turned(t)`."""

    seed: int = 1
    size: tuple = (320, 240)
    fps: float = 12.9
    quality: int | None = 75
    colour: tuple = (40, 60, 255)  # blue, green, red
    light: float = 1.0  # peak in linear light, white is 1
    blur: float = 1.1
    noise: float = 2.0
    exposure: float = 0.010
    row_time: float = 0.0
    start: tuple = (120.0, 110.0)
    direction: float = 0.4
    spacing: float = 36.0
    travelled: object = staticmethod(lambda t: 0.0 * np.asarray(t))
    turned: object = staticmethod(lambda t: 0.0 * np.asarray(t))
    uneven: float = 0.010  # s, of the frames' spacing
    stamp_error: float = 0.0
    lost: float = 0.02
    walker: bool = False
    rates: tuple = (FRONT_HZ, REAR_HZ)
    lit: tuple = (True, True)
    channel: str = "gray"
    gamma: float = 2.2

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        width, height = self.size
        fine = cv2.GaussianBlur(self.rng.random((height, width)), (0, 0), 3)
        fine = (fine - fine.min()) / np.ptp(fine)
        coarse = cv2.resize(self.rng.random((height // 40, width // 40)), self.size, interpolation=cv2.INTER_CUBIC)
        self.floor = np.clip(0.06 + 0.3 * fine + 0.2 * coarse, 0.01, 1.0).astype(np.float32)
        # one field of noise, seen at another place in every frame
        self.grain = self.noise * self.rng.standard_normal((height + 64, width + 64, 3), np.float32)
        self.phase = self.rng.uniform(0.0, 1.0)

    def place(self, beacon, t):
        """True (u, v) of a beacon at the time t."""
        angle = self.direction + float(self.turned(t))
        along = float(self.travelled(t))
        middle = np.array(self.start) + along * np.array([np.cos(self.direction), np.sin(self.direction)])
        side = 0.5 * self.spacing * (1.0 if beacon == "front" else -1.0)
        return middle + side * np.array([np.cos(angle), np.sin(angle)])

    def share(self, hz, t):
        """Of the exposure that begins at t, how much of it an LED is on."""

        def integral(x):
            whole, rest = np.divmod(x - self.phase, 1.0 / hz)
            return whole * 0.5 / hz + min(rest, 0.5 / hz)

        return (integral(t + self.exposure) - integral(t)) / self.exposure

    def grey(self, linear):
        """Grey levels of linear light, white 1."""
        return 255.0 * cv2.pow(np.clip(linear, 0.0, 1.0), 1.0 / self.gamma)

    def frames(self, seconds):
        """Stamp and picture of each frame."""
        rng = self.rng
        for k in range(int(seconds * self.fps)):
            t = k / self.fps + rng.normal(0.0, self.uneven)
            if rng.random() < self.lost:
                continue
            yield t + rng.normal(0.0, self.stamp_error), self.draw(t)

    def draw(self, t):
        linear = self.floor.copy()
        middle = 0.5 * (self.place("front", t) + self.place("rear", t))

        def disc(at, radius, light):
            at = np.rint(16 * np.asarray(at)).astype(int).tolist()
            cv2.circle(linear, at, int(16 * radius), light, -1, cv2.LINE_AA, 4)

        disc(middle, 1.0 * self.spacing, 0.05)
        disc(middle + 3.0, 0.3 * self.spacing, 0.2)
        open_view = np.ones_like(linear)
        if self.walker:  # higher than the robot: hides its lights
            at = (int(16 * (30 + 90 * (t % 3.0))), int(16 * (60 + 40 * np.sin(t))))
            cv2.ellipse(open_view, at, (16 * 18, 16 * 45), 10, 0, 360, 0.0, -1, cv2.LINE_AA, 4)
            linear = linear * open_view + np.float32(0.3 + 0.2 * np.sin(6 * t)) * (1.0 - open_view)
        out = cv2.merge([self.grey(linear)] * 3)
        for (name, hz), is_lit in zip(zip(RATES, self.rates, strict=True), self.lit, strict=True):
            at = self.place(name, t + 0.5 * self.exposure)
            begun = t + self.row_time * at[1]
            at = self.place(name, begun + 0.5 * self.exposure)
            left, top = int(at[0]) - 9, int(at[1]) - 9
            box = np.s_[top : top + 19, left : left + 19]
            v, u = np.ogrid[top : top + 19, left : left + 19]
            spot = np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / self.blur**2)
            light = (self.light * self.share(hz, begun) * is_lit * spot * open_view[box])[:, :, None]
            out[box] = self.grey((linear[box][:, :, None] + light * np.array(self.colour) / 255.0).astype(np.float32))
        top, left = self.rng.integers(0, 64, 2)
        out += self.grain[top : top + out.shape[0], left : left + out.shape[1]]
        out = np.clip(np.rint(out, out=out), 0, 255, out=out).astype(np.uint8)
        if self.quality is not None:
            out = cv2.imdecode(cv2.imencode(".jpg", out, (cv2.IMWRITE_JPEG_QUALITY, self.quality))[1], 1)
        if self.channel == "red":
            return np.ascontiguousarray(out[:, :, 2])
        return cv2.cvtColor(out, cv2.COLOR_BGR2GRAY)


def errors(film, detector, seconds):
    """Every fix of a detector with its error: rows of (fix, du, dv)."""
    found = []
    for t, image in film.frames(seconds):
        for fix in detector.update(image, t):
            true = film.place(fix.beacon, fix.t)
            found.append((fix, fix.u - true[0], fix.v - true[1]))
    return found
