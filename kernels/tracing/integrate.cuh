// Flow map and its gradient by the classical Runge-Kutta method of order 4 with fixed steps. The gradient follows from the variational equation,
// integrated together with the path, or from central differences of neighbouring paths (Shadden et al. 2005). Mirrors src/flow/rk4.rs.
#pragma once
#include "common/stretch.cuh"

namespace rw {

// End of one particle's path.
template <class R, int D, int C> struct Path {
    R log_stretch;
    // Completed steps.
    int steps;
    bool left;
    R state[D];
    // Gradient in orthonormal bases, times 2^-exponent.
    R metric[C][C];
    R exponent;
};

// Steps between rescalings: in four steps a tangent grows by less than the 2^87 that single precision leaves.
constexpr int RESCALE_EVERY = 4;

// A step is not taken if its end is outside or if it meets a missing node. The tangent passes through the same stages as the path, so it is the
// exact gradient of the discrete flow map.
template <class Flow> RW_FN Path<typename Flow::R, Flow::D, Flow::C> trace_tangent(const Flow& flow, int steps, typename Flow::R h, const double (&seed)[3]) {
    using R = typename Flow::R;
    constexpr int D = Flow::D, C = Flow::C;
    const R half = h / 2, sixth = h / 6;
    Path<R, D, C> path;
    R(&x)[D] = path.state;
    R m[D][C];
    typename Flow::Memory memory{};
    flow.start(seed, x);
    flow.first_tangent(seed, m);
    path.exponent = 0;
    path.left = !flow.inside(x);
    path.steps = path.left ? 0 : steps;
    for (int n = 0; n < path.steps; n++) {
        const typename Flow::Step step = flow.step(n);
        R k[D], g[D][C], at[D], mm[D][C], sum[D], sums[D][C];
        bool known = flow.tangent(step, 0, x, m, k, g, memory);
        RW_UNROLL for (int i = 0; i < D; i++) {
            sum[i] = k[i];
            RW_UNROLL for (int c = 0; c < C; c++) sums[i][c] = g[i][c];
        }
        RW_UNROLL for (int stage = 1; stage < 4; stage++) {
            const R ahead = stage == 3 ? h : half, weight = stage == 3 ? R(1) : R(2);
            RW_UNROLL for (int i = 0; i < D; i++) {
                at[i] = fma_(ahead, k[i], x[i]);
                RW_UNROLL for (int c = 0; c < C; c++) mm[i][c] = fma_(ahead, g[i][c], m[i][c]);
            }
            known = flow.tangent(step, stage == 3 ? 2 : 1, at, mm, k, g, memory) && known;
            RW_UNROLL for (int i = 0; i < D; i++) {
                sum[i] = fma_(weight, k[i], sum[i]);
                RW_UNROLL for (int c = 0; c < C; c++) sums[i][c] = fma_(weight, g[i][c], sums[i][c]);
            }
        }
        RW_UNROLL for (int i = 0; i < D; i++) at[i] = fma_(sixth, sum[i], x[i]);
        if (Flow::SETTLES) {
            RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) mm[i][c] = fma_(sixth, sums[i][c], m[i][c]);
            flow.settle_tangent(at, mm);
        }
        bool inside = flow.inside(at);
        if (!(inside && known)) {
            path.steps = n;
            path.left = !inside;
            break;
        }
        RW_UNROLL for (int i = 0; i < D; i++) {
            x[i] = at[i];
            RW_UNROLL for (int c = 0; c < C; c++) m[i][c] = Flow::SETTLES ? mm[i][c] : fma_(sixth, sums[i][c], m[i][c]);
        }
        if ((n & (RESCALE_EVERY - 1)) == RESCALE_EVERY - 1) rescale<D, C, R>(m, path.exponent);
    }
    rescale<D, C, R>(m, path.exponent);
    flow.metric(x, m, path.metric);
    path.log_stretch = fma_(path.exponent, R(0.6931471805599453), log_stretch<C, R>(path.metric));
    return path;
}

