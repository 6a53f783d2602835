"""The links of an instrument as tissue meets them: capsules that touch, jaws that hold, edges that cut."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from endo_sim_ros.instruments.shapes import Capsule

JAW_LINKS = "jaw_left", "jaw_right"


class PlacedLinks(NamedTuple):
    """Where the links of an instrument are, float64, m, in the frame of their poses."""

    starts: Tensor  # of capsules [..., K, 3]
    ends: Tensor  # [..., K, 3]
    jaws: Tensor  # hinge and tips of the left and the right jaw [..., 3, 3]; zero without jaws

    def edge(self, cutting: Tensor) -> np.ndarray:
        """Corners [C, 3] of the edge that capsules [K], of which these cut, are together one after the other, or else of closed jaws."""
        if cutting.any():
            return torch.cat([self.starts[cutting], self.ends[cutting][-1:]]).numpy()
        return np.stack([self.jaws[0].numpy(), self.jaws[1:].mean(0).numpy()])


class ToolLinks:
    """An instrument as tissue meets it.

    A jaw reaches from the start of the first capsule of its link to the end of the last; the hinge is half way between the starts.

    Args:
        capsules: Those of `build_instrument`, in the frames of their links.

    Raises:
        ValueError: If there is none, a number is not finite, a radius is not above zero, or there is one jaw alone.
    """

    def __init__(self, capsules: Sequence[Capsule]):
        if not capsules:
            raise ValueError("an instrument needs at least one capsule; build_instrument gives those of the known tools")
        points = np.array([[each.start, each.end] for each in capsules], np.float64).reshape(-1, 2, 3)
        radii = np.array([each.radius for each in capsules], np.float64)
        for capsule, good in zip(capsules, np.isfinite(points).all((1, 2)) & np.isfinite(radii) & (radii > 0)):
            if not good:
                raise ValueError(f"a capsule of link {capsule.link} must have finite ends and a radius above zero, got {capsule}")
        self.links = tuple(dict.fromkeys(each.link for each in capsules))
        """Names of the links in the order of the poses that `place` takes."""
        self.radii = torch.from_numpy(radii)  # [K] m
        jaws = [[i for i, each in enumerate(capsules) if each.link == link] for link in JAW_LINKS]
        if bool(jaws[0]) != bool(jaws[1]):
            raise ValueError(f"an instrument needs capsules of both links {' and '.join(JAW_LINKS)} or of neither")
        self.has_jaws = bool(jaws[0])
        cuts = torch.tensor([each.cuts for each in capsules])
        of_jaws = torch.tensor([each.link in JAW_LINKS for each in capsules])
        self.scissors = self.has_jaws and bool(cuts[of_jaws].all())
        """Whether its jaws are blades, which cut what lies between them when they close."""
        self.grasps = self.has_jaws and not self.scissors
        """Whether its jaws hold what lies between them."""
        self.wire = cuts & ~of_jaws
        """Capsules [K] of the edge that cuts when told to, none where that is the line between the jaws."""
        self.sharp = self.wire if self.wire.any() else of_jaws
        """Capsules [K] that do not push while they cut: they would keep off what they are to cut."""
        self._of = torch.tensor([self.links.index(each.link) for each in capsules])  # link of each capsule [K]
        self._points = torch.from_numpy(points)  # [K, 2, 3]
        self._on: dict[torch.device, tuple[Tensor, Tensor, Tensor]] = {}  # these two and the radii by device
        self._jaws = [(each[0], each[-1]) for each in jaws if each]  # first and last capsule of each
        self.jaw_radius = min((float(radii[last]) for _, last in self._jaws), default=0.0)
        """Of the jaws at their tips, m; zero without jaws."""

    def __len__(self) -> int:
        """Number of capsules K."""
        return len(self.radii)

    def _at(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        if device not in self._on:
            self._on[device] = self._of.to(device), self._points.to(device), self.radii.to(device)
        return self._on[device]

    def on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Radius, m, and number of the link of each capsule [K], on a device, copied there once."""
        of, _, radii = self._at(device)
        return radii, of

    def place(self, poses: Tensor) -> PlacedLinks:
        """Where capsules and jaws are when the links are at poses [..., L, 4, 4], float64, on any device."""
        of, points, _ = self._at(poses.device)
        own = poses[..., of, :, :]
        ends = (own[..., None, :3, :3] @ points[..., None])[..., 0] + own[..., None, :3, 3]  # [..., K, 2, 3]
        if self.has_jaws:
            (left, left_tip), (right, right_tip) = self._jaws
            hinge = 0.5 * (ends[..., left, 0, :] + ends[..., right, 0, :])
            jaws = torch.stack([hinge, ends[..., left_tip, 1, :], ends[..., right_tip, 1, :]], -2)
        else:
            jaws = poses.new_zeros(*poses.shape[:-3], 3, 3)
        return PlacedLinks(ends[..., 0, :], ends[..., 1, :], jaws)

    def order(self, tool: str, poses: Mapping[str, ArrayLike]) -> Tensor:
        """Poses of the links by name, others left out, as one tensor [L, 4, 4].

        Args:
            tool: Name of the tool, for errors.
            poses: Link-to-world transforms [4, 4], m.

        Raises:
            ValueError: If a link is missing, or a pose has a wrong shape or is not finite, or scales or mirrors.
        """
        missing = [link for link in self.links if link not in poses]
        if missing:
            raise ValueError(f"links of tool {tool!r}: {', '.join(missing)} missing; give poses of all of {', '.join(self.links)}")
        try:
            together = np.array([poses[link] for link in self.links], np.float64)
        except (TypeError, ValueError):
            together = np.zeros(0)
        if together.shape != (len(self.links), 4, 4) or not are_rigid(together):  # one of them is not
            together = np.array([rigid_pose(f"link {link} of tool {tool!r}", poses[link]) for link in self.links])
        return torch.from_numpy(together)


def are_rigid(poses: np.ndarray) -> bool:
    """Whether transforms [..., 4, 4] turn and shift only, and are finite."""
    R = poses[..., :3, :3]
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max()
    return bool(off < 1e-3 and np.isfinite(poses).all() and (np.linalg.det(R) > 0).all())


def rigid_pose(of: str, value: ArrayLike) -> np.ndarray:
    """A transform [4, 4] as float64.

    Args:
        of: What it is the pose of, for errors.
        value: The transform.

    Raises:
        ValueError: If it has a wrong shape, is not finite, or scales or mirrors.
    """
    try:
        pose = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"pose of {of} must be a finite 4×4 matrix, got {value!r:.80}") from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose of {of} must be a finite 4×4 matrix, got {pose.tolist()}")
    if not are_rigid(pose):
        raise ValueError(f"pose of {of} must turn and shift, not scale or mirror, got {pose.round(4).tolist()}")
    return pose
