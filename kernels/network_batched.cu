// Networks too wide or too deep for a warp's registers: a batch goes through them layer by layer, one product of matrices each. Values and
// weights are in half precision, sums in single precision, as in network_fused.cu.
//
// Rows of values are as long as PADDED says (ENCODED_PADDED before the first layer) and there are whole tiles of them; what is beyond the
// network is 0 in the weights, so that it never counts.
#include "network_data.cuh"

using namespace rw;

// Outputs of a block of a product: TILE x TILE, summed up in steps of DEPTH (whole lines of the cache), STAGES of which are in shared memory
// or on the way.
constexpr int THREADS = 256, TILE = 128, DEPTH = 64, STAGES = RW_STAGES;
constexpr uint32_t PADDED = (WIDTH + TILE - 1) / TILE * TILE, ENCODED_PADDED = (ENCODED + TILE - 1) / TILE * TILE;

// TILE rows or columns of a matrix, DEPTH of the other kind. DOWN: what is summed up goes down the rows.
template <bool DOWN> struct Panel {
    static constexpr int ROWS = DOWN ? DEPTH : TILE, COLUMNS = DOWN ? TILE : DEPTH, ROW = COLUMNS + SKEW;
    uint16_t values[ROWS][ROW];

    // The panel of `from` (rows of `stride` values) that begins at `first` of the outputs and at `k` of what is summed up; without waiting.
    RW_FN void bring(const uint16_t* from, size_t stride, uint32_t first, uint32_t k) {
        from += DOWN ? k * stride + first : first * stride + k;
        constexpr int A_ROW = COLUMNS / 8;
        RW_UNROLL for (int i = 0; i < TILE * DEPTH / 8 / THREADS; ++i) {
            const uint32_t part = threadIdx.x + THREADS * i, row = part / A_ROW, column = part % A_ROW * 8;
            asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(uint32_t(__cvta_generic_to_shared(&values[row][column]))),
                         "l"(from + row * stride + column)
                         : "memory");
        }
    }
};

// A block's product: a warp has 64 rows and 32 columns of it.
template <bool A_DOWN, bool B_DOWN> struct Product {
    struct Shared {
        Panel<A_DOWN> a[STAGES];
        Panel<B_DOWN> b[STAGES];
    };
    float sums[4][4][4];

    // First row and column of this lane's part of tile (m, n) of the warp's, in the whole product.
    static RW_FN uint32_t row(int m) { return blockIdx.y * TILE + threadIdx.x / 128u * 64u + 16u * m + (lane() >> 2); }
    static RW_FN uint32_t column(int n) { return blockIdx.x * TILE + threadIdx.x / 32u % 4u * 32u + 8u * n + 2u * (lane() & 3u); }

    // Over [from, to) of what is summed up, a multiple of DEPTH.
    RW_FN void run(const uint16_t* a, size_t a_stride, const uint16_t* b, size_t b_stride, uint32_t from, uint32_t to) {
        extern __shared__ __align__(16) unsigned char memory[];
        Shared& shared = *reinterpret_cast<Shared*>(memory);
        RW_UNROLL for (int m = 0; m < 4; ++m) {
            RW_UNROLL for (int n = 0; n < 4; ++n) {
                RW_UNROLL for (int k = 0; k < 4; ++k) sums[m][n][k] = 0.0f;
            }
        }
        const uint32_t steps = (to - from) / DEPTH;
        auto bring = [&](uint32_t step) {
            if (step < steps) {
                shared.a[step % STAGES].bring(a, a_stride, blockIdx.y * TILE, from + step * DEPTH);
                shared.b[step % STAGES].bring(b, b_stride, blockIdx.x * TILE, from + step * DEPTH);
            }
            // An empty group counts too.
            asm volatile("cp.async.commit_group;" ::: "memory");
        };
        RW_UNROLL for (int step = 0; step < STAGES - 1; ++step) bring(step);
        for (uint32_t step = 0; step < steps; ++step) {
            asm volatile("cp.async.wait_group %0;" ::"n"(STAGES - 2) : "memory");
            __syncthreads();
            // Into the stage that all have done with.
            bring(step + STAGES - 1);
            add(shared.a[step % STAGES], shared.b[step % STAGES]);
        }
    }

    RW_FN void add(const Panel<A_DOWN>& a, const Panel<B_DOWN>& b) {
        const uint32_t l = lane(), low = l & 7u, middle = (l >> 3 & 1u) * 8u, high = (l >> 4) * 8u;
        const uint32_t first_row = threadIdx.x / 128u * 64u, first_column = threadIdx.x / 32u % 4u * 32u;
        RW_UNROLL for (int k = 0; k < DEPTH; k += 16) {
            uint32_t left[4][4], right[2][4];
            RW_UNROLL for (int m = 0; m < 4; ++m) {
                if constexpr (A_DOWN) read_turned(left[m], &a.values[k + high + low][first_row + 16 * m + middle]);
                else read_blocks(left[m], &a.values[first_row + 16 * m + middle + low][k + high]);
            }
            RW_UNROLL for (int n = 0; n < 2; ++n) {
                if constexpr (B_DOWN) read_turned(right[n], &b.values[k + middle + low][first_column + 16 * n + high]);
                else read_blocks(right[n], &b.values[first_column + 16 * n + high + low][k + middle]);
            }
            RW_UNROLL for (int m = 0; m < 4; ++m) {
                RW_UNROLL for (int n = 0; n < 4; ++n) multiply(sums[m][n], left[m], right[n / 2][n % 2 * 2], right[n / 2][n % 2 * 2 + 1]);
            }
        }
    }
};
// What launches ask for.
static_assert(sizeof(Product<false, true>::Shared) <= RW_PRODUCT_BYTES && sizeof(Product<false, false>::Shared) <= RW_PRODUCT_BYTES &&
                  sizeof(Product<true, true>::Shared) <= RW_PRODUCT_BYTES,
              "shared memory");

