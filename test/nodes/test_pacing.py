"""When work is due: the rhythm that physics and rendering follow, and commands in lockstep."""

import numpy as np
import pytest

from endo_sim_ros.nodes.pacing import CommandQueue, Pacer


def run(arrivals=(), seconds=10.0, period=0.04, poll=0.001, busy=0.0):
    """Times at which work ran when input came at the given times, and the delay of each input until it was used."""
    pacer, ran, delays, waiting = Pacer(), [], [], []
    arrivals, now = list(arrivals), 0.0
    while now < seconds:
        while arrivals and arrivals[0] <= now:
            waiting.append(arrivals.pop(0))
            pacer.note_input(now)
        if pacer.is_due(now, period):
            ran.append(now)
            delays += [now - arrival for arrival in waiting]
            waiting.clear()
            now += busy
        now += poll
    return np.array(ran), np.array(delays), pacer


def test_without_input_work_runs_once_a_period():
    ran, _, pacer = run()
    np.testing.assert_allclose(np.diff(ran), 0.04, atol=0.0011)
    assert len(ran) in (250, 251) and pacer.skipped == 0


@pytest.mark.parametrize("phase", [0.0, 0.01, 0.025, 0.039])
def test_work_meets_input_of_the_same_rate_whatever_its_phase(phase):
    ran, delays, _ = run(phase + np.arange(0, 10, 0.04))
    assert len(ran) == pytest.approx(250, abs=2)
    assert delays[10:].max() <= 0.0011


@pytest.mark.parametrize("phase", [0.0, 0.01, 0.02, 0.03])
@pytest.mark.parametrize("gap", [0.001, 0.01])
def test_the_inputs_of_two_sources_are_used_together(phase, gap):
    pacer, waiting, delays, ran = Pacer(), {}, [], 0
    events = sorted((phase + 0.04 * k + gap * arm, arm) for k in range(400) for arm in (0, 1))
    now = 0.0
    while now < 15.9:
        while events and events[0][0] <= now:
            _, arm = events.pop(0)
            pacer.note_input(now, arm)
            waiting.setdefault(arm, now)
        if pacer.is_due(now, 0.04):
            ran += 1
            delays += [now - since for since in waiting.values()]
            waiting.clear()
        now += 0.001
    assert ran == pytest.approx(15.9 / 0.04, abs=3) and pacer.skipped == 0
    assert max(delays[100:]) <= gap + 0.0021


def test_jitter_and_late_inputs_do_not_make_work_wait():
    rng = np.random.default_rng(0)
    jitter = rng.uniform(-0.01, 0.01, 250) + 0.015 * (rng.random(250) < 0.05)
    ran, delays, pacer = run(np.sort(0.03 + 0.04 * np.arange(250) + jitter))
    assert len(ran) == pytest.approx(250, abs=2) and pacer.skipped == 0
    assert np.percentile(delays, 97) <= 0.0011


@pytest.mark.parametrize("rate", [10.0, 23.0, 30.0, 60.0, 500.0])
def test_input_of_any_rate_does_not_change_the_average_rate(rate):
    ran, delays, pacer = run(np.arange(0, 10, 1 / rate))
    ahead = 0.04 * np.arange(len(ran)) - (ran - ran[0])
    assert -0.041 <= ahead.min() and ahead.max() <= 0.041, "never more than a period from the clock"
    assert pacer.skipped == 0
    assert delays.max() <= 0.042


def test_input_slightly_faster_than_the_rate_waits_once_in_a_while_instead_of_always():
    _, delays, pacer = run(np.arange(0, 30, 0.04 / 1.01), seconds=30.0)
    assert (delays > 0.0011).mean() < 0.02 and pacer.skipped == 0


def test_after_a_late_input_those_that_follow_do_not_wait():
    arrivals = 0.013 + 0.04 * np.arange(1000)
    arrivals[50::50] += 0.035  # so late that work runs without them
    _, delays, pacer = run(arrivals, seconds=40.0)
    assert (delays > 0.0011).mean() < 0.02 and pacer.skipped == 0


def test_input_that_came_while_nobody_asked_is_used_by_the_first_work():
    pacer, ran = Pacer(), []
    for k in range(200):  # asked eight times a period, with a stall from 0.4 to 0.48 s
        now = 0.005 * k
        if 0.4 < now < 0.48:
            continue
        due = [pacer.is_due(now, 0.04)]
        if k % 8 == 6 or now == 0.48:
            pacer.note_input(now)
            due.append(pacer.is_due(now, 0.04))
        ran += [now] * sum(due)
    assert np.diff(ran).min() > 0.02, "work ran without the input, and once more with it"


def test_two_sources_faster_than_the_rate_are_used_together():
    pacer, since, delays, now = Pacer(), {}, [], 0.0
    events = sorted((0.039 * k + gap * arm, arm) for k in range(400) for arm, gap in ((0, 0.0), (1, 0.01)))
    while events:
        while events and events[0][0] <= now:
            _, arm = events.pop(0)
            pacer.note_input(now, arm)
            since[arm] = now
        if pacer.is_due(now, 0.04):
            delays.append(now - max(since.values()))
            assert len(since) == 1 or abs(since[0] - since[1]) < 0.012, "one of the two is of the round before"
        now += 0.001
    assert np.mean(np.array(delays) > 0.0021) < 0.06


def test_slow_work_skips_and_never_queues():
    ran, _, pacer = run(busy=0.1)
    assert np.diff(ran).min() > 0.08
    assert len(ran) + pacer.skipped == pytest.approx(250, abs=4)


def test_a_clock_that_jumps_starts_the_rhythm_anew():
    pacer = Pacer()
    assert pacer.is_due(100.0, 0.04)
    assert not pacer.is_due(100.01, 0.04)
    assert pacer.is_due(5.0, 0.04)  # a simulated clock began again
    assert pacer.is_due(1000.0, 0.04) and not pacer.is_due(1000.01, 0.04)


def test_commands_are_taken_in_order_when_complete_and_others_are_given_up():
    queue, given_up = CommandQueue(frozenset("ab")), []
    note = lambda stamp, missing: given_up.append((stamp, missing))  # noqa: E731
    queue.put(20, "a", 1)
    queue.put(10, "a", 2)
    assert queue.take(note) is None and queue.missing() == (10, {"b"})
    queue.put(20, "b", 3)
    queue.put(20, "c", 4)
    queue.put(30, "b", 5)
    assert queue.take(note) == (20, {"a": 1, "b": 3, "c": 4})
    assert given_up == [(10, {"b"})]
    with pytest.raises(ValueError, match="stamps must grow"):
        queue.put(20, "a", 6)
    queue.put(30, "a", 7)
    assert queue.take(note) == (30, {"a": 7, "b": 5}) and queue.missing() is None
    queue.clear()
    queue.put(1, "a", 8)


def test_commands_that_wait_are_bounded():
    queue = CommandQueue(frozenset("ab"))
    with pytest.raises(ValueError, match="over 1000 commands wait; the oldest, of 0.000001 s"):
        for stamp in range(1, 2000):
            queue.put(stamp * 1000, "a", None)
