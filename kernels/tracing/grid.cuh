// Velocity between nodes and snapshots: linear in time, linear or cubic (Catmull and Rom 1974) in space, with the exact derivative of the
// interpolant. Mirrors src/flow/axis_map.rs, sampler.rs and grid_flow.rs.
//
// Neighbouring threads have neighbouring seeds, and a particle stays in its cell for several stages. Each thread therefore caches the corners of
// its cell, at both snapshots, in registers and reads them again only if the cell or the snapshots change (Config::KEEP).
#pragma once
#include "common/base.cuh"

namespace rw {

// Storage of nodes. F16_PAIRS stores each node in half precision, followed by its change to the next snapshot, so that one request reads both
// and the second snapshot is never accessed.
enum Storage { F32 = 0, F16 = 1, F16_PAIRS = 2 };

// One axis. A state coordinate is the distance from the first node in mean spacings.
template <class R> struct AxisData {
    // Uneven nodes only: node positions, 1 / cell lengths, and for each of `intervals` even intervals the cell in which it begins.
    const R* positions;
    const R* inverse;
    const uint32_t* begins;
    // Domain coordinate of the first node, and mean spacing.
    double first, spacing;
    R density;
    // State coordinate of the last node (or of the first one's image).
    R high;
    // Period of the state; 0 if the axis does not wrap.
    R wrap;
    int nodes, last_cell, intervals;
};

// A window on the device.
template <class R> struct GridData {
    uint32_t row, plane;
    AxisData<R> axes[3];
    // Factors from stored velocities to state units per time.
    R rate[4];
    // Particles stop outside these bounds.
    R low[3], high[3];
    // Mean spacing of axis i over that of axis j.
    R ratios[3][3];
    // Sphere only (see sphere.cuh).
    R per_radian[2], origin[2], turn[2], poles[2];
    double middle;
    // Radius, and mean distance between levels in radii.
    double radius, level;
};

// Start, middle and end of one step: the two adjacent snapshots around each time, and the weight of the later one. Addresses instead of indices
// into a table of snapshots save a dependent load before each cell is read.
template <class R> struct GridStep {
    const void* first[3];
    const void* second[3];
    R weight[3];
};

template <class R> struct Place {
    int cell;
    R fraction, slope;
};

// See axis_map.rs.
template <class R> constexpr R EDGE = R(1) / R(1024);

// Finds the cell, which is in range for every state, NaN included.
template <bool EVEN, bool WRAP, class R> RW_FN Place<R> locate(const AxisData<R>& axis, R state) {
    Place<R> place;
    R held = state;
    place.slope = 1;
    if (WRAP) {
        held = state - axis.wrap * floor_(state / axis.wrap);
    } else {
        held = min_(max_(state, R(0)), axis.high);
        const R beyond = held - state;
        place.slope = max_(beyond, -beyond) <= EDGE<R> ? R(1) : R(0);
    }
    if (EVEN) {
        // NaN is clamped to 0 above; on an axis that wraps, it converts to 0 or is clamped here.
        place.cell = max_(min_(int(held), axis.last_cell), 0);
        place.fraction = held - R(place.cell);
    } else {
        int interval = max_(min_(int(held * axis.density), axis.intervals - 1), 0);
        int cell = int(axis.begins[interval]);
        while (cell < axis.last_cell && held >= axis.positions[cell + 1]) cell++;
        while (cell > 0 && held < axis.positions[cell]) cell--;
        R inverse = axis.inverse[cell];
        place.cell = cell;
        place.fraction = (held - axis.positions[cell]) * inverse;
        place.slope *= inverse;
    }
    return place;
}

// One node: velocity components, and false in `known` if it is missing. NaN in the fourth place marks a missing node; without a fourth component
// the place holds the mark alone.
template <class Config> struct Node {
    float v[4];
    bool known;
};

// Replaces the mark by 0: a missing node must contribute nothing, and NaN times a weight of 0 is NaN.
template <class Config> RW_FN Node<Config> known_node(float x, float y, float z, float w) {
    const bool known = !Config::MISSING || !is_nan(w);
    return {{x, y, z, known ? w : 0.0f}, known};
}
template <class Config> RW_FN Node<Config> halves(uint32_t low, uint32_t high) {
    return known_node<Config>(from_half(uint16_t(low)), from_half(uint16_t(low >> 16)), from_half(uint16_t(high)), from_half(uint16_t(high >> 16)));
}

template <class Config> RW_FN Node<Config> node_at(const void* nodes, size_t index) {
    if constexpr (Config::STORAGE == F32) {
        const Float4 f = load(static_cast<const Float4*>(nodes) + index);
        return known_node<Config>(f.x, f.y, f.z, f.w);
    } else {
#if RW_DEVICE
        const uint2 w = __ldg(static_cast<const uint2*>(nodes) + index);
        return halves<Config>(w.x, w.y);
#else
        const uint32_t* w = static_cast<const uint32_t*>(nodes) + 2 * index;
        return halves<Config>(w[0], w[1]);
#endif
    }
}

// One node at both snapshots. `second` is its velocity at the later one or, with F16_PAIRS, its change since the first.
template <class Config> struct NodePair {
    Node<Config> first, second;
};

template <class Config> RW_FN NodePair<Config> node_pair_at(const void* first, const void* second, size_t index) {
    if constexpr (Config::STORAGE == F16_PAIRS) {
        const Uint4 w = load(static_cast<const Uint4*>(first) + index);
        return {halves<Config>(w.x, w.y), halves<Config>(w.z, w.w)};
    } else {
        return {node_at<Config>(first, index), node_at<Config>(second, index)};
    }
}

// Index of the node after `cell` along an axis.
template <bool SEAM, class R> RW_FN int next_node(const AxisData<R>& axis, int cell) {
    return SEAM && cell + 1 == axis.nodes ? 0 : cell + 1;
}

// The four nodes and weights of a cubic Hermite interpolant whose slopes are central differences (one-sided at an end).
template <class R> struct Stencil {
    int nodes[4];
    R weights[4], slopes[4];
};

template <bool EVEN, bool SEAM, class R> RW_FN Stencil<R> stencil(const AxisData<R>& axis, int cell, R f) {
    Stencil<R> s;
    const int cells = axis.last_cell + 1;
    const bool has_before = cell > 0 || SEAM, has_after = cell + 1 < cells || SEAM;
    R before = -1, after = 2;
    if (!EVEN) {
        const R here = axis.inverse[cell];
        if (has_before) before = -here / axis.inverse[cell > 0 ? cell - 1 : cells - 1];
        if (has_after) after = R(1) + here / axis.inverse[cell + 1 < cells ? cell + 1 : 0];
    }
    s.nodes[1] = cell;
    s.nodes[2] = next_node<SEAM>(axis, cell);
    s.nodes[0] = has_before ? (cell == 0 ? axis.nodes - 1 : cell - 1) : s.nodes[1];
    s.nodes[3] = has_after ? (cell + 2 >= axis.nodes ? cell + 2 - axis.nodes : cell + 2) : s.nodes[2];
    const R g = R(1) - f;
    const R basis[4] = {(R(1) + R(2) * f) * g * g, f * f * (R(3) - R(2) * f), f * g * g, f * f * (f - R(1))};
    const R slope[4] = {R(6) * f * (f - R(1)), R(6) * f * g, g * (R(1) - R(3) * f), f * (R(3) * f - R(2))};
    const R to_before = has_before ? R(1) / (R(1) - before) : R(0), to_after = has_after ? R(1) / after : R(0);
    RW_UNROLL for (int d = 0; d < 2; d++) {
        const R* h = d == 0 ? basis : slope;
        R* w = d == 0 ? s.weights : s.slopes;
        w[0] = -h[2] * to_before;
        w[1] = h[0] - (has_before ? R(0) : h[2]) - h[3] * (has_after ? to_after : R(1));
        w[2] = h[1] + h[2] * (has_before ? to_before : R(1)) + (has_after ? R(0) : h[3]);
        w[3] = h[3] * to_after;
    }
    return s;
}

// Velocity and derivatives along the grid's axes, in state units.
template <class R, int N> struct Sample {
    R velocity[4];
    // slopes[axis][component]
    R slopes[N][4];
};

// Config: N (axes), COMPONENTS, STORAGE, CUBIC, MISSING (nodes may be missing), KEEP (cache the cell), SCALED, EVEN, WRAP, SEAM (bit k: axis k).
template <class Config, class Real> struct Sampler {
    using R = Real;
    static constexpr int N = Config::N, NC = Config::COMPONENTS;
    static constexpr bool DOUBLE = sizeof(R) == 8, IN_PAIRS = Config::STORAGE == F16_PAIRS;
    // Cached nodes: the cell's corners, or the stencil of a cubic in the plane.
    static constexpr int KEPT = Config::CUBIC ? (N == 2 ? 16 : 1) : (N == 2 ? 4 : 8);
    static constexpr bool SCALE_LATE = Config::SCALED && DOUBLE;
    using Step = GridStep<R>;

    // The cell read last. `second` is the change since the first snapshot in single precision, the second snapshot's velocity in double
    // precision.
    struct CellCache {
        const void* snapshot = nullptr;
        uint32_t cell = 0;
        bool known_first = true, known_second = true;
        float first[KEPT][NC], second[KEPT][NC];
    };

    const GridData<R>& data;

    template <int K> RW_FN Place<R> place(R x) const {
        return locate<(Config::EVEN >> K & 1) != 0, (Config::WRAP >> K & 1) != 0>(data.axes[K], x);
    }
    RW_FN void places(const R (&x)[N], Place<R> (&p)[N]) const {
        p[0] = place<0>(x[0]);
        p[1] = place<1>(x[1]);
        if constexpr (N == 3) p[2] = place<2>(x[2]);
    }
    template <int K> RW_FN Stencil<R> stencil_along(int cell, R fraction) const {
        return stencil<(Config::EVEN >> K & 1) != 0, (Config::SEAM >> K & 1) != 0>(data.axes[K], cell, fraction);
    }

    RW_FN void load_node(CellCache& cache, int k, const void* first, const void* second, size_t index) const {
        const NodePair<Config> node = node_pair_at<Config>(first, second, index);
        RW_UNROLL for (int c = 0; c < NC; c++) {
            float u = node.first.v[c], w = node.second.v[c];
            if (DOUBLE) {
                if (IN_PAIRS) w += u;
            } else {
                if (!IN_PAIRS) w -= u;
                if (Config::SCALED) {
                    u *= float(data.rate[c]);
                    w *= float(data.rate[c]);
                }
            }
            cache.first[k][c] = u;
            cache.second[k][c] = w;
        }
        if (Config::MISSING) {
            cache.known_first = cache.known_first && node.first.known;
            cache.known_second = cache.known_second && node.second.known;
        }
    }
    // Bytes of a node.
    static constexpr size_t NODE = Config::STORAGE == F16 ? 8 : 16;

    // Reads the corners of a cell at both snapshots.
    RW_FN void read(CellCache& cache, const void* first, const void* second, uint32_t cell, const Place<R> (&p)[N]) const {
        cache.known_first = cache.known_second = true;
        if constexpr (!Config::CUBIC && Config::SEAM == 0) {
            // Offsets from the first corner are uniform over threads, and the one along x is a constant.
            const char *a = static_cast<const char*>(first) + cell * NODE, *b = static_cast<const char*>(second) + cell * NODE;
            RW_UNROLL for (int k = 0; k < KEPT; k += 2) {
                const size_t offset = ((k & 2 ? size_t(data.row) : 0) + (k & 4 ? size_t(data.plane) : 0)) * NODE;
                load_node(cache, k, a + offset, b + offset, 0);
                load_node(cache, k + 1, a + offset, b + offset, 1);
            }
        } else if constexpr (!Config::CUBIC) {
            const int ex[2] = {p[0].cell, next_node<(Config::SEAM & 1) != 0>(data.axes[0], p[0].cell)};
            const int ey[2] = {p[1].cell, next_node<(Config::SEAM & 2) != 0>(data.axes[1], p[1].cell)};
            int ez[2] = {0, 0};
            if constexpr (N == 3) {
                ez[0] = p[2].cell;
                ez[1] = next_node<(Config::SEAM & 4) != 0>(data.axes[2], p[2].cell);
            }
            RW_UNROLL for (int k = 0; k < KEPT; k++) {
                const uint32_t index = uint32_t(ez[k >> 2]) * data.plane + uint32_t(ey[k >> 1 & 1]) * data.row + uint32_t(ex[k & 1]);
                load_node(cache, k, first, second, index);
            }
        } else if constexpr (N == 2) {
            const Stencil<R> sx = stencil_along<0>(p[0].cell, R(0)), sy = stencil_along<1>(p[1].cell, R(0));
            RW_UNROLL for (int k = 0; k < KEPT; k++)
                load_node(cache, k, first, second, uint32_t(sy.nodes[k >> 2]) * data.row + uint32_t(sx.nodes[k & 3]));
        }
    }
    RW_FN uint32_t flat(const Place<R> (&p)[N]) const {
        uint32_t cell = uint32_t(p[1].cell) * data.row + uint32_t(p[0].cell);
        if constexpr (N == 3) cell += uint32_t(p[2].cell) * data.plane;
        return cell;
    }
    // Returns true if all nodes are known at this time.
    RW_FN bool known(bool known_first, bool known_second, R weight) const {
        // At a snapshot's own time the other snapshot has no effect.
        return !Config::MISSING || ((known_first || weight == R(1)) && (known_second || weight == R(0)));
    }
    RW_FN void load_cell(CellCache& cache, const Step& step, int stage, const Place<R> (&p)[N]) const {
        const uint32_t cell = flat(p);
        if (!Config::KEEP || cell != cache.cell || step.first[stage] != cache.snapshot) {
            read(cache, step.first[stage], step.second[stage], cell, p);
            cache.cell = cell;
            cache.snapshot = step.first[stage];
        }
    }
    RW_FN R in_time(float first, float second, R weight) const {
        if (DOUBLE) return fma_(R(second), weight, R(first) * (R(1) - weight));
        return fma_(R(second), weight, R(first));
    }

    // Difference of two nodes, subtracted before rounding.
    RW_FN R difference(float first, float from_first, float second, float from_second, R weight) const {
        const R a = R(first) - R(from_first), b = R(second) - R(from_second);
        if (DOUBLE) return fma_(b, weight, a * (R(1) - weight));
        return fma_(b, weight, a);
    }

    // Velocity, and with SLOPES its derivatives, from the cached cell. Returns false if a node is missing.
    template <bool SLOPES> RW_FN bool interpolate(const Step& step, int stage, const R (&x)[N], Sample<R, N>& out, CellCache& cache) const {
        if constexpr (Config::CUBIC && N == 3) {
            return stream<SLOPES>(step, stage, x, out);
        } else {
            Place<R> p[N];
            places(x, p);
            load_cell(cache, step, stage, p);
            const R weight = step.weight[stage];
            if constexpr (Config::CUBIC) {
                const Stencil<R> sx = stencil_along<0>(p[0].cell, p[0].fraction), sy = stencil_along<1>(p[1].cell, p[1].fraction);
                RW_UNROLL for (int c = 0; c < NC; c++) {
                    R v = 0, dx = 0, dy = 0;
                    RW_UNROLL for (int j = 0; j < 4; j++) {
                        // The weights of a slope sum to 0, so a common value is subtracted from all nodes first (see sampler.rs).
                        const float common[2] = {cache.first[4 * j + 1][c], cache.second[4 * j + 1][c]};
                        R row = 0, row_slope = 0;
                        RW_UNROLL for (int i = 0; i < 4; i++) {
                            const float first = cache.first[4 * j + i][c], second = cache.second[4 * j + i][c];
                            row = fma_(in_time(first, second, weight), sx.weights[i], row);
                            if (SLOPES && i != 1) row_slope = fma_(difference(first, common[0], second, common[1], weight), sx.slopes[i], row_slope);
                        }
                        v = fma_(row, sy.weights[j], v);
                        if (SLOPES) {
                            dx = fma_(row_slope, sy.weights[j], dx);
                            dy = fma_(row, sy.slopes[j], dy);
                        }
                    }
                    out.velocity[c] = v;
                    out.slopes[0][c] = dx;
                    out.slopes[1][c] = dy;
                }
            } else {
                const R fx = p[0].fraction, fy = p[1].fraction;
                RW_UNROLL for (int c = 0; c < NC; c++) {
                    R d[KEPT / 2], e[KEPT / 2];
                    RW_UNROLL for (int k = 0; k < KEPT / 2; k++) {
                        const float first[2] = {cache.first[2 * k][c], cache.first[2 * k + 1][c]};
                        const float second[2] = {cache.second[2 * k][c], cache.second[2 * k + 1][c]};
                        const R left = in_time(first[0], second[0], weight);
                        // Beside a pole, neighbours along the first axis are close, and their difference would lose digits.
                        if (SLOPES && (Config::SEAM & 1) != 0) d[k] = difference(first[1], first[0], second[1], second[0], weight);
                        else d[k] = in_time(first[1], second[1], weight) - left;
                        e[k] = fma_(d[k], fx, left);
                    }
                    const R near_y = e[1] - e[0], near = fma_(near_y, fy, e[0]), near_x = fma_(fy, d[1] - d[0], d[0]);
                    if constexpr (N == 2) {
                        out.velocity[c] = near;
                        out.slopes[0][c] = near_x;
                        out.slopes[1][c] = near_y;
                    } else {
                        constexpr int B = KEPT / 2 - 2;
                        const R fz = p[N - 1].fraction, far_y = e[B + 1] - e[B], far = fma_(far_y, fy, e[B]), far_x = fma_(fy, d[B + 1] - d[B], d[B]);
                        out.slopes[N - 1][c] = far - near;
                        out.velocity[c] = fma_(out.slopes[N - 1][c], fz, near);
                        out.slopes[0][c] = fma_(fz, far_x - near_x, near_x);
                        out.slopes[1][c] = fma_(fz, far_y - near_y, near_y);
                    }
                }
            }
            finish<SLOPES>(p, out);
            return known(cache.known_first, cache.known_second, weight);
        }
    }

    // Applies units, and sets derivatives to 0 along an axis beyond whose end the particle is clamped.
    template <bool SLOPES> RW_FN void finish(const Place<R> (&p)[N], Sample<R, N>& out) const {
        if (SCALE_LATE) {
            RW_UNROLL for (int c = 0; c < NC; c++) {
                out.velocity[c] *= data.rate[c];
                if (SLOPES) RW_UNROLL for (int k = 0; k < N; k++) out.slopes[k][c] *= data.rate[c];
            }
        }
        bool sloped = false;
        RW_UNROLL for (int k = 0; k < N; k++) sloped = sloped || p[k].slope != R(1);
        if (SLOPES && sloped) {
            RW_UNROLL for (int k = 0; k < N; k++) RW_UNROLL for (int c = 0; c < NC; c++) out.slopes[k][c] *= p[k].slope;
        }
    }

    // Cubic in space. 64 nodes at two times are too many to cache, so rows are read and summed up.
    template <bool SLOPES> RW_FN bool stream(const Step& step, int stage, const R (&x)[N], Sample<R, N>& out) const {
        Place<R> p[N];
        places(x, p);
        const Stencil<R> sx = stencil_along<0>(p[0].cell, p[0].fraction), sy = stencil_along<1>(p[1].cell, p[1].fraction);
        const Stencil<R> sz = stencil_along<N - 1>(p[N - 1].cell, p[N - 1].fraction);
        const R weight = step.weight[stage];
        const void *first = step.first[stage], *second = step.second[stage];
        bool known_first = true, known_second = true;
        R v[NC] = {}, d[3][NC] = {};
        for (int z = 0; z < 4; z++) {
            for (int y = 0; y < 4; y++) {
                R row[NC] = {}, row_slope[NC] = {};
                RW_UNROLL for (int i = 0; i < 4; i++) {
                    const size_t index = uint32_t(sz.nodes[z]) * data.plane + uint32_t(sy.nodes[y]) * data.row + uint32_t(sx.nodes[i]);
                    const NodePair<Config> node = node_pair_at<Config>(first, second, index);
                    known_first = known_first && node.first.known;
                    known_second = known_second && node.second.known;
                    RW_UNROLL for (int c = 0; c < NC; c++) {
                        const R u = node.first.v[c], e = fma_(R(node.second.v[c]), weight, IN_PAIRS ? u : u * (R(1) - weight));
                        row[c] = fma_(e, sx.weights[i], row[c]);
                        row_slope[c] = fma_(e, sx.slopes[i], row_slope[c]);
                    }
                }
                const R w = sy.weights[y] * sz.weights[z], wy = sy.slopes[y] * sz.weights[z], wz = sy.weights[y] * sz.slopes[z];
                RW_UNROLL for (int c = 0; c < NC; c++) {
                    v[c] = fma_(row[c], w, v[c]);
                    if (SLOPES) {
                        d[0][c] = fma_(row_slope[c], w, d[0][c]);
                        d[1][c] = fma_(row[c], wy, d[1][c]);
                        d[2][c] = fma_(row[c], wz, d[2][c]);
                    }
                }
            }
        }
        RW_UNROLL for (int c = 0; c < NC; c++) {
            const R rate = Config::SCALED ? data.rate[c] : R(1);
            out.velocity[c] = v[c] * rate;
            if (SLOPES) RW_UNROLL for (int k = 0; k < N; k++) out.slopes[k][c] = d[k][c] * rate;
        }
        if (SLOPES) {
            RW_UNROLL for (int k = 0; k < N; k++) RW_UNROLL for (int c = 0; c < NC; c++) out.slopes[k][c] *= p[k].slope;
        }
        return known(known_first, known_second, weight);
    }
};

// Flow on a Cartesian grid. States are in mean spacings from the first node.
template <class Config, class Real> struct GridFlow {
    using R = Real;
    static constexpr int D = Config::N, C = Config::N;
    static constexpr bool SETTLES = false;
    using Field = Sampler<Config, R>;
    using Memory = typename Field::CellCache;
    using Step = GridStep<R>;
    const GridData<R>& data;
    const Step* steps;

    RW_FN GridFlow(const GridData<R>& data, const Step* steps, const float (&)[3]) : data(data), steps(steps) {}
    RW_FN Step step(int n) const { return steps[n]; }
    RW_FN void start(const double (&seed)[3], R (&x)[D]) const {
        RW_UNROLL for (int k = 0; k < D; k++) x[k] = R((seed[k] - data.axes[k].first) / data.axes[k].spacing);
    }
    RW_FN void first_tangent(const double (&)[3], R (&m)[D][C]) const {
        RW_UNROLL for (int i = 0; i < D; i++) RW_UNROLL for (int c = 0; c < C; c++) m[i][c] = R(i == c);
    }
    RW_FN R separation(const double (&)[3], int axis, double difference_step) const { return R(2.0 * difference_step / data.axes[axis].spacing); }
    RW_FN bool velocity(const Step& step, int stage, const R (&x)[D], R (&v)[D], Memory& memory) const {
        Sample<R, D> sample;
        const bool known = Field{data}.template interpolate<false>(step, stage, x, sample, memory);
        RW_UNROLL for (int i = 0; i < D; i++) v[i] = sample.velocity[i];
        return known;
    }
    RW_FN bool tangent(const Step& step, int stage, const R (&x)[D], const R (&m)[D][C], R (&v)[D], R (&p)[D][C], Memory& memory) const {
        Sample<R, D> sample;
        const bool known = Field{data}.template interpolate<true>(step, stage, x, sample, memory);
        RW_UNROLL for (int i = 0; i < D; i++) {
            v[i] = sample.velocity[i];
            RW_UNROLL for (int c = 0; c < C; c++) {
                R sum = sample.slopes[0][i] * m[0][c];
                RW_UNROLL for (int k = 1; k < D; k++) sum = fma_(sample.slopes[k][i], m[k][c], sum);
                p[i][c] = sum;
            }
        }
        return known;
    }
    RW_FN bool inside(const R (&x)[D]) const {
        bool in = true;
        RW_UNROLL for (int k = 0; k < D; k++) in = in && data.low[k] <= x[k] && x[k] <= data.high[k];
        return in;
    }
    RW_FN void settle(R (&)[D]) const {}
    RW_FN void settle_tangent(R (&)[D], R (&)[D][C]) const {}
    RW_FN void metric(const R (&)[D], const R (&m)[D][C], R (&out)[C][C]) const {
        RW_UNROLL for (int i = 0; i < C; i++) RW_UNROLL for (int c = 0; c < C; c++) out[i][c] = m[i][c] * data.ratios[i][c];
    }
    RW_FN void arrival(const R (&x)[D], const float (&seed)[3], float (&out)[3]) const {
        RW_UNROLL for (int k = 0; k < 3; k++) {
            const int j = k < D ? k : 0;
            out[k] = k < D ? float(data.axes[j].first + double(x[j]) * data.axes[j].spacing) : seed[k];
        }
    }
    RW_FN void coordinate_jacobian(const double (&)[3], const R (&)[D], double (&)[C][C]) const {}
};

}  // namespace rw