// A block's results in half precision, in place of its panels: they go out in whole lines.
struct Results {
    static constexpr int CHUNKS = TILE / 8, ROWS = THREADS / CHUNKS;
    uint16_t values[TILE][TILE + SKEW];

    static RW_FN Results& of_block() {
        extern __shared__ __align__(16) unsigned char memory[];
        return *reinterpret_cast<Results*>(memory);
    }
    // Eight columns, and the first row of several ROWS apart, that a thread takes.
    static RW_FN uint32_t chunk() { return threadIdx.x % CHUNKS * 8u; }
    static RW_FN uint32_t row() { return threadIdx.x / CHUNKS; }
    RW_FN Words4& at(uint32_t row) { return *reinterpret_cast<Words4*>(&values[row][chunk()]); }
};
static_assert(sizeof(Results) <= RW_PRODUCT_BYTES, "shared memory");

// By the whole block: each pair of sums, with its column in the product, through `change`, as halves into shared memory.
template <class P, class Change> RW_FN Results& gather(const P& product, Change change) {
    Results& results = Results::of_block();
    __syncthreads();
    RW_UNROLL for (int n = 0; n < 4; ++n) {
        const uint32_t column = product.column(n), inside = column - blockIdx.x * TILE;
        RW_UNROLL for (int m = 0; m < 4; ++m) {
            RW_UNROLL for (int half = 0; half < 2; ++half) {
                const float2 pair = change(make_float2(product.sums[m][n][2 * half], product.sums[m][n][2 * half + 1]), n);
                const uint32_t row = product.row(m) + 8 * half - blockIdx.y * TILE;
                *reinterpret_cast<uint32_t*>(&results.values[row][inside]) = pack(pair.x, pair.y);
            }
        }
    }
    __syncthreads();
    return results;
}

// A layer's values from those before it. Grid: tiles of columns, tiles of rows.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
batched_forward(const uint16_t* __restrict__ in, uint32_t in_stride, uint32_t depth, const uint16_t* __restrict__ weights,
                const float* __restrict__ biases, uint16_t* __restrict__ out) {
    Product<false, true> product;
    product.run(in, in_stride, weights, PADDED, 0, depth);
    float2 bias[4];
    RW_UNROLL for (int n = 0; n < 4; ++n) {
        const uint32_t column = product.column(n);
        bias[n] = make_float2(column < WIDTH ? biases[column] : 0.0f, column + 1 < WIDTH ? biases[column + 1] : 0.0f);
    }
    Results& results = gather(product, [&](float2 pair, int n) { return make_float2(rectify(pair.x + bias[n].x), rectify(pair.y + bias[n].y)); });
    for (uint32_t row = Results::row(); row < TILE; row += Results::ROWS) {
        uint16_t* to = out + (blockIdx.y * TILE + row) * size_t(PADDED) + blockIdx.x * TILE + Results::chunk();
        *reinterpret_cast<Words4*>(to) = results.at(row);
    }
}

