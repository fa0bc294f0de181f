"""What roof cameras add to a rig's unknowns: where the beacons are on the robot, and the homographies themselves.

A homography's correction is a matrix I + E on world coordinates that are centred on, and scaled to, the places where
its camera saw beacons; the eight free entries of E are metres over the radius of these (thesis section 2.5.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.transforms import pose_matrix
from ..records import Floats
from .problem import Ints, Problem, Roofs, State

ENTRIES = 8  # of a homography
_LEAST_RADIUS_M = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class RoofUnknowns:
    """Beacons and homographies as unknowns of a problem.

    Attributes
    ----------
    names : tuple of str
        Of the roof cameras, R of them.
    given : (B, 3) array
        Beacons in robot axes, as measured.
    beacon, roof : (N,) arrays
        Which beacon and which camera each of the problem's roof sightings is of.
    H : (R, 3, 3) array
        World to pixels, as calibrated.
    normal : (R, 3, 3) array
        World coordinates to those in which corrections are expressed.
    sigma : (2 B + 8 R,) array
        Standard deviations of the values around zero.
    values : (2 B + 8 R,) array
        Shifts of the beacons' x and y, then the entries of E, row by row but for the last.
    """

    names: tuple[str, ...]
    given: Floats
    beacon: Ints
    roof: Ints
    H: Floats
    normal: Floats
    sigma: Floats
    values: Floats

    @classmethod
    def of(cls, problem: Problem, state: State, beacon_sigma: float, roof_sigma: float) -> RoofUnknowns:
        """Those of a problem, at a state near its optimum; standard deviations in metres."""
        given = np.array(list(problem.survey.rig.beacons.values())).reshape(-1, 3)
        cameras, roofs = problem.survey.roof_cameras, problem.roofs
        H = np.array([np.linalg.inv(np.array(camera.H_world_image)) for camera in cameras]).reshape(-1, 3, 3)
        none = np.zeros(0, dtype=np.int64)
        away = np.linalg.norm(roofs.beacon[:, None] - given[None], axis=2)
        beacon = np.argmin(away, axis=1) if len(roofs.stop) else none
        unlike = np.abs(roofs.H_image_world[:, None] - H[None]).sum(axis=(2, 3))
        roof = np.argmin(unlike, axis=1) if len(roofs.stop) else none
        world = _world(problem, state, roofs.beacon)
        normal = np.tile(np.eye(3), (len(H), 1, 1))
        sigma = [np.full(2 * len(given), beacon_sigma)]
        for r in range(len(H)):
            mine = world[roof == r]
            centre = mine.mean(axis=0) if len(mine) else np.zeros(2)
            radius = max(
                float(np.sqrt(((mine - centre) ** 2).sum(axis=1).mean())) if len(mine) else 1.0, _LEAST_RADIUS_M
            )
            normal[r, :2, :2] /= radius
            normal[r, :2, 2] = -centre / radius
            sigma.append(np.full(ENTRIES, roof_sigma / radius))
        every = np.concatenate(sigma)
        names = tuple(camera.name for camera in cameras)
        return cls(names, given, beacon, roof, H, normal, every, np.zeros(len(every)))

    def __len__(self) -> int:
        return len(self.values)

    def moved(self, step: Floats) -> RoofUnknowns:
        """With values changed by a step."""
        return replace(self, values=self.values + step)

    @property
    def beacons(self) -> Floats:
        """(B, 3) in robot axes."""
        shift = self.values[: 2 * len(self.given)].reshape(-1, 2)
        return self.given + np.column_stack([shift, np.zeros(len(shift))])

    @property
    def corrections(self) -> Floats:
        """(R, 3, 3) I + E."""
        E = np.zeros((len(self.H), 9))
        E[:, :ENTRIES] = self.values[2 * len(self.given) :].reshape(-1, ENTRIES)
        return np.eye(3) + E.reshape(-1, 3, 3)

    @property
    def homographies(self) -> Floats:
        """(R, 3, 3) world to pixels, corrected."""
        return np.asarray(self.H @ np.linalg.inv(self.normal) @ self.corrections @ self.normal)

    def applied(self, roofs: Roofs) -> Roofs:
        """A problem's roof sightings with these beacons and homographies."""
        if len(self.beacon) == 0:
            return roofs
        return replace(roofs, beacon=self.beacons[self.beacon], H_image_world=self.homographies[self.roof])

    def jacobian(self, problem: Problem, state: State, by_stop: Floats) -> Floats:
        """(N, 2, 2 B + 8 R) whitened derivatives of the roof sightings of the problem that `applied` made.

        `by_stop` (N, 2, 5) are those by the stops' entries.
        """
        roofs, count = problem.roofs, len(self.beacon)
        J = np.zeros((count, 2, len(self)))
        R_stop = pose_matrix(*problem.stop_entries(state).T)[roofs.stop, :3, :3]
        rows = np.arange(count)[:, None]
        J[rows, :, 2 * self.beacon[:, None] + np.arange(2)] = np.swapaxes(by_stop[:, :, :2] @ R_stop[:, :2, :2], 1, 2)
        world = np.column_stack([_world(problem, state, roofs.beacon), np.ones(count)])
        n = (self.normal[self.roof] @ world[:, :, None])[:, :, 0]
        m = (self.corrections[self.roof] @ n[:, :, None])[:, :, 0]
        back = self.H[self.roof] @ np.linalg.inv(self.normal)[self.roof]
        h = (back @ m[:, :, None])[:, :, 0]
        pixels = h[:, :2] / h[:, 2:]
        by_m = (back[:, :2] - pixels[:, :, None] * back[:, 2:]) / (h[:, 2:] * roofs.sigma[:, None])[:, :, None]
        first = 2 * len(self.given) + ENTRIES * self.roof
        for k in range(ENTRIES):
            J[np.arange(count), :, first + k] = by_m[:, :, k // 3] * n[:, k % 3, None]
        return J

    def roof_sigma(self, covariance: Floats, r: int) -> tuple[float, float]:
        """How far camera r's plane was moved, and its standard deviation: rms over a circle of the radius, metres."""
        angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        n = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])
        m = n @ self.corrections[r].T
        J = np.zeros((len(n), 2, ENTRIES))
        for k in range(ENTRIES):
            if k < 6:
                J[:, k // 3, k] = n[:, k % 3]
            else:
                J[:, :, k] = -n[:, :2] * n[:, k % 3, None]
        radius = 1.0 / self.normal[r, 0, 0]
        moved = np.linalg.norm(m[:, :2] / m[:, 2:] - n[:, :2], axis=1)
        first = 2 * len(self.given) + ENTRIES * r
        P = covariance[first : first + ENTRIES, first : first + ENTRIES]
        spread = np.einsum("ank,kl,anl->a", J, P, J)
        return float(radius * np.sqrt((moved**2).mean())), float(radius * np.sqrt(spread.mean()))

    def matrix_covariance(self, covariance: Floats, r: int) -> Floats:
        """(9, 9) of camera r's corrected homography, world to pixels, scaled to unit norm."""
        first = 2 * len(self.given) + ENTRIES * r
        P = covariance[first : first + ENTRIES, first : first + ENTRIES]
        back = self.H[r] @ np.linalg.inv(self.normal[r])
        J = np.stack([np.outer(back[:, k // 3], self.normal[r, k % 3]).ravel() for k in range(ENTRIES)], axis=1)
        h = self.homographies[r].ravel()
        size = float(np.linalg.norm(h))
        J = (J - np.outer(h, h @ J) / size**2) / size
        return np.asarray(J @ P @ J.T)


def _world(problem: Problem, state: State, beacon: Floats) -> Floats:
    """(N, 2) where the beacons of the roof sightings are in the world."""
    poses = problem.stop_entries(state)[problem.roofs.stop]
    arm = (pose_matrix(*poses.T)[:, :3, :3] @ beacon[:, :, None])[:, :2, 0]
    return np.asarray(poses[:, :2] + arm)
