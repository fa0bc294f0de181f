"""How far a dead-reckoned path can be off: second moments of its error, for any spread of heading.

Notation: the plane is complex, z = x + iy; u is a step's displacement as reckoned, in the axes of the path's start. If
the heading is off by h when the step begins, the step really goes u exp(ih) + exp(ih) n, with n what the wheels' own
errors add, and the heading error becomes h + r, with r = (error of the right wheel - error of the left) / base. The
errors e of position and h of heading are what the moments are of, about the reckoned pose and not about their mean:

    e' = e + u (c - 1) + c n        c = exp(ih)        c' = c exp(ir)        h' = h + r

n and r of different steps are independent, so the expectations of |e|^2, e^2, e h and h^2 follow exactly from one step
to the next, with those of c, c^2, e c, e conj(c) and c h, and the characteristic function of r. First-order propagation
of a covariance instead is right for moves of a few metres; it is not after a hundred metres, when headings are off by
0.3 rad: the true path then bends away from the reckoned one to either side and always falls short of it.

Errors of a wheel's travel in one step: a Gaussian random walk; slips, a compound Poisson process; while the base
reports that its wheels slip, an unknown share of the travel; and, when a wheel reverses, where between two counts it
did so, which an encoder with one channel does not see. What lasts for the whole path, the errors of the
calibration, is carried along as the derivative of the pose by them.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING

import numpy as np

from .oi import COUNT
from .records import Floats, Matrix3

if TYPE_CHECKING:
    from .odometry import Wheels

# m^2: a share f of a count is rolled one way before and 1 - f the other way after, so the error is 2 f - 1 counts
REVERSAL = COUNT * COUNT / 3.0


class PathError:
    """Second moments of the error that the wheels' noise has made since the start of a path.

    Parameters
    ----------
    wheels : Wheels
        `base`, `travel_noise`, `slip_length` and `slip_distance` count.
    slips : bool
        Whether slips that nobody notices are part of it.
    """

    def __init__(self, wheels: Wheels, *, slips: bool) -> None:
        self._base = wheels.base
        self._noise = wheels.travel_noise * wheels.travel_noise
        self._slip = wheels.slip_length
        self._slip_rate = 0.5 / wheels.slip_distance if slips and wheels.slip_distance > 0.0 else 0.0  # of one wheel
        self._doubted = [0.0, 0.0]  # metres that each wheel rolled since the base began to report slipping
        self._ways = [0.0, 0.0]  # the way that each wheel last rolled, +1 or -1
        # expectations
        self._e = self._ee = self._eh = self._ec = self._e_c = complex(0.0)  # e, e^2, e h, e c, e conj(c)
        self._abs_ee = self._h = self._hh = 0.0  # |e|^2, h, h^2
        self._c = self._cc = complex(1.0)  # c, c^2
        self._ch = complex(0.0)  # c h

    def add(self, step: complex, along: complex, left: float, right: float, slipping: bool = False) -> None:
        """Append one short step.

        Parameters
        ----------
        step : complex
            Displacement in metres, in the axes of the path's start.
        along : complex
            Unit vector of the heading in the middle of the step.
        left, right : float
            Metres rolled by each wheel.
        slipping : bool, optional
            The base reports that its wheels slip: an unknown share between none and all of each wheel's travel, the
            same one until the report ends, moved nothing. It has mean 1/2 and variance 1/12.
        """
        base, slip_mean = self._base, self._slip_rate * 0.5 * abs(left + right)  # expected slips of one wheel
        swing = 0.5j * step / base
        # moments of n and r: E n, E |n - En|^2, E (n - En)^2, E r, var r, cov(n, r), log E exp(ir), log E exp(2ir)
        n = nn = nr = complex(0.0)
        abs_nn = r = rr = 0.0
        log_1 = log_2 = complex(0.0)
        # E n exp(ir), E r exp(ir) over E exp(ir), and E n exp(-ir) over E exp(-ir)
        n_tilted = r_tilted = n_tilted_conj = complex(0.0)
        for wheel, sign, rolled in ((0, -1.0, left), (1, 1.0, right)):
            gain, turn = 0.5 * along + sign * swing, sign / base  # of a metre of this wheel's error
            drift, gauss = 0.0, self._noise * abs(rolled)
            if rolled * self._ways[wheel] < 0.0:
                gauss += REVERSAL
            if rolled:
                self._ways[wheel] = math.copysign(1.0, rolled)
            if slipping:
                before = self._doubted[wheel]
                self._doubted[wheel] = before + abs(rolled)
                drift = -0.5 * rolled
                gauss += (self._doubted[wheel] ** 2 - before * before) / 12.0
            mean, variance, tilted = drift, gauss, drift + 1j * turn * gauss
            log_1 += 1j * turn * drift - 0.5 * turn * turn * gauss
            log_2 += 2j * turn * drift - 2.0 * turn * turn * gauss
            if slip_mean and rolled:
                jump = -math.copysign(self._slip, rolled)
                kick = cmath.exp(1j * turn * jump)
                mean += slip_mean * jump
                variance += slip_mean * jump * jump
                tilted += slip_mean * jump * kick
                log_1 += slip_mean * (kick - 1.0)
                log_2 += slip_mean * (kick * kick - 1.0)
            n += gain * mean
            abs_nn += abs(gain) ** 2 * variance
            nn += gain * gain * variance
            r += turn * mean
            rr += turn * turn * variance
            nr += gain * turn * variance
            n_tilted += gain * tilted
            r_tilted += turn * tilted
            n_tilted_conj += gain * tilted.conjugate()
        if not slipping:
            self._doubted = [0.0, 0.0]
        phi = cmath.exp(log_1)
        c, cc, u = self._c, self._cc, step
        c_conj, u_conj = c.conjugate(), step.conjugate()
        e_w, e_w_conj = self._ec - self._e, self._e_c - self._e  # w = c - 1
        w_h, w_w, w_c, w_c_conj = self._ch - self._h, cc - 2.0 * c + 1.0, cc - c, 1.0 - c_conj
        self._abs_ee += (
            abs(u) ** 2 * (2.0 - 2.0 * c.real)
            + 2.0 * (u_conj * e_w_conj + n.conjugate() * (self._e_c + u * w_c_conj)).real
            + abs_nn
            + abs(n) ** 2
        )
        self._ee += u * u * w_w + 2.0 * u * e_w + 2.0 * n * (self._ec + u * w_c) + cc * (nn + n * n)
        self._eh += self._e * r + u * (w_h + (c - 1.0) * r) + self._ch * n + c * (nr + n * r)
        self._hh += 2.0 * self._h * r + rr + r * r
        self._e_c = (self._e_c + u * w_c_conj + n_tilted_conj) * phi.conjugate()
        self._ec = (self._ec + u * w_c + cc * n_tilted) * phi
        self._ch = (self._ch + c * r_tilted) * phi
        self._e += u * (c - 1.0) + c * n
        self._h += r
        self._c = c * phi
        self._cc = cc * cmath.exp(log_2)

    def second_moment(self) -> Matrix3:
        """E of the error's outer product (x, y in metres, heading in radians), in the axes of the path's start."""
        xx, yy, xy = 0.5 * (self._abs_ee + self._ee.real), 0.5 * (self._abs_ee - self._ee.real), 0.5 * self._ee.imag
        xh, yh = self._eh.real, self._eh.imag
        return (xx, xy, xh), (xy, yy, yh), (xh, yh, self._hh)


class CalibrationError:
    """How the pose at the end of a path depends on `scale_left`, `scale_right` and `base`.

    Parameters
    ----------
    wheels : Wheels
    """

    def __init__(self, wheels: Wheels) -> None:
        self._wheels = wheels
        self._position = [complex(0.0)] * 3  # derivatives by scale_left, scale_right, base
        self._heading = [0.0] * 3

    def add(self, step: complex, along: complex, left: float, right: float) -> None:
        """Append one short step; the arguments are those of `PathError.add`."""
        wheels, position, heading = self._wheels, self._position, self._heading
        base = wheels.base
        rolled_left, rolled_right = left / wheels.scale_left, right / wheels.scale_right
        turns = -rolled_left / base, rolled_right / base, (left - right) / (base * base)
        forwards = 0.5 * rolled_left, 0.5 * rolled_right, 0.0
        for parameter in range(3):
            turn = turns[parameter]
            position[parameter] += 1j * step * (heading[parameter] + 0.5 * turn) + along * forwards[parameter]
            heading[parameter] += turn

    def second_moment(self) -> Matrix3:
        """J S J^T with S the calibration's covariance, in the axes of the path's start."""
        J = self._derivatives()
        return as_matrix3(J @ np.array(self._wheels.covariance) @ J.T)

    def by_errors(self) -> Matrix3:
        """Derivatives of x, y, heading by relative errors of scale and turns, and by drift, radians per metre.

        Scale with the turns kept is both wheels' size and as much of the base; the turns alone are the base.
        """
        wheels = self._wheels
        by_left, by_right, by_base = self._derivatives().T
        by_scale = wheels.scale_left * by_left + wheels.scale_right * by_right + wheels.base * by_base
        by_drift = 0.5 * wheels.base * (by_right - by_left)
        return as_matrix3(np.column_stack([by_scale, -wheels.base * by_base, by_drift]))

    def _derivatives(self) -> Floats:
        return np.array([[z.real for z in self._position], [z.imag for z in self._position], self._heading])


def as_matrix3(array: Floats) -> Matrix3:
    """(3, 3) array to nested tuples."""
    (a, b, c), (d, e, f), (g, h, i) = array.tolist()
    return (a, b, c), (d, e, f), (g, h, i)
