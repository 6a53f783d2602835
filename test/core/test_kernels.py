"""Launches that are recorded, and filled in again."""

import gc
import threading
import weakref

import torch
import warp as wp

from endo_sim_ros.core.kernels import launch

wp.set_module_options({"enable_backward": False})


@wp.struct
class Shift:
    by: float


@wp.kernel
def shifted(values: wp.array[wp.vec3], factor: float, shift: Shift, out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = factor * values[i] + wp.vec3(shift.by)


def shift_of(by):
    shift = Shift()
    shift.by = by
    return shift


def test_a_repeated_launch_works_on_the_tensors_and_numbers_that_it_is_given():
    one, kept = shift_of(1.0), []
    for factor, shift in ((2.0, one), (2.0, one), (3.0, one), (3.0, shift_of(-1.0))):
        values, out = torch.rand(5, 3), torch.zeros(5, 3)
        launch(shifted, 5, [values, factor, shift, out], "cpu")
        kept.append((out, factor * values + shift.by))
    for out, expected in kept:
        assert torch.allclose(out, expected)


def test_tensors_of_other_strides_are_another_launch():
    for values in (torch.rand(5, 3), torch.rand(5, 6)[:, :3]):
        out = torch.zeros(5, 3)
        launch(shifted, 5, [values, 1.0, shift_of(0.0), out], "cpu")
        assert torch.equal(out, values)


@wp.struct
class Held:
    values: wp.array[wp.vec3]


@wp.kernel
def copied(held: Held, out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = held.values[i]


def test_a_recorded_launch_keeps_no_memory_of_its_struct():
    values, out = torch.rand(5, 3), torch.zeros(5, 3)
    held = Held()
    held.values = wp.from_torch(values, dtype=wp.vec3)
    launch(copied, 5, [held, out], "cpu")
    assert torch.equal(out, values)
    memory = weakref.ref(held.values)
    del held
    gc.collect()
    assert memory() is None


def test_no_items_are_no_launch():
    launch(shifted, 0, [torch.zeros(0, 3), 1.0, shift_of(0.0), torch.zeros(0, 3)], "cpu")


def test_threads_do_not_write_to_each_others_tensors():
    shift, wrong = shift_of(0.0), []

    def repeat(number):
        values = torch.full((4000, 3), float(number))
        for _ in range(200):
            out = torch.zeros(4000, 3)
            launch(shifted, 4000, [values, 1.0, shift, out], "cpu")
            if not torch.equal(out, values):
                wrong.append(number)

    threads = [threading.Thread(target=repeat, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
