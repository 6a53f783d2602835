"""Hostile checkpoints: one sentence, no code, and training goes on."""

import io
import pickle
import zipfile

import numpy as np
import pytest
import torch
from trained import trainer_of

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction import ReconstructionConfig


class Payload:
    """Unpickled, it leaves a file behind."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return open, (str(self.trace), "w")


@pytest.fixture(scope="module")
def trainer(small_frames):
    """A training that has begun."""
    config = ReconstructionConfig(iterations=20, max_gaussians=500, image_width=48, device="cpu")
    trainer = trainer_of(list(small_frames[:1]), config)
    trainer.step()
    return trainer


def bomb(data):
    """A checkpoint whose tensors are a hundred megabytes of zeros, in a tenth of a megabyte."""
    source, packed = zipfile.ZipFile(io.BytesIO(data)), io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in source.infolist():
            archive.writestr(entry.filename, bytes(10**8) if entry.filename.endswith("/data/0") else source.read(entry))
    return packed.getvalue()


def repacked(**changes):
    """Changes to the contents of a checkpoint."""

    def change(data, trace):
        state = torch.load(io.BytesIO(data))
        buffer = io.BytesIO()
        torch.save(state | {name: make(state[name], trace) for name, make in changes.items()}, buffer)
        return buffer.getvalue()

    return change


def huge(model, _):
    """Views of one number that claim to be a trillion Gaussians."""
    return {name: torch.zeros(1).expand(10**12, *tensor.shape[1:]) for name, tensor in model.items()}


def short_moments(optimizer, _):
    return optimizer | {"means": {name: value[:1] if value.ndim else value for name, value in optimizer["means"].items()}}


HOSTILE_CHECKPOINTS = {
    "payload": (repacked(order=lambda _, trace: Payload(trace)), "other objects than tensors and numbers"),
    "bare_pickle": (lambda _, trace: pickle.dumps(Payload(trace)), "not a zip file"),
    "truncated": (lambda data, _: data[:-100], "not a zip file"),
    "damaged": (lambda data, _: data[: len(data) // 2] + bytes(64) + data[len(data) // 2 + 64 :], "it is damaged"),
    "zip_bomb": (lambda data, _: bomb(data), "claims more than it holds"),
    "a_trillion_gaussians": (repacked(model=huge), "claims more than it holds"),
    "wrong_keys": (repacked(model=lambda model, _: {"means": model["means"]}), "missing 4 required"),
    "wrong_shapes": (repacked(model=lambda model, _: model | {"quats": model["means"]}), r"quats has shape \(\d+, 3\)"),
    "not_finite": (repacked(model=lambda model, _: model | {"means": model["means"] * np.nan}), "finite float32"),
    "other_optimiser": (repacked(optimizer=short_moments), "does not fit the model"),
    "other_views": (repacked(order=lambda *_: [7]), "names views"),
    "a_number": (repacked(config=lambda *_: 3), "not a readable checkpoint"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE_CHECKPOINTS)
def test_a_hostile_checkpoint_is_one_sentence_runs_no_code_and_leaves_the_training_alone(trainer, tmp_path, name):
    change, sentence = HOSTILE_CHECKPOINTS[name]
    path, trace = tmp_path / "checkpoint.pt", tmp_path / "trace"
    trainer.save_checkpoint(path)
    path.write_bytes(change(path.read_bytes(), trace))
    before = trainer.model.means
    with pytest.raises(SequenceError, match=f"checkpoint.pt: .*{sentence}") as caught:
        trainer.load_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    assert not trace.exists() and torch.equal(trainer.model.means, before)
    trainer.step()
    assert trainer.model.means.isfinite().all()
