// The network on the device: prediction, and training steps (network_gradient, then network_adam_tables and network_adam_layers).
#include "answer.cuh"
#include "network.cuh"
#include "table.cuh"

using namespace rw;

constexpr int WARPS = 8, THREADS = 32 * WARPS, ROWS = 16 * WARPS;
// Two blocks a multiprocessor, so that one gathers while the other multiplies, unless registers run short.
constexpr int TOGETHER = 16 * WIDTH_BLOCKS * HIDDEN <= 128 ? 2 : 1;

// How outputs become log-stretch.
struct Reading {
    float mean, deviation, tau;
    int published;  // 0: output * deviation + mean; 1: tau * sign(output) (exp|output| - 1)
    float share;    // of the network, above `base`
    int pad;
    Table base;     // without values: none
};
static_assert(sizeof(Reading) == 48, "layout");

RW_FN float read_output(const Reading& reading, float output, const float (&unit)[3]) {
    const float value = reading.published ? reading.tau * copysignf(expm1f(fabsf(output)), output) : fma_(output, reading.deviation, reading.mean);
    return reading.base.values ? fma_(reading.share, value, look_up(reading.base, unit)) : value;
}

extern __shared__ __align__(16) unsigned char shared[];

RW_FN void read_levels(Level* levels, const Grid& grid) {
    for (int i = threadIdx.x; i < LEVELS; i += blockDim.x) levels[i] = grid.levels[i];
}

// The inputs of the network, of a unit point.
RW_FN void inputs(float (&point)[DIMS], const float (&unit)[3]) {
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int k = 0; k < DIMS; ++k) point[k] = unit[axes[k]];
}

// points: 3 floats each, unit coordinates. Log-stretch goes to `out`.
extern "C" __global__ void __launch_bounds__(THREADS, TOGETHER)
network_predict(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const float* __restrict__ layers,
                const __grid_constant__ Reading reading, const float* __restrict__ points, uint32_t n, float* __restrict__ out) {
    Weights& weights = *reinterpret_cast<Weights*>(shared);
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    read_levels(levels, grid);
    read_layers(weights, layers);
    const uint32_t tiles = (n + 15u) / 16u, stride = gridDim.x * WARPS, g = lane() >> 2;
    for (uint32_t tile = blockIdx.x * WARPS + threadIdx.x / 32u; tile < tiles; tile += stride) {
        float units[2][3], rows[2][DIMS];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const uint32_t sample = tile * 16u + g + 8u * row, at = sample < n ? sample : n - 1u;
            RW_UNROLL for (int k = 0; k < 3; ++k) units[row][k] = points[3 * size_t(at) + k];
            inputs(rows[row], units[row]);
        }
        Rows<ENCODED_BLOCKS> encoded;
        encode_rows(encoded, levels, {tables}, rows);
        Rows<WIDTH_BLOCKS> hidden[HIDDEN];
        float outputs[2];
        layers_forward(outputs, encoded, hidden, weights);
        // Lane 4g writes sample g, lane 4g + 1 sample g + 8.
        const uint32_t from = lane() & ~3u, q = lane() & 3u, sample = tile * 16u + g + 8u * q;
        const float first = __shfl_sync(0xffffffffu, outputs[0], from), second = __shfl_sync(0xffffffffu, outputs[1], from);
        if (q < 2u && sample < n) {
            const float unit[3] = {q ? units[1][0] : units[0][0], q ? units[1][1] : units[0][1], q ? units[1][2] : units[0][2]};
            out[sample] = read_output(reading, q ? second : first, unit);
        }
    }
}

// Which samples make up a batch (Pick in train.rs).
struct Draw {
    const Four* samples;  // unit point, target: the first `first` of `count`
    const Four* more;     // those behind them
    uint64_t seed, counter;
    uint32_t count, first, batch;
    uint32_t random;    // 0: the first ones, in order
    uint32_t hold_out;  // samples whose number is a multiple of this are left out, where one is drawn; 0: none
    uint32_t pad;
};
static_assert(sizeof(Draw) == 56, "layout");

