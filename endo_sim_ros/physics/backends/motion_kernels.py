"""Functions for kernels: where tissue rests that breath and heart have moved.

A control node follows paths, each in common for an environment, by its own shares: it rests at X + Σ s p, with the gradient
I + Σ p ⊗ ∇s.
"""

import warp as wp


@wp.func
def rest_shift(follows: wp.array2d[wp.vec4], paths: wp.array2d[wp.vec3], b: int, p: int) -> wp.vec3:
    """How far control node p is moved in environment b, m: by its shares and their slopes of paths [M, P], with paths [B, P], m."""
    shift = wp.vec3()
    for i in range(follows.shape[1]):
        shift += follows[p, i][0] * paths[b, i]
    return shift


@wp.func
def rest_gradient(follows: wp.array2d[wp.vec4], paths: wp.array2d[wp.vec3], b: int, p: int) -> wp.mat33:
    """The deformation gradient of that."""
    F = wp.identity(3, float)
    for i in range(follows.shape[1]):
        F += wp.outer(paths[b, i], wp.vec3(follows[p, i][1], follows[p, i][2], follows[p, i][3]))
    return F
