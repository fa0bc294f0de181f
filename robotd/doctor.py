"""`robotd doctor`: check all that a new owner gets wrong, and say of each finding how to mend it."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from .config import Calibration, Config, load_calibration
from .daemon import Plan, read_config
from .doctor_checks import (
    Accounts,
    Finding,
    check_calibration,
    check_camera,
    check_clock,
    check_disk,
    check_pins,
    check_power,
    check_serial,
    check_token,
)
from .errors import ConfigError, InputError, UploadError
from .hardware import CameraMode
from .web import WebServer

NETWORK_S = 8.0
LOOPBACK = ("127.0.0.1", "::1", "localhost")
ANSWERS = 16 << 20  # bytes of the longest list of surveys
TOGETHER_S = 60.0


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; returns 1 if something is to be mended, else 0."""
    findings: list[Finding] = []
    for finding in examine(arguments.config, arguments.socket, is_quick=arguments.quick):
        findings.append(finding)
        if not arguments.json:
            print(_text(finding), flush=True)
    errors = sum(finding.level == "error" for finding in findings)
    if arguments.json:
        print(json.dumps({"errors": errors, "findings": [asdict(finding) for finding in findings]}, indent=2))
    else:
        warnings = sum(finding.level == "warning" for finding in findings)
        print(f"\n{errors} errors, {warnings} warnings" if errors or warnings else "\nall is well")
    return 1 if errors else 0


def examine(
    path: Path, control: Path | None = None, *, is_quick: bool = False, root: Path = Path("/")
) -> Iterator[Finding]:
    """Every finding, as it is made."""
    accounts = Accounts()
    try:
        config, plans = read_config(path)
    except ConfigError as error:
        for problem in error.problems:
            yield Finding("error", "configuration", problem, f"edit {path}")
        return
    yield Finding("ok", "configuration", f"{path} has no mistakes")
    calibration_path = path.parent / config.robot.calibration
    calibration = Calibration()
    if calibration_path.exists():
        try:
            calibration = load_calibration(calibration_path)
        except ConfigError as error:
            for problem in error.problems:
                yield Finding("error", "calibration", problem, f"edit {calibration_path}")
    yield from check_calibration(calibration_path, time.time(), {camera.name: camera for camera in calibration.cameras})
    yield from _devices(root, config, plans, accounts)
    yield from check_disk(root, path.parent / config.robot.state_directory)
    yield from check_clock(root)
    yield from check_power(root)
    token_file = None if config.upload.token_file is None else path.parent / config.upload.token_file
    yield from check_token(token_file, f"{path} upload.token_file", accounts)
    yield from check_server(config, path.parent)
    yield from check_together(control or path.parent / config.robot.control, 0.0 if is_quick else TOGETHER_S)


def _devices(root: Path, config: Config, plans: dict[str, Plan], accounts: Accounts) -> Iterator[Finding]:
    base = next(plan for plan in plans.values() if plan.cls.kind == "base")
    if (port := getattr(base.config, "port", None)) is not None:
        yield from check_serial(root, port, accounts)
    has_beacons = any(plan.cls.kind == "beacons" for plan in plans.values())
    has_lgpio = importlib.util.find_spec("lgpio") is not None
    yield from check_pins(root, getattr(base.config, "wake_pin", None), has_beacons, accounts, has_lgpio)
    for plan in plans.values():
        if config.drivers[plan.name]["driver"] == "v4l2":
            yield from check_camera(root, plan.name, plan.config.device, accounts, _look)


def _look(device: str) -> tuple[float, tuple[str, ...]]:
    """Open a camera as a mission does, and close it again."""
    from .v4l2 import negotiate

    camera = negotiate(device, CameraMode())
    try:
        return camera.mode.fps, tuple(camera.remarks)
    finally:
        camera.areas.clear()
        camera.node.close()


