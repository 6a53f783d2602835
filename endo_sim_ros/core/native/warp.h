// What our headers take from Warp's, for a compiler or an editor that reads one of them alone.
#pragma once
#if !defined(WP_NO_CRT)
#include <cmath>
#include <cstddef>
#define CUDA_CALLABLE
#define WP_FORCEINLINE inline __attribute__((always_inline))
#endif

#define ENDO_SIM_INLINE CUDA_CALLABLE WP_FORCEINLINE

// At the beginning of a function: which products and sums Clang may fuse, `off` (Warp's own choice), `on` (within a
// statement: the same code then rounds alike wherever it is inlined) or `fast`.
#if defined(__clang__)
#define ENDO_SIM_PRAGMA(text) _Pragma(#text)
#define ENDO_SIM_FUSE(mode) ENDO_SIM_PRAGMA(clang fp contract(mode))
#else
#define ENDO_SIM_FUSE(mode)
#endif
