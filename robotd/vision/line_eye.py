"""Pictures of the floor to lines in a top view, at three levels of effort, and which pictures are none."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..records import CameraModel, Line
from .stroke import WIDTH_ERROR, LineConfig, LineDetector
from .top_view import TopView

Bytes = NDArray[np.uint8]

WIDTH_TOLERANCE, RELAXED_TOLERANCE = 0.25, 0.45  # the tape may be that much narrower or wider than it is said to be
SURE_CONFIDENCE = 0.5  # of a line that may be ours, whatever else is in view
RELAXED_CONFIDENCE = 0.25  # of a line that is searched where it is predicted, or after a loss
DEPTH = 0.80  # m of floor, from the nearest in view on, that the top view has at least
FARTHEST = 3.0  # m before the robot within which a camera must see floor
BLOCKS = (32, 24)  # of a picture, across and down: small enough for the last of a tape, large enough to average noise
FLAT = 4.0  # grey levels between the darkest and the brightest block of a picture: nobody looks through that lens
CLIPPED = 0.9  # share of pixels at white beyond which a picture shows nothing
WHITE = 250


class LineEye:
    """One camera that looks at the floor, with all that turns its pictures into lines.

    Parameters
    ----------
    camera : CameraModel
        Calibrated, on the robot.
    line_width : float
        Metres.
    color : "dark", "bright" or "both"
    metres_per_pixel : float
        Of the top view.
    x, y : (least, greatest) in metres, robot axes
        The rectangle of floor to look at. If the nearest floor in view is farther away than x begins, it reaches
        0.8 m beyond that at least: a camera that looks ahead sees floor only from some distance on.

    Attributes
    ----------
    view : TopView
    blind : float
        Metres from the robot's origin to the nearest floor in view.

    Raises
    ------
    ValueError
        If the camera sees nothing of the rectangle.
    """

    def __init__(
        self,
        camera: CameraModel,
        line_width: float,
        color: str,
        metres_per_pixel: float,
        x: tuple[float, float],
        y: tuple[float, float],
    ) -> None:
        self._size = camera.size
        near = max(x[0], _nearest_floor(camera))
        self.view = TopView(camera, metres_per_pixel, (x[0], max(x[1], near + DEPTH)), y)
        self.blind = float(self.view.to_robot(np.array([[0.0, self.view.valid.shape[0] - 1.0]]))[0, 0])
        self._color = color
        self.expect(line_width)
        self._top: Bytes = np.empty(self.view.valid.shape, np.uint8)
        self._last: Bytes | None = None

    @property
    def top(self) -> Bytes:
        """The top view of the last picture looked at."""
        return self._top

    def expect(self, line_width: float) -> None:
        """From now on look for a line of this width (metres, as it looks: glare and blur make bright tape wider)."""
        width = line_width / self.view.metres_per_pixel

        def detector(tolerance: float, least: float) -> LineDetector:
            widths = max(width * (1.0 - tolerance), 1.0), max(width * (1.0 + tolerance), 1.0)
            return LineDetector(LineConfig(self._color, widths, least))  # type: ignore[arg-type]

        self._detector = detector(WIDTH_TOLERANCE, SURE_CONFIDENCE)
        self._searcher = detector(RELAXED_TOLERANCE, RELAXED_CONFIDENCE)

    def forget(self) -> None:
        """The next picture is the first of a new stream."""
        self._last = None

    def doubt(self, image: Bytes) -> str | None:
        """Why a picture cannot show the floor, in words, or None; each picture of a stream is to be given once."""
        last, self._last = self._last, image
        if image.ndim != 2 or image.shape != self._size[::-1]:
            found = f"{image.shape[1]}x{image.shape[0]}" if image.ndim == 2 else "x".join(map(str, image.shape))
            return f"its pictures are {found} pixels instead of {self._size[0]}x{self._size[1]}"
        if last is not None and np.array_equal(last, image):  # because two pictures of a real camera never are
            return "its picture is frozen"
        blocks = cv2.resize(image, BLOCKS, interpolation=cv2.INTER_AREA)
        low, high = int(blocks.min()), int(blocks.max())
        if np.count_nonzero(image >= WHITE) > CLIPPED * image.size:
            return "its picture is saturated"
        if high - low < FLAT and float(image.std()) < FLAT:
            return f"its picture is blank (grey level {low} all over)"
        return None

    def look(self, image: Bytes) -> list[Line]:
        """The lines of a new picture, best first, in pixels of `view`."""
        self._top = self.view.apply(image)
        return _by_themselves(self._detector, self._top, self.view.valid)

    def search(self, where: NDArray[np.bool_] | None = None) -> list[Line]:
        """Look again at the last picture with relaxed limits: in part of the top view (H, W), or everywhere."""
        return _by_themselves(self._searcher, self._top, self.view.valid if where is None else where)


def _by_themselves(detector: LineDetector, top: Bytes, valid: NDArray[np.bool_]) -> list[Line]:
    """Lines that are as wide and as sure as asked for without another one beside them.

    Because the memory knows better what continues our line, and a top view hardly tapers.
    """
    config = detector.config
    least, greatest = config.width_px or (0.0, np.inf)
    return [
        line
        for line in detector.detect(top, valid)
        if line.confidence >= config.min_confidence and least - WIDTH_ERROR <= line.width <= greatest + WIDTH_ERROR
    ]


def _nearest_floor(camera: CameraModel) -> float:
    """Metres straight ahead of the robot's origin to the nearest floor in view; 0 if there is none."""
    lens = Camera(camera)
    x = np.arange(0.0, FARTHEST, 0.01)
    floor = np.column_stack([x, np.zeros((len(x), 2))])
    R, origin = lens.T_robot_camera[:3, :3], lens.T_robot_camera[:3, 3]
    pixels, seen = lens.project((floor - origin) @ R)
    seen &= lens.in_image(np.where(seen[:, None], pixels, -10.0), margin=1.0)
    return float(x[int(seen.argmax())]) if seen.any() else 0.0
