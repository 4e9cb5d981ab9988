// Flows in closed form: velocity, and the velocity gradient times a tangent. Double gyre (Shadden et al. 2005), Arnold-Beltrami-Childress flow
// (Dombre et al. 1986) and linear flows. Mirrors src/field/analytic.rs and src/flow/velocity.rs.
#pragma once
#include "common/base.cuh"

namespace rw {

RW_FN void sin_cos_pi(double x, double& sine, double& cosine) {
#if RW_DEVICE
    sincospi(x, &sine, &cosine);
#else
    double half_turns = std::nearbyint(2.0 * x), r = (x - 0.5 * half_turns) * 3.141592653589793238;
    int quarter = int(std::fmod(half_turns, 4.0) + 4.0) & 3;
    double s = std::sin(r), c = std::cos(r), a = quarter & 1 ? c : s, b = quarter & 1 ? s : c;
    sine = quarter & 2 ? -a : a;
    cosine = (quarter + 1) & 2 ? -b : b;
#endif
}
// sin and cos of pi x without their common sign, which is minus if the lowest bit of the result is set. Reduction to half a turn, unlike a
// quarter, never exchanges the two, which saves instructions. Minimax polynomials with errors of 4e-9 and 5e-8.
RW_FN uint32_t half_turn(float x, float& sine, float& cosine) {
    float shifted = x + 12582912.0f, r = x - (shifted - 12582912.0f), u = r * r;
    sine = fma_(fma_(fma_(fma_(0.077222246f, u, -0.59804645f), u, 2.5500316f), u, -5.1677069f), u, 3.1415926f) * r;
    cosine = fma_(fma_(fma_(fma_(0.22008065f, u, -1.3320939f), u, 4.0584513f), u, -4.9347955f), u, 1.0f);
#if RW_DEVICE
    return __float_as_uint(shifted);
#else
    uint32_t bits;
    std::memcpy(&bits, &shifted, 4);
    return bits;
#endif
}
RW_FN uint32_t half_turn(double x, double& sine, double& cosine) {
    sin_cos_pi(x, sine, cosine);
    return 0;
}
// -a if the lowest bit is set, else a.
RW_FN float signed_by(uint32_t bit, float a) {
#if RW_DEVICE
    return __uint_as_float(__float_as_uint(a) ^ (bit << 31));
#else
    return bit & 1u ? -a : a;
#endif
}
RW_FN double signed_by(uint32_t, double a) { return a; }

RW_FN void sin_cos(float x, float& sine, float& cosine) {
#if RW_DEVICE
    sincosf(x, &sine, &cosine);
#else
    sine = std::sin(x);
    cosine = std::cos(x);
#endif
}
RW_FN void sin_cos(double x, double& sine, double& cosine) {
#if RW_DEVICE
    sincos(x, &sine, &cosine);
#else
    sine = std::sin(x);
    cosine = std::cos(x);
#endif
}

// Constants of a form at one time.
template <class R> struct alignas(4 * sizeof(R)) Constants {
    R c[4];
};

enum Form { DOUBLE_GYRE = 0, ABC = 1, LINEAR = 2 };

template <int FORM> struct FormOf;

template <> struct FormOf<DOUBLE_GYRE> {
    static constexpr int D = 2;
    template <class R> static RW_FN void velocity(const R* k, const R (&x)[2], R (&v)[2]) {
        R ax = k[2] * x[0], slope = ax + ax + k[3], sf, cf, sy, cy;
        // Every term has one factor of x's angle, one of y's and one scale, so the scale takes both signs.
        const uint32_t sign = half_turn((ax + k[3]) * x[0], sf, cf) ^ half_turn(x[1], sy, cy);
        const R scale = signed_by(sign, k[0]);
        v[0] = -(scale * sf) * cy;
        v[1] = (scale * cf) * (sy * slope);
    }
    template <class R> static RW_FN void tangent(const R* k, const R (&x)[2], const R (&m)[2][2], R (&v)[2], R (&p)[2][2]) {
        R ax = k[2] * x[0], slope = ax + ax + k[3], sf, cf, sy, cy;
        const uint32_t sign = half_turn((ax + k[3]) * x[0], sf, cf) ^ half_turn(x[1], sy, cy);
        const R scale = signed_by(sign, k[0]), scale_pi = signed_by(sign, k[1]);
        R along = scale * cf * sy, across = sf * sy;
        v[0] = -(scale * sf) * cy;
        v[1] = along * slope;
        // -u_x = v_y = q, u_y = r, v_x = w
        R q = scale_pi * slope * (cf * cy), r = scale_pi * across, w = fma_(-r * slope, slope, along * (k[2] + k[2]));
        RW_UNROLL for (int c = 0; c < 2; c++) {
            p[0][c] = fma_(r, m[1][c], -(q * m[0][c]));
            p[1][c] = fma_(w, m[0][c], q * m[1][c]);
        }
    }
    // Turns constants relative to the start (k[2], k[3]: epsilon times sine and cosine of the phase since then) into those of a seed whose start
    // has the phase with this sine and cosine.
    template <class R> static RW_FN void start_at(R (&k)[4], R sine, R cosine) {
        k[2] = fma_(k[2], cosine, k[3] * sine);
        k[3] = R(1) - (k[2] + k[2]);
    }
};

template <> struct FormOf<ABC> {
    static constexpr int D = 3;
    template <class R> static RW_FN void velocity(const R* k, const R (&x)[3], R (&v)[3]) {
        R s[3], c[3];
        RW_UNROLL for (int i = 0; i < 3; i++) sin_cos(x[i], s[i], c[i]);
        v[0] = fma_(k[0], s[2], k[2] * c[1]);
        v[1] = fma_(k[1], s[0], k[0] * c[2]);
        v[2] = fma_(k[2], s[1], k[1] * c[0]);
    }
    template <class R> static RW_FN void tangent(const R* k, const R (&x)[3], const R (&m)[3][3], R (&v)[3], R (&p)[3][3]) {
        R s[3], c[3];
        RW_UNROLL for (int i = 0; i < 3; i++) sin_cos(x[i], s[i], c[i]);
        R asz = k[0] * s[2], acz = k[0] * c[2], bsx = k[1] * s[0], bcx = k[1] * c[0], csy = k[2] * s[1], ccy = k[2] * c[1];
        v[0] = asz + ccy;
        v[1] = bsx + acz;
        v[2] = csy + bcx;
        RW_UNROLL for (int j = 0; j < 3; j++) {
            p[0][j] = fma_(acz, m[2][j], -(csy * m[1][j]));
            p[1][j] = fma_(bcx, m[0][j], -(asz * m[2][j]));
            p[2][j] = fma_(ccy, m[1][j], -(bsx * m[0][j]));
        }
    }
};

// v = G x: saddle, rotation, shear.
template <> struct FormOf<LINEAR> {
    static constexpr int D = 2;
    template <class R> static RW_FN void velocity(const R* k, const R (&x)[2], R (&v)[2]) {
        // An infinite coordinate times a zero coefficient must give 0, not NaN.
        RW_UNROLL for (int i = 0; i < 2; i++)
            v[i] = (k[2 * i] == R(0) ? R(0) : k[2 * i] * x[0]) + (k[2 * i + 1] == R(0) ? R(0) : k[2 * i + 1] * x[1]);
    }
    template <class R> static RW_FN void tangent(const R* k, const R (&x)[2], const R (&m)[2][2], R (&v)[2], R (&p)[2][2]) {
        velocity(k, x, v);
        RW_UNROLL for (int i = 0; i < 2; i++)
            RW_UNROLL for (int c = 0; c < 2; c++) p[i][c] = fma_(k[2 * i], m[0][c], k[2 * i + 1] * m[1][c]);
    }
};

// Edge policies of flow::Boundary.
enum Boundary { STOP = 0, CLAMP = 1, PERIODIC = 2, UNBOUNDED = 3, ZERO = 4 };

// The flow's bounds: particles stop outside [low, high]; `box` is the domain. `rate`: radians of phase per unit of time, used if every seed has
// its own start.
template <class Real> struct ClosedData {
    Real low[3], high[3], box_low[3], box_high[3];
    double rate;
};

// Config: FORM, BOUNDARY, STARTS (the third coordinate of a seed is its start time).
template <class Config, class Real> struct ClosedFlow {
    using R = Real;
    using F = FormOf<Config::FORM>;
    static constexpr int D = F::D, C = F::D;
    static constexpr bool SETTLES = false;
    using Stage = Constants<R>;
    struct Step {
        Stage stage[3];
    };
    struct Memory {};
    const ClosedData<R>& data;
    const Stage* stages;
    // Sine and cosine of the phase at this seed's start.
    R sine, cosine;

    RW_FN ClosedFlow(const ClosedData<R>& data, const Stage* stages, const float (&seed)[3]) : data(data), stages(stages), sine(0), cosine(1) {
        if constexpr (Config::STARTS) {
            double s, c;
            sin_cos(data.rate * double(seed[2]), s, c);
            sine = R(s);
            cosine = R(c);
        }
    }

    RW_FN Step step(int n) const {
        Step step = {stages[2 * n], stages[2 * n + 1], stages[2 * n + 2]};
        if constexpr (Config::STARTS) RW_UNROLL for (int i = 0; i < 3; i++) F::start_at(step.stage[i].c, sine, cosine);
        return step;
    }
    RW_FN void start(const double (&seed)[3], R (&x)[D]) const { RW_UNROLL for (int k = 0; k < D; k++) x[k] = R(seed[k]); }
    RW_FN void first_tangent(const double (&)[3], R (&m)[D][C]) const {
        RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) m[i][c] = R(i == c);
    }
    RW_FN R separation(const double (&)[3], int, double difference_step) const { return R(2.0 * difference_step); }

