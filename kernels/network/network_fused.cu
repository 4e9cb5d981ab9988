// Prediction and gradient of a batch by a fully fused multilayer perceptron (Mueller et al. 2021): a warp keeps its samples in registers through
// all layers, whose weights are in shared memory. network_batched.cu has the networks that are too large for this.
#include "network/network_data.cuh"

using namespace rw;

constexpr int WARPS = 8, THREADS = 32 * WARPS, ROWS = 16 * WARPS;
// Two blocks per multiprocessor, so that one gathers while the other multiplies, unless registers are too few.
constexpr int TOGETHER = 16 * WIDTH_BLOCKS * HIDDEN <= 128 ? 2 : 1;

extern __shared__ __align__(16) unsigned char shared[];

// points: 3 floats each, unit coordinates. out: log-stretch.
extern "C" __global__ void __launch_bounds__(THREADS, RW_FLOW_MAP ? 1 : TOGETHER)
network_predict(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const float* __restrict__ layers,
                const __grid_constant__ Reading reading, const float* __restrict__ points, uint32_t n, float* __restrict__ out) {
    Weights& weights = *reinterpret_cast<Weights*>(shared);
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    read_levels(levels, grid);
    read_layers(weights, layers);
    const uint32_t tiles = (n + 15u) / 16u, stride = gridDim.x * WARPS, g = lane() >> 2;
    for (uint32_t tile = blockIdx.x * WARPS + threadIdx.x / 32u; tile < tiles; tile += stride) {
        float units[2][PLACES], rows[2][DIMS];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const uint32_t sample = tile * 16u + g + 8u * row, at = sample < n ? sample : n - 1u;
            read_point(reading, points, at, units[row]);
            place_times(reading, units[row]);
            inputs(rows[row], units[row]);
        }
        Rows<WIDTH_BLOCKS> hidden[HIDDEN];
        // Lane 4g writes sample g, lane 4g + 1 sample g + 8.
        const uint32_t q = lane() & 3u, sample = tile * 16u + g + 8u * q;
#if RW_FLOW_MAP
        Rows<ENCODED_BLOCKS> encoded[GROUPS];
        encode_rows(encoded, levels, {tables}, rows, reading.step);
        hidden_forward(encoded[0], hidden, weights);
        float tangents[OUTPUTS][SPACE];
        RW_UNROLL for (int along = 0; along < SPACE; ++along) {
            Rows<WIDTH_BLOCKS> passed[HIDDEN];
            float outputs[4];
            tangent_forward(outputs, encoded[1 + along], passed, hidden, weights);
            RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
                const float first = output_of(outputs, 0, output), second = output_of(outputs, 1, output);
                tangents[output][along] = q ? second : first;
            }
        }
        if (q < 2u && sample < n) out[sample] = read_tangents(reading, tangents);
#else
        Rows<ENCODED_BLOCKS> encoded;
        encode_rows(encoded, levels, {tables}, rows);
        float outputs[4];
        layers_forward(outputs, encoded, hidden, weights);
        const float first = output_of(outputs, 0, 0), second = output_of(outputs, 1, 0);
        if (q < 2u && sample < n) {
            float unit[PLACES];
            RW_UNROLL for (int k = 0; k < PLACES; ++k) unit[k] = q ? units[1][k] : units[0][k];
            out[sample] = read_output(reading, q ? second : first, unit);
        }
#endif
    }
}

