"""Recordings of the serial line: play them, and renew what is expected of them.

    python -m tests.replay                  play every recording and say what differs from what is expected
    python -m tests.replay CASE...          the same for some
    python -m tests.replay --update         take what comes now for what is expected: look at the diff before committing
    python -m tests.replay --record         make the simulated recordings anew first (the driver sends something else)

A recording from a robot (`[robot] serial_log`) becomes a case by copying it here as CASE.log and running
`--update CASE`.
"""

from __future__ import annotations

import argparse
import sys

from robotd.errors import InputError

from .maker import CASES, record
from .player import FOLDER, cases, differences, load, play


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.replay", description="play recordings of the serial line")
    parser.add_argument("case", nargs="*", help="names of recordings (default: all)")
    parser.add_argument("--update", action="store_true", help="write what comes now as what is expected")
    parser.add_argument("--record", action="store_true", help="make the simulated recordings anew; implies --update")
    arguments = parser.parse_args()
    if arguments.record:
        for case in CASES:
            if not arguments.case or case.name in arguments.case:
                path = FOLDER / f"{case.name}.log"
                path.unlink(missing_ok=True)
                record(case, path)
    failed = False
    for name in arguments.case or cases():
        try:
            recording, expected = load(name)
        except InputError as error:
            print(error)
            return 2
        outcome = play(recording)
        if arguments.update or arguments.record:
            expected.write_text(outcome, encoding="utf-8")
        problems = differences(expected.read_text(encoding="utf-8"), outcome) if expected.exists() else ["no .expected"]
        failed = failed or bool(problems)
        print(f"{name}: {'; '.join(problems) or 'as expected'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
