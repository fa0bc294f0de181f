"""`make check`: what systemd itself finds in the units that are shipped, and how exposed they leave the system.

`systemd-analyze verify` only warns of an unknown key and exits with 0, so any word of it about a unit is a failure.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SYSTEMD = Path(__file__).parent.parent / "systemd"
EXPOSURE = 1.5  # of 10, the highest allowed
INSTALLED = "/opt/robotd/bin/"


def main() -> int:
    """Print a line for each unit and each remark; returns 1 if there is one."""
    if shutil.which("systemd-analyze") is None:
        print("units: not checked, because systemd-analyze is not here; apt-get install systemd")
        return 0
    remarks: list[str] = []
    units = sorted(SYSTEMD.glob("*.service"))
    for unit in units:
        found = check(unit)
        print("\n".join(found) if found else f"{unit.name}: nothing to remark, exposure at most {EXPOSURE}")
        remarks += found
    return 1 if remarks or not units else 0


def check(unit: Path) -> list[str]:
    """Everything that systemd remarks of a unit, as if it were installed with this Python's programs."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / unit.name
        path.write_text(unit.read_text().replace(INSTALLED, f"{Path(sys.executable).parent}/"))
        verified = _analyze("verify", "--man=no", str(path))
        exposed = _analyze("security", "--offline=yes", f"--threshold={round(10 * EXPOSURE)}", str(path))
    lines = (verified.stdout + verified.stderr).splitlines()
    remarks = [f"{unit.name}: {line}" for line in lines if unit.stem in line]
    if verified.returncode != 0 and not remarks:
        remarks = [f"{unit.name}: systemd-analyze verify fails: {' '.join(lines)}"]
    if exposed.returncode != 0:
        level = next((line for line in exposed.stdout.splitlines() if "exposure level" in line), exposed.stderr)
        remarks.append(f"{unit.name}: {level.strip(' →')}; expected at most {EXPOSURE}")
    return remarks


def _analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False)


if __name__ == "__main__":
    sys.exit(main())
