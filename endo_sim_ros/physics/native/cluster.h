// Blocks of a GPU that work together as a thread block cluster (compute capability 9.0), in PTX. Nothing of it on a CPU.
//
// Shared memory is addressed as PTX does, from where it begins in a block, in fours of float32 (16 bytes).
#pragma once
#include "core/native/warp.h"

#if !defined(__CUDA_ARCH__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

namespace endo_sim {

// Until all threads of the cluster are here, and see what the others wrote.
ENDO_SIM_INLINE void wait_for_cluster()
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("barrier.cluster.arrive.release;" ::: "memory");
    asm volatile("barrier.cluster.wait.acquire;" ::: "memory");
#endif
}

// Until all threads of the block are here; those of a warp go on together.
ENDO_SIM_INLINE void wait_for_block()
{
#if defined(__CUDA_ARCH__)
    __syncthreads();
    __syncwarp();
#endif
}

// Where the shared memory begins that tiles take; the same in all blocks.
ENDO_SIM_INLINE int shared_memory()
{
#if defined(__CUDA_ARCH__)
    extern __shared__ char memory[];
    return (int)__cvta_generic_to_shared(memory);
#else
    return 0;
#endif
}

template <class Four> ENDO_SIM_INLINE Four load_shared(int memory, int i)
{
    Four value;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
        : "=f"(value[0]), "=f"(value[1]), "=f"(value[2]), "=f"(value[3]) : "r"(memory + 16 * i) : "memory");
#endif
    return value;
}

template <class Four> ENDO_SIM_INLINE void store_shared(int memory, int i, const Four& value)
{
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.v4.f32 [%0], {%1, %2, %3, %4};"
        :: "r"(memory + 16 * i), "f"(value[0]), "f"(value[1]), "f"(value[2]), "f"(value[3]) : "memory");
#endif
}

// Two of them, at this address; others may use them after `wait_for_cluster`.
ENDO_SIM_INLINE void make_barriers(int barrier)
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    if (threadIdx.x == 0) {
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barrier) : "memory");
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barrier + 8) : "memory");
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
#endif
}

// Store in the shared memory of another block, and count it at that block's barrier.
template <class Four> ENDO_SIM_INLINE void send(int block, int memory, int i, const Four& value, int barrier)
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    unsigned int place, at;
    asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(place) : "r"(memory + 16 * i), "r"(block));
    asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(at) : "r"(barrier), "r"(block));
    asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v4.f32 [%0], {%1, %2, %3, %4}, [%5];"
        :: "r"(place), "f"(value[0]), "f"(value[1]), "f"(value[2]), "f"(value[3]), "r"(at) : "memory");
#endif
}

// Wait until that many fours have been sent to the barrier, which is used for the turn-th time; all threads of the block.
ENDO_SIM_INLINE void receive(int barrier, int count, int turn)
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    if (threadIdx.x == 0)
        asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" :: "r"(barrier), "r"(16 * count) : "memory");
    int done = 0;
    while (!done)
        asm volatile("{ .reg .pred p; mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2; selp.b32 %0, 1, 0, p; }"
            : "=r"(done) : "r"(barrier), "r"(turn & 1) : "memory");
    __syncwarp();
#endif
}

// Sum over a power of two of lanes so far apart; all lanes of the warp must be here.
template <int SIZE, class Vector> ENDO_SIM_INLINE Vector sum_of_lanes(Vector value, int apart, int lanes)
{
#if defined(__CUDA_ARCH__)
    __syncwarp();
    for (int offset = apart; offset < apart * lanes; offset *= 2)
        for (int c = 0; c < SIZE; ++c)
            value[c] += __shfl_xor_sync(0xffffffffu, value[c], offset);
#endif
    return value;
}

}  // namespace endo_sim
