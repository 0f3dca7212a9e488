"""Rotations and 3-vectors: the bottom of the house.

The rod's orientation is a unit quaternion q = (x, y, z, w), RoMa's order, so that everything RoMa offers (rotation vectors,
matrices, interpolation) applies to it. This module has the pointwise algebra of the arc-length step, which must stay free of
branches and of 0/0 at zero rotation so that derivatives are exact there. RoMa does the rest, and is imported where it is used: it
brings in torch's tracer, which takes as long as torch itself.
"""

import torch
from jaxtyping import Float
from torch import Tensor

Vector = Float[Tensor, "... 3"]
Matrix = Float[Tensor, "... 3 3"]
Quaternion = Float[Tensor, "... 4"]
Twist = Float[Tensor, "... 6"]
SMALL = 1e-4  # of a squared sine: below it series to the third term are exact to round-off


def cross(a: Vector, b: Vector) -> Vector:
    """a x b along the last dimension; leading dimensions broadcast."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=-1)


def matvec(A: Matrix, x: Vector) -> Vector:
    """A x with A (..., 3, 3) and x (..., 3), written pointwise so that a sample's result never depends on its batch."""
    return (A * x.unsqueeze(-2)).sum(-1)


def hat(a: Vector) -> Matrix:
    """The skew matrix with hat(a) b = a x b."""
    x, y, z = a.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def inverse3(A: Matrix) -> Matrix:
    """Inverse of (..., 3, 3) by cofactors: pointwise, no pivoting; for the well-conditioned matrices of the strain balance."""
    a, b, c = A.unbind(-1)
    rows = torch.stack([cross(b, c), cross(c, a), cross(a, b)], -2)
    return rows / (a * cross(b, c)).sum(-1)[..., None, None]


def rotate(q: Quaternion, a: Vector) -> Vector:
    """q a q*, which is R(q) a, from the section frame into the base frame.

    Within a step |q| is not quite 1. In this form R(q e) = R(q) R(e) even then, so that a step does not depend on the frame in
    which it is seen.
    """
    t = 2.0 * cross(q[..., :3], a)
    return (q * q).sum(-1, keepdim=True) * a + q[..., 3:] * t + cross(q[..., :3], t)


def unrotate(q: Quaternion, a: Vector) -> Vector:
    """q* a q, which is R(q)^T a, from the base frame into the section frame."""
    t = 2.0 * cross(q[..., :3], a)
    return (q * q).sum(-1, keepdim=True) * a - q[..., 3:] * t + cross(q[..., :3], t)


def quaternion_rate(q: Quaternion, u: Vector) -> Quaternion:
    """q' = q (u, 0) / 2, the quaternion form of R' = R hat(u), with u (1/m) in the section frame."""
    w = q[..., 3:]
    vector = w * u + cross(q[..., :3], u)
    return 0.5 * torch.cat([vector, -(q[..., :3] * u).sum(-1, keepdim=True)], -1)


def normalized(q: Quaternion) -> Quaternion:
    """q / |q|."""
    return q / (q * q).sum(-1, keepdim=True).sqrt()


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """a b: first b, then a."""
    va, wa, vb, wb = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    return torch.cat([wa * vb + wb * va + cross(va, vb), wa * wb - (va * vb).sum(-1, keepdim=True)], -1)


def conjugate(q: Quaternion) -> Quaternion:
    """q*: of a unit quaternion the inverse."""
    return torch.cat([-q[..., :3], q[..., 3:]], -1)


def exponential(w: Vector) -> Quaternion:
    """The rotation by a rotation vector w (rad): [sin(|w| / 2) w / |w|, cos(|w| / 2)], by its series near zero."""
    t = 0.25 * (w * w).sum(-1, keepdim=True)
    small = t < SMALL
    half = torch.where(small, 1.0, t).sqrt()
    sinc = torch.where(small, 1 - t / 6 * (1 - t / 20 * (1 - t / 42)), torch.sin(half) / half)
    cosine = torch.where(small, 1 - t / 2 * (1 - t / 12 * (1 - t / 30)), torch.cos(half))
    return torch.cat([0.5 * sinc * w, cosine], -1)


def logarithm(q: Quaternion) -> Vector:
    """The rotation vector (rad) of a unit quaternion, no longer than pi: 2 atan2(|v|, w) v / |v|, by its series near zero."""
    q = torch.where(q[..., 3:] < 0, -q, q)
    v, w = q[..., :3], q[..., 3:]
    t = (v * v).sum(-1, keepdim=True)
    small = t < SMALL
    n = torch.where(small, 1.0, t).sqrt()
    x = t / (w * w).clamp(min=SMALL)
    series = 2 / w.clamp(min=SMALL) * (1 - x / 3 * (1 - 3 * x / 5 * (1 - 5 * x / 7)))
    return torch.where(small, series, 2 * torch.atan2(n, w) / n) * v


def turned(w: Vector, q: Quaternion) -> Quaternion:
    """exp(w) q, w (rad) in the base frame."""
    return product(exponential(w), q.expand(*w.shape[:-1], 4))


def identity_quaternion(shape: tuple[int, ...], like: Tensor) -> Quaternion:
    """Unit quaternions of no rotation, of shape (*shape, 4), with the dtype and device of `like`."""
    return like.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*shape, 4)


def move(zeta: Twist, p: Float[Tensor, "... P 3"]) -> Float[Tensor, "... P 3"]:
    """Rigid motion of points: exp(rotation) p + translation, with zeta = [translation (m), rotation vector (rad)] (..., 6).

    The derivative at zeta = 0 is exact (RoMa's series). Source: the registration twist of the paper, (2).
    """
    import roma

    R = roma.rotvec_to_rotmat(zeta[..., 3:])
    return matvec(R.unsqueeze(-3), p) + zeta[..., None, :3]