// Of two halves side by side, those that the activation passed.
RW_FN uint32_t pass(uint32_t values, uint32_t active) {
    return (active & 0x00007fffu ? values & 0x0000ffffu : 0u) | (active & 0x7fff0000u ? values & 0xffff0000u : 0u);
}

// Gradient with respect to a hidden layer's sums, from that of the layer above; adds up its biases' gradient.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
batched_backward(const uint16_t* __restrict__ delta, const uint16_t* __restrict__ weights, const uint16_t* __restrict__ passed,
                 uint16_t* __restrict__ out, float* __restrict__ bias_gradient) {
    Product<false, false> product;
    product.run(delta, PADDED, weights, PADDED, 0, PADDED);
    Results& results = gather(product, [](float2 pair, int) { return pair; });
    __shared__ float biases[TILE];
    if (threadIdx.x < TILE) biases[threadIdx.x] = 0.0f;
    __syncthreads();
    float sums[8] = {};
    for (uint32_t row = Results::row(); row < TILE; row += Results::ROWS) {
        const size_t at = (blockIdx.y * TILE + row) * size_t(PADDED) + blockIdx.x * TILE + Results::chunk();
        const Words4 values = results.at(row), active = *reinterpret_cast<const Words4*>(passed + at);
        const Words4 kept = {pass(values.x, active.x), pass(values.y, active.y), pass(values.z, active.z), pass(values.w, active.w)};
        *reinterpret_cast<Words4*>(out + at) = kept;
        const uint32_t words[4] = {kept.x, kept.y, kept.z, kept.w};
        RW_UNROLL for (int k = 0; k < 4; ++k) {
            const float2 pair = unpack(words[k]);
            sums[2 * k] += pair.x;
            sums[2 * k + 1] += pair.y;
        }
    }
    RW_UNROLL for (int k = 0; k < 8; ++k) {
        // Lanes l and l + 16 have the same columns.
        sums[k] += __shfl_xor_sync(0xffffffffu, sums[k], 16);
        if (lane() < 16u) atomicAdd(biases + Results::chunk() + k, sums[k]);
    }
    __syncthreads();
    const uint32_t column = blockIdx.x * TILE + threadIdx.x;
    if (threadIdx.x < TILE && column < WIDTH) atomicAdd(bias_gradient + column, biases[threadIdx.x]);
}

// Gradient with respect to the encoded points.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
batched_backward_encoded(const uint16_t* __restrict__ delta, const uint16_t* __restrict__ weights, uint16_t* __restrict__ out) {
    Product<false, false> product;
    product.run(delta, PADDED, weights, PADDED, 0, PADDED);
    Results& results = gather(product, [](float2 pair, int) { return pair; });
    for (uint32_t row = Results::row(); row < TILE; row += Results::ROWS) {
        uint16_t* to = out + (blockIdx.y * TILE + row) * size_t(ENCODED_PADDED) + blockIdx.x * TILE + Results::chunk();
        *reinterpret_cast<Words4*>(to) = results.at(row);
    }
}

// Adds a layer's gradient over `rows` samples, of which blocks take `share` each (along z): inputs turned, times gradients of sums.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
batched_products(const uint16_t* __restrict__ in, uint32_t in_stride, const uint16_t* __restrict__ delta, uint32_t rows, uint32_t share,
                 uint32_t inputs, float* __restrict__ gradient) {
    Product<true, true> product;
    const uint32_t from = blockIdx.z * share;
    if (from >= rows) return;
    product.run(in, in_stride, delta, PADDED, from, from + share < rows ? from + share : rows);
    RW_UNROLL for (int m = 0; m < 4; ++m) {
        RW_UNROLL for (int n = 0; n < 4; ++n) {
            RW_UNROLL for (int half = 0; half < 2; ++half) {
                const uint32_t row = product.row(m) + 8 * half, column = product.column(n);
                float* to = gradient + row * size_t(WIDTH) + column;
                if (row >= inputs || column >= WIDTH) continue;
                // Two at once where they are side by side and aligned: in an even width all are.
                if constexpr (WIDTH % 2 == 0) {
                    add(to, product.sums[m][n][2 * half], product.sums[m][n][2 * half + 1]);
                } else {
                    atomicAdd(to, product.sums[m][n][2 * half]);
                    if (column + 1 < WIDTH) atomicAdd(to + 1, product.sums[m][n][2 * half + 1]);
                }
            }
        }
    }
}

