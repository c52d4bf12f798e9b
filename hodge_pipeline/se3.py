"""Rigid motions in batches: the only place where conventions meet.

A motion `b_from_a` is a 4x4 matrix that maps a point given in a to b. A twist is ξ = (φ, ρ): rotation first, radians
and metres; `exp(ξ)` has the rotation exp(φ^) and the translation V(φ) ρ. Quaternions are xyzw. Every function takes
any leading batch shape.
"""

from __future__ import annotations

import math

import numpy as np

from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints, Trajectory

SMALL_ANGLE = 1e-4
"""Radians: below, two terms of a series are exact; above, closed forms cancel to 1e-8 at worst, times θ² of 1e-8."""
SAME_STAMP_S = 1e-6
"""Text often has six digits, and a double holds seconds since 1970 to 0.2 µs."""
MAX_NUMBER = 1e100
"""Past it squares and products of numbers overflow."""
ARM_M = 1.0
"""Metres: a rotation counts as the displacement that it causes at this distance, about that of a room's walls."""

OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between axes of a camera (x right, y down, z ahead) and of OpenGL and Blender (y up, z back): its own inverse."""
LEAST_PRECISION, MOST_PRECISION = 1e-6, 1e6
"""Of each axis's median, in units in which that is 1: eigenvalues of an information beyond are clipped."""


def hat(v: Floats) -> Floats:
    """The skew matrices v^ (..., 3, 3) of vectors (..., 3): `hat(v) @ u == cross(v, u)`."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(phi: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (paper, Section 3.3)."""
    half = 0.5 * np.sqrt(np.einsum("...i,...i->...", phi, phi))
    return _rotation(np.moveaxis(phi, -1, 0) * (0.5 * np.sinc(half / np.pi)), np.cos(half))