// 64 random bits (module.rs).
RW_FN uint64_t mix(uint64_t seed, uint64_t counter) {
    uint64_t z = seed * 0xD1342543DE82EF95ull + (counter + 1ull) * 0x9E3779B97F4A7C15ull;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
}

RW_FN uint32_t drawn(const Draw& draw, uint32_t position) {
    if (!draw.random) return position;
    const uint32_t index = uint32_t(__umul64hi(mix(draw.seed, draw.counter + position), draw.count));
    return draw.hold_out && index % draw.hold_out == 0u ? (index + 1u) % draw.count : index;
}

// Sums of the outer products of inputs and deltas over samples: (IN + 1) * OUT tiles of 16 x 8, divided among the warps. The last row of
// tiles belongs to an input that is always 1: the biases.
template <int IN, int OUT> struct Products {
    static constexpr int TILES = (IN + 1) * OUT, OWN = (TILES + WARPS - 1) / WARPS;
    float tile[OWN][4];

    RW_FN void clear() {
        RW_UNROLL for (int i = 0; i < OWN; ++i) {
            RW_UNROLL for (int k = 0; k < 4; ++k) tile[i][k] = 0.0f;
        }
    }

    // Of the whole block's samples.
    RW_FN void add(const uint16_t* in, int in_stride, const uint16_t* delta, int delta_stride) {
        const int warp = threadIdx.x / 32u, l = lane();
        RW_UNROLL for (int i = 0; i < OWN; ++i) {
            const int t = warp + WARPS * i, n = t % OUT, m = t / OUT;
            if (t >= TILES) break;
            for (int k = 0; k < WARPS; ++k) {
                uint32_t a[4] = {0x3c003c00u, 0x3c003c00u, 0x3c003c00u, 0x3c003c00u}, b[2];
                if (m < IN) read_turned(a, in + (16 * k + (l >> 4) * 8 + (l & 7)) * in_stride + 16 * m + (l >> 3 & 1) * 8);
                read_turned(b, delta + (16 * k + (l & 15)) * delta_stride + 8 * n);
                multiply(tile[i], a, b[0], b[1]);
            }
        }
    }

    // To the flat gradient of a layer.
    RW_FN void flush(float* layer, int inputs, int outputs) const {
        const int warp = threadIdx.x / 32u, g = lane() >> 2, q = lane() & 3;
        RW_UNROLL for (int i = 0; i < OWN; ++i) {
            const int t = warp + WARPS * i, n = t % OUT, m = t / OUT;
            if (t >= TILES) break;
            RW_UNROLL for (int k = 0; k < 4; ++k) {
                const int in = 16 * m + g + 8 * (k >> 1), out = 8 * n + 2 * q + (k & 1);
                if (out >= outputs) continue;
                if (m == IN ? in == 16 * IN : in < inputs) atomicAdd(layer + (m == IN ? inputs : in) * outputs + out, tile[i][k]);
            }
        }
    }
};

template <int BLOCKS> RW_FN void store(uint16_t* to, int stride, const Rows<BLOCKS>& rows) {
    const int row = 16 * (threadIdx.x / 32u) + (lane() >> 2), column = 2 * (lane() & 3u);
    RW_UNROLL for (int k = 0; k < BLOCKS; ++k) {
        RW_UNROLL for (int part = 0; part < 4; ++part)
            *reinterpret_cast<uint32_t*>(to + (row + 8 * (part & 1)) * stride + 16 * k + 8 * (part >> 1) + column) = rows.block[k][part];
    }
}

