"""Data that the model cannot explain: each is told in a sentence."""

from dataclasses import replace

import numpy as np
import pytest
from slab import HEAVY, SPACING, pressed, slab

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.identification import IdentificationConfig, IdentificationError, identify
from endo_sim_ros.identification.synthetic import measure
from endo_sim_ros.identification.unknowns import Unknowns

pytestmark = pytest.mark.slow
PHYSICS = replace(HEAVY, density=9000.0)  # presses of 40 steps are slow enough for that
NODES = slab(7, half=3 * SPACING)
WIDER = slab(deep=3)  # its rim is farther from where the tool presses; with thicker layers it takes fewer nodes and substeps
CONFIG = IdentificationConfig(model_error=0.0, surface_error=0.0)


@pytest.fixture(scope="module")
def good():
    return measure(pressed(steps=40), NODES, PHYSICS, np.random.default_rng(0))


@pytest.fixture(scope="module")
def found(good):
    """What it tells."""
    return identify([good], NODES, PHYSICS, CONFIG, "cpu")


def findings(*experiments, config=CONFIG) -> str:
    return "\n".join(identify(experiments, NODES, PHYSICS, config, "cpu").findings)


def test_good_data_have_no_findings(found):
    assert not found.findings


def test_forces_of_the_opposite_sign_are_refused(good):
    with pytest.raises(IdentificationError, match="opposite sign"):
        findings(replace(good, forces=-good.forces))


def test_forces_in_another_frame_are_refused(good):
    with pytest.raises(IdentificationError, match=r"turned by 9\d°|turned by 8\d°"):
        findings(replace(good, forces=good.forces[:, [2, 0, 1]]))


def test_a_tool_that_never_touches_is_refused(good):
    away = replace(good, tips=good.tips - [0, 0, 0.05], forces=0 * good.forces)
    with pytest.raises(IdentificationError, match="never touches the tissue: it stays 5"):
        findings(away)
    with pytest.raises(IdentificationError, match="forces of up to 0.* N were measured, but the tool stays"):
        findings(replace(good, tips=good.tips - [0, 0, 0.05]))
    with pytest.raises(IdentificationError, match=r"forces of up to 0\.\d+ N were measured"):
        findings(replace(away, forces=np.nan * good.forces), replace(good, tips=good.tips - [0, 0, 0.05]))
    with pytest.raises(IdentificationError, match="is never present"):
        findings(replace(good, present=np.zeros(40, bool), forces=0 * good.forces))


def test_nothing_measured_is_refused(good):
    with pytest.raises(IdentificationError, match="nothing was measured"):
        findings(replace(good, forces=np.full((40, 3), np.nan)))


def test_forces_that_are_noise_alone_are_refused(good):
    for forces in (0 * good.forces, np.random.default_rng(1).normal(0, good.force_noise, good.forces.shape)):
        with pytest.raises(IdentificationError, match="would exert up to .* N on it, but no force beyond the noise of 0.05 N was measured"):
            findings(replace(good, forces=forces))


@pytest.mark.thorough
def test_experiments_with_the_opposite_sign_or_in_another_frame_are_refused_by_their_numbers(good):
    with pytest.raises(IdentificationError, match="experiment 2: measured forces point against"):
        findings(good, good, replace(good, forces=-good.forces))
    turned = replace(good, forces=good.forces[:, [2, 0, 1]])
    with pytest.raises(IdentificationError, match=r"^experiment 1: measured forces are turned by [89]\d°"):
        findings(good, turned, good)
    with pytest.raises(IdentificationError, match="^experiments 0, 2: measured forces are turned"):
        findings(turned, good, turned)
    with pytest.raises(IdentificationError, match="^measured forces are turned"):
        findings(turned, turned)


def test_forces_that_no_tissue_exerts_are_refused_at_once(good):
    with pytest.raises(IdentificationError, match=r"forces of up to \d+ N were measured, .* times what tissue of 4000 Pa .* their unit"):
        findings(replace(good, forces=1000 * good.forces))  # mN


