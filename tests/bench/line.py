"""Line detection."""

from __future__ import annotations

import cv2
import numpy as np

from robotd.vision.cluster import dbscan
from robotd.vision.stroke import LineConfig, LineDetector

from .table import Row, median_ms


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


def textured_floor(height: int, width: int) -> np.ndarray:
    """Blotches of about a line's width with hard edges, all over: no line, but edges and strokes everywhere."""
    blotches = cv2.GaussianBlur(np.random.default_rng(2).normal(0, 1, (height, width)), (0, 0), 6.0)
    grey = np.where(blotches > 0, 165.0, 95.0) + np.random.default_rng(3).normal(0, 6, blotches.shape)
    return cv2.GaussianBlur(np.clip(grey, 0, 255).astype(np.uint8), (0, 0), 0.8)


def clustering() -> list[Row]:
    """Our grid DBSCAN of 5000 strokes along eight curves, against scikit-learn's."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError:
        return []
    rng = np.random.default_rng(0)
    along, curve = rng.uniform(0, 1, 5000), rng.integers(0, 8, 5000)
    features = np.column_stack([60 * along, 8 * curve + 5 * np.sin(3 * along), 0 * along, np.cos(along), np.sin(along)])
    features += rng.normal(0, 0.1, features.shape)
    other = DBSCAN(eps=1.0, min_samples=5, algorithm="kd_tree")
    assert (dbscan(features, 1.0, 5)[0] == other.fit(features).labels_).all()
    yardstick = median_ms(lambda: other.fit(features), 10)
    return [Row("DBSCAN of 5000 strokes", median_ms(lambda: dbscan(features, 1.0, 5), 50), "scikit-learn", yardstick)]


def rows() -> list[Row]:
    """Detection of one frame, with grey and remap, against the OpenCV floor."""
    found = []
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
        found.append(Row(f"line detection {width}x{height}", median_ms(ours, 200), "OpenCV floor", floor))
        colour[:] = textured_floor(height, width)[..., None]
        found.append(Row(f"line detection {width}x{height}, textured", median_ms(ours, 200), "OpenCV floor", floor))
    return found + clustering()
