"""C++ headers: that a compiler reads each alone, and that kernels are compiled anew when one is edited."""

import shutil
import subprocess

import numpy as np
import pytest
import warp as wp
from thorough import mostly_thorough

from endo_sim_ros.core import glint_kernels, native as loader
from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.native import LANE_COUNT, PACKAGE, native
from endo_sim_ros.instruments import drawing_kernels, resolving_kernels
from endo_sim_ros.physics.backends import cpu_kernels
from endo_sim_ros.reconstruction import ssim_kernels
from endo_sim_ros.rendering import behind_kernels
from endo_sim_ros.splatting import common_kernels, cuda_kernels

HEADERS = sorted(str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.h"))


def test_there_are_headers():
    assert "core/native/vector.h" in HEADERS


@pytest.mark.slow
@pytest.mark.parametrize("header", HEADERS)
def test_a_compiler_reads_each_header_alone(header):
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    # Functions with vectors of 16 numbers are inlined: how they would be passed does not matter.
    command = [compiler, "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", "-Wno-psabi", "-I", str(PACKAGE), "-x", "c++", "-"]
    done = subprocess.run(command, input=f'#include "{header}"\n', capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def answer(options: wp.ModuleBuildOptions) -> int:
    """What the function `answer` of a header returns in a kernel that is compiled with it."""

    @wp.func_native("return endo_sim::answer();")
    def ask() -> int: ...

    @wp.kernel(enable_backward=False, module="unique", module_options={"extra_build_options": options})
    def write(out: wp.array[int]):
        out[0] = ask()

    init_warp()
    out = wp.zeros(1, dtype=int, device="cpu")
    wp.launch(write, 1, [out], device="cpu")
    return int(out.numpy()[0])


@wp.func_native("return {endo_sim::sine(x), endo_sim::power(x, -1.7f)};")
def sine_and_power(x: float) -> wp.vec2: ...


@wp.kernel(enable_backward=False, module="unique", module_options={"extra_build_options": native("core/native/lanes.h")})
def evaluate(x: wp.array[float], out: wp.array[wp.vec2]):
    out[wp.tid()] = sine_and_power(x[wp.tid()])


def test_sines_and_powers_are_those_of_numpy():
    init_warp()
    x = np.concatenate([np.linspace(-1e3, 1e3, 9999), np.geomspace(1e-3, 1e3, 999)]).astype(np.float32)
    out = wp.zeros(len(x), dtype=wp.vec2, device="cpu")
    wp.launch(evaluate, len(x), [wp.array(x, dtype=float, device="cpu"), out], device="cpu")
    np.testing.assert_allclose(out.numpy()[:, 0], np.sin(x.astype(float)), atol=5e-6)
    np.testing.assert_allclose(out.numpy()[9999:, 1], x[9999:].astype(float) ** -1.7, rtol=5e-6)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A package with the headers inner.h, and outer.h, which includes it."""
    monkeypatch.setattr(loader, "PACKAGE", tmp_path)
    (tmp_path / "inner.h").write_text("#pragma once\nnamespace endo_sim { constexpr int INNER = 20; constexpr float HALF = 0.5f; }\n")
    text = '#pragma once\n#include "inner.h"\nnamespace endo_sim { inline int answer() { return INNER + 1; } }\n'
    (tmp_path / "outer.h").write_text(text)
    return tmp_path


def test_an_edited_header_makes_kernels_compile_anew(folder):
    assert answer(native("outer.h", "inner.h", INNER=20, HALF=0.5)) == 21
    (folder / "inner.h").write_text((folder / "inner.h").read_text().replace("20", "30"))
    assert answer(native("outer.h")) == 31


@pytest.mark.thorough
@pytest.mark.slow
def test_a_number_that_differs_between_python_and_a_header_stops_the_compiler(folder, capfd):
    with pytest.raises(Exception, match="build failed"):
        answer(native("outer.h", HALF=0.25))
    assert "HALF is 0.25 in Python" in capfd.readouterr().err


def test_python_and_headers_count_the_same_numbers_in_a_vector():
    shared = (wp.get_module_options(module)["extra_build_options"] for module in (common_kernels, glint_kernels))
    for options in (*shared, cpu_kernels.HEADER):
        assert f"endo_sim::LANE_COUNT == {LANE_COUNT}," in options.extra_cpu_preamble


def test_a_header_that_is_not_there_is_named(folder):
    (folder / "outer.h").write_text('#include "missing.h"\n')
    with pytest.raises(FileNotFoundError, match=r"no header .*missing\.h"):
        native("outer.h")


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    mostly_thorough([cuda_kernels, behind_kernels, common_kernels, ssim_kernels, drawing_kernels, resolving_kernels], 2),
    ids=lambda module: module.__name__.rsplit(".")[-1],
)
def test_kernels_for_gpus_compile_without_one(module, tmp_path):
    init_warp()
    wp.compile_aot_module(module, arch=75, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))
