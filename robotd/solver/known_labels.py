"""Known labels against what the sightings say: whether they hold together as a set, and which mistake would explain it.

One wrong position among several is found and named by the adjustment. If all are wrong alike (an axis counted the other
way, another unit, a drawing's axes), most are dropped or the moves contradict them instead.
"""

from __future__ import annotations

import numpy as np

from ..records import Floats
from .problem import Bools, Known, Problem

_SLIPPING = 0.25  # of the moves, and two, from which known labels are doubted
_WRONG = 5.0  # standard deviations
_SAME_M = 0.05  # rms to which two sets of positions are the same
_ANOTHER_SIZE = 0.02
_ON_A_LINE_M = 0.3  # aside of the line through the known labels


def chosen(known: Known, keep: Bools) -> Known:
    """Some of the known labels."""
    return Known(known.label[keep], known.position[keep], known.sigma[keep])


def slipped(problem: Problem) -> int:
    """How many moves were loosened because they contradict everything else."""
    return int(np.count_nonzero(problem.moves.loosened))


def slips_often(problem: Problem) -> bool:
    """Whether more moves were loosened than wheels slip."""
    return slipped(problem) >= max(2, _SLIPPING * len(problem.moves.before))


def contradicted(asked: Problem, found: Problem, points: Floats) -> bool:
    """Whether moves or sightings contradict the known labels that fix the world frame, given the points (L, 3) found.

    Two, or some along a line, that are left when another was dropped fit a world and its mirror image alike; then all
    tell.
    """
    if asked.frame != "known labels":
        return False
    left, dropped = len(found.known.label), len(asked.known.label) - len(found.known.label)
    if slips_often(found) or dropped > left:
        return True
    seen = np.isin(asked.known.label, found.sightings.label)
    given, here = asked.known.position[seen], points[asked.known.label[seen]]
    open_ = left <= 2 or _along_a_line(found.known.position)
    return dropped > 0 and open_ and difference(given, here) != ""


def undecided(asked: Problem, points: Floats) -> bool:
    """Whether so few known labels agree with the points (L, 3) found that which of them is wrong is open."""
    known = asked.known
    seen = np.isin(known.label, asked.sightings.label)
    wrong = np.linalg.norm(points[known.label] - known.position, axis=1) > np.maximum(_WRONG * known.sigma, _SAME_M)
    count = int(np.count_nonzero(wrong & seen))
    return bool(asked.frame == "known labels" and count > 0 and np.count_nonzero(seen) - count <= 2)


def difference(given: Floats, found: Floats) -> str:
    """How positions (K, 3) differ from those found (K, 3) in other axes, in words; empty if nothing simple explains it.

    Both are moved onto each other in the plane, with and without a mirror and another size (Umeyama, 1991).
    """
    if len(given) < 3:
        return ""
    a, b = (points[:, :2] - points[:, :2].mean(axis=0) for points in (given, found))
    U, sizes, Vt = np.linalg.svd(b.T @ a)
    turn = np.sign(np.linalg.det(U @ Vt))
    for mirrored in (False, True):
        D = np.diag([1.0, -turn if mirrored else turn])
        size = float((sizes * np.diagonal(D)).sum() / max((a**2).sum(), 1e-12))
        apart = b - size * a @ (U @ D @ Vt).T
        if size > 0.0 and np.sqrt((apart**2).sum(axis=1).mean()) < _SAME_M:
            said = "mirrored (is an axis counted the other way, or are x and y exchanged?)" if mirrored else ""
            if abs(size - 1.0) > _ANOTHER_SIZE:
                said += f"{' and ' if said else ''}times {size:.4g} (another unit?)"
            return said
    return ""


def on_a_line(problem: Problem) -> str | None:
    """A caution if mirrored positions of the known labels would fit as well."""
    if problem.frame != "known labels":
        return None
    seen = problem.known.position[np.isin(problem.known.label, problem.sightings.label)]
    if not _along_a_line(seen):
        return None
    return (
        f"the {len(seen)} known labels that were seen hang along one line, so that nothing would show if an axis of "
        "their positions were counted the other way; measure one that hangs aside"
    )


def _along_a_line(positions: Floats) -> bool:
    """Whether positions (K, 3) are on one line in the plane, so that mirrored ones would fit as well."""
    spread = np.linalg.svd(positions[:, :2] - positions[:, :2].mean(axis=0), compute_uv=False)
    return len(spread) < 2 or bool(spread[1] <= _ON_A_LINE_M)
