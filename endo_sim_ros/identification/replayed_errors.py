"""Errors of the tool that derivatives by its place do not tell: copies that err as it may tell them, once, before the estimate."""

from dataclasses import replace

import numpy as np

from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.unknowns import Unknowns

_TREMBLES, _ABOUT = 4, 5  # copies whose tips err as measured ones do; steps over which what they tell is averaged
_PLACES = 8  # copies whose tool is a bit elsewhere all along


def learn_errors(seen: Observations, model: ForwardModel, unknowns: Unknowns, theta: np.ndarray) -> None:
    """Set `uneven`, `lasting` and `apart` of what was measured, as they are of tissue of numbers θ [P + 5]."""
    config, steps, held = unknowns.config, len(seen.experiment.tips), seen.closed_at >= 0
    plain = unknowns.copy(theta[: unknowns.count], theta[unknowns.count :][:3] * config.tip_offset)
    draws = np.random.default_rng(0).standard_normal((_TREMBLES, steps, 3))
    errors = seen.smoother @ (seen.experiment.tip_noise * draws)
    jogs = [*config.tip_step * np.eye(3), *errors, seen.rounded]
    # What is pressed tells where the tool stands, but not where the skin is; what is held tells neither.
    off = np.hypot(config.tip_offset * held.any(), config.surface_error) * np.random.default_rng(1).standard_normal((_PLACES, 3))
    copies = [plain, *(replace(plain, jog=jog) for jog in jogs), *(replace(plain, shift=plain.shift + each) for each in off)]
    told = seen.predicted(model.replay(seen.experiment, copies))
    told = told[1:] - told[0]
    by_tip, trembling, rounded, elsewhere = np.split(told, [3, 3 + _TREMBLES, len(jogs)])
    seen.uneven, seen.lasting = _unevenness(seen, by_tip / config.tip_step, errors, trembling)
    # Where a way bends, smoothing takes away in proportion to its width, and half the width still half of it.
    # What a jaw holds changes in jumps, and the grid is rough: both are beyond what derivatives by the place of the tool tell.
    beyond = elsewhere - np.where(held, 0, off @ by_tip / config.tip_step)
    seen.apart = np.concatenate([2 * rounded, beyond / np.sqrt(_PLACES)]).T


def _unevenness(seen: Observations, by_tip: np.ndarray, errors: np.ndarray, told: np.ndarray) -> tuple[np.ndarray, float]:
    """Variance of each number [N], if it is a force, by errors of single tips, beyond what derivatives by the place of all tips tell; and
    the share of it that lasts as these errors do: the smoother of tips takes less away of that than of what is other from step to step.

    Skin sticks to a tool: one that trembles across it drags at it, while one that is elsewhere all along does not. What copies tell of the
    three axes is averaged, and over some steps.

    Args:
        seen: What was measured.
        by_tip: Derivatives by the place of all tips [3, N], per m.
        errors: Smoothed errors that were drawn [K, T, 3], m.
        told: What they make of the numbers [K, N].
    """
    forces = seen.of_forces()
    steps, count = seen.steps[forces], len(seen.experiment.tips)
    left = np.zeros((len(told), count, 3))
    left[:, steps, seen.axes[forces]] = (told - np.einsum("kna,an->kn", errors[:, seen.steps], by_tip))[:, forces]
    around = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= _ABOUT // 2
    sums, numbers = (around @ each for each in ((left**2).mean(0).sum(1), np.bincount(steps, minlength=count)))
    rough = np.eye(count) - seen.smoother
    of_all, of_smooth, of_this = (
        float(((rough @ each) ** 2).sum() / max((each**2).sum(), 1e-30))
        for each in (np.eye(count), seen.smoother, left.swapaxes(0, 1).reshape(count, -1))
    )
    lasting = float(np.clip((of_all - of_this) / (of_all - of_smooth), 0, 1)) if of_all > of_smooth else 0.0
    return np.where(forces, (sums / np.maximum(numbers, 1))[seen.steps], 0.0), lasting
