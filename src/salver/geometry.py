"""Maps of SO(3) and SE(3), vectorised.

Every function takes leading axes, so one call handles a whole trajectory. Rotations act on column vectors;
perturbations are on the right, R <- R Exp(theta). Formulas: Sola, Deray, Atchuthan, "A micro Lie theory
for state estimation in robotics", 2018; small angles by series, so that all maps are smooth at zero.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

GRAVITY = 9.81  # m/s^2
GRAVITY_S: Array = np.array([0.0, 0.0, -GRAVITY])
GRAVITY_S.setflags(write=False)

_SMALL = 1e-4  # rad; below this the series is exact to rounding
_HAT = np.zeros((3, 9))  # takes a vector to the rows of its skew matrix
_HAT[[2, 1, 2, 0, 1, 0], [1, 2, 3, 5, 6, 7]] = -1.0, 1.0, 1.0, -1.0, -1.0, 1.0


def hat(x: npt.ArrayLike) -> Array:
    """Skew matrix (..., 3, 3) of vectors (..., 3): hat(x) y = x cross y."""
    x = np.asarray(x, dtype=float)
    return np.asarray((x @ _HAT).reshape(*x.shape, 3))


def cross(a: Array, b: Array) -> Array:
    """Cross product a x b of vectors (..., 3); five times faster than np.cross."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def vee(matrix: npt.ArrayLike) -> Array:
    """Vectors (..., 3) of the skew parts of matrices (..., 3, 3): the inverse of `hat`."""
    m = np.asarray(matrix, dtype=float)
    return 0.5 * np.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1
    )


def _series(angle: Array) -> tuple[Array, Array, Array]:
    """sin(x)/x, (1-cos x)/x^2, (x-sin x)/x^3 of angles x >= 0."""
    small = angle < _SMALL
    x = np.where(small, 1.0, angle)
    x2 = angle**2
    a = np.where(small, 1 - x2 / 6, np.sin(x) / x)
    b = np.where(small, 0.5 - x2 / 24, 2 * (np.sin(0.5 * x) / x) ** 2)
    c = np.where(small, 1 / 6 - x2 / 120, (x - np.sin(x)) / x**3)
    return a, b, c


def exp(theta: npt.ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    theta = np.asarray(theta, dtype=float)
    a, b, _ = _series(np.linalg.norm(theta, axis=-1))
    skew = hat(theta)
    return np.eye(3) + a[..., None, None] * skew + b[..., None, None] * (skew @ skew)


def log(rotation: npt.ArrayLike) -> Array:
    """Rotation vectors (..., 3), of angle at most pi, of rotation matrices (..., 3, 3)."""
    quat = quat_wxyz_from_matrix(rotation)
    w, xyz = quat[..., 0], quat[..., 1:]
    sine = np.linalg.norm(xyz, axis=-1)
    small = sine < _SMALL
    factor = np.where(small, 2 + sine**2 / 3, 2 * np.arctan2(sine, w) / np.where(small, 1.0, sine))
    return factor[..., None] * xyz


def right_jacobian_inverse(theta: npt.ArrayLike) -> Array:
    """J_r^-1 (..., 3, 3) for angles below 2 pi, with Exp(theta + d) = Exp(theta) Exp(J_r d) to first order."""
    theta = np.asarray(theta, dtype=float)
    angle = np.linalg.norm(theta, axis=-1)
    a, b, _ = _series(angle)
    small = angle < 1e-2  # this closed form loses digits at larger angles than those of `_series`
    x2 = angle**2
    factor = np.where(small, 1 / 12 + x2 / 720 + x2**2 / 30240, (1 - a / (2 * b)) / np.where(small, 1.0, x2))
    skew = hat(theta)
    return np.eye(3) + 0.5 * skew + factor[..., None, None] * (skew @ skew)


def quat_wxyz_from_matrix(rotation: npt.ArrayLike) -> Array:
    """Unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    Shepperd's method: dividing by the largest of the four components avoids a small divisor.
    """
    m = np.asarray(rotation, dtype=float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)
    # 4 q q^T from the entries of the matrix: its column with the largest diagonal entry is along q.
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    outer[..., 0, 1:] = outer[..., 1:, 0] = 2 * vee(m)
    outer[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    for i in range(3):
        outer[..., i + 1, i + 1] = 1 + 2 * diagonal[..., i] - trace
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    quat = np.take_along_axis(outer, best[..., None, None], axis=-1)[..., 0]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[..., :1] < 0, -quat, quat)


def matrix_from_quat_wxyz(quat: npt.ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which need not be normalised."""
    q = np.asarray(quat, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, skew = q[..., 0, None, None], hat(q[..., 1:])
    return np.eye(3) + 2 * w * skew + 2 * (skew @ skew)


def matrix_from_rpy(rpy: npt.ArrayLike) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll) of (..., 3) angles (roll, pitch, yaw) in rad."""
    rpy = np.asarray(rpy, dtype=float)
    axes = np.eye(3)
    roll, pitch, yaw = (exp(rpy[..., i, None] * axes[i]) for i in range(3))
    return yaw @ pitch @ roll


def adjoint(p: npt.ArrayLike, rotation: npt.ArrayLike) -> Array:
    """Ad of the pose (p_AB, R_AB): twists (v, omega) in B to twists in A, (..., 6, 6).

    Its transpose takes wrenches in A to wrenches in B. Eq (3) of the paper is the transpose
    of this matrix's inverse: its lower-left block is hat(p_bc) R_bc.
    """
    p, r = np.asarray(p, dtype=float), np.asarray(rotation, dtype=float)
    ad = np.zeros((*p.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = r
    ad[..., :3, 3:] = hat(p) @ r
    return ad


def invert(p: Array, rotation: Array) -> tuple[Array, Array]:
    """Inverse pose: (p_AB, R_AB) to (p_BA, R_BA)."""
    r = np.swapaxes(rotation, -1, -2)
    return -(r @ p[..., None])[..., 0], r


def compose(p_AB: Array, R_AB: Array, p_BC: Array, R_BC: Array) -> tuple[Array, Array]:
    """Pose of C in A from the pose of B in A and of C in B."""
    return (R_AB @ p_BC[..., None])[..., 0] + p_AB, R_AB @ R_BC


def continuous(quat_wxyz: Array) -> Array:
    """Quaternions (N, 4), each with the sign that brings it nearer to the one before."""
    turned = np.einsum("ij,ij->i", quat_wxyz[1:], quat_wxyz[:-1]) < 0
    return quat_wxyz * np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))])[:, None]


def lean(rotation: Array) -> Array:
    """Tilt angles (...) in rad of the z axes of rotations (..., 3, 3) from the vertical."""
    return np.asarray(np.arccos(np.clip(rotation[..., 2, 2], -1.0, 1.0)))


def spread(count: int, wanted: int) -> Indices:
    """At most `wanted` evenly spread indices of 0 ... count - 1, both ends included."""
    return np.unique(np.round(np.linspace(0, count - 1, min(count, wanted))).astype(np.intp))


def interpolated(t: Array, values: Array, at: Array) -> Array:
    """Values (K, ...) at instants `at` (K,), linear between values (T, ...) at t (T,), constant beyond both ends."""
    columns = values.reshape(len(t), -1).T
    return np.stack([np.interp(at, t, column) for column in columns], axis=1).reshape(len(at), *values.shape[1:])
