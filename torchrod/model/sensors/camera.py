"""A camera: pixel coordinates of markers, with intrinsics, distortion and extrinsics by OpenCV's conventions."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, matvec, rotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, rows_of, shape_error, variance

ORTHONORMAL = 1e-4  # what a rotation matrix may miss by: that of a file with five digits
BEHIND = (
    "the rod is behind a camera; give rotation and translation from the base frame into the camera's frame, "
    "z forward, as OpenCV's solvePnP does"
)


@dataclass(frozen=True)
class Camera(Float64):
    """Pixel coordinates of P markers on B samples in one camera, two rows for each; several cameras are several sensors.

    s: (P,) m. pixels: (B, P, 2) px, NaN where a marker is not seen. noise: standard deviation of a coordinate (px), one number or
    one for each sample (B,). matrix: (3, 3) [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] px. rotation (3, 3), translation (3,) m: from the
    base frame into the camera's, x to the right, y down, z forward. distortion: (5,), k1, k2, p1, p2, k3; None: a pinhole. offsets:
    (P, 3) m, r, from the centre line in the section frame. With X = rotation (p(s) + R(s) r) + translation, x = X_1 / X_3,
    y = X_2 / X_3, q = x^2 + y^2 and d = 1 + k1 q + k2 q^2 + k3 q^3:

        u = fx (x d + 2 p1 x y + p2 (q + 2 x^2)) + cx,   v = fy (y d + p1 (q + 2 y^2) + 2 p2 x y) + cy

    One camera hardly tells the distance; what the rod can do, and its length, tell the rest, and the spreads say how well. A place
    behind the camera has no pixel: NaN. Errors: ValueError of `check`, and of a start where the unloaded rod is behind the camera.
    Source: OpenCV, Camera Calibration and 3D Reconstruction.
    """

    s: Float[Tensor, " P"]
    pixels: Float[Tensor, "B P 2"]
    noise: float | Float[Tensor, " B"]
    matrix: Float[Tensor, "3 3"]
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    distortion: Float[Tensor, "5"] | None = None
    offsets: Float[Tensor, "P 3"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "noise")

    @property
    def present(self) -> Bool[Tensor, "B P"]:
        """Which markers were seen."""
        return torch.isfinite(self.pixels).all(-1)

    @property
    def rows(self) -> int:
        """Two for each marker."""
        return 2 * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A marker's two rows."""
        return torch.arange(len(self.s)).repeat_interleave(2)

    def depth(self, p: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        """How far points (m) of the base frame are before the camera (m)."""
        return matvec(self.rotation, p)[..., 2] + self.translation[2]

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """u, v (px)."""
        p = rod.p if self.offsets is None else rod.p + rotate(rod.q, self.offsets)
        X, Y, Z = (matvec(self.rotation, p) + self.translation).unbind(-1)
        Z = torch.where(Z > 0, Z, torch.nan)
        x, y = X / Z, Y / Z
        if self.distortion is not None:
            k1, k2, p1, p2, k3 = self.distortion.unbind()
            q = x * x + y * y
            d = 1 + q * (k1 + q * (k2 + q * k3))
            x, y = x * d + 2 * p1 * x * y + p2 * (q + 2 * x * x), y * d + p1 * (q + 2 * y * y) + 2 * p2 * x * y
        K = self.matrix
        return torch.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], -1).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """As seen (px)."""
        return self.pixels.flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2."""
        return self.present.to(self.s.dtype).repeat_interleave(2, -1) / variance(self.noise)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """None: pixels are no distances."""
        return rows.new_empty(len(rows), 0, 3)

    def take(self, index: Int[Tensor, " b"]) -> "Camera":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "pixels", "noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "Camera":
        """The markers of these groups not seen."""
        return replace(self, pixels=self.pixels.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "Camera":
        """The same pixels of a camera in the frame p' = R p + t."""
        turned = self.rotation @ R.mT
        return replace(self, rotation=turned, translation=self.translation - matvec(turned, t))

    def check(self) -> None:
        """Shapes that belong together, a noise, intrinsics and extrinsics that a camera can have, a rod that can be before it."""
        P, B = self.s.numel(), len(self.pixels)
        own = {"matrix": (3, 3), "rotation": (3, 3), "translation": (3,), "distortion": (5,), "offsets": (P, 3)}
        if said := shape_error(self, {"s": (P,), "pixels": (B, P, 2), "noise": (B,)} | own):
            raise ValueError(f"{said} with {P} arc lengths and {B} samples")
        if not P or not B:
            raise ValueError("there are no pixels; give at least one sample with one marker")
        check_noise("Camera.noise", self.noise, "px")
        K, R = self.matrix, self.rotation
        if not float(torch.minimum(K[0, 0], K[1, 1])) > 0 or not bool((K[2] == K.new_tensor([0.0, 0.0, 1.0])).all()):
            raise ValueError("Camera.matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy positive")
        if not float((R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().max()) < ORTHONORMAL or not float(torch.linalg.det(R)) > 0:
            raise ValueError("Camera.rotation must be a rotation matrix: orthonormal, of determinant 1")
        if self.distortion is not None and not bool(torch.isfinite(self.distortion).all()):
            raise ValueError("Camera.distortion must be five finite numbers, k1, k2, p1, p2, k3")
        if not float(self.translation[2]) + float(self.s.max()) > 0:
            raise ValueError(f"{BEHIND} (the base at z = {float(self.translation[2]):.3g} m of its frame)")
