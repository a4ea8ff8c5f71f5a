"""A camera: intrinsics with lens distortion, pose, and the maps between pixels and rays."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.lenses import LENSES
from splatseg.core.lenses import CameraModel as CameraModel
from splatseg.core.options import Count, Positive
from splatseg.core.rigid import Similarity, check_rotation
from splatseg.errors import InputError, RangeError

_MAX_UNDISTORTED_GROWTH = 8.0
_OF_THE_LENS = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """One view: x right, y down, z forward (OpenCV); see ``docs/conventions.md``.

    The centre of the top-left pixel is (0.5, 0.5), so that ``cx = width / 2`` is the image centre.
    """

    width: Count
    """Pixels a row."""

    height: Count
    """Rows."""

    fx: Positive
    """Focal length in pixels, horizontally."""

    fy: Positive
    """Focal length in pixels, vertically."""

    cx: float
    """Principal point, pixels from the left edge of the image."""

    cy: float
    """Principal point, pixels from the top edge of the image."""

    cam_from_world: Float[Tensor, "4 4"]
    """Rigid transform into camera axes, float64. It may require a gradient."""

    model: CameraModel = "pinhole"
    """Lens model, see `core.lenses`."""

    distortion: tuple[float, ...] = ()
    """opencv: k1 k2 p1 p2 k3 k4 k5 k6; fisheye: k1 k2 k3 k4; mei: xi k1 k2 p1 p2;
    thin_prism_fisheye: k1 k2 p1 p2 k3 k4 s1 s2; pinhole: nothing. Missing trailing values are 0."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        lens = {"cx": (self.cx,), "cy": (self.cy,), "distortion": self.distortion}
        for name, numbers in lens.items():
            if not all(math.isfinite(number) for number in numbers):
                raise RangeError(f"{name}: expected finite numbers, got {numbers}.")
        count = LENSES[self.model].parameters
        if len(self.distortion) > count:
            raise InputError(
                f"distortion: {self.model} takes at most {count} values, "
                f"got {len(self.distortion)}."
            )
        padded = tuple(float(v) for v in self.distortion) + (0.0,) * count
        object.__setattr__(self, "distortion", padded[:count])
        pose = self.cam_from_world
        check_finite("cam_from_world", pose)
        check_rotation("cam_from_world", pose[:3, :3])
        if pose[3].detach().tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise RangeError(
                f"cam_from_world: expected a last row of 0 0 0 1, got {pose[3].tolist()}."
            )
        if not pose.requires_grad:
            object.__setattr__(self, "cam_from_world", pose.to(torch.float64))

    @classmethod
    def of_lens(cls, lens: tuple[Any, ...]) -> "Camera":
        """The camera at the origin that has this `lens`, looking along z."""
        fields = dict(zip(_OF_THE_LENS, lens, strict=True))
        return cls(**fields, cam_from_world=torch.eye(4, dtype=torch.float64))

    @property
    def lens(self) -> tuple[Any, ...]:
        """Everything but the pose. A key to what views of one camera share."""
        return tuple(getattr(self, name) for name in _OF_THE_LENS)

    @property
    def is_pinhole(self) -> bool:
        """True where straight lines stay straight: no distortion, or all of it zero."""
        if self.model in ("fisheye", "thin_prism_fisheye"):
            return False
        return not any(self.distortion)

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix in pixels, float64."""
        return torch.tensor(
            [[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64
        )

    @property
    def world_from_cam(self) -> Float[Tensor, "4 4"]:
        """Pose of the camera in the world: inverse of `cam_from_world`."""
        rotation = self.cam_from_world[:3, :3].T
        translation = -(rotation @ self.cam_from_world[:3, 3:])
        return torch.cat(
            (torch.cat((rotation, translation), dim=1), self.cam_from_world[3:]), dim=0
        )

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """Centre of projection in the world."""
        return self.world_from_cam[:3, 3]

    @boundary
    def project(
        self, points_world: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Pixels (u, v) and z-depth of world points, distortion included.

        Points on or behind the camera plane have pixels without meaning; look at the depth.
        """
        pose = self.cam_from_world.to(points_world)
        points_cam = points_world @ pose[:3, :3].T + pose[:3, 3]
        depth = points_cam[..., 2]
        safe = torch.where(depth.abs() < 1e-12, torch.full_like(depth, 1e-12), depth)
        plane = points_cam[..., :2] / safe.unsqueeze(-1)
        return self._pixels_from_plane(plane, distorted=False), depth

    @boundary
    def unproject(
        self, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        r"""Lift pixels of known z-depth to world points. Inverse of `project`.

        .. math:: X_{world} = R^\top (z \, d^{-1}(K^{-1} \tilde u) - t)

        Raises:
            ShapeError: If the leading axes differ.
            RangeError: If a depth is zero, negative or NaN.
        """
        check_shape("depth", depth, pixels.shape[:-1])
        if not bool((depth > 0).all()):
            raise RangeError("depth: expected positive z-depths, got one that is not.")
        plane = self._plane_from_pixels(pixels)
        points_cam = torch.cat((plane, torch.ones_like(plane[..., :1])), -1) * depth.unsqueeze(-1)
        pose = self.world_from_cam.to(points_cam)
        return points_cam @ pose[:3, :3].T + pose[:3, 3]

    @boundary
    def rays(
        self, pixels: Float[Tensor, "*batch 2"] | None = None
    ) -> tuple[Float[Tensor, "3"], Float[Tensor, "*batch 3"]]:
        """The centre and unit world directions of pixels; None is all centres, (H, W, 3)."""
        plane = self.plane_of_pixels() if pixels is None else self._plane_from_pixels(pixels)
        directions = torch.cat((plane, torch.ones_like(plane[..., :1])), -1)
        directions = directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
        pose = self.world_from_cam.to(directions)
        return pose[:3, 3], directions @ pose[:3, :3].T

    def plane_of_pixels(self) -> Float[Tensor, "height width 2"]:
        """Where the ray of every pixel's centre meets the plane z = 1 of the camera, float64.

        Kept for the last lenses, as a distortion is slow to invert: not to be changed.
        """
        return self._plane_of_pixels(self.lens)

    def pixel_centres(self) -> Float[Tensor, "height width 2"]:
        """Coordinates (u, v) of every pixel's centre, float64."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float64) + 0.5,
            torch.arange(self.width, dtype=torch.float64) + 0.5,
            indexing="ij",
        )
        return torch.stack((u, v), dim=-1)

    @boundary
    def undistort_pixels(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Where pixels would lie without distortion, same intrinsics."""
        return self._pixels_from_plane(self._plane_from_pixels(pixels), distorted=True)

    @boundary
    def distort_pixels(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Where undistorted pixels lie in the photograph. Inverse of `undistort_pixels`."""
        return self._pixels_from_plane((pixels - self._offset(pixels)) / self._focal(pixels))

    def undistorted(self) -> "Camera":
        """A pinhole camera that covers every pixel of this one, corners included.

        It has the same pose and focal length, so that resolution at the centre is kept; the
        image is as large as the outermost pixel asks for.

        Raises:
            InputError: If the view is so wide that the plane image would be more than 8 times
                wider or higher than the photograph.
        """
        if self.is_pinhole:
            return replace(self, model="pinhole", distortion=())
        u = torch.arange(self.width + 1, dtype=torch.float64)
        v = torch.arange(self.height + 1, dtype=torch.float64)
        border = torch.cat(
            (
                torch.stack((u, torch.zeros_like(u)), -1),
                torch.stack((u, torch.full_like(u, self.height)), -1),
                torch.stack((torch.zeros_like(v), v), -1),
                torch.stack((torch.full_like(v, self.width), v), -1),
            )
        )
        flat = self.undistort_pixels(border)
        # One pixel of margin, so that bilinear resampling finds all four neighbours.
        low = torch.floor(flat.amin(dim=0)) - 1
        high = torch.ceil(flat.amax(dim=0)) + 1
        width, height = (int(x) for x in (high - low).tolist())
        growth = max(width / self.width, height / self.height)
        if growth > _MAX_UNDISTORTED_GROWTH:
            raise InputError(
                f"camera: its view is too wide for a plane image ({width}x{height} pixels for a "
                f"photograph of {self.width}x{self.height}); crop the photographs first."
            )
        return replace(
            self,
            width=width,
            height=height,
            cx=self.cx - float(low[0]),
            cy=self.cy - float(low[1]),
            model="pinhole",
            distortion=(),
        )

    @boundary
    def resized(self, width: int, height: int) -> "Camera":
        """The same view on another pixel grid: all intrinsics scale, distortion stays."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    @boundary
    def moved(self, new_from_old: Similarity) -> "Camera":
        """The camera in a world that was moved by `new_from_old`; its image is the same."""
        old_from_new = new_from_old.inverse()
        pose = torch.eye(4, dtype=torch.float64)
        rotation = self.cam_from_world[:3, :3].double()
        # cam_from_new keeps unit scale: depths grow with the world, pixels do not change.
        pose[:3, :3] = rotation @ old_from_new.rotation.double()
        pose[:3, 3] = new_from_old.scale * (
            rotation @ old_from_new.translation.double() + self.cam_from_world[:3, 3].double()
        )
        return replace(self, cam_from_world=pose)

    def _focal(self, like: Tensor) -> Tensor:
        return torch.tensor([self.fx, self.fy], dtype=like.dtype, device=like.device)

    def _offset(self, like: Tensor) -> Tensor:
        return torch.tensor([self.cx, self.cy], dtype=like.dtype, device=like.device)

    @staticmethod
    @lru_cache(maxsize=2)
    def _plane_of_pixels(lens: tuple[Any, ...]) -> Tensor:
        camera = Camera.of_lens(lens)
        return camera._plane_from_pixels(camera.pixel_centres())

    def _plane_from_pixels(self, pixels: Tensor) -> Tensor:
        plane = (pixels - self._offset(pixels)) / self._focal(pixels)
        if self.is_pinhole:
            return plane
        return LENSES[self.model].undistort(plane, self.distortion)

    def _pixels_from_plane(self, plane: Tensor, *, distorted: bool = False) -> Tensor:
        """Pixels of plane points; `distorted` says that the points need no distortion."""
        if not distorted and not self.is_pinhole:
            plane = LENSES[self.model].distort(plane, self.distortion)
        return plane * self._focal(plane) + self._offset(plane)