// `from` where the activation passed it, as rows.
RW_FN void gate(Rows<WIDTH_BLOCKS>& delta, const Rows<WIDTH_BLOCKS>& passed, const Sums<2 * WIDTH_BLOCKS>& from) {
    RW_UNROLL for (int n = 0; n < WIDTH_BLOCKS; ++n) {
        RW_UNROLL for (int part = 0; part < 4; ++part) {
            const float(&sums)[4] = from.block[2 * n + (part >> 1)];
            const uint32_t active = passed.block[n][part];
            delta.block[n][part] = pack(active & 0x00007fffu ? sums[2 * (part & 1)] : 0.0f, active & 0x7fff0000u ? sums[2 * (part & 1) + 1] : 0.0f);
        }
    }
}

constexpr int WIDEST = ENCODED_BLOCKS > WIDTH_BLOCKS ? ENCODED_BLOCKS : WIDTH_BLOCKS;
constexpr int IN_STRIDE = 16 * WIDEST + SKEW;

struct alignas(16) Workspace {
    Weights weights;
    uint16_t in[ROWS][IN_STRIDE];
    uint16_t delta[ROWS][STRIDE];
};
// What launches ask for.
static_assert(sizeof(Weights) == RW_WEIGHTS_BYTES && sizeof(Workspace) == RW_WORKSPACE_BYTES, "layout");

// Adds, for each sample of the batch, the gradient of its squared error; their mean is the loss, so the optimizer divides by the batch.
// A target that is not finite counts for nothing.
extern "C" __global__ void __launch_bounds__(THREADS, TOGETHER)
network_gradient(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const float* __restrict__ layers, const Draw draw,
                 float* __restrict__ table_gradient, float* __restrict__ layer_gradient, double* __restrict__ loss) {
    Workspace& work = *reinterpret_cast<Workspace*>(shared);
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    __shared__ float losses[WARPS];
    read_levels(levels, grid);
    read_layers(work.weights, layers);
    const uint32_t tiles = (draw.batch + ROWS - 1u) / ROWS, g = lane() >> 2, q = lane() & 3u;
    Products<ENCODED_BLOCKS, 2 * WIDTH_BLOCKS> first;
    Products<WIDTH_BLOCKS, 2 * WIDTH_BLOCKS> middle[HIDDEN > 1 ? HIDDEN - 1 : 1];
    Products<WIDTH_BLOCKS, 1> last;
    first.clear();
    last.clear();
    RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer) middle[layer - 1].clear();
    float squares = 0.0f;
    for (uint32_t tile = blockIdx.x; tile < tiles; tile += gridDim.x) {
        float points[2][DIMS], targets[2];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const uint32_t position = tile * ROWS + 16u * (threadIdx.x / 32u) + g + 8u * row;
            Four sample = {0.0f, 0.0f, 0.0f, not_a_number()};
            if (position < draw.batch) {
                const uint32_t number = drawn(draw, position);
                sample = load(number < draw.first ? draw.samples + number : draw.more + (number - draw.first));
            }
            const float unit[3] = {sample.x, sample.y, sample.z};
            inputs(points[row], unit);
            targets[row] = sample.w;
        }
        Rows<ENCODED_BLOCKS> encoded;
        encode_rows(encoded, levels, {tables}, points);
        Rows<WIDTH_BLOCKS> hidden[HIDDEN];
        float outputs[2];
        layers_forward(outputs, encoded, hidden, work.weights);

        // Gradient with respect to the outputs; all four lanes of a sample need it.
        float slopes[2];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const float output = __shfl_sync(0xffffffffu, outputs[row], lane() & ~3u);
            const float difference = isfinite(targets[row]) ? output - targets[row] : 0.0f;
            if (q == 0u) squares = fma_(difference, difference, squares);
            slopes[row] = 2.0f * difference;
        }
        // The head.
        store(&work.in[0][0], IN_STRIDE, hidden[HIDDEN - 1]);
        RW_UNROLL for (int row = 0; row < 2; ++row)
            *reinterpret_cast<uint32_t*>(&work.delta[16 * (threadIdx.x / 32u) + g + 8 * row][2 * q]) = q == 0u ? pack(slopes[row], 0.0f) : 0u;
        __syncthreads();
        last.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
        Rows<WIDTH_BLOCKS> delta;
        {
            Sums<2 * WIDTH_BLOCKS> sums;
            RW_UNROLL for (int n = 0; n < 2 * WIDTH_BLOCKS; ++n) {
                RW_UNROLL for (int k = 0; k < 4; ++k) sums.block[n][k] = slopes[k >> 1] * from_half(work.weights.head[8 * n + 2 * q + (k & 1)][0]);
            }
            gate(delta, hidden[HIDDEN - 1], sums);
        }
        // The hidden layers, last to second.
        RW_UNROLL for (int layer = HIDDEN - 1; layer > 0; --layer) {
            __syncthreads();
            store(&work.in[0][0], IN_STRIDE, hidden[layer - 1]);
            store(&work.delta[0][0], STRIDE, delta);
            __syncthreads();
            middle[layer - 1].add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
            Sums<2 * WIDTH_BLOCKS> sums;
            backward(sums, delta, work.weights.hidden[layer - 1]);
            gate(delta, hidden[layer - 1], sums);
        }
        // The first layer, and the tables below it.
        __syncthreads();
        store(&work.in[0][0], IN_STRIDE, encoded);
        store(&work.delta[0][0], STRIDE, delta);
        __syncthreads();
        first.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
