// Gridded flow on the sphere: a unit vector is carried by velocity / radius, so that a pole is no singularity. As src/flow/sphere.rs.
#pragma once
#include "grid.cuh"

namespace rw {

template <class R> RW_FN R dot(const R (&a)[3], const R (&b)[3]) { return fma_(a[0], b[0], fma_(a[1], b[1], a[2] * b[2])); }

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

    // Below this cosine of the latitude, longitude has no meaning.
    static RW_FN R at_pole() { return R(1e-8); }

    // As `least_colatitude` there.
    static RW_FN R least() { return sizeof(R) == 4 ? R(1.0 / 1024.0) : R(1.0 / 1073741824.0); }

    struct Here {
        R p[3], inverse_length, cosine, circle, place[2];
    };
    RW_FN Here here(const R (&x)[3]) const {
        Here h;
        h.inverse_length = R(1) / sqrt_(dot(x, x));
        RW_UNROLL for (int i = 0; i < 3; i++) h.p[i] = x[i] * h.inverse_length;
        R cosine = sqrt_(fma_(h.p[0], h.p[0], h.p[1] * h.p[1]));
        R ahead = fma_(data.turn[0], h.p[0], data.turn[1] * h.p[1]), aside = fma_(data.turn[0], h.p[1], -(data.turn[1] * h.p[0]));
        if (cosine < at_pole()) ahead = 1;
        h.place[0] = fma_(atan2_(aside, ahead), data.per_radian[0], data.origin[0]);
        h.place[1] = fma_(atan2_(h.p[2], cosine), data.per_radian[1], data.origin[1]);
        // Beside a row at a pole the circle of latitude has the length that belongs to the place on the grid.
        h.place[1] = min_(max_(h.place[1], data.poles[0] + least()), data.poles[1] - least());
        const R beside = min_(h.place[1] - data.poles[0], data.poles[1] - h.place[1]), angle = beside / data.per_radian[1];
        h.cosine = max_(cosine, at_pole());
        h.circle = beside < R(0.125) ? angle * fma_(angle * angle, R(-1.0 / 6.0), R(1)) : h.cosine;
        return h;
    }
    // East and north at a direction.
    RW_FN void basis(const R (&p)[3], R cosine, R (&b)[2][3]) const {
        const R inverse = R(1) / cosine;
        const bool pole = cosine <= at_pole();
        const R c = pole ? data.turn[0] : p[0] * inverse, s = pole ? data.turn[1] : p[1] * inverse;
        b[0][0] = -s;
        b[0][1] = c;
        b[0][2] = 0;
        b[1][0] = -(p[2] * c);
        b[1][1] = -(p[2] * s);
        b[1][2] = cosine;
    }
    static RW_FN void angles(const double (&seed)[3], double& sin_lon, double& cos_lon, double& sin_lat, double& cos_lat) {
        const double radian = 3.14159265358979323846 / 180.0;
        sin_lon = sin(seed[0] * radian);
        cos_lon = cos(seed[0] * radian);
        sin_lat = sin(seed[1] * radian);
        cos_lat = cos(seed[1] * radian);
    }

    RW_FN Step step(int n) const { return steps[n]; }
    RW_FN void start(const double (&seed)[3], R (&x)[3]) const {
        double sl, cl, sp, cp;
        angles(seed, sl, cl, sp, cp);
        x[0] = R(cp * cl);
        x[1] = R(cp * sl);
        x[2] = R(sp);
    }
    RW_FN void first_tangent(const double (&seed)[3], R (&m)[3][2]) const {
        double sl, cl, sp, cp;
        angles(seed, sl, cl, sp, cp);
        m[0][0] = R(-sl);
        m[0][1] = R(-sp * cl);
        m[1][0] = R(cl);
        m[1][1] = R(-sp * sl);
        m[2][0] = R(0);
        m[2][1] = R(cp);
    }
    RW_FN R separation(const double (&seed)[3], int axis, double gap) const {
        const double radian = 3.14159265358979323846 / 180.0, arc = 2.0 * gap * radian;
        return R(axis == 0 ? arc * cos(seed[1] * radian) : arc);
    }
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[3], R (&v)[3], Memory& memory) const {
        const Here h = here(x);
        R all[3];
        const bool known = Field{data}.value(step, stage, h.place, all, memory);
        const R radial = dot(h.p, all);
        RW_UNROLL for (int i = 0; i < 3; i++) v[i] = fma_(-radial, h.p[i], all[i]);
        return known;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[3], const R (&m)[3][2], R (&v)[3], R (&product)[3][2], Memory& memory) const {
        const Here h = here(x);
        Sample<R, 2> sample;
        const bool known = Field{data}.sample(step, stage, h.place, sample, memory);
        const R radial = dot(h.p, sample.velocity);
        R b[2][3];
        basis(h.p, h.cosine, b);
        RW_UNROLL for (int c = 0; c < 2; c++) {
            // Change of direction for a change of the state along the column.
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            const R outward = dot(h.p, column);
            R change[3], between[3];
            RW_UNROLL for (int i = 0; i < 3; i++) change[i] = fma_(-outward, h.p[i], column[i]) * h.inverse_length;
            const R longitude = dot(b[0], change) / h.circle * data.per_radian[0], latitude = dot(b[1], change) * data.per_radian[1];
            RW_UNROLL for (int i = 0; i < 3; i++) between[i] = fma_(longitude, sample.slopes[0][i], latitude * sample.slopes[1][i]);
            // Derivative of V - p (p . V).
            const R turned = dot(change, sample.velocity) + dot(h.p, between);
            RW_UNROLL for (int i = 0; i < 3; i++) product[i][c] = fma_(-radial, change[i], fma_(-turned, h.p[i], between[i]));
        }
        RW_UNROLL for (int i = 0; i < 3; i++) v[i] = fma_(-radial, h.p[i], sample.velocity[i]);
        return known;
    }
    RW_FN bool inside(const R (&x)[3]) const {
        const Here h = here(x);
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
        const R cosine = max_(sqrt_(fma_(x[0], x[0], x[1] * x[1])), at_pole());
        R b[2][3];
        basis(x, cosine, b);
        RW_UNROLL for (int i = 0; i < 2; i++) RW_UNROLL for (int c = 0; c < 2; c++) {
            const R column[3] = {m[0][c], m[1][c], m[2][c]};
            out[i][c] = dot(b[i], column);
        }
    }
    RW_FN void arrival(const R (&x)[3], const float (&seed)[3], float (&out)[3]) const {
        const double degree = 180.0 / 3.14159265358979323846;
        const double a = double(x[0]), b = double(x[1]), c = double(x[2]);
        double longitude = atan2(b, a) * degree;
        longitude += 360.0 * round((data.middle - longitude) / 360.0);
        out[0] = float(longitude);
        out[1] = float(atan2(c, sqrt(a * a + b * b)) * degree);
        out[2] = seed[2];
    }
    RW_FN void coordinate_jacobian(const double (&seed)[3], const R (&x)[3], double (&j)[2][2]) const {
        const double a = double(x[0]), b = double(x[1]);
        const double before = cos(seed[1] * (3.14159265358979323846 / 180.0)), length = sqrt(a * a + b * b), after = length > 1e-8 ? length : 1e-8;
        j[0][0] *= before / after;
        j[0][1] /= after;
        j[1][0] *= before;
    }
};

}  // namespace rw
