// Constitutive laws. One definition each, for every kernel: one node a lane.
//
// A law is a struct with a function `stress` from the deformation gradient F, Lamé's parameters and what is the same for the
// whole tissue (`Substep`) to the first Piola-Kirchhoff stress P = dψ/dF [Pa], exactly zero at F = 1, so that a rest state stays
// at rest bit for bit; it returns det F. Matrices are nine numbers, row by row. The energy density ψ of each law is in
// materials.py.
#pragma once
#include "core/native/lanes.h"
#include "physics/native/svd.h"

namespace endo_sim {

constexpr float LEAST_VOLUME = 0.05f;  // det F below which logarithm and quotients are held

// The cofactor matrix det(F) F⁻ᵀ, which singular F has as well; returns det F.
template <class T> ENDO_SIM_INLINE T cofactor_of(const T* F, T* out)
{
    ENDO_SIM_FUSE(on)
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            const int r1 = (r + 1) % 3, r2 = (r + 2) % 3, c1 = (c + 1) % 3, c2 = (c + 2) % 3;
            out[3 * r + c] = F[3 * r1 + c1] * F[3 * r2 + c2] - F[3 * r1 + c2] * F[3 * r2 + c1];
        }
    return dot<1>(F, out);
}

// Rotation of the polar decomposition F = R S by the singular value decomposition, whose factors are proper rotations.
ENDO_SIM_INLINE void decompose(const float* F, float* R)
{
    ENDO_SIM_FUSE(on)
    wp::mat33 one, U, V;
    wp::vec3 sigma;
    for (int i = 0; i < 9; ++i)
        one.data[i / 3][i % 3] = F[i];
    wp::svd3(one, U, sigma, V);
    for (int i = 0; i < 9; ++i) {
        float sum = 0.0f;
        for (int k = 0; k < 3; ++k)
            sum += U.data[i / 3][k] * V.data[i % 3][k];
        R[i] = sum;
    }
}

// Rotation R of the polar decomposition F = R S.
//
// Newton's iteration R ← (R + R⁻ᵀ)/2 (Higham 1986) for healthy F, which stays exact at the identity; near-singular and
// inverted F are decomposed.
template <class T> ENDO_SIM_INLINE void rotation_of(const T* F, T* R)
{
    ENDO_SIM_FUSE(on)
    T inverse[9];
    const T J = cofactor_of(F, inverse), size = dot(F, F) + dot(F + 3, F + 3) + dot(F + 6, F + 6);
    const auto healthy = J > 0.02f * size * root(size);  // 0.19 at rest; below 0.02 the iteration loses digits, measured
    for (int i = 0; i < 9; ++i)  // the identity where this cannot work
        R[i] = healthy ? F[i] : everywhere<T>(i % 4 == 0 ? 1.0f : 0.0f);
    for (int round = 0; round < 12; ++round) {
        const T half = 0.5f / cofactor_of(R, inverse);
        T change = {};
        for (int i = 0; i < 9; ++i) {
            const T next = 0.5f * R[i] + half * inverse[i];
            change += (next - R[i]) * (next - R[i]);
            R[i] = next;
        }
        if (!any(change >= 1e-9f))  // quadratic convergence: the next change would be below rounding
            break;
    }
    for (int lane = 0; lane < Lanes<T>::count; ++lane)
        if (!lane_of(healthy, lane)) {
            float one[9];
            for (int i = 0; i < 9; ++i)
                one[i] = lane_of(F[i], lane);
            decompose(one, one);
            for (int i = 0; i < 9; ++i)
                set_lane(R[i], lane, one[i]);
        }
}

// P = 2μ (F − R) + λ (J − 1) cof F (Stomakhin et al. 2012).
struct fixed_corotated {
    template <class T, class Substep> ENDO_SIM_INLINE static T stress(const T* F, T mu, T lam, const Substep&, T* P)
    {
        ENDO_SIM_FUSE(on)
        T R[9], cofactor[9];
        rotation_of(F, R);
        const T J = cofactor_of(F, cofactor), pressure = lam * (J - 1.0f);
        for (int i = 0; i < 9; ++i)
            P[i] = pressure * cofactor[i] + 2.0f * mu * (F[i] - R[i]);
        return J;
    }
};

// P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ; below LEAST_VOLUME the resistance is held, as the logarithm has no value there.
struct neo_hookean {
    template <class T, class Substep> ENDO_SIM_INLINE static T stress(const T* F, T mu, T lam, const Substep&, T* P)
    {
        ENDO_SIM_FUSE(on)
        T inverse_transpose[9];
        cofactor_of(F, inverse_transpose);
        const T J = dot(F, inverse_transpose), held = larger(J, everywhere<T>(LEAST_VOLUME)), log_J = logarithm(held);
        for (int i = 0; i < 9; ++i) {
            inverse_transpose[i] /= held;
            P[i] = mu * (F[i] - inverse_transpose[i]) + lam * log_J * inverse_transpose[i];
        }
        return J;
    }
};

// The law above with μ exp(a W) in place of μ, where W = tr FᵀF − 3 − 2 ln J is zero at rest and above it everywhere else (Fung
// 1967, Demiray 1972). The exponent grows up to a limit, and stays there: without it the stress and the speed of sound would too.
struct fung {
    template <class T, class Substep> ENDO_SIM_INLINE static T stress(const T* F, T mu, T lam, const Substep& substep, T* P)
    {
        ENDO_SIM_FUSE(on)
        T cofactor[9];
        const T J = larger(cofactor_of(F, cofactor), everywhere<T>(LEAST_VOLUME));
        const T W = dot(F, F) + dot(F + 3, F + 3) + dot(F + 6, F + 6) - 3.0f - 2.0f * logarithm(J);
        const T exponent = clamp(substep.stiffening * W, 0.0f, substep.largest_exponent);
        return neo_hookean::stress(F, mu * exp2<true>(1.44269504f * exponent), lam, substep, P);
    }
};

}  // namespace endo_sim