// The layers in half precision, padded: the first has ENCODED_PADDED rows, the others PADDED. A thread a value.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_weights(const float* __restrict__ layers, uint64_t n, uint16_t* __restrict__ out) {
    const size_t i = blockIdx.x * size_t(THREADS) + threadIdx.x;
    if (i >= n) return;
    constexpr size_t FIRST = size_t(ENCODED_PADDED) * PADDED, OTHER = size_t(PADDED) * PADDED;
    const int layer = i < FIRST ? 0 : 1 + int((i - FIRST) / OTHER);
    const size_t inside = i < FIRST ? i : (i - FIRST) % OTHER;
    const uint32_t row = uint32_t(inside / PADDED), column = uint32_t(inside % PADDED), inputs = layer == 0 ? ENCODED : WIDTH;
    out[i] = to_half(row < inputs && column < WIDTH ? layers[size_t(layer_start(layer)) + row * size_t(WIDTH) + column] : 0.0f);
}

// Encoded points: a thread two neighbouring columns.
RW_FN void encode_two(const Grid& grid, const uint16_t* tables, const float (&unit)[3], size_t i, uint16_t* out) {
    __shared__ Level levels[LEVELS > 0 ? LEVELS : 1];
    read_levels(levels, grid);
    __syncthreads();
    float point[DIMS];
    inputs(point, unit);
    const float2 pair = encode(levels, {tables}, point, int(i % (ENCODED_PADDED / 2)) * 2);
    reinterpret_cast<uint32_t*>(out)[i] = pack(pair.x, pair.y);
}

// Of `n` points (3 floats each, unit coordinates); rows beyond repeat the last one. Launched with THREADS a multiple of what is to do.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_encode_points(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const __grid_constant__ Reading reading,
                      const float* __restrict__ points, uint32_t n, uint16_t* __restrict__ out) {
    const size_t i = blockIdx.x * size_t(THREADS) + threadIdx.x, row = i / (ENCODED_PADDED / 2), at = row < n ? row : n - 1u;
    float unit[3] = {points[3 * at], points[3 * at + 1], points[3 * at + 2]};
    place_times(reading, unit);
    encode_two(grid, tables, unit, i, out);
}

// Sample number `position` of a batch; without a target beyond it.
RW_FN Four sample_at(const Draw& draw, uint32_t position) {
    if (position >= draw.batch) return {0.0f, 0.0f, 0.0f, not_a_number()};
    return drawn_sample(draw, position);
}

// Of the samples of a batch from number `first` on, and their targets.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_encode_samples(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const Draw draw, uint32_t first,
                       uint16_t* __restrict__ out, float* __restrict__ targets) {
    const size_t i = blockIdx.x * size_t(THREADS) + threadIdx.x, row = i / (ENCODED_PADDED / 2);
    const Four sample = sample_at(draw, first + uint32_t(row));
    if (i % (ENCODED_PADDED / 2) == 0) targets[row] = sample.w;
    const float unit[3] = {sample.x, sample.y, sample.z};
    encode_two(grid, tables, unit, i, out);
}

// The output of a row, in all lanes of its warp. `head` are the weights of the last layer and its bias.
RW_FN float output_of(const uint16_t* row, const float* head) {
    float sum = 0.0f;
    for (uint32_t column = 2 * lane(); column < WIDTH; column += 64u) {
        const float2 pair = unpack(*reinterpret_cast<const uint32_t*>(row + column));
        sum = fma_(pair.x, from_half(to_half(head[column])), sum);
        if (column + 1 < WIDTH) sum = fma_(pair.y, from_half(to_half(head[column + 1])), sum);
    }
    for (int apart = 16; apart > 0; apart /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, apart);
    return sum + head[WIDTH];
}

