"""The folder of a policy that was trained: it holds one."""

from pathlib import Path

from endo_sim_ros.core.config import ConfigError


def check_free(folder: Path, *but: str) -> None:
    """Find out whether a policy can be trained into a folder: of several, whatever their kinds, one alone would be found there.

    Args:
        folder: Where.
        but: Files that may be there.

    Raises:
        ConfigError: If there is a policy, or what one is trained by.
    """
    for name in ("policy.npz", "keypoints.npz", "lerobot", "train_config.json"):
        if name not in but and (folder / name).exists():
            raise ConfigError(f"{folder / name} exists already; choose another folder or remove it first")
