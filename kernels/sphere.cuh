// Gridded flow on the sphere: a unit vector is carried by velocity / radius, so that a pole is no singularity. As src/flow/sphere.rs.
#pragma once
#include "grid.cuh"

namespace rw {

template <class R> RW_FN R dot(const R (&a)[3], const R (&b)[3]) { return fma_(a[0], b[0], fma_(a[1], b[1], a[2] * b[2])); }

// Below this cosine of the latitude, longitude has no meaning.
template <class R> RW_FN R at_pole() { return R(1e-8); }

// As `least_colatitude` there.
template <class R> RW_FN R least_colatitude() { return sizeof(R) == 4 ? R(1.0 / 1024.0) : R(1.0 / 1073741824.0); }

// A direction, and its place on the grid.
template <class R> struct Here {
    R p[3], inverse_length, cosine, circle, place[2];
};
template <class R> RW_FN Here<R> here(const GridData<R>& data, const R (&x)[3]) {
    Here<R> h;
    h.inverse_length = R(1) / sqrt_(dot(x, x));
    RW_UNROLL for (int i = 0; i < 3; i++) h.p[i] = x[i] * h.inverse_length;
    R cosine = sqrt_(fma_(h.p[0], h.p[0], h.p[1] * h.p[1]));
    R ahead = fma_(data.turn[0], h.p[0], data.turn[1] * h.p[1]), aside = fma_(data.turn[0], h.p[1], -(data.turn[1] * h.p[0]));
    if (cosine < at_pole<R>()) ahead = 1;
    h.place[0] = fma_(atan2_(aside, ahead), data.per_radian[0], data.origin[0]);
    h.place[1] = fma_(atan2_(h.p[2], cosine), data.per_radian[1], data.origin[1]);
    // Beside a row at a pole the circle of latitude has the length that belongs to the place on the grid.
    h.place[1] = min_(max_(h.place[1], data.poles[0] + least_colatitude<R>()), data.poles[1] - least_colatitude<R>());
    const R beside = min_(h.place[1] - data.poles[0], data.poles[1] - h.place[1]), angle = beside / data.per_radian[1];
    h.cosine = max_(cosine, at_pole<R>());
    h.circle = beside < R(0.125) ? angle * fma_(angle * angle, R(-1.0 / 6.0), R(1)) : h.cosine;
    return h;
}

// East and north at a direction.
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

// Of a seed in degrees.
struct Angles {
    double sin_lon, cos_lon, sin_lat, cos_lat;
    RW_FN explicit Angles(const double (&seed)[3])
        : sin_lon(sin(seed[0] * RADIAN)), cos_lon(cos(seed[0] * RADIAN)), sin_lat(sin(seed[1] * RADIAN)), cos_lat(cos(seed[1] * RADIAN)) {}
};

// Longitude near the middle of the grid and latitude of a direction, degrees.
RW_FN void degrees(double a, double b, double c, double middle, float (&out)[3]) {
    const double longitude = atan2(b, a) / RADIAN;
    out[0] = float(longitude + 360.0 * round((middle - longitude) / 360.0));
    out[1] = float(atan2(c, sqrt(a * a + b * b)) / RADIAN);
}

// Velocity along the sphere: what points outward is left out.
template <class R> RW_FN void carry(const Here<R>& h, const R (&all)[4], R (&v)[3]) {
    const R across[3] = {all[0], all[1], all[2]}, radial = dot(h.p, across);
    RW_UNROLL for (int i = 0; i < 3; i++) v[i] = fma_(-radial, h.p[i], all[i]);
}

// Config as for Sampler, with N = 2 and COMPONENTS = 3.
template <class Config, class Real> struct SphereFlow {
    using R = Real;
    static constexpr int D = 3, C = 2;
    static constexpr bool SETTLES = true;
    using Field = Sampler<Config, R>;
    using Memory = typename Field::Memory;
    using Step = GridStep<R>;
    const GridData<R>& data;
    const Step* steps;

    RW_FN Step step(int n) const { return steps[n]; }
    RW_FN void start(const double (&seed)[3], R (&x)[3]) const {
        const Angles a(seed);
        x[0] = R(a.cos_lat * a.cos_lon);
        x[1] = R(a.cos_lat * a.sin_lon);
        x[2] = R(a.sin_lat);
    }
    RW_FN void first_tangent(const double (&seed)[3], R (&m)[3][2]) const {
        const Angles a(seed);
        m[0][0] = R(-a.sin_lon);
        m[0][1] = R(-a.sin_lat * a.cos_lon);
        m[1][0] = R(a.cos_lon);
        m[1][1] = R(-a.sin_lat * a.sin_lon);
        m[2][0] = R(0);
        m[2][1] = R(a.cos_lat);
    }
    RW_FN R separation(const double (&seed)[3], int axis, double gap) const {
        const double arc = 2.0 * gap * RADIAN;
        return R(axis == 0 ? arc * cos(seed[1] * RADIAN) : arc);
    }
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[3], R (&v)[3], Memory& memory) const {
        const Here<R> h = here(data, x);
        R all[4];
        const bool known = Field{data}.value(step, stage, h.place, all, memory);
        carry(h, all, v);
        return known;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[3], const R (&m)[3][2], R (&v)[3], R (&product)[3][2], Memory& memory) const {
        const Here<R> h = here(data, x);
        Sample<R, 2> sample;
        const bool known = Field{data}.sample(step, stage, h.place, sample, memory);
        const R across[3] = {sample.velocity[0], sample.velocity[1], sample.velocity[2]};
        const R radial = dot(h.p, across);
        R b[2][3];
        basis(data, h.p, h.cosine, b);
        RW_UNROLL for (int c = 0; c < 2; c++) {
            // Change of direction for a change of the state along the column.
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(h.p, column);
            R change[3], between[3];
            RW_UNROLL for (int i = 0; i < 3; i++) change[i] = fma_(-outward, h.p[i], column[i]) * h.inverse_length;
            const R longitude = dot(b[0], change) / h.circle * data.per_radian[0], latitude = dot(b[1], change) * data.per_radian[1];
            RW_UNROLL for (int i = 0; i < 3; i++) between[i] = fma_(longitude, sample.slopes[0][i], latitude * sample.slopes[1][i]);
            // Derivative of V - p (p . V).
            const R turned = dot(change, across) + dot(h.p, between);
            RW_UNROLL for (int i = 0; i < 3; i++) product[i][c] = fma_(-radial, change[i], fma_(-turned, h.p[i], between[i]));
        }
        carry(h, sample.velocity, v);
        return known;
    }
    RW_FN bool inside(const R (&x)[3]) const {
        const Here<R> h = here(data, x);
        bool in = true;
        RW_UNROLL for (int k = 0; k < 2; k++) in = in && data.low[k] <= h.place[k] && h.place[k] <= data.high[k];
        return in;
    }
    RW_FN void settle(R (&x)[3]) const {
        const R inverse = R(1) / sqrt_(dot(x, x));
        RW_UNROLL for (int i = 0; i < 3; i++) x[i] *= inverse;
    }
    RW_FN void settle_tangent(R (&x)[3], R (&m)[3][2]) const {
        const R inverse = R(1) / sqrt_(dot(x, x));
        RW_UNROLL for (int i = 0; i < 3; i++) x[i] *= inverse;
        RW_UNROLL for (int c = 0; c < 2; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(x, column);
            RW_UNROLL for (int i = 0; i < 3; i++) m[i][c] = fma_(-outward, x[i], column[i]) * inverse;
        }
    }
    RW_FN void metric(const R (&x)[3], const R (&m)[3][2], R (&out)[2][2]) const {
        const R cosine = max_(sqrt_(fma_(x[0], x[0], x[1] * x[1])), at_pole<R>());
        R b[2][3];
        basis(data, x, cosine, b);
        RW_UNROLL for (int i = 0; i < 2; i++) RW_UNROLL for (int c = 0; c < 2; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            out[i][c] = dot(b[i], column);
        }
    }
    RW_FN void arrival(const R (&x)[3], const float (&seed)[3], float (&out)[3]) const {
        degrees(double(x[0]), double(x[1]), double(x[2]), data.middle, out);
        out[2] = seed[2];
    }
    RW_FN void coordinate_jacobian(const double (&seed)[3], const R (&x)[3], double (&j)[2][2]) const {
        const double a = double(x[0]), b = double(x[1]);
        const double before = cos(seed[1] * RADIAN), length = sqrt(a * a + b * b), after = length > 1e-8 ? length : 1e-8;
        j[0][0] *= before / after;
        j[0][1] /= after;
        j[1][0] *= before;
    }
};

