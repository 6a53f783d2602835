"""The figures that the paper prints ("Efficient 3D Scene Reconstruction and Simulation from Sparse Endoscopic Views").

Of its own data and splits of it; it does not state the backbone of LPIPS, nor the unit, scaling and reference of the depth error.
"""

from typing import NamedTuple


class Printed(NamedTuple):
    """One row of a table of the paper for one split."""

    dataset: str
    split: str
    method: str  # ours, if it has one of that name
    psnr: float
    ssim: float
    lpips: float
    depth_rmse: float
    minutes: float | None  # of training, of all splits alike; the tables of StereoMIS and of the ablation have none

    @property
    def figures(self) -> dict[str, float]:
        """By the names of ours; LPIPS under both backbones."""
        same = {"lpips_alex": self.lpips, "lpips_vgg": self.lpips}
        time = {} if self.minutes is None else {"seconds": 60 * self.minutes}
        return {"psnr": self.psnr, "ssim": self.ssim, **same, "depth_rmse": self.depth_rmse, **time}


_SPLITS = ("1:49", "1:99", "two-views")
# (dataset, method): PSNR, SSIM, LPIPS and depth RMSE of each split
_TABLES = {
    ("SCARED", "EndoGaussian"): (25.44, 0.817, 0.382, 0.540, 23.52, 0.788, 0.398, 0.514, 20.32, 0.732, 0.417, 0.517),
    ("SCARED", "EndoGS"): (26.42, 0.840, 0.283, 0.363, 23.87, 0.796, 0.311, 0.377, 21.15, 0.742, 0.350, 0.381),
    ("SCARED", "3dgs"): (26.26, 0.847, 0.255, 0.319, 23.44, 0.801, 0.285, 0.337, 20.82, 0.743, 0.325, 0.317),
    ("SCARED", "MVSGaussian"): (25.67, 0.758, 0.334, 0.320, 24.06, 0.707, 0.363, 0.342, 22.20, 0.648, 0.404, 0.366),
    ("SCARED", "fsgs"): (26.18, 0.836, 0.343, 0.261, 24.28, 0.807, 0.352, 0.273, 22.07, 0.769, 0.364, 0.269),
    ("SCARED", "paper"): (27.19, 0.855, 0.254, 0.143, 25.28, 0.819, 0.279, 0.137, 22.94, 0.769, 0.307, 0.184),
    ("SCARED", "paper without virtual cameras"):
        (26.22, 0.848, 0.254, 0.333, 23.63, 0.803, 0.283, 0.325, 21.09, 0.745, 0.324, 0.320),
    ("SCARED", "paper without frequency"):
        (25.61, 0.822, 0.298, 0.216, 23.87, 0.794, 0.310, 0.251, 22.08, 0.750, 0.331, 0.229),
    ("SCARED", "paper without distortion"):
        (26.20, 0.847, 0.255, 0.328, 23.67, 0.803, 0.283, 0.334, 21.27, 0.747, 0.322, 0.321),
    ("SCARED", "paper without total variation"):
        (26.02, 0.847, 0.257, 0.340, 23.88, 0.803, 0.283, 0.350, 21.09, 0.744, 0.325, 0.315),
    ("StereoMIS", "EndoGaussian"): (21.65, 0.779, 0.351, 0.398, 20.71, 0.727, 0.355, 0.392, 19.08, 0.710, 0.382, 0.399),
    ("StereoMIS", "EndoGS"): (19.31, 0.676, 0.430, 0.463, 17.18, 0.627, 0.459, 0.341, 17.45, 0.628, 0.441, 0.364),
    ("StereoMIS", "3dgs"): (25.51, 0.800, 0.279, 0.337, 23.31, 0.738, 0.305, 0.305, 22.06, 0.727, 0.315, 0.304),
    ("StereoMIS", "MVSGaussian"): (19.95, 0.734, 0.370, 0.452, 18.69, 0.690, 0.403, 0.363, 17.90, 0.669, 0.414, 0.352),
    ("StereoMIS", "fsgs"): (21.28, 0.736, 0.402, 0.325, 20.80, 0.709, 0.364, 0.309, 18.91, 0.671, 0.377, 0.303),
    ("StereoMIS", "paper"): (27.23, 0.816, 0.261, 0.170, 24.20, 0.743, 0.300, 0.222, 23.39, 0.728, 0.309, 0.261),
}  # fmt: skip
_MINUTES = {"EndoGaussian": 3, "EndoGS": 5, "3dgs": 6, "MVSGaussian": 2, "fsgs": 4, "paper": 2}  # on SCARED, with a GeForce RTX 3090

PRINTED = [
    Printed(dataset, split, method, *values[4 * i : 4 * i + 4], minutes=_MINUTES.get(method) if dataset == "SCARED" else None)
    for (dataset, method), values in _TABLES.items()
    for i, split in enumerate(_SPLITS)
]