def test_forces_of_another_unit_are_compared_with_the_tissue_that_was_estimated(good, found):
    with pytest.raises(IdentificationError, match=f"tissue of {found['young_modulus'].estimate:.4g} Pa, as it was estimated before,"):
        identify([replace(good, forces=1000 * good.forces)], NODES, PHYSICS, CONFIG, "cpu", start=found)


def test_a_sensor_that_drifts_is_told_and_not_taken_for_another_frame():
    soft, rng = replace(PHYSICS, young_modulus=1.5e3), np.random.default_rng(0)
    felt = [measure(pressed(x, steps=40), NODES, soft, rng) for x in (-0.006, 0.006)]
    drifting = [replace(each, forces=each.forces + np.linspace(0, 0.5, 40)[:, None] * [0.8, 0.6, 0]) for each in felt]
    found = identify(drifting, NODES, PHYSICS, CONFIG, "cpu")
    (told,) = found.doubts
    assert float(told.removeprefix("forces drift by up to ").split()[0]) == pytest.approx(0.5, abs=0.1) and not found.any_known


def test_going_on_needs_the_same_tissue_and_keeps_that_forces_were_felt(good, found):
    with pytest.raises(ConfigError, match="start is an estimate of other tissue"):
        identify([good], NODES, replace(PHYSICS, young_modulus=2 * PHYSICS.young_modulus), CONFIG, "cpu", start=found)
    moved = replace(good, forces=np.full((40, 3), np.nan), displacements=np.zeros((40, 1, 3)), nodes=np.array([0]))
    assert found["young_modulus"].told == identify([moved], NODES, PHYSICS, CONFIG, "cpu", start=found)["young_modulus"].told == "known"


@pytest.mark.thorough
def test_going_on_from_an_estimate_that_is_doubtful_is_doubtful():
    good = measure(pressed(steps=40), WIDER, PHYSICS, np.random.default_rng(0))
    late = identify([replace(good, forces=np.roll(good.forces, 5, axis=0))], WIDER, PHYSICS, CONFIG, "cpu")
    assert late.doubts and late.doubts == late.findings[: len(late.doubts)]
    then = identify([good], WIDER, PHYSICS, CONFIG, "cpu", start=late)
    assert then.doubts and "goes on from an estimate whose data" in then.findings[0] and not then.any_known


@pytest.mark.thorough
def test_contact_that_begins_elsewhere_than_before_is_not_taken_in(good, found):
    deep = replace(good, tips=good.tips + [0, 0, 0.003])
    then = identify([deep], NODES, PHYSICS, CONFIG, "cpu", start=found)
    assert then.odd == (0,) and not then.any_known
    assert any(text.startswith("experiment 0 contradicts what was known before") for text in then.doubts)


def test_an_inclusion_needs_all_experiments_at_once(good, found):
    config = replace(CONFIG, stiffness="inclusion", iterations=1)
    with pytest.raises(ConfigError, match="needs all experiments together"):
        identify([good], NODES, PHYSICS, config, "cpu", start=replace(found, parameters=Unknowns(NODES, PHYSICS, config, good.tips)))


def presses(physics, nodes=NODES):
    """In three places."""
    return [measure(pressed(x, steps=40), nodes, physics, np.random.default_rng(n)) for n, x in enumerate((-0.006, 0.0, 0.006))]


@pytest.fixture(scope="module")
def three():
    return presses(PHYSICS)


def moved(experiment, steps):
    """Its forces that many steps late."""
    return replace(experiment, forces=np.roll(experiment.forces, steps, axis=0))


def of_clocks(text):
    return [line for line in text.split("\n") if "measured forces come" in line]


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [-4, 4])
def test_a_lag_of_the_forces_is_told_with_the_option_that_takes_it_away(three, steps):
    for presses in (three, three[:1]):
        (told,) = of_clocks(findings(*[moved(each, steps) for each in presses]))
        side, delay = told.split(" the poses: record with one clock, or give force_delay ")
        assert side.endswith("after" if steps > 0 else "before") and float(delay) == pytest.approx(0.04 * steps, abs=0.02)


