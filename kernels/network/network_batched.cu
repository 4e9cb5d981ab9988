// Prediction and gradient of a batch for networks too wide or too deep for a warp's registers: tiled matrix products with asynchronous copies
// (software pipelining, as in CUTLASS). A block takes a tile of samples through all layers; their values stay in shared memory while slices of
// the layers stream in from the L2 cache. Training stores each layer's values and gradients, whose products over all samples are the weight
// gradients. Values and weights are in half precision, sums in single precision, as in network_fused.cu.
//
// Macros besides those of network.cuh: RW_ROWS, samples of a tile; RW_STAGES, slices in shared memory or in flight; RW_TILE_BYTES and
// RW_PRODUCT_BYTES, the shared memory of a tile and of a product. Slices are padded with zeros, which contribute nothing.
#include "network/network_data.cuh"

using namespace rw;

constexpr int WARPS = 8, THREADS = 32 * WARPS, ROWS = RW_ROWS, STAGES = RW_STAGES, DEPTH = 32;
// A pass computes COLUMNS neurons, as many as registers hold sums of, in whole pairs of blocks of 8 for each of four warps.
constexpr int PASSES = (WIDTH + 255) / 256, PADDED = (WIDTH + 64 * PASSES - 1) / (64 * PASSES) * (64 * PASSES), COLUMNS = PADDED / PASSES;
constexpr int ENCODED_PADDED = (ENCODED + DEPTH - 1) / DEPTH * DEPTH, ENCODED_PASSES = (ENCODED + COLUMNS - 1) / COLUMNS;
constexpr int ROW = (ENCODED_PASSES > PASSES ? ENCODED_PASSES : PASSES) * COLUMNS + SKEW;
// A warp's sums: M blocks of 16 rows by N of 8 columns; in a product over all samples, four blocks of its PANEL inputs.
constexpr int M = ROWS / 32, N = COLUMNS / 32, PANEL = 128;

RW_FN int warp_row(int blocks) { return threadIdx.x / 128 * 16 * blocks; }
RW_FN int warp_column() { return threadIdx.x / 32 % 4 * 8 * N; }
// First row and column of this lane in block (m, n) of `blocks` times N. Its second row is 8 further, its second column the next one.
RW_FN int lane_row(int blocks, int m) { return warp_row(blocks) + 16 * m + int(lane() >> 2); }
RW_FN int lane_column(int n) { return warp_column() + 8 * n + 2 * int(lane() & 3u); }

// Starts an asynchronous copy of 16 bytes to shared memory; writes zeros if `there` is false.
RW_FN void copy_async(uint16_t* to, const uint16_t* from, bool there = true) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(uint32_t(__cvta_generic_to_shared(to))), "l"(from), "r"(there ? 16 : 0)
                 : "memory");
}
// Ends a group of asynchronous copies. An empty group counts too.
RW_FN void commit_group() { asm volatile("cp.async.commit_group;" ::: "memory"); }
// Waits until all groups except the last STAGES - 2 have arrived, and until the whole block has finished with all stages except the oldest.
RW_FN void wait_for_group() {
    asm volatile("cp.async.wait_group %0;" ::"n"(STAGES - 2) : "memory");
    __syncthreads();
}

// A slice of the right operand: DEPTH rows of COLUMNS columns.
struct Slice {
    uint16_t values[DEPTH][COLUMNS + SKEW];
};

// Starts copies of DEPTH rows of LENGTH values, `stride` apart.
template <int LENGTH> RW_FN void copy_rows_async(uint16_t (&to)[DEPTH][LENGTH + SKEW], const uint16_t* from, size_t stride, bool there = true) {
    constexpr int CHUNKS = LENGTH / 8;
    RW_UNROLL for (int i = 0; i < DEPTH * CHUNKS / THREADS; ++i) {
        const int part = threadIdx.x + THREADS * i, row = part / CHUNKS, column = part % CHUNKS * 8;
        copy_async(&to[row][column], from + row * stride + column, there);
    }
}

// This lane's addresses in both operands, for 16 terms of the sum.
struct Operands {
    const uint16_t *left, *right;
};

