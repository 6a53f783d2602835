// Four numbers in one piece, and sums and the like over threads of a GPU. On a CPU a launch has one thread at a time.
#pragma once
#include "core/native/warp.h"

namespace endo_sim {

template <class Four> ENDO_SIM_INLINE Four load_four(const Four* at)
{
#if defined(__CUDA_ARCH__)
    const float4 four = *reinterpret_cast<const float4*>(at);
    return Four(four.x, four.y, four.z, four.w);
#else
    return *at;
#endif
}

template <class Four> ENDO_SIM_INLINE void store_four(Four* at, const Four& value)
{
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(at) = make_float4(value[0], value[1], value[2], value[3]);
#else
    *at = value;
#endif
}

// Over the lanes of a warp, in the same order every time.
template <class T> ENDO_SIM_INLINE T lane_sum(T value)
{
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset /= 2)
        value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
}

// Over the threads of a block, all of which must be here, in the same order every time.
ENDO_SIM_INLINE double block_sum(double value)
{
#if defined(__CUDA_ARCH__)
    __shared__ double sums[32];
    value = lane_sum(value);
    __syncthreads();  // the sums before have been read
    if (threadIdx.x % 32 == 0)
        sums[threadIdx.x / 32] = value;
    __syncthreads();
    value = 0.0;
    for (int warp = 0; warp < blockDim.x / 32; ++warp)
        value += sums[warp];
#endif
    return value;
}

// The largest value of the threads of a block, all of which must be here.
ENDO_SIM_INLINE float block_max(float value)
{
#if defined(__CUDA_ARCH__)
    __shared__ float most[32];
    for (int offset = 16; offset > 0; offset /= 2)
        value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, offset));
    __syncthreads();
    if (threadIdx.x % 32 == 0)
        most[threadIdx.x / 32] = value;
    __syncthreads();
    for (int warp = 0; warp < blockDim.x / 32; ++warp)
        value = fmaxf(value, most[warp]);
#endif
    return value;
}

// What the first 64 threads of a block say, a bit for each; all threads must be here.
ENDO_SIM_INLINE unsigned long long block_bits(bool mine)
{
#if defined(__CUDA_ARCH__)
    __shared__ unsigned bits[2];
    const unsigned found = __ballot_sync(0xffffffffu, mine);
    __syncthreads();
    if (threadIdx.x % 32 == 0 && threadIdx.x < 64)
        bits[threadIdx.x / 32] = found;
    __syncthreads();
    return bits[0] | (unsigned long long)bits[1] << 32;
#else
    return mine;
#endif
}

}  // namespace endo_sim