// One step of one particle. Returns false if a node was missing.
template <class Flow, int D> RW_FN bool runge_kutta(const Flow& flow, const typename Flow::Step& step, typename Flow::R h, const typename Flow::R (&x)[D],
                                                   typename Flow::R (&end)[D], typename Flow::Memory& memory) {
    using R = typename Flow::R;
    const R half = h / 2, sixth = h / 6;
    R k[D], at[D], sum[D];
    bool known = flow.velocity(step, 0, x, k, memory);
    RW_UNROLL for (int i = 0; i < D; i++) sum[i] = k[i];
    RW_UNROLL for (int stage = 1; stage < 4; stage++) {
        const R ahead = stage == 3 ? h : half, weight = stage == 3 ? R(1) : R(2);
        RW_UNROLL for (int i = 0; i < D; i++) at[i] = fma_(ahead, k[i], x[i]);
        known = flow.velocity(step, stage == 3 ? 2 : 1, at, k, memory) && known;
        RW_UNROLL for (int i = 0; i < D; i++) sum[i] = fma_(weight, k[i], sum[i]);
    }
    RW_UNROLL for (int i = 0; i < D; i++) end[i] = fma_(sixth, sum[i], x[i]);
    flow.settle(end);
    return known;
}

// Gradient from the end points of a seed's particles, and the log-stretch.
template <class Flow>
RW_FN void gradient_by_differences(const Flow& flow, const typename Flow::R (&x)[2 * Flow::C][Flow::D], double difference_step,
                                     const double (&seed)[3], Path<typename Flow::R, Flow::D, Flow::C>& path) {
    using R = typename Flow::R;
    constexpr int D = Flow::D, C = Flow::C, P = 2 * C;
    R m[D][C];
    RW_UNROLL for (int c = 0; c < C; c++) {
        R inverse = R(1) / flow.separation(seed, c, difference_step);
        RW_UNROLL for (int i = 0; i < D; i++) m[i][c] = (x[2 * c][i] - x[2 * c + 1][i]) * inverse;
    }
    RW_UNROLL for (int i = 0; i < D; i++) {
        R mean = 0;
        RW_UNROLL for (int p = 0; p < P; p++) mean = fma_(R(0.5 / C), x[p][i], mean);
        path.state[i] = mean;
    }
    flow.settle(path.state);
    flow.metric(path.state, m, path.metric);
    path.exponent = 0;
    path.log_stretch = log_stretch<C, R>(path.metric);
}

// Two particles per axis, `difference_step` coordinate units before and behind the seed. All stop as soon as one of them does.
template <class Flow>
RW_FN Path<typename Flow::R, Flow::D, Flow::C> trace_differences(const Flow& flow, int steps, typename Flow::R h, double difference_step,
                                                                              const double (&seed)[3]) {
    using R = typename Flow::R;
    constexpr int D = Flow::D, C = Flow::C, P = 2 * C;
    Path<R, D, C> path;
    R x[P][D];
    typename Flow::Memory memory{};
    path.left = false;
    RW_UNROLL for (int p = 0; p < P; p++) {
        double there[3] = {seed[0], seed[1], seed[2]};
        RW_UNROLL for (int k = 0; k < C; k++) if (k == p / 2) there[k] += p % 2 == 0 ? difference_step : -difference_step;
        flow.start(there, x[p]);
        path.left = path.left || !flow.inside(x[p]);
    }
    path.steps = path.left ? 0 : steps;
    for (int n = 0; n < path.steps; n++) {
        const typename Flow::Step step = flow.step(n);
        R end[P][D];
        bool known = true, inside = true;
        RW_UNROLL for (int p = 0; p < P; p++) {
            known = runge_kutta(flow, step, h, x[p], end[p], memory) && known;
            inside = inside && flow.inside(end[p]);
        }
        if (!(inside && known)) {
            path.steps = n;
            path.left = !inside;
            break;
        }
        RW_UNROLL for (int p = 0; p < P; p++) RW_UNROLL for (int i = 0; i < D; i++) x[p][i] = end[p][i];
    }
    gradient_by_differences(flow, x, difference_step, seed, path);
    return path;
}