// A product's sums, and blocks of its operands in registers. The next blocks are read into registers of blocks already multiplied. The four
// quarters of the sums alternate, so that loads are one or two quarters ahead of their use.
template <class Left, int BLOCKS> struct Product {
    static constexpr int HALF_BLOCKS = (BLOCKS + 1) / 2, PAIRS = N / 2, HALF_PAIRS = (PAIRS + 1) / 2;
    float (&sums)[BLOCKS][N][4];
    uint32_t a[BLOCKS][4], b[PAIRS][4];

    RW_FN explicit Product(float (&sums)[BLOCKS][N][4]) : sums(sums) {}
    RW_FN void read_left(const Operands& from, int half) {
        RW_UNROLL for (int m = half * HALF_BLOCKS; m < (half ? BLOCKS : HALF_BLOCKS); ++m) Left::read(a[m], from.left, m);
    }
    RW_FN void read_right(const Operands& from, int half) {
        RW_UNROLL for (int n = half * HALF_PAIRS; n < (half ? PAIRS : HALF_PAIRS); ++n) load_transposed(b[n], from.right + 16 * n);
    }
    RW_FN void multiply_quarter(int left, int right) {
        RW_UNROLL for (int m = left * HALF_BLOCKS; m < (left ? BLOCKS : HALF_BLOCKS); ++m) {
            RW_UNROLL for (int n = right * HALF_PAIRS; n < (right ? PAIRS : HALF_PAIRS); ++n) {
                multiply(sums[m][2 * n], a[m], b[n][0], b[n][1]);
                multiply(sums[m][2 * n + 1], a[m], b[n][2], b[n][3]);
            }
        }
    }
    // Multiplies the loaded blocks, starting with half `first` of the right operand, and loads those that `next()` returns.
    template <class Next> RW_FN void multiply_block(int first, Next next) {
        multiply_quarter(0, first);
        const Operands to_come = next();
        multiply_quarter(0, 1 - first);
        read_left(to_come, 0);
        multiply_quarter(1, 1 - first);
        read_right(to_come, 1 - first);
        multiply_quarter(1, first);
        read_left(to_come, 1);
        read_right(to_come, first);
    }
    // Adds `steps` times DEPTH terms. `take()` returns the operands of the first 16 of the next DEPTH terms.
    template <class Take> RW_FN void add(int steps, Take take) {
        static_assert(DEPTH == 32, "two blocks a step");
        Operands now = take();
        auto second = [&] { return Operands{now.left + Left::SECOND, now.right + 16 * (COLUMNS + SKEW)}; };
        RW_UNROLL for (int half = 0; half < 2; ++half) {
            read_left(now, half);
            read_right(now, half);
        }
#pragma unroll 1
        for (int step = 1; step < steps; ++step) {
            multiply_block(0, second);
            multiply_block(1, [&] { return now = take(); });
        }
        multiply_block(0, second);
        RW_UNROLL for (int quarter = 0; quarter < 4; ++quarter) multiply_quarter(quarter / 2, quarter % 2);
    }
};
// Row and column of a lane's address in blocks of the right operand.
RW_FN int right_row() { return (lane() >> 3 & 1u) * 8u + (lane() & 7u); }
RW_FN int right_column() { return warp_column() + (lane() >> 4) * 8u; }

template <int BLOCKS> RW_FN void clear(float (&sums)[BLOCKS][N][4]) {
    RW_UNROLL for (int m = 0; m < BLOCKS; ++m) {
        RW_UNROLL for (int n = 0; n < N; ++n)
            RW_UNROLL for (int k = 0; k < 4; ++k) sums[m][n][k] = 0.0f;
    }
}

// Slices of the layers in the order of use: forward, from the first layer to the last, pass by pass, with rows for inputs; then for training the
// transposed ones, from the last to the second, and the first if the encoding has tables.
constexpr int DEEP = PADDED / DEPTH, ENCODED_DEEP = ENCODED_PADDED / DEPTH;
constexpr uint32_t FIRST_SLICES = PASSES * ENCODED_DEEP, HIDDEN_SLICES = PASSES * DEEP;
constexpr uint32_t FORWARD_SLICES = FIRST_SLICES + (HIDDEN - 1) * HIDDEN_SLICES, BACK_SLICES = FORWARD_SLICES + (HIDDEN - 1) * HIDDEN_SLICES;
constexpr uint32_t ALL_SLICES = BACK_SLICES + (LEVELS > 0 ? ENCODED_PASSES * DEEP : 0), SLICE = DEPTH * COLUMNS;

// Rounds the layers into the first `n` values of their slices, and pads biases to PADDED. One thread per value.
extern "C" __global__ void __launch_bounds__(THREADS)
batched_slices(const float* __restrict__ layers, uint32_t n, uint16_t* __restrict__ slices, float* __restrict__ biases) {
    const uint32_t i = blockIdx.x * uint32_t(THREADS) + threadIdx.x;
    if (i >= n) return;
    const uint32_t slice = i / SLICE, row = i % SLICE / COLUMNS, column = i % COLUMNS;
    const bool first = slice < FIRST_SLICES || slice >= BACK_SLICES, back = slice >= FORWARD_SLICES;
    const uint32_t start = slice < FIRST_SLICES ? 0 : slice < FORWARD_SLICES ? FIRST_SLICES : slice < BACK_SLICES ? FORWARD_SLICES : BACK_SLICES;
    const uint32_t inside = slice - start, number = first ? 0 : inside / HIDDEN_SLICES, deep = first && !back ? ENCODED_DEEP : DEEP;
    const uint32_t layer = first ? 0 : back ? HIDDEN - 1 - number : 1 + number, part = inside - number * HIDDEN_SLICES;
    const uint32_t summed = part % deep * DEPTH + row, other = part / deep * COLUMNS + column;
    const uint32_t input = back ? other : summed, neuron = back ? summed : other, inputs = layer == 0 ? ENCODED : WIDTH;
    slices[i] = to_half(input < inputs && neuron < WIDTH ? layers[layer_start(layer) + input * size_t(WIDTH) + neuron] : 0.0f);
    if (i < HIDDEN * PADDED) {
        const uint32_t of = i / PADDED, at = i % PADDED;
        biases[i] = at < WIDTH ? layers[layer_start(of) + (of == 0 ? ENCODED : WIDTH) * size_t(WIDTH) + at] : 0.0f;
    }
}

struct alignas(16) Tile {
    uint16_t values[ROWS][ROW];
    Slice stages[STAGES];
    Sample samples[ROWS];
    float slopes[ROWS][OUTPUTS];
    Level levels[LEVELS > 0 ? LEVELS : 1];
};
// Shared memory of the launches.
static_assert(sizeof(Tile) <= RW_TILE_BYTES, "shared memory");

extern __shared__ __align__(16) unsigned char memory[];

// Streams `count` slices in a cycle, STAGES - 1 ahead of their use.
struct Stream {
    const uint16_t* slices;
    Slice* stages;
    uint32_t count, next, stage;

