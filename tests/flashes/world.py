"""What stands before the camera: a wall of shelves, people, lamps, other things that blink.

Everything is linear light, 1 being white; the camera is in `film`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]
MARGIN = 12  # px drawn beyond the picture on each side, because the camera shakes


def light_of(grey: Singles | float, gamma: float) -> Singles:
    """Linear light of grey levels."""
    return np.asarray((np.clip(grey, 0.0, 255.0) / 255.0) ** gamma, np.float32)


def shelves(rng: np.random.Generator, shape: tuple[int, int]) -> Singles:
    """Grey picture of shelves with goods, strips of price labels, and a wall."""
    height, width = shape
    grey = np.full(shape, rng.uniform(60.0, 120.0), np.float32)
    row = int(rng.uniform(0.0, 40.0))
    while row < height:
        depth = int(rng.uniform(40.0, 95.0))
        column = 0
        while column < width:
            wide = int(rng.uniform(10.0, 45.0))
            tall = int(depth * rng.uniform(0.5, 0.95))
            level = rng.uniform(25.0, 190.0)
            box = grey[row + depth - tall : row + depth, column : column + wide]
            if box.size and rng.random() < 0.9:
                box[:] = level
                stripe = slice(int(0.3 * tall), int(0.3 * tall) + max(1, int(0.25 * tall)))
                box[stripe] = np.clip(level + rng.normal(0.0, 50.0), 10.0, 220.0)
            column += wide + int(rng.uniform(0.0, 4.0))
        grey[row + depth : row + depth + 7] = rng.uniform(120.0, 190.0)  # the strip that carries the labels
        row += depth + 7
    texture = cv2.GaussianBlur(rng.normal(0.0, 1.0, shape).astype(np.float32), (0, 0), 1.5) * 12.0
    shade = cv2.resize(
        rng.uniform(0.75, 1.2, (3, 4)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    picture = cv2.GaussianBlur(grey * shade + texture, (0, 0), rng.uniform(0.6, 1.0))
    return np.asarray(np.clip(picture, 8.0, 225.0), np.float32)


@dataclass(frozen=True, eq=False)
class Walker:
    """Somebody who walks through the picture at `speed` px/s, in textured clothes, with arms and legs that swing."""

    begins: float
    left: float  # column of the middle at `begins`
    speed: float
    foot: float  # row
    height: float
    cloth: Singles  # linear light

    def paint(self, light: Singles, t: float, bright: float) -> NDArray[np.uint8] | None:
        """Paint the walker over `light` in place; returns the mask of the pixels covered, or None if out of sight."""
        x = self.left + self.speed * (t - self.begins)
        tall = self.height
        if not -tall < x < light.shape[1] + tall:
            return None
        swing = np.sin(2.0 * np.pi * 0.9 * (t - self.begins) + self.left)
        bob = 0.008 * tall * abs(swing)
        mask = np.zeros(light.shape, np.uint8)
        top, hip, foot = self.foot - tall - bob, self.foot - 0.48 * tall - bob, self.foot

        def limb(x0: float, y0: float, x1: float, y1: float, thick: float) -> None:
            ends = [(round(16 * x0), round(16 * y0)), (round(16 * x1), round(16 * y1))]
            cv2.line(mask, *ends, 255, max(1, int(thick)), cv2.LINE_AA, shift=4)

        for side in (-1.0, 1.0):
            limb(x, hip, x + side * 0.16 * tall * swing, foot, 0.10 * tall)
            limb(x, top + 0.2 * tall, x - side * 0.13 * tall * swing, hip + 0.02 * tall, 0.06 * tall)
        limb(x, top + 0.23 * tall, x, hip, 0.2 * tall)
        cv2.circle(
            mask, (round(16 * x), round(16 * (top + 0.07 * tall))), round(16 * 0.065 * tall), 255, -1, cv2.LINE_AA, 4
        )
        rows, columns = cv2.boundingRect(mask)[1::2], cv2.boundingRect(mask)[0::2]
        if rows[1] == 0:
            return None
        window = np.s_[rows[0] : rows[0] + rows[1], columns[0] : columns[0] + columns[1]]
        offset = (x - columns[0]) - self.cloth.shape[1] / 2.0
        move = np.array([[1.0, 0.0, offset], [0.0, 1.0, top - rows[0]]])
        cloth = cv2.warpAffine(self.cloth, move, (columns[1], rows[1]), borderMode=cv2.BORDER_REFLECT) * bright
        share = mask[window].astype(np.float32) / 255.0
        light[window] += share * (cloth - light[window])
        return mask


def walker(rng: np.random.Generator, shape: tuple[int, int], seconds: float, gamma: float) -> Walker:
    """Somebody who crosses the picture during the film."""
    height, width = shape
    tall = rng.uniform(0.35, 0.9) * height
    speed = rng.uniform(0.35, 0.8) * tall * rng.choice([-1.0, 1.0])  # people walk about 0.6 heights a second
    size = (int(tall), int(0.6 * tall))
    cloth = np.clip(
        rng.uniform(25.0, 150.0)
        + 30.0
        * cv2.resize(rng.normal(0.0, 1.0, (14, 8)).astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)
        + 6.0 * rng.normal(0.0, 1.0, size).astype(np.float32),
        8.0,
        225.0,
    )
    middle = rng.uniform(0.1, 0.9) * seconds
    return Walker(
        begins=middle,
        left=rng.uniform(0.2, 0.8) * width,
        speed=speed,
        foot=rng.uniform(0.7, 1.05) * height,
        height=tall,
        cloth=light_of(cv2.GaussianBlur(cloth.astype(np.float32), (0, 0), 1.0), gamma),
    )
