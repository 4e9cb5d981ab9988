// Log-stretch: ln of the largest singular value of the flow map's gradient (Haller 2001; Shadden et al. 2005). The FTLE is this over |tau|.
// The singular value is in closed form in the plane and from Jacobi sweeps over the Cauchy-Green tensor in space. Mirrors src/flow/stretch.rs.
#pragma once
#include "common/base.cuh"

namespace rw {

// Largest absolute entry of a D x C matrix.
template <int D, int C, class R> RW_FN R largest(const R (&m)[D][C]) {
    R size = 0;
    RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) size = max_(abs_(m[i][c]), size);
    return size;
}

// A 2x2 matrix is the sum of a scaled rotation and a scaled reflection; sigma_max is the mean of their scales. No digits cancel.
template <class R> RW_FN R sigma_max(const R (&m)[2][2]) {
    R a = m[0][0] + m[1][1], b = m[0][1] - m[1][0], c = m[0][0] - m[1][1], d = m[0][1] + m[1][0];
    return (sqrt_(fma_(a, a, b * b)) + sqrt_(fma_(c, c, d * d))) * R(0.5);
}

// Cyclic Jacobi sweeps over the Cauchy-Green tensor stay accurate if the two largest eigenvalues nearly coincide.
template <class R> RW_FN R sigma_max(const R (&m)[3][3]) {
    R diagonal[3], off[3];
    RW_UNROLL for (int k = 0; k < 3; k++) {
        int i = k == 0 ? 1 : 0, j = k == 2 ? 1 : 2;
        diagonal[k] = fma_(m[0][k], m[0][k], fma_(m[1][k], m[1][k], m[2][k] * m[2][k]));
        // Entry k lies in neither row k nor column k.
        off[k] = fma_(m[0][i], m[0][j], fma_(m[1][i], m[1][j], m[2][i] * m[2][j]));
    }
    for (int sweep = 0; sweep < 5; sweep++) {
        RW_UNROLL for (int turn = 0; turn < 3; turn++) {
            const int p = turn == 2 ? 1 : 0, q = turn == 0 ? 1 : 2, r = 2 - turn;
            // t = tan of the smaller of the two angles that make entry (p, q) vanish.
            R twice = off[r] + off[r], difference = diagonal[q] - diagonal[p];
            R root = sqrt_(fma_(difference, difference, twice * twice));
            R t = (difference < R(0) ? -twice : twice) / (abs_(difference) + root + Limits<R>::tiny());
            R cosine = R(1) / sqrt_(fma_(t, t, R(1))), sine = t * cosine;
            diagonal[p] = fma_(-t, off[r], diagonal[p]);
            diagonal[q] = fma_(t, off[r], diagonal[q]);
            off[r] = 0;
            R rp = off[q], rq = off[p];
            off[q] = fma_(cosine, rp, -(sine * rq));
            off[p] = fma_(sine, rp, cosine * rq);
        }
    }
    return sqrt_(max_(max_(max_(diagonal[0], diagonal[1]), diagonal[2]), R(0)));
}

// Minus infinity for the zero matrix.
template <int C, class R> RW_FN R log_stretch(const R (&m)[C][C]) {
    R size = largest<C, C, R>(m), scale = R(1) / (R(0) < size ? size : R(1)), scaled[C][C];
    RW_UNROLL for (int i = 0; i < C; i++) RW_UNROLL for (int j = 0; j < C; j++) scaled[i][j] = m[i][j] * scale;
    return log_(sigma_max(scaled)) - log_(scale);
}

// Multiplies a tangent whose entries leave [2^-40, 2^40] by 2^-40 or 2^40 and counts that in `exponent`, so that it never overflows.
template <int D, int C, class R> RW_FN void rescale(R (&m)[D][C], R& exponent) {
    const R high = R(1099511627776.0), low = R(1.0 / 1099511627776.0);
    R size = largest<D, C, R>(m);
    bool small = size < low, large = high < size;
    if (small || large) {
        R factor = large ? low : high;
        RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) m[i][c] *= factor;
        exponent += large ? R(40) : R(-40);
    }
}

}  // namespace rw