    RW_FN Stream(const uint16_t* from, Slice* to, uint32_t count) : slices(from), stages(to), count(count), next(0), stage(0) {
        RW_UNROLL for (int i = 0; i < STAGES - 1; ++i) copy_next(i);
    }
    RW_FN void copy_next(uint32_t to) {
        copy_rows_async<COLUMNS>(stages[to].values, slices + next * size_t(SLICE), COLUMNS);
        commit_group();
        next = next + 1 < count ? next + 1 : 0;
    }
    // Returns the next slice, valid until the next call. The whole block must call it; it is also a barrier for shared memory.
    RW_FN const Slice& take() {
        wait_for_group();
        copy_next(stage == 0 ? STAGES - 1 : stage - 1);
        const Slice& taken = stages[stage];
        stage = stage + 1 < STAGES ? stage + 1 : 0;
        return taken;
    }
};

// Rows of a tile as a left operand.
struct TileRows {
    static constexpr int SECOND = 16;
    static RW_FN void read(uint32_t (&to)[4], const uint16_t* from, int m) { load_blocks(to, from + 16 * m * ROW); }
};

// Replaces the tile's values by their product with the next slices (`depth` rows, PARTS * COLUMNS columns). `begin(sums, part)` initialises a
// part's sums, and `end(sums, part, pairs)` turns them into pairs of halves. The whole block must call it.
template <int PARTS, class Begin, class End> RW_FN void multiply_tile(Tile& tile, Stream& stream, int depth, Begin begin, End end) {
    const uint32_t l = lane();
    const uint16_t* left = &tile.values[warp_row(M) + (l >> 3 & 1u) * 8u + (l & 7u)][(l >> 4) * 8u];
    uint32_t pairs[PARTS][M][N][2];
    RW_UNROLL for (int part = 0; part < PARTS; ++part) {
        float sums[M][N][4];
        begin(sums, part);
        const uint16_t* at = left;
        Product<TileRows, M>(sums).add(depth / DEPTH, [&] {
            const Operands taken = {at, &stream.take().values[right_row()][right_column()]};
            at += DEPTH;
            return taken;
        });
        end(sums, part, pairs[part]);
    }
    // All warps have read their operands.
    __syncthreads();
    RW_UNROLL for (int part = 0; part < PARTS; ++part) {
        RW_UNROLL for (int m = 0; m < M; ++m) {
            RW_UNROLL for (int n = 0; n < N; ++n) {
                RW_UNROLL for (int half = 0; half < 2; ++half)
                    *reinterpret_cast<uint32_t*>(&tile.values[lane_row(M, m) + 8 * half][part * COLUMNS + lane_column(n)]) = pairs[part][m][n][half];
            }
        }
    }
    __syncthreads();
}

// Words that hold the ReLU's bits of a tile's layer.
constexpr int PASSED = PASSES * M * THREADS;

// Bit of a block's word that is set if the lower value of a pair is not 0; the upper value's bit is 16 higher.
RW_FN constexpr int passed_bit(int n, int half) { return 16 - 2 * N + 2 * n + half; }

// Computes a layer's values from the previous layer's. If `passed` is not null, it gets the bits of values that are not 0: one word for each of
// a thread's M blocks, with adjacent threads in adjacent words.
RW_FN void forward_tile(Tile& tile, Stream& stream, int depth, const float* __restrict__ biases, uint32_t* passed) {
    auto begin = [&](float (&sums)[M][N][4], int pass) {
        RW_UNROLL for (int n = 0; n < N; ++n) {
            const float2 bias = __ldg(reinterpret_cast<const float2*>(biases + pass * COLUMNS + lane_column(n)));
            RW_UNROLL for (int m = 0; m < M; ++m) {
                sums[m][n][0] = sums[m][n][2] = bias.x;
                sums[m][n][1] = sums[m][n][3] = bias.y;
            }
        }
    };
    multiply_tile<PASSES>(tile, stream, depth, begin, [&](const float (&sums)[M][N][4], int pass, uint32_t (&pairs)[M][N][2]) {
        RW_UNROLL for (int m = 0; m < M; ++m) {
            uint32_t bits = 0;
            RW_UNROLL for (int n = 0; n < N; ++n) {
                RW_UNROLL for (int half = 0; half < 2; ++half) {
                    const uint32_t pair = pairs[m][n][half] = pack_relu(sums[m][n][2 * half], sums[m][n][2 * half + 1]);
                    // Halves are not negative; the sum carries into the sign bit unless they are 0.
                    bits = bits >> 1 | (pair + 0x7fff7fffu & 0x80008000u);
                }
            }
            if (passed) passed[(pass * M + m) * THREADS + threadIdx.x] = bits;
        }
    });
}

// Adds to the gradients of two neighbouring neurons, in one access if the width is even, since pairs are then aligned.
RW_FN void add_pair(float* row, int column, float x, float y) {
    if (column >= WIDTH) return;
    if constexpr (WIDTH % 2 == 0) {
        add(row + column, x, y);
    } else {
        atomicAdd(row + column, x);
        if (column + 1 < WIDTH) atomicAdd(row + column + 1, y);
    }
}