#if RW_LEVELS > 0
        Sums<2 * ENCODED_BLOCKS> sums;
        backward(sums, delta, work.weights.first);
        RW_UNROLL for (int n = 0; n < 2 * ENCODED_BLOCKS; ++n) {
            RW_UNROLL for (int row = 0; row < 2; ++row) {
                // What has no target would only add zeros.
                if (isfinite(targets[row]))
                    scatter(levels, points[row], 8 * n + 2 * int(q), sums.block[n][2 * row], sums.block[n][2 * row + 1], table_gradient);
            }
        }
#endif
        __syncthreads();
    }
    first.flush(layer_gradient, ENCODED, WIDTH);
    RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer) middle[layer - 1].flush(layer_gradient + layer_start(layer), WIDTH, WIDTH);
    last.flush(layer_gradient + layer_start(HIDDEN), WIDTH, 1);
    for (int apart = 16; apart > 0; apart /= 2) squares += __shfl_xor_sync(0xffffffffu, squares, apart);
    if (lane() == 0u) losses[threadIdx.x / 32u] = squares;
    __syncthreads();
    if (threadIdx.x == 0) {
        double sum = 0.0;
        for (int warp = 0; warp < WARPS; ++warp) sum += losses[warp];
        atomicAdd(loss, sum / draw.batch);
    }
}

// The factors of one step of Adam (Kingma and Ba 2015), with burn's arithmetic (adam.rs).
struct Adam {
    float rate, epsilon, correction;
    float gradient;  // factor on the gradient
};
static_assert(sizeof(Adam) == 16, "layout");

RW_FN float adam_step(const Adam& adam, float gradient, float* parameter, float* first, float* second) {
    const float g = gradient * adam.gradient, m = *first * 0.9f + g * (1.0f - 0.9f), v = *second * 0.999f + g * g * (1.0f - 0.999f);
    const float p = *parameter - m * adam.correction / (sqrtf(v) + adam.epsilon) * adam.rate;
    *first = m;
    *second = v;
    return *parameter = p;
}

// The level of padded value `i`, and its place in burn's tables; false in the padding.
RW_FN bool place(const Grid& grid, size_t i, size_t* at) {
    const uint32_t entry = uint32_t(i / FEATURES);
    int level = 0;
    for (int next = 1; next < LEVELS; ++next) level = entry >= grid.levels[next].offset ? next : level;
    const uint32_t inside = entry - grid.levels[level].offset;
    *at = size_t(grid.levels[level].start + inside) * FEATURES + i % FEATURES;
    return inside < grid.levels[level].entries;
}

