"""`robotctl`: the command line. The table of commands is here; what they do is imported when it is needed."""

from __future__ import annotations

import argparse
import os
import sys

from .. import __version__
from .errors import INTERRUPTED, USAGE, CtlError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    Option = tuple[tuple[str, ...], dict[str, Any]]  # what argparse's add_argument takes

EPILOG = """\
exit codes: 0 done; 1 refused or failed, the robot says why; 2 wrong command line; 3 robotd is not running;
4 not in the group of its socket; 5 no connection over ssh, or it broke; 6 robotctl and robotd are of different
releases; 130 interrupted. ROBOTCTL_HOST stands for -H, ROBOTCTL_SOCKET for --socket, ROBOTCTL_SSH for "ssh".
"""

SURVEY: Option = (("--survey",), {"metavar": "NAME", "help": "default: the configured one"})
STOP: Option = (("stop",), {"metavar": "[LEG.]STOP", "help": "e.g. 3, or 2.3 if several legs have a stop 3"})
START: list[Option] = [
    (
        ("--stop",),
        {"type": int, "default": 1, "metavar": "N", "help": "the stop at which the robot stands (default: 1)"},
    )
]
COUNT: Option = (("--pictures",), {"type": int, "default": 12, "metavar": "N", "help": "default: 12"})
BOARD: list[Option] = [
    (("--board",), {"default": "9x6", "metavar": "CxR", "help": "inner corners of the chessboard (default: 9x6)"}),
    (("--square",), {"type": float, "default": 0.025, "metavar": "M", "help": "side of a square (default: 0.025 m)"}),
]
CAMERA: Option = (("camera",), {"metavar": "CAMERA", "help": "its name in the configuration"})
FILE: Option = (("-c", "--config"), {"metavar": "FILE", "help": "default: /etc/robotd/robotd.toml"})

