"""Files of an interrupted training. Reading one runs no code that it holds, and takes no more memory than it is large."""

import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.optimizer import parameters_of


def write_checkpoint(state: dict[str, Any], path: str | Path) -> None:
    """Write the state of a training; what was there before stays until it is complete."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    torch.save(state, partial)
    partial.replace(path)


def read_checkpoint(path: str | Path, device: str) -> dict[str, Any]:
    """The state that was written.

    Raises:
        ValueError: If the file claims more than it holds, or its parts do not fit each other. A damaged file can make the unpickler
            raise anything else.
    """
    size = Path(path).stat().st_size
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > size:
            raise ValueError("it claims more than it holds")
        if archive.testzip() is not None:
            raise ValueError("it is damaged")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError:  # whose text advises to load it all the same
        raise ValueError("it holds other objects than tensors and numbers") from None
    written = {"config", "stamps", "iteration", "order", "generator", "noise", "model", "optimizer", "strategy", "light", "light_optimizer"}
    if set(state) != written:
        raise ValueError("another version made it; start anew")
    moments, lights = state["optimizer"], state["light_optimizer"]  # of each parameter, by its name
    tensors = [*state["model"].values(), *state["light"].values(), *state["strategy"].values()]
    tensors += [value for values in [*moments.values(), *lights.values()] for value in values.values()]
    if sum(tensor.numel() * tensor.element_size() for tensor in tensors) > size:  # views of less
        raise ValueError("it claims more than it holds")
    if any(tensor.dtype != torch.float32 or tensor.is_meta or not tensor.isfinite().all() for tensor in tensors):
        raise ValueError("its tensors are not of finite float32 numbers")
    parameters = parameters_of(GaussianModel(**state["model"]))  # none without Gaussians
    optimized = parameters | {name: state["light"][name] for name in lights}
    expected = {name: {"step": (), "exp_avg": x.shape, "exp_avg_sq": x.shape} for name, x in optimized.items()}
    if not parameters or {name: {key: x.shape for key, x in values.items()} for name, values in (moments | lights).items()} != expected:
        raise ValueError("the state of the optimiser does not fit the model")
    return state