// Products with the next slices, masked by the ReLU's bits. `also(column, sum)` gets the sums over this lane's rows for its column and the next
// one.
template <class Also> RW_FN void masked_tile(Tile& tile, Stream& stream, int depth, const uint32_t* passed, Also also) {
    auto begin = [](float (&sums)[M][N][4], int) { clear(sums); };
    multiply_tile<PASSES>(tile, stream, depth, begin, [&](const float (&sums)[M][N][4], int pass, uint32_t (&pairs)[M][N][2]) {
        uint32_t bits[M];
        RW_UNROLL for (int m = 0; m < M; ++m) bits[m] = passed[(pass * M + m) * THREADS + threadIdx.x];
        RW_UNROLL for (int n = 0; n < N; ++n) {
            float2 sum = make_float2(0.0f, 0.0f);
            RW_UNROLL for (int m = 0; m < M; ++m) {
                RW_UNROLL for (int half = 0; half < 2; ++half) {
                    const uint32_t bit = 1u << passed_bit(n, half);
                    const float x = bits[m] & bit ? sums[m][n][2 * half] : 0.0f, y = bits[m] & bit << 16 ? sums[m][n][2 * half + 1] : 0.0f;
                    sum.x += x;
                    sum.y += y;
                    pairs[m][n][half] = pack(x, y);
                }
            }
            also(pass * COLUMNS + lane_column(n), sum);
        }
    });
}

// Gradient with respect to a hidden layer's sums, from that of the next layer; adds to its biases' gradient.
RW_FN void backward_tile(Tile& tile, Stream& stream, const uint32_t* passed, float* bias_gradient) {
    masked_tile(tile, stream, PADDED, passed, [&](int column, float2 bias) {
        RW_UNROLL for (int apart = 4; apart < 32; apart *= 2) {
            bias.x += __shfl_xor_sync(0xffffffffu, bias.x, apart);
            bias.y += __shfl_xor_sync(0xffffffffu, bias.y, apart);
        }
        if (lane() < 4u) add_pair(bias_gradient, column, bias.x, bias.y);
    });
}

#if RW_FLOW_MAP
// Tangents of a layer's values, from those of the previous layer; or the gradient with respect to a layer's tangents, from that of the next layer.
RW_FN void tangent_tile(Tile& tile, Stream& stream, int depth, const uint32_t* passed) {
    masked_tile(tile, stream, depth, passed, [](int, float2) {});
}

template <int VALUE> struct Number {
    static constexpr int value = VALUE;
};
#endif

// Weight of the last layer, rounded to half precision like those of the others.
RW_FN float head_weight(const float* __restrict__ head, int column, int output) {
    return column < WIDTH ? from_half(to_half(head[column * OUTPUTS + output])) : 0.0f;
}

// Encodes the tile's samples, or their tangents.
template <class Group = Values> RW_FN void encode_tile(Tile& tile, const uint16_t* tables, Group group = Group()) {
    for (int i = threadIdx.x; i < ROWS * ENCODED_PADDED / 2; i += THREADS) {
        const int row = i / (ENCODED_PADDED / 2), column = i % (ENCODED_PADDED / 2) * 2;
        float point[DIMS];
        inputs(point, tile.samples[row].place);
        const float2 pair = encode(tile.levels, {tables}, point, column, group);
        *reinterpret_cast<uint32_t*>(&tile.values[row][column]) = pack(pair.x, pair.y);
    }
}

// Outputs of a warp's OWN rows of a tile, in all its lanes. `head`: weights of the last layer, then its biases, which tangents do not add.
constexpr int OWN = ROWS / WARPS;
RW_FN int own_row() { return threadIdx.x / 32 * OWN; }
RW_FN void outputs_of(float (&outputs)[OWN][OUTPUTS], const Tile& tile, const float* __restrict__ head, bool biased = true) {
    RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
        RW_UNROLL for (int row = 0; row < OWN; ++row) outputs[row][output] = 0.0f;
        for (int column = 2 * lane(); column < WIDTH; column += 64) {
            const float x = head_weight(head, column, output), y = head_weight(head, column + 1, output);
            RW_UNROLL for (int row = 0; row < OWN; ++row) {
                const float2 pair = unpack(*reinterpret_cast<const uint32_t*>(&tile.values[own_row() + row][column]));
                outputs[row][output] = fma_(pair.y, y, fma_(pair.x, x, outputs[row][output]));
            }
        }
        RW_UNROLL for (int row = 0; row < OWN; ++row) {
            outputs[row][output] = warp_sum(outputs[row][output]);
            if (biased) outputs[row][output] += head[WIDTH * OUTPUTS + output];
        }
    }
}

// Calls `give(row, point)` in the lane of each of the warp's rows. The tile's points start at number `first` of `n`.
template <class Give> RW_FN void for_own_row(uint32_t first, uint32_t n, Give give) {
    const int row = own_row() + int(lane());
    if (int(lane()) < OWN && first + row < n) give(row, first + row);
}

// Log-stretch of the tile's points. A flow map needs the network's derivatives along each axis, and `passed` with HIDDEN times PASSED words.
RW_FN void predict_tile(Tile& tile, Stream& stream, const uint16_t* tables, const float* __restrict__ biases, const float* __restrict__ head,
                        const Reading& reading, [[maybe_unused]] uint32_t* passed, uint32_t first, uint32_t n, float* __restrict__ out) {
    auto passed_of = [&](int layer) { return RW_FLOW_MAP ? passed + layer * PASSED : nullptr; };
    encode_tile(tile, tables);
    forward_tile(tile, stream, ENCODED_PADDED, biases, passed_of(0));
#pragma unroll 1
    for (int layer = 1; layer < HIDDEN; ++layer) forward_tile(tile, stream, PADDED, biases + layer * PADDED, passed_of(layer));
#if RW_FLOW_MAP
    float tangents[OUTPUTS][SPACE];
    auto follow = [&](auto group) {
        constexpr int GROUP = decltype(group)::value;
        __syncthreads();
        encode_tile(tile, tables, Tangents{GROUP - 1, reading.step});
        tangent_tile(tile, stream, ENCODED_PADDED, passed);
#pragma unroll 1
        for (int layer = 1; layer < HIDDEN; ++layer) tangent_tile(tile, stream, PADDED, passed_of(layer));
        float outputs[OWN][OUTPUTS];
        outputs_of(outputs, tile, head, false);
        RW_UNROLL for (int row = 0; row < OWN; ++row) {
            RW_UNROLL for (int output = 0; output < OUTPUTS; ++output)
                tangents[output][GROUP - 1] = int(lane()) == row ? outputs[row][output] : tangents[output][GROUP - 1];
        }
    };
    follow(Number<1>());
    follow(Number<2>());
    if constexpr (SPACE > 2) follow(Number<SPACE>());
    for_own_row(first, n, [&](int, uint32_t at) { out[at] = read_tangents(reading, tangents); });
#else
    float outputs[OWN][OUTPUTS], output = 0.0f;
    outputs_of(outputs, tile, head);
    RW_UNROLL for (int row = 0; row < OWN; ++row) output = int(lane()) == row ? outputs[row][0] : output;
    for_own_row(first, n, [&](int row, uint32_t at) { out[at] = read_output(reading, output, tile.samples[row].place); });
#endif
}