def check_server(config: Config, folder: Path) -> Iterator[Finding]:
    """Whether the server is reachable, is the one that is meant, and takes our token; paths are under `folder`."""
    upload = config.upload
    url = upload.url
    if url is None:
        yield Finding("note", "server", "none is configured: stops stay on the robot", "set [upload] url")
        return
    token_file = None if upload.token_file is None else folder / upload.token_file
    is_ours = upload.token_credential is None and (token_file is None or os.access(token_file, os.R_OK))
    try:
        token = token_file.read_text().strip() if token_file is not None and is_ours else None
        server = WebServer(url, token, ca_file=upload.ca_file and folder / upload.ca_file, pins=upload.pins)
        server.ask("GET", "/healthz", timeout_s=NETWORK_S)
    except (UploadError, InputError, OSError) as error:
        text, _, mend = str(error).partition("; ")
        yield Finding(
            "error", "server", text, mend or "check the address, the network, and that robotd-solver serve runs there"
        )
        return
    yield Finding("ok", "server", f"{url} answers")
    if url.startswith("http:") and urlsplit(url).hostname not in LOOPBACK:
        yield Finding(
            "warning",
            "server",
            f"stops and the token go to {url} unencrypted",
            "start robotd-solver serve with --certificate, and write https into [upload] url",
        )
    if not is_ours:
        yield Finding("note", "token", "only robotd has it; robotctl status says whether the server takes it")
        return
    try:
        status, _ = server.ask("GET", "/api/surveys", timeout_s=NETWORK_S, limit=ANSWERS)
    except UploadError as error:
        yield Finding("error", "token", f"it could not be tried: {error}", "mend what is said above")
        return
    if status == 200:
        yield Finding("ok", "token", "the server takes it")
        return
    words = "refuses the token" if status in (401, 403) else f"answers {status}"
    yield Finding(
        "error", "token", f"{url} {words}", "copy the token of robotd-solver serve --token-file into token_file"
    )


def check_together(control: Path, seconds: float) -> Iterator[Finding]:
    """Ask the running robotd how its drivers do, and to run all cameras and the serial line together."""
    what = "robotd"
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
            channel.settimeout(seconds + 30.0)
            channel.connect(str(control))
            with channel.makefile("rb") as lines:
                lines.readline()
                drivers = _ask(channel, lines, "drivers.list", {})["drivers"]
                for driver in drivers:
                    if driver["state"] == "fault":
                        text, _, mend = driver["fault"].partition("; ")
                        yield Finding("error", f"driver {driver['name']}", text, mend or "see robotctl logs")
                yield Finding("ok", what, f"is running, with {len(drivers)} drivers")
                if not seconds:
                    return
                result = _ask(channel, lines, "test", {"seconds": seconds})
                yield from (Finding(**finding) for finding in result["findings"])
    except PermissionError:
        yield Finding("error", what, f"{control} may not be opened", "sudo usermod -aG robotd $USER, then log in again")
    except OSError:
        yield Finding(
            "warning",
            what,
            "is not running, so cameras and serial line were not tried together",
            "sudo systemctl enable --now robotd-guardian robotd, then robotctl doctor again",
        )
    except ValueError as error:
        yield Finding(
            "warning", "all together", f"not tried: {error}", "end what is under way, then robotctl doctor again"
        )


def _ask(channel: socket.socket, lines: Any, method: str, params: dict[str, Any]) -> Any:
    request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    channel.sendall(json.dumps(request).encode() + b"\n")
    message = json.loads(lines.readline() or b"{}")
    if "result" not in message:
        raise ValueError(message.get("error", {}).get("message", "robotd has hung up"))
    return message["result"]


def _text(finding: Finding) -> str:
    mark = {"ok": "ok     ", "note": "note   ", "warning": "WARNING", "error": "ERROR  "}[finding.level]
    mend = f"\n        -> {finding.mend}" if finding.mend else ""
    return f"{mark} {finding.what}: {finding.text}{mend}"