@pytest.mark.thorough
def test_a_lag_that_grows_is_told_as_clocks_that_run_apart(three):
    (told,) = of_clocks(findings(*[moved(each, 2 * number) for number, each in enumerate(three)]))
    assert "at first" in told and "run apart" in told and "force_delay" not in told
    last = told.split("at first and ")[1]
    assert last.split(" s ")[1].startswith("after") and float(last.split(" s ")[0]) == pytest.approx(0.16, abs=0.03)


@pytest.mark.thorough
def test_what_no_lag_explains_is_no_lag(three):
    broken = [replace(three[0], forces=three[0].forces * (np.arange(40) < 18)[:, None]), three[1]]  # a sensor dies
    assert not of_clocks(findings(*broken))


@pytest.mark.thorough
def test_contact_at_another_depth_is_told(good):
    told = findings(replace(good, tips=good.tips + [0, 0, 0.003]))
    assert "contact begins about" in told and "mm deeper than the surface" in told
    depth = float(told.split("about ")[1].split(" mm")[0])
    assert depth == pytest.approx(3, abs=1)


@pytest.mark.thorough
def test_a_tool_that_stands_elsewhere_in_one_experiment_alone_is_told_and_nothing_is_known(three):
    spoilt = [three[0], replace(three[1], tips=three[1].tips - [0, 0, 0.004]), three[2]]
    found = identify(spoilt, NODES, PHYSICS, IdentificationConfig(), "cpu")
    assert [text.split(",")[0] for text in found.doubts if "contradict" in text] == ["experiment 1 contradicts the others"]
    assert not any("leave it out" in text for text in found.doubts), "it is left out already"
    assert not found.any_known


@pytest.mark.thorough
def test_an_experiment_that_agrees_with_those_before_is_not_doubted(three):
    before = identify(three[:2], NODES, PHYSICS, IdentificationConfig(), "cpu")
    assert not identify(three[2:], NODES, PHYSICS, IdentificationConfig(), "cpu", start=before).doubts


@pytest.mark.thorough
def test_two_experiments_that_differ_contradict_each_other(three):
    softer = replace(three[1], forces=0.5 * three[1].forces)
    found = identify([three[0], softer], NODES, PHYSICS, CONFIG, "cpu")
    assert any("experiments 0 and 1 contradict each other" in text for text in found.doubts)


@pytest.mark.thorough
def test_tissue_that_relaxes_is_told_by_quick_presses_where_the_model_does_not():
    physics = replace(PHYSICS, relaxation=1.24, relaxation_time=1.1)
    relaxing = [measure(pressed(x, steps=32), NODES, physics, np.random.default_rng(n)) for n, x in enumerate((-0.006, 0.0, 0.006))]
    found = identify(relaxing, NODES, PHYSICS, IdentificationConfig(), "cpu")
    (told,) = [text for text in found.doubts if text.startswith("forces are those of tissue that relaxes")]
    assert not found.any_known
    assert float(told.split("young_modulus ")[1].split()[0]) == pytest.approx(found["young_modulus"].estimate, rel=0.05)
    modelled = identify(relaxing, NODES, physics, IdentificationConfig(), "cpu")
    assert not modelled.doubts and modelled["young_modulus"].low < 4e3 < modelled["young_modulus"].high


@pytest.mark.thorough
def test_a_press_of_tissue_that_does_not_relax_is_not_told_to():
    """Not by one that is too short to tell it from tissue that relaxes slowly, either, nor by a tool that stands where it well may."""
    nodes = slab()
    for seed in (3, 5):
        rng = np.random.default_rng(seed)
        stiff = measure(
            pressed(steps=40),
            nodes,
            replace(HEAVY, young_modulus=7e3),
            rng,
            offset=0.0005 * np.random.default_rng([1, seed]).standard_normal(3),
        )
        found = identify([stiff], nodes, HEAVY, IdentificationConfig(), "cpu")
        assert not found.findings and found["young_modulus"].low < 7e3 < found["young_modulus"].high


