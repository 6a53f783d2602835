"""What backends take and return: a scene, the settings of a picture, and gradients."""

from typing import NamedTuple

import torch
from torch import Tensor

from endo_sim_ros.splatting.constants import ABSOLUTE, EXTRAS, TILE


class Scene(NamedTuple):
    """N Gaussians, or as many for each camera, and C cameras; float32, contiguous, on one device. The terms are those of `rasterize`."""

    means: Tensor  # [N, 3] or [C, N, 3] m, world
    quats: Tensor | None  # [N, 4] wxyz
    scales: Tensor | None  # [N, 3] m
    covars: Tensor | None  # [N, 3, 3] or [C, N, 3, 3] m², world
    opacities: Tensor  # [N]
    sh: Tensor  # [N, K, 3] or [C, N, K, 3]
    extras: Tensor | None  # [C, N, 4]
    viewmats: Tensor  # [C, 4, 4] world to camera
    Ks: Tensor  # [C, 3, 3] pixels
    background: Tensor  # [3]

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians N that each camera sees."""
        return self.means.shape[-2]

    @property
    def splat_count(self) -> int:
        """Number of splats C·N."""
        return len(self.viewmats) * self.gaussian_count

    @property
    def per_camera(self) -> int:
        """Whether each camera has means and covariances of its own, 0 or 1."""
        return int(self.means.ndim == 3)

    def gaussian_arguments(self) -> list:
        """Return the first arguments of the kernels `project` and `project_backward`."""
        return [self.means, self.quats, self.scales, self.covars]


class Settings(NamedTuple):
    """How a scene is drawn."""

    width: int  # pixels
    height: int  # pixels
    near: float  # m
    eps2d: float  # pixel²
    median: bool  # whether medians are computed
    signed: bool = False  # whether gradients of the mean in the image are added up with their signs
    glints: float = -1.0  # sharpness of those that extras add to colours as light, in place of images of extras; -1: none

    @property
    def tiles_x(self) -> int:
        """Number of tiles in a row."""
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // TILE)

    def tile_count(self, scene: Scene) -> int:
        """Return the number of tiles of all cameras of a scene."""
        return len(scene.viewmats) * self.tiles_x * self.tiles_y


class Gradients(NamedTuple):
    """Gradients of a scene's tensors, shaped as those; None where there is no tensor, or the gradient is not wanted."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    sh: Tensor
    extras: Tensor | None
    camera_shares: Tensor | None  # [C, N, 4, 4] what each Gaussian adds to the gradient of each camera's viewmat
    image: Tensor | None  # [C, N, 2] Σ_pixels |∂L/∂mean2d|, or Σ_pixels ∂L/∂mean2d, 1/pixel

    @classmethod
    def empty(cls, scene: Scene, wants_pose: bool, wants_image: bool) -> "Gradients":
        """Return memory for the gradients of a scene, not initialised."""
        gradients = [None if x is None else torch.empty_like(x) for x in scene[:7]]
        size = (len(scene.viewmats), scene.gaussian_count)
        shares = scene.means.new_empty(*size, 4, 4) if wants_pose else None
        image = scene.means.new_empty(*size, 2) if wants_image else None
        return cls._make([*gradients, shares, image])

    def wants_absolute(self, settings: Settings) -> int:
        """Return whether absolute gradients of the mean in the image are wanted, 0 or 1."""
        return int(self.image is not None and not settings.signed)

    def arguments(self, settings: Settings) -> list:
        """Return the last arguments of the kernel `project_backward`."""
        column = -1 if self.image is None else 0 if settings.signed else ABSOLUTE
        return [int(self.camera_shares is not None), column, *self]


def empty_images(scene: Scene, settings: Settings) -> tuple[list[Tensor], Tensor]:
    """Return memory for images, not initialised.

    Returns:
        Colours [C, H, W, 3], depths, alphas and distortions [C, H, W], and extras [C, 4, H, W], [0] if there are none, or glints in
        their place; float32.
        Owners of the median depths, int32 [C, H, W], or [0] if medians are not wanted.
    """
    size = (len(scene.viewmats), settings.height, settings.width)
    images = [scene.means.new_empty(*size, 3)] + [scene.means.new_empty(size) for _ in range(3)]
    carried = 0 if scene.extras is None or settings.glints >= 0 else (size[0], EXTRAS, *size[1:])
    images.append(scene.means.new_empty(carried) if scene.gaussian_count else scene.means.new_zeros(carried))  # which nobody writes
    owners = torch.empty(size if settings.median else 0, dtype=torch.int32, device=scene.means.device)
    return images, owners
