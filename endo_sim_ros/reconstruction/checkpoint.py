"""Files of an interrupted training. Reading one runs no code that it holds, and takes no more memory than it is large."""

import contextlib
import pickle
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from endo_sim_ros.core.config import option_values
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.optimizer import parameters_of


def identity(config: ReconstructionConfig) -> dict[str, Any]:
    """The options that a training with the same views must have to go on from a checkpoint."""
    return {name: value for name, value in option_values(config).items() if name not in ("device", "hidden_below")}


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Context that makes a SequenceError of whatever its block raises: a damaged file can make the unpickler raise anything."""
    try:
        yield
    except SequenceError:
        raise
    except Exception as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise SequenceError(f"{path}: not a readable checkpoint ({reason})") from error


def write_checkpoint(state: dict[str, Any], path: str | Path) -> None:
    """Write the state of a training; what was there before stays until it is complete.

    Raises:
        OSError: If it cannot be written, as on a full disk; nothing is left of it then.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with written_whole(path) as partial:
            torch.save(state, partial)
    except (OSError, RuntimeError) as error:  # torch turns a full disk into a RuntimeError of its own lines of code
        writer = "inline_container" in str(error) or "PytorchStreamWriter" in str(error)
        reason = getattr(error, "strerror", None) or ("is the disk full?" if writer else str(error).splitlines()[0])
        raise OSError(f"{path}: the checkpoint cannot be written ({reason})") from error


def read_checkpoint(path: str | Path, config: ReconstructionConfig, device: str) -> dict[str, Any]:
    """The state that was written.

    Raises:
        SequenceError: If there is no such file, or it is not a checkpoint, or one of other options.
    """
    if not Path(path).is_file():
        raise SequenceError(f"{path}: there is no such checkpoint to go on from; start the training anew")
    with reading(path):
        state = _read_state(path, device)
        mine, theirs = identity(config), state["config"]
        differing = [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]
    if differing:
        raise SequenceError(f"{path}: the checkpoint was made with other options ({', '.join(differing)}); use the same or start anew")
    return state


def _read_state(path: str | Path, device: str) -> dict[str, Any]:
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
    written = {"config", "stamps", "iteration", "order", "generator", "noise", "model", "optimizer", "strategy", "seen", "motion"}
    written |= {"motion_optimizer", "light", "light_optimizer", "max_gaussians", "fading", "strongest", "without_depth"}
    if set(state) != written:
        raise ValueError("another version made it; start anew")
    if not isinstance(state["without_depth"], bool):
        raise ValueError("it does not say whether it has depth")
    optimizers = state["optimizer"], state["light_optimizer"], state["motion_optimizer"]  # moments of each parameter, by its name
    tensors = [
        *state["model"].values(),
        *state["light"].values(),
        *state["strategy"].values(),
        *state["motion"].values(),
        state["seen"],
        state["strongest"],
    ]
    tensors += [value for moments in optimizers for values in moments.values() for value in values.values()]
    if sum(tensor.numel() * tensor.element_size() for tensor in tensors) > size:  # views of less
        raise ValueError("it claims more than it holds")
    if any(tensor.dtype != torch.float32 or tensor.is_meta or not tensor.isfinite().all() for tensor in tensors):
        raise ValueError("its tensors are not of finite float32 numbers")
    parameters = parameters_of(GaussianModel(**state["model"]))  # none without Gaussians
    optimized = parameters | {name: state[of][name] for of in ("light", "motion") for name in state[f"{of}_optimizer"]}
    expected = {name: {"step": (), "exp_avg": x.shape, "exp_avg_sq": x.shape} for name, x in optimized.items()}
    found = {name: {key: x.shape for key, x in values.items()} for moments in optimizers for name, values in moments.items()}
    if not parameters or found != expected:
        raise ValueError("the state of the optimiser does not fit the model")
    if state["seen"].shape != state["model"]["means"].shape[:1]:
        raise ValueError("what its views see does not fit the model")
    gloss = state["model"].get("gloss")
    if state["strongest"].shape != ((0,) if gloss is None else (len(gloss), 2)):
        raise ValueError("how strong its lobes may be does not fit the model")
    return state