// Log-stretch at `n` points (3 floats each, unit coordinates). `slices` and `biases` are the results of `batched_slices`. `passed`: for a flow
// map HIDDEN times PASSED words per block.
extern "C" __global__ void __launch_bounds__(THREADS, 1)
batched_predict(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const uint16_t* __restrict__ slices,
                const float* __restrict__ biases, const float* __restrict__ head, const __grid_constant__ Reading reading,
                const float* __restrict__ points, uint32_t n, uint32_t* passed, float* __restrict__ out) {
    Tile& tile = *reinterpret_cast<Tile*>(memory);
    read_levels(tile.levels, grid);
    passed += blockIdx.x * size_t(HIDDEN * PASSED);
    Stream stream(slices, tile.stages, FORWARD_SLICES);
    for (uint32_t first = blockIdx.x * ROWS; first < n; first += gridDim.x * ROWS) {
        __syncthreads();
        if (threadIdx.x < ROWS) {
            // Rows beyond the last point repeat it.
            const size_t at = first + threadIdx.x < n ? first + threadIdx.x : n - 1u;
            Sample sample = {};
            read_point(reading, points, at, sample.place);
            place_times(reading, sample.place);
            tile.samples[threadIdx.x] = sample;
        }
        __syncthreads();
        predict_tile(tile, stream, tables, biases, head, reading, passed, first, n, out);
    }
}

// Stores the tile's values, rows of LENGTH, in accesses of 16 bytes.
template <int LENGTH> RW_FN void store_tile(const Tile& tile, uint16_t* __restrict__ to) {
    for (int i = threadIdx.x; i < ROWS * LENGTH / 8; i += THREADS)
        reinterpret_cast<Uint4*>(to)[i] = *reinterpret_cast<const Uint4*>(&tile.values[i / (LENGTH / 8)][i % (LENGTH / 8) * 8]);
}

// Sample number `position` of a batch, or one without a target beyond its end.
RW_FN Sample sample_at(const Draw& draw, uint32_t position) {
    return position < draw.batch ? drawn_sample(draw, position) : no_sample();
}

// Gradient with respect to the last hidden layer's sums of two neighbouring columns, from the slopes of a row's outputs. `active`: not 0 in the
// lower and in the upper half if the ReLU passed. Adds the products of `values` with the slopes to `weights`.
RW_FN float2 head_pair(const float (&slopes)[OUTPUTS], const float (&x)[OUTPUTS], const float (&y)[OUTPUTS], uint32_t values, uint32_t active,
                       float2 (&weights)[OUTPUTS]) {
    const float2 pair = unpack(values);
    float low = 0.0f, high = 0.0f;
    RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
        const float slope = slopes[output];
        low = fma_(slope, x[output], low);
        high = fma_(slope, y[output], high);
        weights[output].x = fma_(pair.x, slope, weights[output].x);
        weights[output].y = fma_(pair.y, slope, weights[output].y);
    }
    return make_float2(active & 0x0000ffffu ? low : 0.0f, active & 0xffff0000u ? high : 0.0f);
}

// Adds the gradient of two neighbouring rows of the head.
RW_FN void add_head_pair(float* head_gradient, int column, const float2 (&weights)[OUTPUTS], float factor) {
    if constexpr (OUTPUTS == 1) {
        add_pair(head_gradient, column, factor * weights[0].x, factor * weights[0].y);
    } else {
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            if (column < WIDTH) atomicAdd(head_gradient + column * OUTPUTS + output, factor * weights[output].x);
            if (column + 1 < WIDTH) atomicAdd(head_gradient + (column + 1) * OUTPUTS + output, factor * weights[output].y);
        }
    }
}

// Two columns per thread; in narrow layers several threads share the rows.
constexpr int PAIRS = PADDED / 2, SHARES = PAIRS < THREADS ? THREADS / PAIRS : 1, SHARE = ROWS / SHARES;

