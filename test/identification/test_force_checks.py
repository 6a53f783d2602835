"""Sensors that are clipped, told by forces of presses alone."""

import numpy as np
import pytest

from endo_sim_ros.identification.force_checks import check_clipped

NOISE, ALONG = 0.05, np.array([0.3, 0.1, -0.95])
DEPTHS = np.interp(np.arange(60), [0, 8, 20, 40, 52, 60], [0, 0, 0.006, 0.006, 0, 0])  # m


def model():
    """Forces of a press with a hold [T, 3], N."""
    return (4e4 * DEPTHS**2 + 100 * DEPTHS)[:, None] * ALONG


def told(change, seeds=range(20), presses=3):
    """Share of cases in which presses whose forces a function makes of those of the model are told."""
    said = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        felt = [change(0.7 * model()) + NOISE * rng.standard_normal((60, 3)) for _ in range(presses)]
        said.append(check_clipped(felt, [model()] * presses, [NOISE] * presses))
    return np.mean([bool(each) for each in said]), said


@pytest.mark.parametrize("limit", [0.5, 0.9])
@pytest.mark.parametrize(("presses", "least"), [(1, 0.4), (3, 0.9)])
def test_a_clipped_sensor_is_told(limit, presses, least):
    def by_size(forces):
        size = np.linalg.norm(forces, axis=1, keepdims=True)
        return forces * np.minimum(1, limit / np.maximum(size, 1e-9))

    for clip in (by_size, lambda forces: forces.clip(-limit, limit)):
        share, said = told(clip, presses=presses)
        assert share >= least
        (text,) = next(each for each in said if each)
        level = float(text.split("forces stop at ")[1].split(" ")[0])
        assert level == pytest.approx(limit, rel=0.2) and "clipped?" in text


def test_a_plateau_that_another_press_goes_beyond_is_none_of_the_sensor():
    rng, presses = np.random.default_rng(0), [0.7 * model() for _ in range(2)]
    clipped, other = (each + NOISE * rng.standard_normal((60, 3)) for each in (presses[0].clip(-0.5, 0.5), presses[1]))
    assert check_clipped([clipped], [model()], [NOISE])
    assert not check_clipped([clipped, other], [model()] * 2, [NOISE] * 2)


def relaxing(forces):
    """Those of tissue that loses half of its force within 0.4 s."""
    fast, out = np.zeros(3), []
    for before, after in zip(np.vstack([forces[:1], forces]), forces):
        fast = fast * np.exp(-0.1) + after - before
        out.append(0.5 * after + 0.5 * fast)
    return np.array(out)


def elsewhere(shift):
    """Those of a tool that is deeper (m) than it is said to be."""
    depths = np.maximum(DEPTHS + shift * (DEPTHS > 0), 0)
    return lambda _: 0.7 * (4e4 * depths**2 + 100 * depths)[:, None] * ALONG


@pytest.mark.parametrize(
    "change",
    [
        lambda forces: forces,
        relaxing,
        lambda forces: np.roll(forces, 1, axis=0),
        lambda forces: np.roll(forces, -1, axis=0),
        lambda forces: np.abs(forces) ** 0.7 * np.sign(forces),
        lambda forces: 0 * forces,
        lambda forces: np.nan * forces,
        elsewhere(0.002),
        elsewhere(-0.002),
    ],
    ids=["good", "relaxing", "late", "early", "softening", "no force", "not measured", "deeper", "less deep"],
)
def test_good_presses_with_a_hold_are_not(change):
    share, said = told(change)
    assert share == 0, said