    RW_FN R confine(int k, R x) const {
        R low = data.box_low[k], high = data.box_high[k];
        if (Config::BOUNDARY == CLAMP) return min_(max_(x, low), high);
        if (Config::BOUNDARY == PERIODIC) return x - (high - low) * floor_((x - low) / (high - low));
        return x;
    }
    // Returns true: a closed form has no missing velocity.
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[D], R (&v)[D], Memory&) const {
        R held[D];
        RW_UNROLL for (int k = 0; k < D; k++) held[k] = confine(k, x[k]);
        F::velocity(step.stage[stage].c, held, v);
        return true;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[D], const R (&m)[D][C], R (&v)[D], R (&p)[D][C], Memory&) const {
        R held[D], mm[D][C];
        RW_UNROLL for (int k = 0; k < D; k++) {
            held[k] = confine(k, x[k]);
            // The clamped velocity is constant along an axis if the particle is beyond its end.
            bool on = Config::BOUNDARY != CLAMP || held[k] == x[k];
            RW_UNROLL for (int c = 0; c < C; c++) mm[k][c] = on ? m[k][c] : R(0);
        }
        F::tangent(step.stage[stage].c, held, mm, v, p);
        return true;
    }
    RW_FN bool inside(const R (&x)[D]) const {
        bool in = true;
        if (Config::BOUNDARY == STOP || Config::BOUNDARY == ZERO) {
            RW_UNROLL for (int k = 0; k < D; k++) in = in && data.low[k] <= x[k] && x[k] <= data.high[k];
        } else {
            // Only NaN is outside, as in a comparison with infinite bounds.
            RW_UNROLL for (int k = 0; k < D; k++) in = in && !is_nan(x[k]);
        }
        return in;
    }
    RW_FN void settle(R (&)[D]) const {}
    RW_FN void settle_tangent(R (&)[D], R (&)[D][C]) const {}
    RW_FN void metric(const R (&)[D], const R (&m)[D][C], R (&out)[C][C]) const {
        RW_UNROLL for (int i = 0; i < C; i++) RW_UNROLL for (int c = 0; c < C; c++) out[i][c] = m[i][c];
    }
    // Domain coordinates of a state.
    RW_FN void arrival(const R (&x)[D], const float (&seed)[3], float (&out)[3]) const {
        RW_UNROLL for (int k = 0; k < 3; k++) out[k] = k < D ? float(x[k < D ? k : 0]) : seed[k];
    }
    RW_FN void coordinate_jacobian(const double (&)[3], const R (&)[D], double (&)[C][C]) const {}
};

}  // namespace rw
