// Gridded flow on the sphere. The state is a unit vector in R^3 that moves with velocity / radius and is normalised after each step, so that
// poles are regular points. Its gradient is taken in the tangent plane. Mirrors src/flow/sphere.rs and src/flow/sphere_levels.rs.
#pragma once
#include "tracing/grid.cuh"

namespace rw {

template <class R> RW_FN R dot(const R (&a)[3], const R (&b)[3]) { return fma_(a[0], b[0], fma_(a[1], b[1], a[2] * b[2])); }

// Below this cosine of the latitude, longitude has no meaning.
template <class R> RW_FN R at_pole() { return R(1e-8); }

// Smallest distance from a row at a pole, in cells; as MIN_COLATITUDE of sphere.rs.
template <class R> RW_FN R min_colatitude() { return sizeof(R) == 4 ? R(1.0 / 1024.0) : R(1.0 / 1073741824.0); }

// A direction and its position on the grid.
template <class R> struct SpherePoint {
    R p[3], inverse_length, cosine, circle, place[2];
};
template <class R> RW_FN SpherePoint<R> sphere_point(const GridData<R>& data, const R (&x)[3]) {
    SpherePoint<R> h;
    h.inverse_length = R(1) / sqrt_(dot(x, x));
    RW_UNROLL for (int i = 0; i < 3; i++) h.p[i] = x[i] * h.inverse_length;
    R cosine = sqrt_(fma_(h.p[0], h.p[0], h.p[1] * h.p[1]));
    R ahead = fma_(data.turn[0], h.p[0], data.turn[1] * h.p[1]), aside = fma_(data.turn[0], h.p[1], -(data.turn[1] * h.p[0]));
    if (cosine < at_pole<R>()) ahead = 1;
    h.place[0] = fma_(atan2_(aside, ahead), data.per_radian[0], data.origin[0]);
    h.place[1] = fma_(atan2_(h.p[2], cosine), data.per_radian[1], data.origin[1]);
    // Beside a row at a pole the length of the circle of latitude follows from the position on the grid.
    h.place[1] = min_(max_(h.place[1], data.poles[0] + min_colatitude<R>()), data.poles[1] - min_colatitude<R>());
    const R beside = min_(h.place[1] - data.poles[0], data.poles[1] - h.place[1]), angle = beside / data.per_radian[1];
    h.cosine = max_(cosine, at_pole<R>());
    h.circle = beside < R(0.125) ? angle * fma_(angle * angle, R(-1.0 / 6.0), R(1)) : h.cosine;
    return h;
}

// Unit vectors to the east and north at a direction.
template <class R> RW_FN void basis(const GridData<R>& data, const R (&p)[3], R cosine, R (&b)[2][3]) {
    const R inverse = R(1) / cosine;
    const bool pole = cosine <= at_pole<R>();
    const R c = pole ? data.turn[0] : p[0] * inverse, s = pole ? data.turn[1] : p[1] * inverse;
    b[0][0] = -s;
    b[0][1] = c;
    b[0][2] = 0;
    b[1][0] = -(p[2] * c);
    b[1][1] = -(p[2] * s);
    b[1][2] = cosine;
}

constexpr double RADIAN = 3.14159265358979323846 / 180.0;

// Sines and cosines of a seed given in degrees.
struct Angles {
    double sin_lon, cos_lon, sin_lat, cos_lat;
    RW_FN explicit Angles(const double (&seed)[3])
        : sin_lon(sin(seed[0] * RADIAN)), cos_lon(cos(seed[0] * RADIAN)), sin_lat(sin(seed[1] * RADIAN)), cos_lat(cos(seed[1] * RADIAN)) {}
};

// Longitude (within 180 degrees of the grid's middle) and latitude of a direction, in degrees.
RW_FN void degrees(double a, double b, double c, double middle, float (&out)[3]) {
    const double longitude = atan2(b, a) / RADIAN;
    out[0] = float(longitude + 360.0 * round((middle - longitude) / 360.0));
    out[1] = float(atan2(c, sqrt(a * a + b * b)) / RADIAN);
}

// Tangential part of the velocity.
template <class R> RW_FN void tangential_velocity(const SpherePoint<R>& h, const R (&all)[4], R (&v)[3]) {
    const R across[3] = {all[0], all[1], all[2]}, radial = dot(h.p, across);
    RW_UNROLL for (int i = 0; i < 3; i++) v[i] = fma_(-radial, h.p[i], all[i]);
}

// Particles on the sphere. The state is a direction and, with levels (Config::N == 3), a height in mean distances between levels. A horizontal
// metre is a metre on the sphere's radius at every height, and the fourth stored component is the vertical velocity. Config as for Sampler, with
// COMPONENTS = N + 1.
template <class Config, class Real> struct SphereFlow {
    using R = Real;
    static constexpr bool LEVELS = Config::N == 3, SETTLES = true;
    static constexpr int N = Config::N, D = N + 1, C = N;
    using Field = Sampler<Config, R>;
    using Memory = typename Field::CellCache;
    using Step = GridStep<R>;
    const GridData<R>& data;
    const Step* steps;

    RW_FN SphereFlow(const GridData<R>& data, const Step* steps, const float (&)[3]) : data(data), steps(steps) {}
    RW_FN SpherePoint<R> at(const R (&x)[D], R (&place)[N]) const {
        const R p[3] = {x[0], x[1], x[2]};
        const SpherePoint<R> h = sphere_point(data, p);
        place[0] = h.place[0];
        place[1] = h.place[1];
        if constexpr (LEVELS) place[2] = x[3];
        return h;
    }
    // Radii per degree of longitude, degree of latitude and unit of height.
    RW_FN void scales(double cosine, double (&scale)[3]) const {
        scale[0] = RADIAN * (cosine > 1e-8 ? cosine : 1e-8);
        scale[1] = RADIAN;
        scale[2] = 1.0 / data.radius;
    }

    RW_FN Step step(int n) const { return steps[n]; }
    RW_FN void start(const double (&seed)[3], R (&x)[D]) const {
        const Angles a(seed);
        x[0] = R(a.cos_lat * a.cos_lon);
        x[1] = R(a.cos_lat * a.sin_lon);
        x[2] = R(a.sin_lat);
        if constexpr (LEVELS) x[3] = R((seed[2] - data.axes[2].first) / data.axes[2].spacing);
    }
    RW_FN void first_tangent(const double (&seed)[3], R (&m)[D][C]) const {
        const Angles a(seed);
        const double start[4][3] = {{-a.sin_lon, -a.sin_lat * a.cos_lon, 0}, {a.cos_lon, -a.sin_lat * a.sin_lon, 0}, {0, a.cos_lat, 0}, {0, 0, 1.0 / data.level}};
        RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) m[i][c] = R(start[i][c]);
    }
    RW_FN R separation(const double (&seed)[3], int axis, double difference_step) const {
        if constexpr (LEVELS) {
            double scale[3];
            scales(cos(seed[1] * RADIAN), scale);
            return R(2.0 * difference_step * scale[axis]);
        } else {
            const double arc = 2.0 * difference_step * RADIAN;
            return R(axis == 0 ? arc * cos(seed[1] * RADIAN) : arc);
        }
    }
    RW_FN void state_velocity(const SpherePoint<R>& h, const R (&all)[4], R (&v)[D]) const {
        R along[3];
        tangential_velocity(h, all, along);
        RW_UNROLL for (int i = 0; i < 3; i++) v[i] = along[i];
        if constexpr (LEVELS) v[3] = all[3];
    }
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[D], R (&v)[D], Memory& memory) const {
        R place[N];
        const SpherePoint<R> h = at(x, place);
        Sample<R, N> sample;
        const bool known = Field{data}.template interpolate<false>(step, stage, place, sample, memory);
        state_velocity(h, sample.velocity, v);
        return known;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[D], const R (&m)[D][C], R (&v)[D], R (&product)[D][C], Memory& memory) const {
        R place[N], b[2][3];
        const SpherePoint<R> h = at(x, place);
        Sample<R, N> sample;
        const bool known = Field{data}.template interpolate<true>(step, stage, place, sample, memory);
        const R across[3] = {sample.velocity[0], sample.velocity[1], sample.velocity[2]};
        const R radial = dot(h.p, across);
        basis(data, h.p, h.cosine, b);
        RW_UNROLL for (int c = 0; c < C; c++) {
            // Change of direction for a change of the state along the column.
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(h.p, column);
            R change[3], between[D];
            RW_UNROLL for (int i = 0; i < 3; i++) change[i] = fma_(-outward, h.p[i], column[i]) * h.inverse_length;
            const R longitude = dot(b[0], change) / h.circle * data.per_radian[0], latitude = dot(b[1], change) * data.per_radian[1];
            RW_UNROLL for (int i = 0; i < D; i++) {
                if constexpr (LEVELS) between[i] = fma_(longitude, sample.slopes[0][i], fma_(latitude, sample.slopes[1][i], m[3][c] * sample.slopes[N - 1][i]));
                else between[i] = fma_(longitude, sample.slopes[0][i], latitude * sample.slopes[1][i]);
            }
            // Derivative of V - p (p . V).
            const R level[3] = {between[0], between[1], between[2]};
            const R turned = dot(change, across) + dot(h.p, level);
            RW_UNROLL for (int i = 0; i < 3; i++) product[i][c] = fma_(-radial, change[i], fma_(-turned, h.p[i], between[i]));
            if constexpr (LEVELS) product[3][c] = between[3];
        }
        state_velocity(h, sample.velocity, v);
        return known;
    }
    RW_FN bool inside(const R (&x)[D]) const {
        R place[N];
        at(x, place);
        bool in = true;
        RW_UNROLL for (int k = 0; k < N; k++) in = in && data.low[k] <= place[k] && place[k] <= data.high[k];
        return in;
    }
    // Normalises the direction; returns the inverse of its former length.
    RW_FN R settle(R (&x)[D]) const {
        const R p[3] = {x[0], x[1], x[2]};
        const R inverse = R(1) / sqrt_(dot(p, p));
        RW_UNROLL for (int i = 0; i < 3; i++) x[i] *= inverse;
        return inverse;
    }
    RW_FN void settle_tangent(R (&x)[D], R (&m)[D][C]) const {
        const R inverse = settle(x);
        const R p[3] = {x[0], x[1], x[2]};
        RW_UNROLL for (int c = 0; c < C; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(p, column);
            RW_UNROLL for (int i = 0; i < 3; i++) m[i][c] = fma_(-outward, p[i], column[i]) * inverse;
        }
    }
    RW_FN void metric(const R (&x)[D], const R (&m)[D][C], R (&out)[C][C]) const {
        const R p[3] = {x[0], x[1], x[2]};
        R b[2][3];
        basis(data, p, max_(sqrt_(fma_(p[0], p[0], p[1] * p[1])), at_pole<R>()), b);
        RW_UNROLL for (int c = 0; c < C; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            out[0][c] = dot(b[0], column);
            out[1][c] = dot(b[1], column);
            if constexpr (LEVELS) out[2][c] = m[3][c] * R(data.level);
        }
    }
    RW_FN void arrival(const R (&x)[D], const float (&seed)[3], float (&out)[3]) const {
        degrees(double(x[0]), double(x[1]), double(x[2]), data.middle, out);
        out[2] = LEVELS ? float(data.axes[2].first + double(x[D - 1]) * data.axes[2].spacing) : seed[2];
    }
    RW_FN void coordinate_jacobian(const double (&seed)[3], const R (&x)[D], double (&j)[C][C]) const {
        const double cosine = cos(seed[1] * RADIAN), length = sqrt(double(x[0]) * double(x[0]) + double(x[1]) * double(x[1]));
        if constexpr (LEVELS) {
            double before[3], after[3];
            scales(cosine, before);
            scales(length, after);
            RW_UNROLL for (int i = 0; i < 3; i++) RW_UNROLL for (int c = 0; c < 3; c++) j[i][c] *= before[c] / after[i];
        } else {
            const double after = length > 1e-8 ? length : 1e-8;
            j[0][0] *= cosine / after;
            j[0][1] /= after;
            j[1][0] *= cosine;
        }
    }
};

}  // namespace rw
