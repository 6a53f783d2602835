"""C++ headers that Warp compiles into the kernels that use them.

A module of kernels names its headers at its top, and its native functions only call what the headers define::

    wp.set_module_options({"extra_build_options": native("splatting/native/tiles.h", TILE=TILE)})

    @wp.func_native("return endo_sim::lowest_bit(bits);")
    def lowest_bit(bits: wp.uint32) -> int: ...

Headers are C++17 in the namespace ``endo_sim``. Each can be compiled alone (``g++ -I endo_sim_ros -fsyntax-only``), takes
pointers and numbers rather than Warp's types, and includes others by their path in the package. `wp.ModuleBuildOptions`
is an experimental interface of Warp; it was seen with version 1.19.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import warp as wp

PACKAGE = Path(__file__).parents[1]
LANE_COUNT = 16  # numbers in a vector of a CPU, see vector.h: whoever counts out items of vectors passes it to `native`
_INCLUDE = re.compile(r'#include "(.+)"')


def native(*headers: str, **constants: float) -> wp.ModuleBuildOptions:
    """Return the Warp option ``extra_build_options`` that compiles headers into a module, for CPUs and GPUs.

    The text of the headers is part of the module's hash, so that an edit makes Warp compile anew.

    Args:
        headers: Paths in the package, e.g. ``splatting/native/tiles.h``.
        constants: Numbers that Python and the headers both define; the compiler stops where they differ.

    Raises:
        FileNotFoundError: If a header, or one that it includes, is not in the package.
    """
    seen: set[str] = set()
    lines = [line for header in headers if header not in seen for line in _expand(header, seen)]
    for name, value in constants.items():
        literal = f"{value!r}f" if isinstance(value, float) else str(value)
        lines.append(f'static_assert(endo_sim::{name} == {literal}, "{name} is {value} in Python and something else in {headers[0]}");')
    text = "\n".join(lines) + "\n"
    return wp.ModuleBuildOptions(extra_cpu_preamble=text, extra_cuda_preamble=text)


def _expand(header: str, seen: set[str]) -> Iterator[str]:
    """Lines of a header with those that it includes, each once, and marks that let a compiler's messages name file and line."""
    seen.add(header)
    path = PACKAGE / header
    if not path.is_file():
        raise FileNotFoundError(f"native: there is no header {path}; give a path in {PACKAGE}, and list new folders in setup.py")
    yield f'#line 1 "{header}"'
    for number, line in enumerate(path.read_text().splitlines(), 1):
        included = _INCLUDE.match(line)
        if included is None:
            yield "" if line.startswith("#pragma once") else line
        elif included[1] not in seen:
            yield from _expand(included[1], seen)
            yield f'#line {number + 1} "{header}"'
        else:
            yield ""