def _rotation(vector: Floats, w: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of unit quaternions with this vector (3, ...) and scalar w (...,)."""
    x, y, z = vector
    out = np.empty((*w.shape, 3, 3))
    for row, (own, after, last) in enumerate(((x, y, z), (y, z, x), (z, x, y))):
        out[..., row, row] = 1 - 2 * (after**2 + last**2)
        out[..., row, (row + 1) % 3] = 2 * (own * after - w * last)
        out[..., row, (row + 2) % 3] = 2 * (own * last + w * after)
    return out


def so3_log(rotation: Floats) -> Floats:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3), of length at most π.

    At exactly π the axis has two signs: its largest entry is taken positive.
    """
    quat = _quat_xyzw(rotation)
    sine = np.linalg.norm(quat[..., :3], axis=-1)
    angle = 2 * np.arctan2(sine, quat[..., 3])
    return np.asarray(quat[..., :3] * (angle / np.where(sine > 0, sine, 1.0))[..., None])


def _quat_xyzw(rotation: Floats) -> Floats:
    """Quaternions (..., 4), w not negative, of no unit length, of rotation matrices (..., 3, 3).

    By the row of 4 q qᵀ with the largest diagonal (Markley 2008), which is accurate at every angle and, where the
    matrix is a rotation, needs no projection.
    """
    rotation = np.asarray(rotation, float)
    r = np.moveaxis(rotation.reshape(-1, 3, 3), 0, 2)
    trace, outer = r[0, 0] + r[1, 1] + r[2, 2], np.empty((4, 4, r.shape[2]))
    outer[:3, :3] = r + np.swapaxes(r, 0, 1)
    for axis in range(3):
        outer[axis, axis] = 1 + 2 * r[axis, axis] - trace
    outer[3, 3] = 1 + trace
    outer[3, 0], outer[3, 1], outer[3, 2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    outer[:3, 3] = outer[3, :3]
    row = np.argmax(np.einsum("iin->in", outer), axis=0)
    quat = outer[row, :, np.arange(len(row))]
    quat *= np.where(quat[:, 3:] < 0, -1.0, 1.0)
    return np.asarray(quat.reshape(*rotation.shape[:-2], 4))


def _series(angle: Floats) -> tuple[Floats, Floats]:
    """(1 − cos θ)/θ² and (θ − sin θ)/θ³ (...,), by their series where θ is small."""
    small = angle < SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    return a, b


def rescaled(motions: Floats, factor: float) -> Floats:
    """Motions (..., 4, 4) with every length times the factor."""
    out = np.array(motions, float)
    out[..., :3, 3] *= factor
    return out


def rescaled_information(information: Floats, factor: float) -> Floats:
    """Information (..., 6, 6) over (rotation, translation) of motions whose lengths are taken times the factor."""
    unit = np.repeat([1.0, 1 / factor], 3)
    return np.asarray(unit[:, None] * information * unit)


def covariances(information: Floats) -> Floats:
    """Inverses (E, p, p) of information matrices, their eigenvalues clipped: never infinite, never negative."""
    if not len(information):
        return information
    p = information.shape[-1]
    split = 1 if p == 3 else 3
    precision = np.einsum("eii->ei", information)
    unit = np.ones(p)
    for part in (slice(0, split), slice(split, p), *(slice(axis, axis + 1) for axis in range(p))):
        positive = precision[:, part][precision[:, part] > 0]
        unit[part] = 1 / np.sqrt(np.median(positive)) if len(positive) else unit[part]
    scale = np.outer(unit, unit)
    values, vectors = np.linalg.eigh(0.5 * (information + np.swapaxes(information, 1, 2)) * scale)
    values = np.clip(values, LEAST_PRECISION, MOST_PRECISION)
    return np.asarray((vectors / values[:, None]) @ np.swapaxes(vectors, 1, 2) * scale)


def left_jacobian(phi: Floats) -> Floats:
    """V(φ) (..., 3, 3), the left Jacobian of SO(3): the translation of exp(φ, ρ) is V(φ) ρ."""
    phi = np.asarray(phi, float)
    a, b = _series(np.linalg.norm(phi, axis=-1))
    k = hat(phi)
    return np.asarray(np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k))


def left_jacobian_inverse(phi: Floats) -> Floats:
    """V(φ)⁻¹ (..., 3, 3)."""
    phi = np.asarray(phi, float)
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < SMALL_ANGLE
    half = np.where(small, 1.0, angle) / 2
    c = np.where(small, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / (4 * half**2))
    k = hat(phi)
    return np.asarray(np.eye(3) - 0.5 * k + c[..., None, None] * (k @ k))


def from_parts(rotation: Floats, translation: Floats) -> Floats:
    """Motions (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*batch, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def exp(xi: Floats) -> Floats:
    """Motions (..., 4, 4) of twists (..., 6) = (φ, ρ)."""
    xi = np.asarray(xi, float)
    if xi.ndim == 1:
        return _exp_of_one(*xi.tolist())
    phi, rho = xi[..., :3], xi[..., 3:]
    v = left_jacobian(phi)  # and exp(φ^) = 1 + φ^ V(φ)
    return from_parts(np.eye(3) + hat(phi) @ v, np.einsum("...ij,...j->...i", v, rho))


def _exp_of_one(x: float, y: float, z: float, u: float, v: float, w: float) -> Floats:
    """The motion (4, 4) of one twist, in a tenth of the time that arrays take: one is needed at each step of a fit."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < SMALL_ANGLE:
        a, b = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        a, b = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    sine, cosine, along = 1 - b * angle**2, 1 - a * angle**2, b * (x * u + y * v + z * w)  # the sine over the angle
    xy, yz, zx = a * x * y, a * y * z, a * z * x
    shift_x = sine * u + a * (y * w - z * v) + along * x
    shift_y = sine * v + a * (z * u - x * w) + along * y
    shift_z = sine * w + a * (x * v - y * u) + along * z
    rows = [
        [cosine + a * x * x, xy - sine * z, zx + sine * y, shift_x],
        [xy + sine * z, cosine + a * y * y, yz - sine * x, shift_y],
        [zx - sine * y, yz + sine * x, cosine + a * z * z, shift_z],
        [0.0, 0.0, 0.0, 1.0],
    ]
    return np.array(rows)


def log(b_from_a: Floats) -> Floats:
    """Twists (..., 6) = (φ, ρ) of motions (..., 4, 4); `log(inverse(T)) == -log(T)`."""
    phi = so3_log(b_from_a[..., :3, :3])
    rho = np.einsum("...ij,...j->...i", left_jacobian_inverse(phi), b_from_a[..., :3, 3])
    return np.concatenate([phi, rho], axis=-1)


def pairing_exp(xi: Floats) -> Floats:
    """Motions (..., 4, 4) with rotation exp(φ^) and translation t of the paper's own pairs (φ, t) (Section 3.3)."""
    xi = np.asarray(xi, float)
    return from_parts(so3_exp(xi[..., :3]), xi[..., 3:])


def pairing_log(b_from_a: Floats) -> Floats:
    """The paper's pairs (φ, t) (..., 6) (Section 3.3): not antisymmetric, since an inverse has −Rᵀt."""
    return np.concatenate([so3_log(b_from_a[..., :3, :3]), b_from_a[..., :3, 3]], axis=-1)


def inverse(b_from_a: Floats) -> Floats:
    """`a_from_b` (..., 4, 4)."""
    rotation = np.swapaxes(b_from_a[..., :3, :3], -1, -2)
    return from_parts(rotation, -np.einsum("...ij,...j->...i", rotation, b_from_a[..., :3, 3]))


def between(world_from_frame: Floats, pairs: Ints) -> Floats:
    """The motions `i_from_j (..., P, 4, 4)` of pairs (P, 2) of poses (..., N, 4, 4)."""
    i, j = pairs.T
    return np.asarray(inverse(world_from_frame[..., i, :, :]) @ world_from_frame[..., j, :, :])


def adjoint(b_from_a: Floats) -> Floats:
    """Ad (..., 6, 6) with `b_from_a exp(ξ) = exp(Ad ξ) b_from_a`, order (rotation, translation)."""
    rotation, translation = b_from_a[..., :3, :3], b_from_a[..., :3, 3]
    out = np.zeros((*b_from_a.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = hat(translation) @ rotation
    return out


def pull_back(b_from_a: Floats, information: Floats) -> Floats:
    """Information (..., 6, 6) on motions ξ of a, `b_from_a exp(ξ)`, from that on motions of b, `exp(ξ) b_from_a`."""
    into = adjoint(b_from_a)
    return np.asarray(np.swapaxes(into, -1, -2) @ information @ into)


def carried(b_from_a: Floats, covariance: Floats) -> Floats:
    """The covariance (..., 6, 6) of twists in the axes of b, from that in the axes of a."""
    into = adjoint(b_from_a)
    return np.asarray(into @ covariance @ np.swapaxes(into, -1, -2))


def transform(b_from_a: Floats, points_in_a: Floats) -> Floats:
    """Points (..., N, 3) in b; the batch shapes broadcast."""
    rotated = np.asarray(points_in_a) @ np.swapaxes(b_from_a[..., :3, :3], -1, -2)
    return np.asarray(rotated + b_from_a[..., None, :3, 3])


def by_twist(points: Floats) -> Floats:
    """The derivative [−p^ I] (..., 3, 6) of points `exp(ξ) p` (..., 3) by ξ at 0."""
    return np.concatenate([-hat(points), np.broadcast_to(np.eye(3), (*points.shape, 3))], axis=-1)


def from_quat_xyzw(translation: Floats, quat_xyzw: Floats) -> Floats:
    """Motions (..., 4, 4); quaternions (..., 4) of any length but zero are normalised."""
    quat = np.asarray(quat_xyzw, float)
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return from_parts(_rotation(np.moveaxis(quat[..., :3], -1, 0), quat[..., 3]), translation)


def to_quat_xyzw(b_from_a: Floats) -> Floats:
    """Unit quaternions (..., 4) of the rotations, w not negative."""
    quat = _quat_xyzw(np.asarray(b_from_a)[..., :3, :3])
    return np.asarray(quat / np.linalg.norm(quat, axis=-1, keepdims=True))


def project_to_so3(matrix: Floats) -> Floats:
    """The nearest rotations (..., 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def rotation_angle(b_from_a: Floats) -> Floats:
    """Angles (...,) of the rotations of motions (..., 4, 4), radians in [0, π]."""
    return np.asarray(np.linalg.norm(so3_log(b_from_a[..., :3, :3]), axis=-1))


def displacement_m(b_from_a: Floats, arm_m: float) -> Floats:
    """How far (...,) motions (..., 4, 4) move what is `arm_m` away: their shift, and their turn as an arc."""
    return np.asarray(np.linalg.norm(b_from_a[..., :3, 3], axis=-1) + arm_m * rotation_angle(b_from_a))


def fit_poses(world_from_cam: Floats, other_from_cam: Floats) -> Floats:
    """The motion `world_from_other (4, 4)` between two sets of poses (N, 4, 4): their mean turn, and the mean shift
    that it leaves. Unlike a fit of positions it is fixed where these lie on a line.
    """
    turn = project_to_so3((world_from_cam[:, :3, :3] @ np.swapaxes(other_from_cam[:, :3, :3], 1, 2)).mean(axis=0))
    return from_parts(turn, (world_from_cam[:, :3, 3] - other_from_cam[:, :3, 3] @ turn.T).mean(axis=0))


def fit_rigid(points_in_b: Floats, points_in_a: Floats, weights: Floats | None = None) -> Floats:
    """The motions `b_from_a (..., 4, 4)` of least squares between matched points (..., N, 3), weighted (..., N).

    Arun, Huang and Blostein 1987; points on a line leave the rotation about it open.
    """
    weights = np.ones(points_in_b.shape[:-1]) if weights is None else weights
    share = (weights / np.maximum(weights.sum(axis=-1, keepdims=True), 1e-12))[..., None]
    centre_b, centre_a = ((share * points).sum(axis=-2, keepdims=True) for points in (points_in_b, points_in_a))
    rotation = project_to_so3(np.swapaxes(share * (points_in_b - centre_b), -1, -2) @ (points_in_a - centre_a))
    return from_parts(rotation, (centre_b - centre_a @ np.swapaxes(rotation, -1, -2))[..., 0, :])


def interpolate(world_from_a: Floats, world_from_b: Floats, share: Floats) -> Floats:
    """Motions (..., 4, 4) on the geodesic from a (share 0) to b (share 1), `a exp(share · log(a⁻¹ b))`."""
    return np.asarray(world_from_a @ exp(np.asarray(share)[..., None] * log(inverse(world_from_a) @ world_from_b)))


def poses_at(trajectory: Trajectory, stamps_s: Floats, max_gap_s: float, near_s: float = 0.0) -> Floats:
    """Poses (N, 4, 4) at the stamps, on the geodesic between the two around; NaN where one of these is farther than
    `max_gap_s`, unless the other is within `near_s`. A pose at the stamp itself, to a microsecond, needs no neighbours.
    """
    poses, times = np.full((len(stamps_s), 4, 4), np.nan), trajectory.stamps_s
    if not len(times):
        return poses
    after = np.clip(np.searchsorted(times, stamps_s), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    to_before, to_after = stamps_s - times[before], times[after] - stamps_s
    nearest = np.where(np.abs(to_before) < np.abs(to_after), before, after)
    exact = np.abs(times[nearest] - stamps_s) <= SAME_STAMP_S
    between = ~exact & (before < after) & (to_before >= 0) & (to_after >= 0)
    between &= (np.maximum(to_before, to_after) <= max_gap_s) | (np.minimum(to_before, to_after) <= near_s)
    a, b = before[between], after[between]
    poses[exact] = trajectory.world_from_cam[nearest[exact]]
    share = to_before[between] / (times[b] - times[a])
    poses[between] = interpolate(trajectory.world_from_cam[a], trajectory.world_from_cam[b], share)
    return poses


def spread_correction(
    times: Floats, world_from_cam: Floats, key_times: Floats, key_before: Floats, key_after: Floats
) -> Floats:
    """The poses (N, 4, 4) at `times (N,)`, corrected as the key poses (K, 4, 4) at `key_times (K,)` were.

    A correction is the motion in the world that takes a key pose from before to after. Between two key moments it is
    interpolated on SE(3) about the pose that it moves, so that the result depends neither on the world's origin nor on
    what the pose is of (camera or body); a pose at a key moment moves exactly as the key pose did. Before the first
    and after the last key moment the nearest correction holds.
    """
    times, key_times = np.asarray(times, float), np.asarray(key_times, float)
    if not len(key_times) or (np.diff(key_times) <= 0).any():
        raise GraphError(f"{len(key_times)} key poses: need at least one, at moments that ascend")
    after = np.clip(np.searchsorted(key_times, times, side="right"), 1, max(len(key_times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(key_times) - 1)
    span = key_times[after] - key_times[before]
    share = np.clip((times - key_times[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    corrections = key_after @ inverse(key_before)
    about = np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy()
    about[:, :3, 3] = world_from_cam[:, :3, 3]
    back = inverse(about)
    local = interpolate(back @ corrections[before] @ about, back @ corrections[after] @ about, share)
    return np.asarray(about @ local @ back @ world_from_cam)


def has_pose(world_from_cam: Floats) -> Bools:
    """Where (...,) a pose (..., 4, 4) is finite: a frame without truth holds NaN."""
    return np.asarray(np.isfinite(world_from_cam).all(axis=(-1, -2)))


def is_motion(matrix: Floats, tolerance: float = 1e-2) -> Bools:
    """Where (...,) a matrix (..., 4, 4) is finite, its last row is (0, 0, 0, 1) and RᵀR is I within the tolerance;
    numbers past `MAX_NUMBER` count as infinite.
    """
    matrix = np.asarray(matrix, float)
    finite = np.asarray((np.abs(matrix) < MAX_NUMBER).all(axis=(-1, -2)))
    safe = np.where(finite[..., None, None], matrix, 0.0)
    rotation = safe[..., :3, :3]
    gram_error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
    row_error = np.abs(safe[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=-1)
    return np.asarray(finite & (gram_error < tolerance) & (row_error < tolerance) & (np.linalg.det(rotation) > 0))