# words: (help, module.function, options)
COMMANDS: dict[str, tuple[str, str, list[Option]]] = {
    "status": ("everything on one screen", "commands.status", []),
    "watch": ("a live view: map with trail, telemetry, events; q ends it", "watch.watch", []),
    "drive": (
        "drive with the arrow keys; the robot halts when they are let go",
        "drive.drive",
        [
            (("--speed",), {"type": float, "default": 0.15, "metavar": "M/S", "help": "to begin with (default: 0.15)"}),
            (("--turn",), {"type": float, "default": 45.0, "metavar": "DEG/S", "help": "to begin with (default: 45)"}),
        ],
    ),
    "halt": ("stand still until somebody asks for motion anew; a mission pauses", "commands.halt", []),
    "estop": ("emergency stop: stand still until `release`", "commands.estop", []),
    "release": ("end the emergency stop and forget hazards that are over", "commands.release", []),
    "mission start": ("begin a survey where the robot stands", "commands.mission_start", [SURVEY, *START]),
    "mission pause": ("halt; `resume` repeats the step", "commands.mission_pause", []),
    "mission resume": ("go on", "commands.mission_resume", []),
    "mission abort": ("halt and end it; its stops are kept", "commands.mission_abort", []),
    "mission status": ("where it is", "commands.mission_status", []),
    "stops list": ("the stops of a survey", "commands.stops_list", [SURVEY]),
    "stops show": ("one stop with its sightings", "commands.stops_show", [STOP, SURVEY]),
    "stops reject": (
        "leave a stop's sightings out of its survey, on the robot and on the server",
        "commands.stops_reject",
        [
            STOP,
            SURVEY,
            (("--reason",), {"default": "", "metavar": "TEXT", "help": "kept with it"}),
            (("--undo",), {"action": "store_true", "help": "take the rejection back"}),
        ],
    ),
    "survey list": ("the surveys on the robot", "commands.survey_list", []),
    "survey export": (
        "a survey as robotd-survey/1",
        "commands.survey_export",
        [
            (("survey",), {"nargs": "?", "metavar": "NAME", "help": "default: the configured one"}),
            (("-o", "--output"), {"metavar": "FILE", "help": "default: standard output"}),
        ],
    ),
    "survey continue": (
        "begin another leg of a survey where the robot stands",
        "commands.survey_continue",
        [SURVEY, *START],
    ),
    "drivers list": ("every driver and how it does", "commands.drivers_list", []),
    "drivers restart": (
        "close a driver and open it again",
        "commands.drivers_restart",
        [(("name",), {"metavar": "DRIVER", "help": "its name in the configuration"})],
    ),
    "record start": (
        "record every frame of cameras (MCAP), on the robot",
        "commands.record_start",
        [
            (("cameras",), {"nargs": "*", "metavar": "CAMERA", "help": "default: those of the rig"}),
            (("--name",), {"metavar": "NAME", "help": "of the file (default: robot and date)"}),
            (("--seconds",), {"type": float, "metavar": "S", "help": "at most (default: of the configuration)"}),
            (("--megabytes",), {"type": float, "metavar": "MB", "help": "at most (default: of the configuration)"}),
            (("--raw",), {"action": "store_true", "help": "grey levels instead of the cameras' own JPEG"}),
        ],
    ),
    "record stop": ("end it; its file is finished then", "commands.record_stop", []),
    "record status": ("the recording that runs, or the last one", "commands.record_status", []),
    "record list": ("the finished recordings on the robot", "commands.record_list", []),
    "beacons": (
        "whether the beacons flash; switch them",
        "commands.beacons",
        [(("switch",), {"nargs": "?", "choices": ("on", "off"), "help": "default: leave them as they are"})],
    ),
    "prompts": (
        "what the robot asks of a person, e.g. to have labels flash",
        "prompts.prompts",
        [(("-f", "--follow"), {"action": "store_true", "help": "and answer it by typing, until Ctrl-C"})],
    ),
    "answer": (
        "answer what was asked last",
        "prompts.answer",
        [(("text",), {"nargs": "*", "metavar": "WORD", "help": "default: done"})],
    ),
    "wake": ("wake a base that does not answer", "commands.wake", []),
    "dock": ("drive onto the charger; Ctrl-C ends that", "commands.dock", []),
    "calibrate odometry": (
        "wheels and base, with tape and a tape measure; Ctrl-C halts",
        "calibrate.odometry",
        [
            (("--distance",), {"type": float, "metavar": "M", "help": "of each straight (default: 2)"}),
            (("--turns",), {"type": int, "metavar": "N", "help": "of each spin (default: 5)"}),
            (("--repeat",), {"type": int, "metavar": "N", "help": "how often each kind of run (default: 2)"}),
        ],
    ),
    "calibrate camera": ("pictures of a chessboard, for a camera's lens", "calibrate.camera", [CAMERA, COUNT, *BOARD]),
    "calibrate floor": (
        "pictures of a chessboard on the floor, for the floor camera's place",
        "calibrate.floor",
        [COUNT, *BOARD],
    ),
    "calibrate rig": (
        "a survey with turns on the spot at some places, for where the cameras are",
        "calibrate.rig",
        [
            (("--places",), {"type": int, "default": 5, "metavar": "N", "help": "default: 5"}),
            (
                ("--headings",),
                {"type": int, "metavar": "N", "help": "N turns on the spot at each place, not out and back"},
            ),
        ],
    ),
    "calibrate flash": (
        "how a label flashes: a recording of one that does",
        "calibrate.flash",
        [
            CAMERA,
            (("label",), {"metavar": "LABEL", "help": "id of a label in view of that camera"}),
            (("--seconds",), {"type": int, "default": 10, "metavar": "S", "help": "default: 10"}),
        ],
    ),
    "calibrate time": (
        "offset between cameras and odometry: the robot turns to and fro",
        "calibrate.time",
        [(("--seconds",), {"type": float, "default": 20.0, "metavar": "S", "help": "default: 20"})],
    ),
    "logs": (
        "what the robot told, from its journal",
        "commands.logs",
        [
            (("-n", "--count"), {"type": int, "default": 50, "metavar": "N", "help": "so many (default: 50)"}),
            (("-f", "--follow"), {"action": "store_true", "help": "and what comes, until Ctrl-C"}),
            (("--level",), {"choices": ("info", "warning", "error"), "default": "info", "help": "at least"}),
        ],
    ),
    "doctor": (
        "check all that a new owner gets wrong; each finding says how to mend it",
        "local.doctor",
        [
            FILE,
            (("--quick",), {"action": "store_true", "help": "leave out running everything together for a minute"}),
        ],
    ),
    "config show": (
        "the configuration of the running robotd",
        "commands.config_show",
        [(("--effective",), {"action": "store_true", "help": "with every default; secrets are masked"})],
    ),
    "config schema": ("the configuration's JSON schema", "local.schema", []),
    "config check": ("name every mistake in a configuration file", "local.check", [FILE]),
    "config reload": ("have robotd read its configuration again", "commands.config_reload", []),
    "completion": (
        "a completion script for a shell",
        "completion.completion",
        [(("shell",), {"choices": ("bash", "zsh", "fish"), "help": "e.g. source <(robotctl completion bash)"})],
    ),
    "dial-stdio": ("", "local.dial_stdio", []),
}
GROUPS = {
    "mission": "start, pause, resume, abort, status",
    "stops": "list, show, reject",
    "survey": "list, export, continue",
    "drivers": "list, restart",
    "record": "start, stop, status, list",
    "calibrate": "odometry, camera, floor, rig, flash, time: collect what a calibration needs",
    "config": "show, schema, check, reload",
}


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Knows its width without shutil, whose import takes a tenth of the start."""

    def __init__(self, prog: str) -> None:
        try:
            columns = os.get_terminal_size(1).columns
        except OSError:
            columns = 100
        super().__init__(prog, width=max(40, columns - 2))


def parser(words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The command line; with `words` only the command that they name, because building all takes as long as a start."""
    top = argparse.ArgumentParser(
        prog="robotctl",
        description="Command a robot that runs robotd, here or over ssh.",
        epilog=EPILOG,
        formatter_class=_Formatter,
    )
    _add_common(top, suppress=False)
    top.add_argument("--version", action="version", version=f"robotctl {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    groups: dict[str, Any] = {}
    named = next((word for word in words if word in GROUPS or word in COMMANDS), None)
    for name, (text, function, options) in COMMANDS.items():
        first, _, second = name.partition(" ")
        if named is not None and first != named:
            continue
        where = commands
        if second:
            if first not in groups:
                group = commands.add_parser(first, help=GROUPS[first], formatter_class=_Formatter)
                groups[first] = group.add_subparsers(dest="subcommand", required=True, metavar="COMMAND")
            where = groups[first]
        extra: dict[str, Any] = {"help": text, "description": text[:1].upper() + text[1:]} if text else {}
        command = where.add_parser(second or first, formatter_class=_Formatter, **extra)
        for flags, settings in options:
            command.add_argument(*flags, **settings)
        _add_common(command, suppress=True)
        command.set_defaults(function=function)
    return top


def _add_common(command: argparse.ArgumentParser, *, suppress: bool) -> None:
    """Options that may stand before and behind the command."""
    default = argparse.SUPPRESS if suppress else None
    text = argparse.SUPPRESS if suppress else ""
    command.add_argument(
        "-H", "--host", default=default, metavar="ssh://user@host[:port]", help=text or "a robot elsewhere, over ssh"
    )
    command.add_argument(
        "--socket", default=default, metavar="PATH", help=text or "of robotd here (default: /run/robotd/control.sock)"
    )
    command.add_argument(
        "--json",
        action="store_true",
        default=argparse.SUPPRESS if suppress else False,
        help=text or "JSON, for scripts",
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code, see `errors`."""
    words = sys.argv[1:] if argv is None else list(argv)
    arguments = parser(words).parse_args(words)
    arguments.host = arguments.host or os.environ.get("ROBOTCTL_HOST") or None
    module, _, function = arguments.function.partition(".")
    try:
        if arguments.host and arguments.socket:
            raise CtlError(
                USAGE, "--socket is of robotd here; at the far end of -H set ROBOTCTL_SOCKET, or leave it out"
            )
        found = __import__(f"robotd.ctl.{module}", fromlist=[function])
        return int(getattr(found, function)(arguments))
    except CtlError as error:
        for problem in error.problems:
            print(f"robotctl: {problem}", file=sys.stderr)
        return error.code
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # whoever read our output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0


__all__ = ["COMMANDS", "GROUPS", "USAGE", "main", "parser"]


if __name__ == "__main__":
    sys.exit(main())
