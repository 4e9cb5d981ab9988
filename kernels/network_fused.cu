// Networks that a warp carries its samples through in registers: prediction, and the gradient of a batch.
#include "network_data.cuh"

using namespace rw;

constexpr int WARPS = 8, THREADS = 32 * WARPS, ROWS = 16 * WARPS;
// Two blocks a multiprocessor, so that one gathers while the other multiplies, unless registers run short.
constexpr int TOGETHER = 16 * WIDTH_BLOCKS * HIDDEN <= 128 ? 2 : 1;

extern __shared__ __align__(16) unsigned char shared[];

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
            place_times(reading, units[row]);
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
            if (position < draw.batch) sample = drawn_sample(draw, position);
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