// With levels: a direction and a height in mean distances between levels; a horizontal metre is a metre on the sphere's radius at every
// height, and the fourth stored component is the vertical velocity. As src/flow/sphere_levels.rs. Config with N = 3 and COMPONENTS = 4.
template <class Config, class Real> struct LayeredSphereFlow {
    using R = Real;
    static constexpr int D = 4, C = 3;
    static constexpr bool SETTLES = true;
    using Field = Sampler<Config, R>;
    using Memory = typename Field::Memory;
    using Step = GridStep<R>;
    const GridData<R>& data;
    const Step* steps;

    static RW_FN void direction(const R (&x)[4], R (&p)[3]) {
        RW_UNROLL for (int i = 0; i < 3; i++) p[i] = x[i];
    }
    RW_FN Here<R> at(const R (&x)[4], R (&place)[3]) const {
        R p[3];
        direction(x, p);
        const Here<R> h = here(data, p);
        place[0] = h.place[0];
        place[1] = h.place[1];
        place[2] = x[3];
        return h;
    }
    // Radii in a degree of longitude, a degree of latitude and a unit of height.
    RW_FN void scales(double cosine, double (&scale)[3]) const {
        scale[0] = RADIAN * (cosine > 1e-8 ? cosine : 1e-8);
        scale[1] = RADIAN;
        scale[2] = 1.0 / data.radius;
    }

    RW_FN Step step(int n) const { return steps[n]; }
    RW_FN void start(const double (&seed)[3], R (&x)[4]) const {
        const Angles a(seed);
        x[0] = R(a.cos_lat * a.cos_lon);
        x[1] = R(a.cos_lat * a.sin_lon);
        x[2] = R(a.sin_lat);
        x[3] = R((seed[2] - data.axes[2].first) / data.axes[2].spacing);
    }
    RW_FN void first_tangent(const double (&seed)[3], R (&m)[4][3]) const {
        const Angles a(seed);
        const double start[4][3] = {{-a.sin_lon, -a.sin_lat * a.cos_lon, 0}, {a.cos_lon, -a.sin_lat * a.sin_lon, 0}, {0, a.cos_lat, 0}, {0, 0, 1.0 / data.level}};
        RW_UNROLL for (int i = 0; i < 4; i++) RW_UNROLL for (int c = 0; c < 3; c++) m[i][c] = R(start[i][c]);
    }
    RW_FN R separation(const double (&seed)[3], int axis, double gap) const {
        double scale[3];
        scales(cos(seed[1] * RADIAN), scale);
        return R(2.0 * gap * scale[axis]);
    }
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[4], R (&v)[4], Memory& memory) const {
        R place[3], all[4], along[3];
        const Here<R> h = at(x, place);
        const bool known = Field{data}.value(step, stage, place, all, memory);
        carry(h, all, along);
        RW_UNROLL for (int i = 0; i < 3; i++) v[i] = along[i];
        v[3] = all[3];
        return known;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[4], const R (&m)[4][3], R (&v)[4], R (&product)[4][3], Memory& memory) const {
        R place[3], b[2][3], along[3];
        const Here<R> h = at(x, place);
        Sample<R, 3> sample;
        const bool known = Field{data}.sample(step, stage, place, sample, memory);
        const R across[3] = {sample.velocity[0], sample.velocity[1], sample.velocity[2]};
        const R radial = dot(h.p, across);
        basis(data, h.p, h.cosine, b);
        RW_UNROLL for (int c = 0; c < 3; c++) {
            // Change of direction for a change of the state along the column.
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(h.p, column);
            R change[3], between[4];
            RW_UNROLL for (int i = 0; i < 3; i++) change[i] = fma_(-outward, h.p[i], column[i]) * h.inverse_length;
            const R longitude = dot(b[0], change) / h.circle * data.per_radian[0], latitude = dot(b[1], change) * data.per_radian[1];
            RW_UNROLL for (int i = 0; i < 4; i++) between[i] = fma_(longitude, sample.slopes[0][i], fma_(latitude, sample.slopes[1][i], m[3][c] * sample.slopes[2][i]));
            // Derivative of V - p (p . V).
            const R level[3] = {between[0], between[1], between[2]};
            const R turned = dot(change, across) + dot(h.p, level);
            RW_UNROLL for (int i = 0; i < 3; i++) product[i][c] = fma_(-radial, change[i], fma_(-turned, h.p[i], between[i]));
            product[3][c] = between[3];
        }
        carry(h, sample.velocity, along);
        RW_UNROLL for (int i = 0; i < 3; i++) v[i] = along[i];
        v[3] = sample.velocity[3];
        return known;
    }
    RW_FN bool inside(const R (&x)[4]) const {
        R place[3];
        at(x, place);
        bool in = true;
        RW_UNROLL for (int k = 0; k < 3; k++) in = in && data.low[k] <= place[k] && place[k] <= data.high[k];
        return in;
    }
    RW_FN void settle(R (&x)[4]) const {
        R p[3];
        direction(x, p);
        const R inverse = R(1) / sqrt_(dot(p, p));
        RW_UNROLL for (int i = 0; i < 3; i++) x[i] *= inverse;
    }
    RW_FN void settle_tangent(R (&x)[4], R (&m)[4][3]) const {
        R p[3];
        direction(x, p);
        const R inverse = R(1) / sqrt_(dot(p, p));
        RW_UNROLL for (int i = 0; i < 3; i++) p[i] = x[i] *= inverse;
        RW_UNROLL for (int c = 0; c < 3; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(p, column);
            RW_UNROLL for (int i = 0; i < 3; i++) m[i][c] = fma_(-outward, p[i], column[i]) * inverse;
        }
    }
    RW_FN void metric(const R (&x)[4], const R (&m)[4][3], R (&out)[3][3]) const {
        R p[3], b[2][3];
        direction(x, p);
        basis(data, p, max_(sqrt_(fma_(p[0], p[0], p[1] * p[1])), at_pole<R>()), b);
        RW_UNROLL for (int c = 0; c < 3; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            out[0][c] = dot(b[0], column);
            out[1][c] = dot(b[1], column);
            out[2][c] = m[3][c] * R(data.level);
        }
    }
    RW_FN void arrival(const R (&x)[4], const float (&)[3], float (&out)[3]) const {
        degrees(double(x[0]), double(x[1]), double(x[2]), data.middle, out);
        out[2] = float(data.axes[2].first + double(x[3]) * data.axes[2].spacing);
    }
    RW_FN void coordinate_jacobian(const double (&seed)[3], const R (&x)[4], double (&j)[3][3]) const {
        double before[3], after[3];
        scales(cos(seed[1] * RADIAN), before);
        scales(sqrt(double(x[0]) * double(x[0]) + double(x[1]) * double(x[1])), after);
        RW_UNROLL for (int i = 0; i < 3; i++) RW_UNROLL for (int c = 0; c < 3; c++) j[i][c] *= before[c] / after[i];
    }
};

}  // namespace rw