@pytest.mark.thorough
@pytest.mark.parametrize("away", [-0.003, 0.002])
def test_a_tool_that_stands_elsewhere_is_found_there(away):
    two = presses(PHYSICS, WIDER)[:2]
    found = identify([replace(each, tips=each.tips + [0, 0, away]) for each in two], WIDER, PHYSICS, CONFIG, "cpu")
    modulus = found["young_modulus"]
    assert any(text.startswith("contact begins about") for text in found.findings)
    assert modulus.told == "known" and modulus.low < 4e3 < modulus.high
    assert found.tip_offset[2] == pytest.approx(-away, abs=0.0005)
    one = replace(two[1], tips=two[1].tips + [0, 0, away])
    then = identify([one], WIDER, PHYSICS, CONFIG, "cpu", start=found)
    assert any(text.startswith("contact begins about") for text in then.findings), "it still stands there"


def broken(experiment, how):
    """The experiment with forces that are not what they are taken for."""
    rising = np.arange(len(experiment.forces))[:, None] < 16
    forces = {
        "dead": experiment.forces * rising,
        "shaken": experiment.forces + 0.3 * np.sin(np.arange(40))[:, None] * [1, 0, 0],
        "late": np.roll(experiment.forces, 5, axis=0),
    }
    return replace(experiment, forces=forces[how])


@pytest.mark.thorough
@pytest.mark.parametrize("how", ["dead", "shaken", "late"])
def test_nothing_is_known_by_data_that_a_finding_says_are_wrong(three, how):
    found = identify([broken(each, how) for each in three], NODES, PHYSICS, CONFIG, "cpu")
    assert found["young_modulus"].told == "not told by these data" and not found.known.any() and not found.any_known and found.findings
    assert not any("rests on what was thought before" in text for text in found.findings)


@pytest.mark.thorough
def test_nothing_is_known_by_a_sensor_that_is_clipped_where_a_softer_tissue_would_explain_it(three):
    stiff = [measure(replace(each, forces=0 * each.forces), NODES, replace(PHYSICS, young_modulus=8e3), np.random.default_rng(n))
             for n, each in enumerate(three[:2])]  # fmt: skip
    sizes = [np.linalg.norm(each.forces, axis=1, keepdims=True) for each in stiff]
    limit = 0.6 * max(size.max() for size in sizes)
    found = identify([replace(each, forces=each.forces * np.minimum(1, limit / np.maximum(size, 1e-9)))
                      for each, size in zip(stiff, sizes)], NODES, PHYSICS, CONFIG, "cpu")  # fmt: skip
    (told,) = [text for text in found.doubts if text.startswith("forces stop at ")]
    assert float(told.split(" N ")[0].split()[-1]) == pytest.approx(limit, rel=0.1) and not found.any_known


@pytest.mark.thorough
def test_a_clipped_sensor_is_told_of_soft_tissue_too():
    """Where forces are a few times their noise."""
    rng = np.random.default_rng([2, 6])
    felt = [measure(pressed(x, steps=40), NODES, replace(PHYSICS, young_modulus=2.5e3), rng) for x in (-0.006, 0.0, 0.006)]
    sizes = [np.linalg.norm(each.forces, axis=1, keepdims=True) for each in felt]
    limit = 0.6 * max(size.max() for size in sizes)
    clipped = [replace(each, forces=each.forces * np.minimum(1, limit / size)) for each, size in zip(felt, sizes)]
    found = identify(clipped, NODES, PHYSICS, IdentificationConfig(), "cpu")
    assert [text.split(" at ")[0] for text in found.doubts] == ["forces stop"] and not found.any_known
    assert not of_clocks("\n".join(found.findings))


@pytest.mark.thorough
def test_nothing_is_known_by_an_estimate_that_did_not_settle_or_contact_beyond_the_scan():
    press = measure(pressed(-0.006, steps=40), NODES, HEAVY, np.random.default_rng(0))
    found = identify([replace(press, forces=8 * press.forces)], NODES, HEAVY, replace(CONFIG, iterations=1), "cpu")
    assert any("had not settled after 1 iterations" in text for text in found.findings) and not found.any_known
    assert any("above what was thought: check the units of forces and lengths" in text for text in found.findings)
    far = replace(press, tips=press.tips + [0, 0, 0.004])
    found = identify([far], NODES, HEAVY, replace(CONFIG, depth_scan=0.002), "cpu")
    assert any("mm or more deeper than" in text for text in found.doubts) and not found.any_known