#if RW_DEVICE
// As `trace_differences` with one particle per lane, each with its own cached cell. The particles of a seed are in the lanes of the mask
// `group`, from lane `first` on. All lanes of the warp must call it; a lane without a seed has an empty `group`. The result is valid in lane
// `first`.
template <class Flow>
RW_FN Path<typename Flow::R, Flow::D, Flow::C> trace_differences_lanes(const Flow& flow, int steps, typename Flow::R h, double difference_step,
                                                                      const double (&seed)[3], int particle, int first, uint32_t group) {
    using R = typename Flow::R;
    constexpr int D = Flow::D, C = Flow::C, P = 2 * C;
    constexpr uint32_t ALL = 0xffffffffu;
    Path<R, D, C> path;
    R x[D], end[D];
    typename Flow::Memory memory{};
    double there[3] = {seed[0], seed[1], seed[2]};
    RW_UNROLL for (int k = 0; k < C; k++) if (k == particle / 2) there[k] += particle % 2 == 0 ? difference_step : -difference_step;
    flow.start(there, x);
    path.left = (__ballot_sync(ALL, flow.inside(x)) & group) != group;
    bool going = group != 0 && !path.left;
    path.steps = going ? steps : 0;
    for (int n = 0; n < steps; n++) {
        bool known = true, inside = true;
        if (going) {
            const typename Flow::Step step = flow.step(n);
            known = runge_kutta(flow, step, h, x, end, memory);
            inside = flow.inside(end);
        }
        const uint32_t in = __ballot_sync(ALL, inside), well = __ballot_sync(ALL, inside && known);
        if (going && (well & group) != group) {
            going = false;
            path.steps = n;
            path.left = (in & group) != group;
        }
        if (!__any_sync(ALL, going)) break;
        if (going) RW_UNROLL for (int i = 0; i < D; i++) x[i] = end[i];
    }
    R all[P][D];
    RW_UNROLL for (int p = 0; p < P; p++) RW_UNROLL for (int i = 0; i < D; i++) all[p][i] = __shfl_sync(ALL, x[i], first + p);
    gradient_by_differences(flow, all, difference_step, seed, path);
    return path;
}
#endif

// Results of seeds. Every pointer except `log_stretch` may be null.
struct Outputs {
    float* log_stretch;
    double* log_stretch_f64;
    float* lifetime_share;
    // 3 and 9 floats per seed.
    float* arrival;
    float* jacobian;
};

// Edge policy and normalisation, as in src/flow/tracer.rs.
struct ResultPolicy {
    int zero_if_left;
    int by_lifetime;
    int steps;
};

template <class Flow> RW_FN void write_results(const Flow& flow, const Path<typename Flow::R, Flow::D, Flow::C>& path, const ResultPolicy& policy,
                                               const float (&seed)[3], size_t at, const Outputs& out) {
    using R = typename Flow::R;
    constexpr int C = Flow::C;
    // A quotient, as on the CPU: exactly 1 if all steps were taken.
    double lifetime_share = double(R(path.steps) / R(policy.steps)), s = double(path.log_stretch);
    if (policy.zero_if_left && path.left) s = 0;
    else if (policy.by_lifetime) s = lifetime_share > 0 ? s / lifetime_share : 0;
    out.log_stretch[at] = float(s);
    if (out.log_stretch_f64) out.log_stretch_f64[at] = s;
    if (out.lifetime_share) out.lifetime_share[at] = float(lifetime_share);
    if (out.arrival) {
        float there[3];
        flow.arrival(path.state, seed, there);
        RW_UNROLL for (int k = 0; k < 3; k++) out.arrival[3 * at + k] = there[k];
    }
    if (out.jacobian) {
        double j[C][C];
        const double factor = exp2(double(path.exponent));
        RW_UNROLL for (int i = 0; i < C; i++) RW_UNROLL for (int c = 0; c < C; c++) j[i][c] = double(path.metric[i][c]) * factor;
        const double from[3] = {seed[0], seed[1], seed[2]};
        flow.coordinate_jacobian(from, path.state, j);
        RW_UNROLL for (int i = 0; i < 3; i++)
            RW_UNROLL for (int c = 0; c < 3; c++)
                out.jacobian[9 * at + 3 * i + c] = i < C && c < C ? float(j[i < C ? i : 0][c < C ? c : 0]) : float(i == c);
    }
}

}  // namespace rw
