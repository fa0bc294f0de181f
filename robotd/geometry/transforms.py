"""Rotations and rigid motions in two and three dimensions, in the axes of ARCHITECTURE.md.

`T_a_b` takes coordinates in b to coordinates in a. Rotations are stored as rotation vectors: axis times angle, radians.
All functions work on stacks: leading dimensions broadcast.
"""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from ..records import Floats, Pose, Transform


@overload
def wrap_angle(angle: float) -> float: ...
@overload
def wrap_angle(angle: Floats) -> Floats: ...
def wrap_angle(angle: float | Floats) -> float | Floats:
    """Bring angles in radians into (-pi, pi]; a float stays a float."""
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle, dtype=np.float64), 2.0 * np.pi)
    return float(wrapped) if wrapped.ndim == 0 else wrapped


def skew(vector: ArrayLike) -> Floats:
    """Cross-product matrix of (..., 3) vectors: `skew(a) @ b` is a x b. Shape (..., 3, 3)."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def rotation_matrix(rotation: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula; exact near zero."""
    v = np.asarray(rotation, dtype=np.float64)
    if v.shape[-1:] != (3,):
        raise ValueError(f"need rotation vectors of shape (..., 3), got {v.shape}")
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    # sinc(x) of numpy is sin(pi x) / (pi x); 1 - cos a = 2 sin^2(a / 2) loses no digits near zero
    R = np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (k @ k)
    return np.asarray(R, dtype=np.float64)


def rotation_vector(matrix: ArrayLike) -> Floats:
    """Rotation vectors (..., 3), angle in [0, pi], of rotation matrices (..., 3, 3); accurate near 0 and near pi.

    Goes through the unit quaternion, dividing by its largest component (Shepperd 1978), because the trace alone
    tells nothing about small angles and the antisymmetric part nothing about half turns.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape[-2:] != (3, 3):
        raise ValueError(f"need rotation matrices of shape (..., 3, 3), got {m.shape}")
    d = np.diagonal(m, axis1=-2, axis2=-1)
    # the outer product 4 q q' of the quaternion q = (w, x, y, z)
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1.0 + d.sum(-1)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i + 1, i + 1] = 1.0 + d[..., i] - d[..., j] - d[..., k]
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = m[..., k, j] - m[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = m[..., k, j] + m[..., j, k]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    scale = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-150)
    return np.asarray(q[..., 1:] * scale, dtype=np.float64)


def heading_matrix(heading: ArrayLike) -> Floats:
    """Rotation matrices (..., 2, 2) of headings: robot axes to world axes in the plane."""
    h = np.asarray(heading, dtype=np.float64)
    c, s = np.cos(h), np.sin(h)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def se2_compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Floats:
    """T_a_c of planar poses (..., 3): x, y, heading; the second is expressed in the first."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    xy = a[..., :2] + (heading_matrix(a[..., 2]) @ b[..., :2, None])[..., 0]
    return np.concatenate([xy, wrap_angle(np.atleast_1d(a[..., 2] + b[..., 2])).reshape(xy.shape[:-1])[..., None]], -1)


def se2_inverse(T_a_b: ArrayLike) -> Floats:
    """T_b_a of planar poses (..., 3)."""
    a = np.asarray(T_a_b, dtype=np.float64)
    xy = -(np.swapaxes(heading_matrix(a[..., 2]), -1, -2) @ a[..., :2, None])[..., 0]
    return np.concatenate([xy, wrap_angle(np.atleast_1d(-a[..., 2])).reshape(xy.shape[:-1])[..., None]], -1)


def se2_relative(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Floats:
    """The move T_a_b from pose a to pose b, in a's axes: dx, dy, dheading."""
    return se2_compose(se2_inverse(T_w_a), T_w_b)


def pose_array(pose: Pose) -> Floats:
    """(3,) x, y, heading of a pose record."""
    return np.array([pose.x, pose.y, pose.heading])


def pose_matrix(
    x: ArrayLike, y: ArrayLike, heading: ArrayLike, roll: ArrayLike = 0.0, pitch: ArrayLike = 0.0
) -> Floats:
    """T_world_robot (..., 4, 4) of a robot on the floor: Rz(heading) Ry(pitch) Rx(roll), origin at (x, y, 0).

    Positive roll lowers the right side, positive pitch lowers the front (ROS REP 103).
    """
    x_, y_, h, r, p = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (x, y, heading, roll, pitch)))
    ch, sh, cp, sp, cr, sr = np.cos(h), np.sin(h), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    T = np.zeros((*h.shape, 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = -sp, cp * sr, cp * cr
    T[..., 0, 3], T[..., 1, 3], T[..., 3, 3] = x_, y_, 1.0
    return T


def transform_matrix(transform: Transform) -> Floats:
    """The (4, 4) matrix of a transform record."""
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(transform.rotation)
    T[:3, 3] = transform.translation
    return T


def transform_record(matrix: ArrayLike) -> Transform:
    """The transform record of a rigid (4, 4) matrix."""
    T = np.asarray(matrix, dtype=np.float64)
    r, t = rotation_vector(T[:3, :3]), T[:3, 3]
    return Transform((float(r[0]), float(r[1]), float(r[2])), (float(t[0]), float(t[1]), float(t[2])))


def invert_rigid(T_a_b: ArrayLike) -> Floats:
    """T_b_a of rigid (..., 4, 4) matrices."""
    T = np.asarray(T_a_b, dtype=np.float64)
    inverse = np.zeros_like(T)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = R_t
    inverse[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Floats:
    """Coordinates in a, (..., N, 3), of points given in b, (..., N, 3)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(points_b, dtype=np.float64) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