// Log-stretch of `n` rows; a warp a row.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_answer(const uint16_t* __restrict__ values, const float* __restrict__ head, const __grid_constant__ Reading reading,
               const float* __restrict__ points, uint32_t n, float* __restrict__ out) {
    const size_t row = blockIdx.x * size_t(THREADS / 32) + threadIdx.x / 32u;
    if (row >= n) return;
    const float output = output_of(values + row * PADDED, head);
    const float unit[3] = {points[3 * row], points[3 * row + 1], points[3 * row + 2]};
    if (lane() == 0u) out[row] = read_output(reading, output, unit);
}

// Rows that a block of batched_head takes.
constexpr int HEAD_ROWS = 64;

// Gradients of the head, and with respect to the sums of the last hidden layer, whose biases' gradient it adds up; the squared error of each
// sample, over the batch, is added to the loss. A sample whose target is not finite counts for nothing.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_head(const uint16_t* __restrict__ values, const float* __restrict__ head, const float* __restrict__ targets, uint32_t batch,
             uint16_t* __restrict__ delta, float* __restrict__ head_gradient, float* __restrict__ bias_gradient, double* __restrict__ loss) {
    __shared__ float slopes[HEAD_ROWS];
    const size_t first = blockIdx.x * size_t(HEAD_ROWS);
    for (int row = threadIdx.x / 32u; row < HEAD_ROWS; row += THREADS / 32) {
        const float target = targets[first + row], output = output_of(values + (first + row) * PADDED, head);
        if (lane() == 0u) slopes[row] = isfinite(target) ? 2.0f * (output - target) : 0.0f;
    }
    __syncthreads();
    if (threadIdx.x < 32u) {
        float squares = 0.0f, sum = 0.0f;
        for (int row = lane(); row < HEAD_ROWS; row += 32) {
            squares = fma_(0.25f * slopes[row], slopes[row], squares);
            sum += slopes[row];
        }
        for (int apart = 16; apart > 0; apart /= 2) {
            squares += __shfl_xor_sync(0xffffffffu, squares, apart);
            sum += __shfl_xor_sync(0xffffffffu, sum, apart);
        }
        if (lane() == 0u) {
            atomicAdd(loss, double(squares) / batch);
            atomicAdd(head_gradient + WIDTH, sum);
        }
    }
    for (uint32_t column = 2 * threadIdx.x; column < PADDED; column += 2 * THREADS) {
        const float x = column < WIDTH ? from_half(to_half(head[column])) : 0.0f, y = column + 1 < WIDTH ? from_half(to_half(head[column + 1])) : 0.0f;
        float weights[2] = {0.0f, 0.0f}, biases[2] = {0.0f, 0.0f};
        for (int row = 0; row < HEAD_ROWS; ++row) {
            const uint32_t active = *reinterpret_cast<const uint32_t*>(values + (first + row) * PADDED + column);
            const float2 pair = unpack(active);
            const float low = active & 0x00007fffu ? slopes[row] * x : 0.0f, high = active & 0x7fff0000u ? slopes[row] * y : 0.0f;
            weights[0] = fma_(pair.x, slopes[row], weights[0]);
            weights[1] = fma_(pair.y, slopes[row], weights[1]);
            biases[0] += low;
            biases[1] += high;
            *reinterpret_cast<uint32_t*>(delta + (first + row) * PADDED + column) = pack(low, high);
        }
        RW_UNROLL for (int k = 0; k < 2; ++k) {
            if (column + k >= WIDTH) continue;
            atomicAdd(head_gradient + column + k, weights[k]);
            atomicAdd(bias_gradient + column + k, biases[k]);
        }
    }
}

#if RW_LEVELS > 0
// The gradient with respect to encoded samples goes to the tables: a thread two neighbouring columns.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_scatter(const __grid_constant__ Grid grid, const Draw draw, uint32_t first, const uint16_t* __restrict__ delta, float* __restrict__ gradient) {
    __shared__ Level levels[LEVELS];
    read_levels(levels, grid);
    __syncthreads();
    const size_t i = blockIdx.x * size_t(THREADS) + threadIdx.x, row = i / (ENCODED_PADDED / 2);
    const Four sample = sample_at(draw, first + uint32_t(row));
    if (!isfinite(sample.w)) return;
    const float unit[3] = {sample.x, sample.y, sample.z};
    float point[DIMS];
    inputs(point, unit);
    const float2 pair = unpack(reinterpret_cast<const uint32_t*>(delta)[i]);
    scatter(levels, point, int(i % (ENCODED_PADDED / 2)) * 2, pair.x, pair.y, gradient);
}
#endif
