// What our headers take from Warp for the singular value decomposition.
#pragma once
#include "core/native/warp.h"

#if !defined(WP_NO_CRT)  // for a compiler that only checks
namespace wp {
struct vec3 {
    float c[3];
};
struct mat33 {
    float data[3][3];
};
void svd3(const mat33& A, mat33& U, vec3& sigma, mat33& V);
}  // namespace wp
#endif
