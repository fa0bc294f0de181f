"""`make bench`: how fast the parts are, each as a ratio to a named yardstick measured in the same run."""

from __future__ import annotations

import cv2

from . import base, beacons, cameras, control, flash, identify, line, robotctl, roof, solver


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    rows = [
        row
        for part in (line, flash, identify, cameras, base, beacons, roof, control, robotctl, solver)
        for row in part.rows()
    ]
    width = max(len(row.part) for row in rows)
    print(f"{'part':<{width}}  {'ms':>9}  {'ratio':>7}  yardstick (ms)")
    for row in rows:
        ratio = row.ms / row.yardstick_ms
        print(f"{row.part:<{width}}  {row.ms:>9.4f}  {ratio:>7.1f}  {row.yardstick} ({row.yardstick_ms:.4f})")


if __name__ == "__main__":
    main()