// A thread a padded value, of which there are `n`. Lines of 16 values that got no gradient wait, where `lazy` (as lazy_step in adam.rs).
extern "C" __global__ void __launch_bounds__(256)
network_adam_tables(const __grid_constant__ Grid grid, const Adam adam, uint64_t n, uint32_t lazy, float* __restrict__ gradient,
                    float* __restrict__ parameters, float* __restrict__ first, float* __restrict__ second, uint16_t* __restrict__ halves) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    const float g = i < n ? gradient[i] : 0.0f;
    const uint32_t line = __ballot_sync(0xffffffffu, g != 0.0f) >> (threadIdx.x & 16u) & 0xffffu;
    size_t at;
    if (i >= n || (lazy && line == 0u) || !place(grid, i, &at)) return;
    gradient[i] = 0.0f;
    halves[i] = to_half(adam_step(adam, g, parameters + at, first + at, second + at));
}

extern "C" __global__ void __launch_bounds__(256)
network_adam_layers(const Adam adam, uint32_t n, float* __restrict__ gradient, float* __restrict__ parameters, float* __restrict__ first,
                    float* __restrict__ second) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    adam_step(adam, gradient[i], parameters + i, first + i, second + i);
    gradient[i] = 0.0f;
}

// The running mean of the parameters.
extern "C" __global__ void __launch_bounds__(256)
network_average(float share, uint64_t n, const float* __restrict__ parameters, float* __restrict__ average) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    if (i < n) average[i] += (parameters[i] - average[i]) * share;
}

// burn's tables as padded tables in half precision.
extern "C" __global__ void __launch_bounds__(256)
network_halves(const __grid_constant__ Grid grid, uint64_t n, const float* __restrict__ tables, uint16_t* __restrict__ halves) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    size_t at;
    if (i < n) halves[i] = place(grid, i, &at) ? to_half(tables[at]) : uint16_t(0);
}

// Uniform points of the domain (domain coordinates): those numbered `first` and on.
extern "C" __global__ void __launch_bounds__(256)
network_points(const __grid_constant__ UnitBox domain, uint64_t seed, uint64_t first, uint32_t n, float* __restrict__ points) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    for (int k = 0; k < 3; ++k) {
        const double unit = double(mix(seed, 3 * (first + i) + k) >> 40) / double(1u << 24);
        points[3 * size_t(i) + k] = float(domain.min[k] + unit * domain.extent[k]);
    }
}

// Traced points (domain coordinates) as samples: the target is what the log-stretch has beyond `base`, scaled (Objective::targets). Of every
// 2^held_back points one gets none, the one that the host may keep as a label; with 0 all get one.
extern "C" __global__ void __launch_bounds__(256)
network_samples(const __grid_constant__ UnitBox domain, const __grid_constant__ Reading reading, const float* __restrict__ points,
                const float* __restrict__ log_stretch, uint32_t n, uint32_t held_back, Four* __restrict__ samples) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const float point[3] = {points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2]};
    float unit[3], target;
    to_unit(domain, point, unit);
    if (reading.published) {
        const float y = log_stretch[i] / reading.tau;
        target = copysignf(log1pf(fabsf(y)), y);
    } else {
        const float below = reading.base.values ? look_up(reading.base, unit) : 0.0f;
        target = (log_stretch[i] - below - reading.mean) / reading.deviation;
    }
    // No place, no target.
    if (!isfinite(point[0] + point[1] + point[2]) || (held_back && keeps_label(point, held_back))) target = not_a_number();
    samples[i] = {unit[0], unit[1], unit[2], target};
}

// Adds the number of samples that have a target to `count`.
extern "C" __global__ void __launch_bounds__(256)
network_usable(const Four* __restrict__ samples, uint32_t n, uint32_t* __restrict__ count) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    const uint32_t usable = __ballot_sync(0xffffffffu, i < n && isfinite(samples[i < n ? i : 0u].w));
    if ((threadIdx.x & 31u) == 0u && usable) atomicAdd(count, uint32_t(__popc(usable)));
}
