"""A lens from MATLAB's cameraParameters. Thesis section 7.2, equations 67-69 with erratum A21.

MATLAB's first pixel has its centre at (1, 1), ours at (0, 0): one is subtracted from the principal point. The old
`IntrinsicMatrix` is transposed, `K` is not. Radial and tangential coefficients mean the same in both, in another order.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.io import loadmat

from ..errors import InputError
from ..records import CameraModel, Floats
from .lens_fit import NOWHERE

HOW = "in MATLAB: s = toStruct(cameraParams); save('lens.mat', '-struct', 's', '-v7')"
HOW_JSON = "or write jsonencode(s) to lens.json"
MOST_SKEW = 1e-6  # of the focal length


def load_matlab(data: bytes, where: str, name: str, size: tuple[int, int] | None = None) -> CameraModel:
    """Read cameraParameters or cameraIntrinsics that were made a struct.

    Parameters
    ----------
    data : bytes
        A MAT file up to version 7, the struct's fields or the struct itself in it, or JSON text.
    where : str
        The file's name, for messages.
    name : str
        Of the camera.
    size : (width, height), optional
        Of the picture, if `ImageSize` is missing; checked against it otherwise.

    Returns
    -------
    CameraModel
        Its pose is not set.

    Raises
    ------
    InputError
        If the file cannot be read or says what a Brown-Conrady lens cannot.
    """
    fields = _fields(_json(data, where) if data.lstrip()[:1] in (b"{", b"[") else _mat(data, where), where)
    problems: list[str] = []
    if "MappingCoefficients" in fields:
        raise InputError(
            f"{where}: MATLAB's fisheye model (MappingCoefficients) has no counterpart here; calibrate from the same"
            " pictures: robotd-solver calibrate camera IMAGES"
        )
    focal, centre, skew = _matrix(fields, where)
    radial = _numbers(fields, "RadialDistortion", (2, 3), where, problems)
    tangential = (
        _numbers(fields, "TangentialDistortion", (2,), where, problems)
        if "TangentialDistortion" in fields
        else np.zeros(2)
    )
    if not abs(skew) <= MOST_SKEW * abs(focal[0]):
        problems.append(f"{where}: skew is {skew:g}; expected 0: calibrate with EstimateSkew false")
    known = _floats(fields.get("ImageSize", ())).ravel()
    if known.size == 2 and np.isfinite(known).all():
        stated = int(known[1]), int(known[0])  # because MATLAB says rows first
        if size is not None and size != stated:
            problems.append(f"{where}: ImageSize is {stated[0]}x{stated[1]}, but --size says {size[0]}x{size[1]}")
        size = stated
    if size is None:
        problems.append(f"{where}: ImageSize is missing; give --size WxH")
    if not (focal > 0.0).all() or not np.isfinite(np.concatenate([focal, centre])).all():
        problems.append(f"{where}: focal length {focal.tolist()}, principal point {centre.tolist()}; expected pixels")
    if problems or size is None:
        raise InputError(*problems)
    u, v = (centre - 1.0).tolist()
    if not (0.0 < u < size[0] and 0.0 < v < size[1]):
        raise InputError(
            f"{where}: the principal point {u:.1f}, {v:.1f} lies outside the picture of {size[0]}x{size[1]}"
        )
    k1, k2, k3 = (*radial.tolist(), 0.0)[:3]
    return CameraModel(name, size, (*focal.tolist(), u, v), NOWHERE, distortion=(k1, k2, *tangential.tolist(), k3))


def _json(data: bytes, where: str) -> Any:
    try:
        return json.loads(data)
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{where}: not valid JSON: {error}") from error


def _mat(data: bytes, where: str) -> Any:
    try:
        return loadmat(io.BytesIO(data), simplify_cells=True)
    except NotImplementedError as error:
        raise InputError(f"{where}: is a MAT file of version 7.3; save it with '-v7', {HOW}") from error
    except Exception as error:  # because scipy lets whatever a broken file causes through
        raise InputError(f"{where}: cannot be read as a MAT file ({error}); {HOW}, {HOW_JSON}") from error


def _fields(found: Any, where: str) -> Mapping[str, Any]:
    """The struct with the lens: what was read, or the one variable or property in it that is."""
    if isinstance(found, Mapping):
        for candidate in (found, *found.values()):
            if isinstance(candidate, Mapping):
                inner = candidate.get("Intrinsics")
                merged = {**candidate, **inner} if isinstance(inner, Mapping) else candidate
                if {"K", "IntrinsicMatrix", "FocalLength", "MappingCoefficients"} & set(merged):
                    return merged
    raise InputError(f"{where}: holds no camera parameters that can be read outside MATLAB; {HOW}, {HOW_JSON}")


def _matrix(fields: Mapping[str, Any], where: str) -> tuple[Floats, Floats, float]:
    """Focal lengths, MATLAB's principal point, and skew."""
    for key in ("K", "IntrinsicMatrix"):
        if key in fields:
            K = _floats(fields[key])
            if K.shape != (3, 3):
                raise InputError(f"{where} {key}: found an array of shape {K.shape}; expected 3x3")
            K = K.T if key == "IntrinsicMatrix" else K
            if not np.allclose(K[2], [0.0, 0.0, 1.0]) or K[1, 0] != 0.0:
                raise InputError(f"{where} {key}: is no camera matrix in MATLAB's order")
            return K[[0, 1], [0, 1]], K[:2, 2], float(K[0, 1])
    focal, centre = _floats(fields["FocalLength"]).ravel(), _floats(fields.get("PrincipalPoint", ())).ravel()
    if focal.size != 2 or centre.size != 2:
        raise InputError(f"{where}: expected FocalLength and PrincipalPoint of two numbers each")
    skew = _floats(fields.get("Skew", 0.0)).ravel()
    return focal, centre, float(skew[0]) if skew.size else 0.0


def _numbers(fields: Mapping[str, Any], key: str, counts: tuple[int, ...], where: str, problems: list[str]) -> Floats:
    values = _floats(fields.get(key, ())).ravel()
    if values.size not in counts or not np.isfinite(values).all():
        wanted = " or ".join(map(str, counts))
        problems.append(f"{where} {key}: found {values.tolist()}; expected {wanted} numbers")
        return np.zeros(counts[-1])
    return values


def _floats(value: Any) -> Floats:
    """An array of what was read, NaN where it is no number."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array([math.nan])