// Adds the gradients of the head and of the last hidden layer's biases, and adds the squared errors over outputs and batch to the loss. Replaces
// the values of the last hidden layer by the gradient with respect to its sums. A sample without targets contributes nothing.
RW_FN void head_tile(Tile& tile, const float* __restrict__ head, const Draw& draw, float* head_gradient, float* bias_gradient, double* loss) {
    float outputs[OWN][OUTPUTS];
    outputs_of(outputs, tile, head);
#if RW_PENALTY
    const float penalty = penalty_slope(draw);
    float penalties = 0.0f;
#endif
    RW_UNROLL for (int row = 0; row < OWN; ++row) {
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            const float target = tile.samples[own_row() + row].target[output];
            if (int(lane()) == row) tile.slopes[own_row() + row][output] = is_finite(target) ? 2.0f * (outputs[row][output] - target) : 0.0f;
        }
#if RW_PENALTY
        const float target = tile.samples[own_row() + row].target[0];
        if (int(lane()) == row) penalties = is_finite(target) ? penalty * expf(fabsf(outputs[row][0])) : 0.0f;
#endif
    }
    __syncthreads();
    if (threadIdx.x < 32u) {
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            float squares = 0.0f, sum = 0.0f;
            for (int row = lane(); row < ROWS; row += 32) {
                squares = fma_(0.25f * tile.slopes[row][output], tile.slopes[row][output], squares);
                sum += tile.slopes[row][output];
            }
            for (int apart = 16; apart > 0; apart /= 2) {
                squares += __shfl_xor_sync(0xffffffffu, squares, apart);
                sum += __shfl_xor_sync(0xffffffffu, sum, apart);
            }
            if (lane() == 0u) {
                atomicAdd(loss, double(squares) / OUTPUTS / draw.batch);
                atomicAdd(head_gradient + WIDTH * OUTPUTS + output, sum);
            }
        }
    }
#if RW_PENALTY
    // The loss is complete, so the slopes can take the penalty in.
    __syncthreads();
    if (int(lane()) < OWN) tile.slopes[own_row() + lane()][0] += penalties;
    penalties = warp_sum(penalties);
    if (lane() == 0u) atomicAdd(head_gradient + WIDTH, penalties);
    __syncthreads();
#endif
    for (int i = threadIdx.x; i < PAIRS * SHARES; i += THREADS) {
        const int column = 2 * (i % PAIRS), first = i / PAIRS * SHARE;
        float x[OUTPUTS], y[OUTPUTS];
        float2 weights[OUTPUTS], bias = make_float2(0.0f, 0.0f);
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            x[output] = head_weight(head, column, output), y[output] = head_weight(head, column + 1, output);
            weights[output] = make_float2(0.0f, 0.0f);
        }
        for (int row = first; row < first + SHARE; ++row) {
            uint32_t& at = *reinterpret_cast<uint32_t*>(&tile.values[row][column]);
            const float2 delta = head_pair(tile.slopes[row], x, y, at, at & 0x7fff7fffu, weights);
            bias.x += delta.x;
            bias.y += delta.y;
            at = pack(delta.x, delta.y);
        }
        add_head_pair(head_gradient, column, weights, 1.0f);
        add_pair(bias_gradient, column, bias.x, bias.y);
    }
    __syncthreads();
}

#if RW_DERIVATIVES
// Bits of a pair of a tile's values, of those that `forward_tile` stored: bit 0 for the lower one, bit 16 for the upper one.
RW_FN uint32_t passed_pair(const uint32_t* passed, int row, int column) {
    const int inside = column % COLUMNS, below = row % (16 * M);
    const int thread = row / (16 * M) * 128 + inside / (8 * N) * 32 + below % 8 * 4 + inside % 8 / 2;
    const uint32_t word = passed[(column / COLUMNS * M + below / 16) * THREADS + thread];
    return word >> passed_bit(inside % (8 * N) / 8, below % 16 / 8) & 0x00010001u;
}

// As `head_tile`, for the tangents of samples number `first` on, which have no biases. `passed`: the bits of the last hidden layer. The gradient
// and the loss get `factor` times those of the tangents; what replaces the tile's values does not have it.
RW_FN void tangent_head_tile(Tile& tile, const float* __restrict__ head, const Draw& draw, uint32_t first, const Tangents& tangents, float factor,
                             const uint32_t* passed, float* head_gradient, double* loss) {
    float outputs[OWN][OUTPUTS], squares = 0.0f;
    outputs_of(outputs, tile, head, false);
    const int own = own_row() + min_(int(lane()), OWN - 1);
    const bool usable = is_usable(tile.samples[own]);
    const Float4* sample = usable ? drawn_at(draw, first + own) : nullptr;
    RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
        float found = 0.0f;
        RW_UNROLL for (int row = 0; row < OWN; ++row) found = int(lane()) == row ? outputs[row][output] : found;
        const float difference = usable ? tangent_difference(found, tangents.step * load_slope(sample, tangents.along, output)) : 0.0f;
        if (int(lane()) < OWN) {
            tile.slopes[own][output] = 2.0f * difference;
            squares = fma_(difference, difference, squares);
        }
    }
    squares = warp_sum(squares);
    if (lane() == 0u) atomicAdd(loss, double(factor * squares) / OUTPUTS / draw.batch);
    __syncthreads();
    for (int i = threadIdx.x; i < PAIRS * SHARES; i += THREADS) {
        const int column = 2 * (i % PAIRS), from = i / PAIRS * SHARE;
        float x[OUTPUTS], y[OUTPUTS];
        float2 weights[OUTPUTS];
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            x[output] = head_weight(head, column, output), y[output] = head_weight(head, column + 1, output);
            weights[output] = make_float2(0.0f, 0.0f);
        }
        for (int row = from; row < from + SHARE; ++row) {
            uint32_t& at = *reinterpret_cast<uint32_t*>(&tile.values[row][column]);
            const float2 delta = head_pair(tile.slopes[row], x, y, at, passed_pair(passed, row, column), weights);
            at = pack(delta.x, delta.y);
        }
        add_head_pair(head_gradient, column, weights, factor);
    }
    __syncthreads();
}
#endif