def test_forces_that_nothing_explains_are_told_and_widen_intervals(good, found):
    spoilt = good.forces + 0.3 * np.sin(np.arange(40))[:, None] * [1, 0, 0]
    told = identify([replace(good, forces=spoilt)], NODES, PHYSICS, CONFIG, "cpu")
    assert any("does not explain the data" in each for each in told.findings)
    plain, wide = (each["young_modulus"] for each in (found, told))
    assert np.log(wide.high / wide.low) > 1.5 * np.log(plain.high / plain.low)


@pytest.fixture(scope="module")
def pulled():
    """Tissue that a jaw holds and lifts, and the physics of that."""
    steps = 40
    way = np.concatenate([np.zeros(5), np.linspace(0, 0.012, steps - 5)])
    pull = replace(
        pressed(), tips=np.array([0, 0, 0.1]) - way[:, None] * [0, 0, 1], rotations=np.tile(np.eye(3), (steps, 1, 1)),
        present=np.ones(steps, bool), closed=np.arange(steps) >= 3, forces=np.full((steps, 3), np.nan),
    )  # fmt: skip
    physics = replace(PHYSICS, contact_radius=0.0, force_radius=0.009)
    return measure(pull, NODES, physics, np.random.default_rng(0)), physics


def test_a_grasp_that_slips_is_told_and_left_out(pulled):
    whole, physics = pulled
    forces = whole.forces.copy()
    forces[25:] = 0.05 * np.random.default_rng(1).standard_normal((15, 3))
    found = identify([replace(whole, forces=forces)], NODES, physics, CONFIG, "cpu")
    told = [each for each in found.findings if "the grasp slipped" in each]
    assert len(told) == 1 and float(told[0].split("slipped ")[1].split(" s")[0]) == pytest.approx(1.0, abs=0.15)
    modulus = found["young_modulus"]
    assert modulus.low < 4e3 < modulus.high and modulus.estimate == pytest.approx(4e3, rel=0.1)


def test_grasps_that_all_slip_early_are_left_out_from_there_on_and_are_no_lag(pulled):
    whole, physics = pulled
    slips = [replace(whole, forces=np.where(np.arange(40)[:, None] < until, whole.forces, 0.0)) for until in (20, 22)]
    found = identify(slips, NODES, physics, CONFIG, "cpu")
    assert [each.startswith("the grasp slipped") for each in found.findings] == [True, True]
    assert found["young_modulus"].estimate == pytest.approx(4e3, rel=0.15)


def test_a_grasp_whose_force_was_not_measured_to_its_end_did_not_slip(pulled):
    whole, physics = pulled
    forces = whole.forces.copy()
    forces[25:] = np.nan
    assert not identify([replace(whole, forces=forces)], NODES, physics, CONFIG, "cpu").findings


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"forces": np.zeros((3, 3))}, "forces has shape"),
        ({"tips": np.full((40, 3), np.nan)}, "not finite"),
        ({"force_noise": 0.0}, "must be above 0"),
        ({"displacements": np.zeros((40, 1, 3))}, "need `nodes`"),
        ({"displacements": np.zeros((3, 1, 3)), "nodes": np.array([0])}, "displacements have shape"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(good, change, said):
    with pytest.raises(IdentificationError, match=said):
        findings(replace(good, **change))
    with pytest.raises(IdentificationError, match="no experiment"):
        identify([], NODES, PHYSICS, CONFIG, "cpu")


@pytest.mark.thorough
def test_steps_that_the_simulation_undid_are_told(good):
    shallow = replace(PHYSICS, travel=0.001)  # the press goes deeper than that
    told = identify([good], NODES, shallow, replace(CONFIG, iterations=1), "cpu").findings
    assert any(sentence.startswith("the simulation had to undo ") for sentence in told)