// Weight gradient of a layer: sums over samples of the outer products of inputs and deltas, in (IN + 1) * OUT tiles of 16 x 8 divided among the
// warps. The last row of tiles belongs to a constant input of 1: the biases.
template <int IN, int OUT> struct Products {
    static constexpr int TILES = (IN + 1) * OUT, OWN = (TILES + WARPS - 1) / WARPS;
    float tile[OWN][4];

    RW_FN void clear() {
        RW_UNROLL for (int i = 0; i < OWN; ++i)
            RW_UNROLL for (int k = 0; k < 4; ++k) tile[i][k] = 0.0f;
    }

    // Adds the samples of the whole block.
    RW_FN void add(const uint16_t* in, int in_stride, const uint16_t* delta, int delta_stride) {
        const int warp = threadIdx.x / 32u, l = lane();
        RW_UNROLL for (int i = 0; i < OWN; ++i) {
            const int t = warp + WARPS * i, n = t % OUT, m = t / OUT;
            if (t >= TILES) break;
            for (int k = 0; k < WARPS; ++k) {
                uint32_t a[4] = {0x3c003c00u, 0x3c003c00u, 0x3c003c00u, 0x3c003c00u}, b[2];
                if (m < IN) load_transposed(a, in + (16 * k + (l >> 4) * 8 + (l & 7)) * in_stride + 16 * m + (l >> 3 & 1) * 8);
                load_transposed(b, delta + (16 * k + (l & 15)) * delta_stride + 8 * n);
                multiply(tile[i], a, b[0], b[1]);
            }
        }
    }

    // Adds `factor` times the sums to the flat gradient of a layer, biases included if `biased`.
    RW_FN void flush(float* layer, int inputs, int outputs, float factor, bool biased) const {
        const int warp = threadIdx.x / 32u, g = lane() >> 2, q = lane() & 3;
        RW_UNROLL for (int i = 0; i < OWN; ++i) {
            const int t = warp + WARPS * i, n = t % OUT, m = t / OUT;
            if (t >= TILES) break;
            RW_UNROLL for (int k = 0; k < 4; ++k) {
                const int in = 16 * m + g + 8 * (k >> 1), out = 8 * n + 2 * q + (k & 1);
                if (out >= outputs) continue;
                if (m == IN ? biased && in == 16 * IN : in < inputs)
                    atomicAdd(layer + (m == IN ? inputs : in) * outputs + out, factor * tile[i][k]);
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

constexpr int WIDEST = ENCODED_BLOCKS > WIDTH_BLOCKS ? ENCODED_BLOCKS : WIDTH_BLOCKS;
constexpr int IN_STRIDE = 16 * WIDEST + SKEW;

struct alignas(16) Workspace {
    Weights weights;
    uint16_t in[ROWS][IN_STRIDE];
    uint16_t delta[ROWS][STRIDE];
};
// Shared memory of the launches.
static_assert(sizeof(Weights) == RW_WEIGHTS_BYTES && sizeof(Workspace) == RW_WORKSPACE_BYTES, "layout");

// Weight gradients of all layers.
struct Gradients {
    Products<ENCODED_BLOCKS, 2 * WIDTH_BLOCKS> first;
    Products<WIDTH_BLOCKS, 2 * WIDTH_BLOCKS> middle[HIDDEN > 1 ? HIDDEN - 1 : 1];
    Products<WIDTH_BLOCKS, 1> last;

    RW_FN void clear() {
        first.clear();
        last.clear();
        RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer) middle[layer - 1].clear();
    }

    // Adds `factor` times the sums to the flat gradient, biases included if `biased`.
    RW_FN void flush(float* layers, float factor, bool biased) const {
        first.flush(layers, ENCODED, WIDTH, factor, biased);
        RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer)
            middle[layer - 1].flush(layers + layer_start(layer), WIDTH, WIDTH, factor, biased);
        last.flush(layers + layer_start(HIDDEN), WIDTH, OUTPUTS, factor, biased);
    }
};

// Adds `sum` of all threads, divided by outputs and batch, to the loss, and `more` once per launch.
RW_FN void add_loss(double* loss, float sum, uint32_t batch, double more) {
    __shared__ float sums[WARPS];
    sum = warp_sum(sum);
    if (lane() == 0u) sums[threadIdx.x / 32u] = sum;
    __syncthreads();
    if (threadIdx.x == 0) {
        double all = 0.0;
        for (int warp = 0; warp < WARPS; ++warp) all += sums[warp];
        atomicAdd(loss, all / OUTPUTS / batch + (blockIdx.x == 0 ? more : 0.0));
    }
}

// Adds the gradient of the squared errors of each sample of the batch. The loss is their mean over outputs and batch; the optimizer divides the
// gradient by both. A sample without targets contributes nothing.
extern "C" __global__ void __launch_bounds__(THREADS, TOGETHER)
network_gradient(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const float* __restrict__ layers, const Draw draw,
                 float* __restrict__ table_gradient, float* __restrict__ layer_gradient, double* __restrict__ loss) {
    Workspace& work = *reinterpret_cast<Workspace*>(shared);
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    read_levels(levels, grid);
    read_layers(work.weights, layers);
    const uint32_t tiles = (draw.batch + ROWS - 1u) / ROWS, g = lane() >> 2, q = lane() & 3u;
    Gradients gradients;
    gradients.clear();
#if RW_PENALTY
    const float penalty = penalty_slope(draw);
#endif
    float squares = 0.0f;
    for (uint32_t tile = blockIdx.x; tile < tiles; tile += gridDim.x) {
        float points[2][DIMS], targets[2][OUTPUTS];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const uint32_t position = tile * ROWS + 16u * (threadIdx.x / 32u) + g + 8u * row;
            const Sample sample = position < draw.batch ? drawn_sample(draw, position) : no_sample();
            inputs(points[row], sample.place);
            RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) targets[row][output] = sample.target[output];
        }
        Rows<ENCODED_BLOCKS> encoded;
        encode_rows(encoded, levels, {tables}, points);
        Rows<WIDTH_BLOCKS> hidden[HIDDEN];
        float outputs[4];
        layers_forward(outputs, encoded, hidden, work.weights);

        // Gradient with respect to the outputs, in all four lanes of a sample.
        float slopes[2][OUTPUTS];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
                const float found = output_of(outputs, row, output);
                const float difference = is_finite(targets[row][output]) ? found - targets[row][output] : 0.0f;
                if (q == 0u) squares = fma_(difference, difference, squares);
                slopes[row][output] = 2.0f * difference;
#if RW_PENALTY
                if (is_finite(targets[row][output])) slopes[row][output] = fma_(penalty, expf(fabsf(found)), slopes[row][output]);
#endif
            }
        }
        // The head.
        store(&work.in[0][0], IN_STRIDE, hidden[HIDDEN - 1]);
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            uint32_t pair = q == 0u ? pack(slopes[row][0], OUTPUTS > 1 ? slopes[row][OUTPUTS > 1] : 0.0f) : 0u;
            if (OUTPUTS > 2 && q == 1u) pair = pack(slopes[row][OUTPUTS - 1], 0.0f);
            *reinterpret_cast<uint32_t*>(&work.delta[16 * (threadIdx.x / 32u) + g + 8 * row][2 * q]) = pair;
        }
        __syncthreads();
        gradients.last.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
        Rows<WIDTH_BLOCKS> delta;
        {
            Sums<2 * WIDTH_BLOCKS> sums;
            RW_UNROLL for (int n = 0; n < 2 * WIDTH_BLOCKS; ++n) {
                RW_UNROLL for (int k = 0; k < 4; ++k) {
                    const uint16_t(&head)[HEAD_STRIDE] = work.weights.head[8 * n + 2 * q + (k & 1)];
                    float sum = slopes[k >> 1][0] * from_half(head[0]);
                    RW_UNROLL for (int output = 1; output < OUTPUTS; ++output) sum = fma_(slopes[k >> 1][output], from_half(head[output]), sum);
                    sums.block[n][k] = sum;
                }
            }
            relu_mask(delta, hidden[HIDDEN - 1], sums);
        }
        // The hidden layers, last to second.
        RW_UNROLL for (int layer = HIDDEN - 1; layer > 0; --layer) {
            __syncthreads();
            store(&work.in[0][0], IN_STRIDE, hidden[layer - 1]);
            store(&work.delta[0][0], STRIDE, delta);
            __syncthreads();
            gradients.middle[layer - 1].add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
            Sums<2 * WIDTH_BLOCKS> sums;
            backward(sums, delta, work.weights.hidden[layer - 1]);
            relu_mask(delta, hidden[layer - 1], sums);
        }
        // The first layer, and the tables below it.
        __syncthreads();
        store(&work.in[0][0], IN_STRIDE, encoded);
        store(&work.delta[0][0], STRIDE, delta);
        __syncthreads();
        gradients.first.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
