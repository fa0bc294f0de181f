"""Lists of label ids, as the operator, the server or the label system keeps them: text, one id a line, or a table."""

from __future__ import annotations

import csv
import io
from collections import Counter

from .errors import InputError

COLUMN = "label"


def read_labels(text: str, where: str) -> tuple[str, ...]:
    """The ids in a list.

    Parameters
    ----------
    text : str
        One id a line, empty lines and what follows a '#' left out; or CSV (comma, semicolon or tab) whose first line
        names a column "label".
    where : str
        Names the list in messages.

    Raises
    ------
    InputError
        Lists every mistake: an id twice, a line with several words, a row without an id, no id at all.
    """
    lines = text.removeprefix("\ufeff").splitlines()
    head = next((line for line in lines if line.strip()), "")
    mark = max(",;\t", key=head.count)
    is_table = COLUMN in [name.strip().lower() for name in head.split(mark)]
    found = _column(lines, mark, where) if is_table else _lines(lines, where)
    labels, problems = found
    twice = sorted(label for label, count in Counter(labels).items() if count > 1)
    if twice:
        problems.append(f"{where}: {', '.join(twice[:10])} listed more than once; expected every id once")
    if not labels and not problems:
        problems.append(f"{where}: found no label; expected one id a line, or a table with a column '{COLUMN}'")
    if problems:
        raise InputError(*problems)
    return tuple(labels)


def _lines(lines: list[str], where: str) -> tuple[list[str], list[str]]:
    labels, problems = [], []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        if len(words) > 1:
            problems.append(f"{where} line {number}: found {line.strip()[:40]!r}; expected one id")
        labels += words[:1]
    return labels, problems


def _column(lines: list[str], mark: str, where: str) -> tuple[list[str], list[str]]:
    labels, problems = [], []
    rows = csv.reader(io.StringIO("\n".join(lines)), delimiter=mark)
    column: int | None = None
    for row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if column is None:
            column = [cell.strip().lower() for cell in row].index(COLUMN)
        elif column < len(row) and row[column].strip():
            labels.append(row[column].strip())
        else:
            problems.append(f"{where} line {rows.line_num}: found no {COLUMN}")
    return labels, problems
