"""`make bench`: how fast the parts are, each as a ratio to a named yardstick measured in the same run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from robotd import oi
from robotd.files import load_survey
from robotd.solver import solve
from robotd.vision.blink import FlashConfig, FlashDetector
from robotd.vision.stroke import LineConfig, LineDetector

SURVEY = Path(__file__).parent / "room.survey.json"


@dataclass(frozen=True)
class Row:
    """One line of the table: milliseconds of the part and of its yardstick."""

    part: str
    ms: float
    yardstick: str
    yardstick_ms: float


def median_ms(function: Callable[[], object], repeats: int) -> float:
    """Median time of one call in milliseconds, after a tenth of the calls as warm-up."""
    times = []
    for k in range(repeats + repeats // 10 + 1):
        begun = time.perf_counter()
        function()
        if k > repeats // 10:
            times.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(times))


def line_scene(height: int, width: int, tape: float) -> np.ndarray:
    """A textured floor with a dark S-shaped tape, grey."""
    rng = np.random.default_rng(1)
    floor = cv2.resize(rng.normal(150, 25, (height // 4, width // 4)).astype(np.float32), (width, height))
    floor += rng.normal(0, 3, floor.shape)
    v = np.arange(height)
    centre = width / 2 + width / 6 * np.sin(v / height * 4)
    floor[np.abs(np.arange(width)[None, :] - centre[:, None]) < tape / 2] = 45
    return cv2.GaussianBlur(np.clip(floor, 0, 255).astype(np.uint8), (0, 0), 0.8)


def opencv_floor(colour: np.ndarray, map_x: np.ndarray, map_y: np.ndarray) -> np.ndarray:
    """The least any line detector does: grey, remap, gradient, threshold."""
    grey = cv2.remap(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY), map_x, map_y, cv2.INTER_LINEAR)
    dx, dy = cv2.Sobel(grey, cv2.CV_16S, 1, 0), cv2.Sobel(grey, cv2.CV_16S, 0, 1)
    magnitude = cv2.add(cv2.absdiff(dx, np.zeros_like(dx)), cv2.absdiff(dy, np.zeros_like(dy)))
    return cv2.threshold(magnitude, 120, 255, cv2.THRESH_BINARY)[1]


def bench_line() -> list[Row]:
    """Detection of one frame, with grey and remap, against the OpenCV floor."""
    rows = []
    for height, width in ((500, 700), (240, 320)):
        image = line_scene(height, width, 20.0)
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        detector = LineDetector(LineConfig("dark", (14.0, 28.0)))

        def ours(
            colour: np.ndarray = colour, u: np.ndarray = u, v: np.ndarray = v, detector: LineDetector = detector
        ) -> object:
            grey = cv2.remap(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY), u, v, cv2.INTER_LINEAR)
            return detector.detect(grey)

        assert ours(), "the detector must find the tape that it is timed on"
        floor = median_ms(lambda colour=colour, u=u, v=v: opencv_floor(colour, u, v), 200)
        rows.append(Row(f"line detection {width}x{height}", median_ms(ours, 200), "OpenCV floor", floor))
    return rows


def bench_flash() -> Row:
    """Streaming flash detection, decisions included, against absdiff + threshold."""
    rng = np.random.default_rng(2)
    still = rng.normal(90, 30, (480, 640))
    frames = [np.clip(still + rng.normal(0, 2, still.shape), 0, 255).astype(np.uint8) for _ in range(60)]
    detector = FlashDetector(FlashConfig())
    step = iter(range(10**9))

    def ours() -> None:
        k = next(step)
        detector.update(frames[k % 60], k / 30)

    def floor() -> None:
        k = next(step)
        cv2.threshold(cv2.absdiff(frames[k % 60], frames[(k + 1) % 60]), 20, 255, cv2.THRESH_BINARY)

    begun = time.perf_counter()
    for _ in range(300):
        ours()
    mean = 1e3 * (time.perf_counter() - begun) / 300  # the mean, because decisions come only now and then
    return Row("flash detection 640x480", mean, "absdiff + threshold", median_ms(floor, 300))


def bench_stream() -> Row:
    """Decoding one frame of the robot's sensor stream, against summing its bytes."""
    ids = (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44)
    values = dict.fromkeys(ids, 0)
    frame = oi.encode_stream_frame(ids, values, "inclusive")
    decoder = oi.StreamDecoder(ids, "inclusive")
    return Row(
        f"sensor stream, {len(frame)} byte frame",
        median_ms(lambda: decoder.feed(frame), 5000),
        "sum of its bytes",
        median_ms(lambda: sum(frame), 5000),
    )


def bench_solver() -> list[Row]:
    """From survey to map, against reading the same survey's JSON."""
    survey = load_survey(SURVEY)
    text = SURVEY.read_bytes()
    reading = median_ms(lambda: json.loads(text), 50)
    return [
        Row(
            f"solve the demo's room, {method}",
            median_ms(lambda method=method: solve(survey, method=method), 5),
            "json.loads",
            reading,
        )
        for method in ("bundle", "linear")
    ]


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    rows = [*bench_line(), bench_flash(), bench_stream(), *bench_solver()]
    width = max(len(row.part) for row in rows)
    print(f"{'part':<{width}}  {'ms':>9}  {'ratio':>7}  yardstick (ms)")
    for row in rows:
        ratio = row.ms / row.yardstick_ms
        print(f"{row.part:<{width}}  {row.ms:>9.4f}  {ratio:>7.1f}  {row.yardstick} ({row.yardstick_ms:.4f})")


if __name__ == "__main__":
    main()