#if RW_LEVELS > 0
        Sums<2 * ENCODED_BLOCKS> sums;
        backward(sums, delta, work.weights.first);
        RW_UNROLL for (int n = 0; n < 2 * ENCODED_BLOCKS; ++n) {
            RW_UNROLL for (int row = 0; row < 2; ++row) {
                // A sample without a target would only add zeros.
                if (is_finite(targets[row][0]))
                    scatter(levels, points[row], 8 * n + 2 * int(q), sums.block[n][2 * row], sums.block[n][2 * row + 1], table_gradient);
            }
        }
#endif
        __syncthreads();
    }
    gradients.flush(layer_gradient, 1.0f, true);
    double more = 0.0;
#if RW_PENALTY
    more = penalty_loss(draw);
#endif
    add_loss(loss, squares, draw.batch, more);
}

#if RW_DERIVATIVES
// Backpropagates `slopes`, the gradient with respect to a tangent's outputs in all four lanes of a sample, through the layers as `network_gradient`
// does (which does not call this: the compiler would spill other registers there): adds to their gradients, and calls `give(sums)` with the
// gradient with respect to the encoded tangents, if there are tables. `rows`: tangents of the hidden layers; `passed`: the ReLU's masks. The whole
// block must call it; ends with a barrier.
template <class Give>
RW_FN void backpropagate(Workspace& work, Gradients& gradients, const float (&slopes)[2][OUTPUTS], const Rows<ENCODED_BLOCKS>& encoded,
                         const Rows<WIDTH_BLOCKS> (&rows)[HIDDEN], const Passed (&passed)[HIDDEN], [[maybe_unused]] Give give) {
    const uint32_t g = lane() >> 2, q = lane() & 3u;
    // The head.
    store(&work.in[0][0], IN_STRIDE, rows[HIDDEN - 1]);
    RW_UNROLL for (int row = 0; row < 2; ++row) {
        uint32_t pair = q == 0u ? pack(slopes[row][0], OUTPUTS > 1 ? slopes[row][OUTPUTS > 1] : 0.0f) : 0u;
        if (OUTPUTS > 2 && q == 1u) pair = pack(slopes[row][OUTPUTS - 1], 0.0f);
        *reinterpret_cast<uint32_t*>(&work.delta[16 * (threadIdx.x / 32u) + g + 8 * row][2 * q]) = pair;
    }
    __syncthreads();
    gradients.last.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
    Rows<WIDTH_BLOCKS> delta;
    {
        Sums<2 * WIDTH_BLOCKS> sums;
        RW_UNROLL for (int n = 0; n < 2 * WIDTH_BLOCKS; ++n) {
            RW_UNROLL for (int k = 0; k < 4; ++k) {
                const uint16_t(&head)[HEAD_STRIDE] = work.weights.head[8 * n + 2 * q + (k & 1)];
                float sum = slopes[k >> 1][0] * from_half(head[0]);
                RW_UNROLL for (int output = 1; output < OUTPUTS; ++output) sum = fma_(slopes[k >> 1][output], from_half(head[output]), sum);
                sums.block[n][k] = sum;
            }
        }
        relu_mask(delta, passed[HIDDEN - 1], sums);
    }
    // The hidden layers, last to second.
    RW_UNROLL for (int layer = HIDDEN - 1; layer > 0; --layer) {
        __syncthreads();
        store(&work.in[0][0], IN_STRIDE, rows[layer - 1]);
        store(&work.delta[0][0], STRIDE, delta);
        __syncthreads();
        gradients.middle[layer - 1].add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
        Sums<2 * WIDTH_BLOCKS> sums;
        backward(sums, delta, work.weights.hidden[layer - 1]);
        relu_mask(delta, passed[layer - 1], sums);
    }
    // The first layer, and the tables below it.
    __syncthreads();
    store(&work.in[0][0], IN_STRIDE, encoded);
    store(&work.delta[0][0], STRIDE, delta);
    __syncthreads();
    gradients.first.add(&work.in[0][0], IN_STRIDE, &work.delta[0][0], STRIDE);
#if RW_LEVELS > 0
    Sums<2 * ENCODED_BLOCKS> sums;
    backward(sums, delta, work.weights.first);
    give(sums);
#endif
    __syncthreads();
}