#if RW_LEVELS > 0
// Replaces the gradient with respect to the first layer's sums by that with respect to the encoded points, or to their tangents, in halves, and
// adds `factor` times it to the tables.
template <class Group = Values>
RW_FN void scatter_tile(Tile& tile, Stream& stream, float* __restrict__ table_gradient, float factor = 1.0f, Group group = Group()) {
    auto begin = [](float (&sums)[M][N][4], int) { clear(sums); };
    multiply_tile<ENCODED_PASSES>(tile, stream, PADDED, begin, [&](const float (&sums)[M][N][4], int, uint32_t (&pairs)[M][N][2]) {
        RW_UNROLL for (int m = 0; m < M; ++m) {
            RW_UNROLL for (int n = 0; n < N; ++n)
                RW_UNROLL for (int half = 0; half < 2; ++half) pairs[m][n][half] = pack(sums[m][n][2 * half], sums[m][n][2 * half + 1]);
        }
    });
    for (int i = threadIdx.x; i < ROWS * ENCODED_PADDED / 2; i += THREADS) {
        const int at = i / (ENCODED_PADDED / 2), column = i % (ENCODED_PADDED / 2) * 2;
        // A sample without a target would only add zeros.
        if (!is_usable(tile.samples[at])) continue;
        float point[DIMS];
        inputs(point, tile.samples[at].place);
        const float2 pair = unpack(*reinterpret_cast<const uint32_t*>(&tile.values[at][column]));
        scatter(tile.levels, point, column, factor * pair.x, factor * pair.y, table_gradient, group);
    }
}
#endif

// First bias of a hidden layer of the flat vector.
RW_FN constexpr int bias_start(int layer) { return layer_start(layer) + (layer == 0 ? ENCODED : WIDTH) * WIDTH; }

// Groups of rows per sample in training.
constexpr int TRAINED_GROUPS = RW_DERIVATIVES ? GROUPS : 1;
// Layers whose ReLU bits training keeps. The last one needs none for the values, whose gradient reads them itself.
constexpr int PASSED_LAYERS = RW_DERIVATIVES ? HIDDEN : HIDDEN - 1;

// Handles `rows` samples (whole tiles) of a batch from number `first` on. Adds the gradients of the tables (`table_gradient`, padded), of the
// biases and the head (`layer_gradient`, flat) and the loss. Stores encoded points (rows of ENCODED_PADDED), and values of and gradients with
// respect to the sums of each hidden layer (rows of PADDED, `held` rows per layer). `passed`: PASSED_LAYERS times PASSED words per block.
//
// If the loss has derivatives, `rows` rows of tangents along each axis follow the rows of the values. Tangents have the length `step`; `factor`,
// which divides it out and weights their part of the loss, multiplies their gradients in single precision. What is stored does not have it, so
// that tangents and their gradients are of the order of values in half precision.
extern "C" __global__ void __launch_bounds__(THREADS, 1)
batched_gradient(const __grid_constant__ Grid grid, const uint16_t* __restrict__ tables, const uint16_t* __restrict__ slices,
                 const float* __restrict__ biases, const float* __restrict__ head, const __grid_constant__ Draw draw, uint32_t first, uint32_t rows,
                 uint32_t held, uint16_t* __restrict__ encoded, uint16_t* __restrict__ values, uint16_t* __restrict__ deltas, uint32_t* passed,
                 float* __restrict__ table_gradient, float* __restrict__ layer_gradient, double* __restrict__ loss, [[maybe_unused]] float step,
                 [[maybe_unused]] float factor) {
    Tile& tile = *reinterpret_cast<Tile*>(memory);
    read_levels(tile.levels, grid);
    passed += blockIdx.x * size_t(PASSED_LAYERS * PASSED);
#if RW_PENALTY
    if (first == 0 && blockIdx.x == 0 && threadIdx.x == 0) atomicAdd(loss, penalty_loss(draw));
#endif
    Stream stream(slices, tile.stages, ALL_SLICES);
    for (uint32_t row = blockIdx.x * ROWS; row < rows; row += gridDim.x * ROWS) {
        auto of = [&](uint16_t* all, int layer, int group) { return all + (layer * size_t(held) + group * size_t(rows) + row) * PADDED; };
        __syncthreads();
        if (threadIdx.x < ROWS) tile.samples[threadIdx.x] = sample_at(draw, first + row + threadIdx.x);
        __syncthreads();
        encode_tile(tile, tables);
        __syncthreads();
        store_tile<ENCODED_PADDED>(tile, encoded + row * size_t(ENCODED_PADDED));
        forward_tile(tile, stream, ENCODED_PADDED, biases, PASSED_LAYERS > 0 ? passed : nullptr);
        store_tile<PADDED>(tile, of(values, 0, 0));
#pragma unroll 1
        for (int layer = 1; layer < HIDDEN; ++layer) {
            forward_tile(tile, stream, PADDED, biases + layer * PADDED, layer < PASSED_LAYERS ? passed + layer * PASSED : nullptr);
            store_tile<PADDED>(tile, of(values, layer, 0));
        }
        __syncthreads();
        head_tile(tile, head, draw, layer_gradient + layer_start(HIDDEN), layer_gradient + bias_start(HIDDEN - 1), loss);
        store_tile<PADDED>(tile, of(deltas, HIDDEN - 1, 0));
#pragma unroll 1
        for (int layer = HIDDEN - 2; layer >= 0; --layer) {
            backward_tile(tile, stream, passed + layer * PASSED, layer_gradient + bias_start(layer));
            store_tile<PADDED>(tile, of(deltas, layer, 0));
        }
#if RW_LEVELS > 0
        scatter_tile(tile, stream, table_gradient);
#endif
#if RW_DERIVATIVES
#pragma unroll 1
        for (int along = 0; along < SPACE; ++along) {
            const Tangents tangents = {along, step};
            const int group = 1 + along;
            __syncthreads();
            encode_tile(tile, tables, tangents);
            __syncthreads();
            store_tile<ENCODED_PADDED>(tile, encoded + (group * size_t(rows) + row) * ENCODED_PADDED);
            tangent_tile(tile, stream, ENCODED_PADDED, passed);
            store_tile<PADDED>(tile, of(values, 0, group));
#pragma unroll 1
            for (int layer = 1; layer < HIDDEN; ++layer) {
                tangent_tile(tile, stream, PADDED, passed + layer * PASSED);
                store_tile<PADDED>(tile, of(values, layer, group));
            }
            __syncthreads();
            const uint32_t* last = passed + (HIDDEN - 1) * PASSED;
            tangent_head_tile(tile, head, draw, first + row, tangents, factor, last, layer_gradient + layer_start(HIDDEN), loss);
            store_tile<PADDED>(tile, of(deltas, HIDDEN - 1, group));
#pragma unroll 1
            for (int layer = HIDDEN - 2; layer >= 0; --layer) {
                tangent_tile(tile, stream, PADDED, passed + layer * PASSED);
                store_tile<PADDED>(tile, of(deltas, layer, group));
            }
#if RW_LEVELS > 0
            scatter_tile(tile, stream, table_gradient, factor, tangents);
#endif
        }
#endif
    }
}