// Adds the gradient of the squared errors of the network's derivatives along each axis, times `factor`. Tangents have the length `step`, which
// `factor` divides out in single precision, so that tangents and their gradients are of the order of values in half precision.
extern "C" __global__ void __launch_bounds__(THREADS, TOGETHER)
network_tangent_gradient(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const float* __restrict__ layers, const Draw draw,
                         float step, float factor, float* __restrict__ table_gradient, float* __restrict__ layer_gradient,
                         double* __restrict__ loss) {
    Workspace& work = *reinterpret_cast<Workspace*>(shared);
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    read_levels(levels, grid);
    read_layers(work.weights, layers);
    const uint32_t tiles = (draw.batch + ROWS - 1u) / ROWS, g = lane() >> 2, q = lane() & 3u;
    Gradients gradients;
    gradients.clear();
    float squares = 0.0f;
    for (uint32_t tile = blockIdx.x; tile < tiles; tile += gridDim.x) {
        float points[2][DIMS];
        // Null: no target.
        const Float4* samples[2];
        RW_UNROLL for (int row = 0; row < 2; ++row) {
            const uint32_t position = tile * ROWS + 16u * (threadIdx.x / 32u) + g + 8u * row;
            samples[row] = position < draw.batch ? drawn_at(draw, position) : nullptr;
            const Sample sample = samples[row] ? load_sample(samples[row]) : no_sample();
            if (!is_usable(sample)) samples[row] = nullptr;
            inputs(points[row], sample.place);
        }
        Rows<ENCODED_BLOCKS> encoded;
        Rows<WIDTH_BLOCKS> rows[HIDDEN];
        encode_rows(encoded, levels, {tables}, points);
        hidden_forward(encoded, rows, work.weights);
        Passed passed[HIDDEN];
        RW_UNROLL for (int layer = 0; layer < HIDDEN; ++layer) passed[layer] = Passed(rows[layer]);
#pragma unroll 1
        for (int along = 0; along < SPACE; ++along) {
            const Tangents tangents = {along, step};
            encode_rows(encoded, levels, {tables}, points, tangents);
            float outputs[4], slopes[2][OUTPUTS];
            tangent_forward(outputs, encoded, rows, passed, work.weights);
            RW_UNROLL for (int row = 0; row < 2; ++row) {
                RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
                    const float found = output_of(outputs, row, output);
                    const float difference = samples[row] ? tangent_difference(found, step * load_slope(samples[row], along, output)) : 0.0f;
                    if (q == 0u) squares = fma_(difference, difference, squares);
                    slopes[row][output] = 2.0f * difference;
                }
            }
            backpropagate(work, gradients, slopes, encoded, rows, passed, [&](const Sums<2 * ENCODED_BLOCKS>& sums) {
                RW_UNROLL for (int n = 0; n < 2 * ENCODED_BLOCKS; ++n) {
                    RW_UNROLL for (int row = 0; row < 2; ++row) {
                        const float x = factor * sums.block[n][2 * row], y = factor * sums.block[n][2 * row + 1];
                        if (samples[row]) scatter(levels, points[row], 8 * n + 2 * int(q), x, y, table_gradient, tangents);
                    }
                }
            });
        }
    }
    // Biases do not move a tangent.
    gradients.flush(layer_gradient, factor, false);
    add_loss(loss, factor * squares, draw.batch, 0.0);
}
#endif