// Stages of a product: DEPTH samples of PANEL inputs and of COLUMNS neurons.
struct Panels {
    uint16_t inputs[DEPTH][PANEL + SKEW];
    Slice deltas;
};
static_assert(STAGES * sizeof(Panels) <= RW_PRODUCT_BYTES, "shared memory");
// Inputs of a panel, transposed, as a left operand.
struct PanelColumns {
    static constexpr int SECOND = 16 * (PANEL + SKEW);
    static RW_FN void read(uint32_t (&to)[4], const uint16_t* from, int m) { load_transposed(to, from + 16 * m); }
};

// Adds the weight gradients over `rows` rows, times `factor` if the loss has derivatives: the transposed inputs of a layer times its gradients, as
// `batched_gradient` stored them. Each block of the grid's y takes `share` rows; each block of its x takes PANEL times COLUMNS weights, layer by
// layer.
extern "C" __global__ void __launch_bounds__(THREADS, 1)
batched_products(const uint16_t* __restrict__ encoded, const uint16_t* __restrict__ values, const uint16_t* __restrict__ deltas, uint32_t rows,
                 uint32_t held, uint32_t share, float* __restrict__ layer_gradient, [[maybe_unused]] float factor) {
    constexpr int FIRST = (ENCODED + PANEL - 1) / PANEL * PASSES, OTHERS = (WIDTH + PANEL - 1) / PANEL * PASSES;
    Panels* stages = reinterpret_cast<Panels*>(memory);
    const int number = blockIdx.x, layer = number < FIRST ? 0 : 1 + (number - FIRST) / OTHERS;
    const int inside = layer == 0 ? number : (number - FIRST) % OTHERS;
    const int first_input = inside / PASSES * PANEL, first_neuron = inside % PASSES * COLUMNS, inputs = layer == 0 ? ENCODED : WIDTH;
    const int stride = layer == 0 ? ENCODED_PADDED : PADDED;
    const uint32_t from = blockIdx.y * share, steps = from < rows ? ((from + share < rows ? share : rows - from) / DEPTH) : 0;
    const uint16_t* left = (layer == 0 ? encoded : values + (layer - 1) * size_t(held) * PADDED) + from * size_t(stride) + first_input;
    const uint16_t* right = deltas + (layer * size_t(held) + from) * PADDED + first_neuron;
    if (steps == 0) return;
    float sums[4][N][4];
    clear(sums);
    // Inputs beyond the row and samples beyond the last step are 0.
    const bool there = first_input + int(threadIdx.x) % (PANEL / 8) * 8 < stride;
    uint32_t copied = 0;
    auto copy_step = [&] {
        Panels& to = stages[copied % STAGES];
        copy_rows_async<PANEL>(to.inputs, left, stride, there && copied < steps);
        copy_rows_async<COLUMNS>(to.deltas.values, right, PADDED, copied < steps);
        commit_group();
        left += DEPTH * stride;
        right += DEPTH * PADDED;
        ++copied;
    };
    RW_UNROLL for (int i = 0; i < STAGES - 1; ++i) copy_step();
    const uint32_t l = lane(), row = (l >> 4) * 8u + (l & 7u), column = warp_row(4) + (l >> 3 & 1u) * 8u;
    uint32_t taken = 0;
    Product<PanelColumns, 4>(sums).add(steps, [&] {
        wait_for_group();
        copy_step();
        const Panels& panels = stages[taken++ % STAGES];
        return Operands{&panels.inputs[row][column], &panels.deltas.values[right_row()][right_column()]};
    });
    float* gradient = layer_gradient + layer_start(layer);
    RW_UNROLL for (int m = 0; m < 4; ++m) {
        RW_UNROLL for (int n = 0; n < N; ++n) {
            RW_UNROLL for (int half = 0; half < 2; ++half) {
                const int input = first_input + lane_row(4, m) + 8 * half;
                float x = sums[m][n][2 * half], y = sums[m][n][2 * half + 1];
#if RW_DERIVATIVES
                x *= factor, y *= factor;
#endif
                if (input < inputs) add_pair(gradient + input * size_t(WIDTH), first_neuron + lane_column(n), x, y);
            }
        }
    }
}
