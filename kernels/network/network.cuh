// The network on tensor cores: multiresolution hash grid (Mueller et al. 2022) or frequency encoding (Mildenhall et al. 2020), and a fully fused
// multilayer perceptron (Mueller et al. 2021). Mirrors src/surrogate/network/.
//
// A warp carries 16 samples through the network in registers. Between layers the values have the layout of the matrix instruction's left operand
// (rows are samples, columns neurons): lane 4g + q holds, of samples g and g + 8, columns 2q and 2q + 1 of every 8. The lane that gathers a pair
// of features is therefore the one that needs them, and the one that receives their gradient. Values are in half precision, sums in single
// precision.
//
// Macros: RW_DIMS, number of inputs; RW_AXES, their places in a sample (axes have their own, times take those of unused axes, then further
// ones); RW_SPACE, number of inputs that are axes, which come first; RW_LEVELS (0: frequencies), RW_FEATURES, RW_OCTAVES; RW_WIDTH, neurons of a
// hidden layer; RW_HIDDEN, number of hidden layers; RW_FLOW_MAP (1: one output per axis, whose derivatives along the axes are the gradient of
// the flow map; 0: one output); RW_DERIVATIVES (1: the loss has these derivatives); RW_PENALTY (1: the loss has a penalty on batch means);
// RW_WEIGHTS_BYTES and RW_WORKSPACE_BYTES, shared memory of prediction and of training.
#pragma once
#include "common/base.cuh"

#if !RW_DEVICE
struct float2 {
    float x, y;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline void sincospif(float x, float* sine, float* cosine) {
    *sine = float(std::sin(3.14159265358979323846 * double(x)));
    *cosine = float(std::cos(3.14159265358979323846 * double(x)));
}
inline void atomicAdd(float* at, float x) { *at += x; }
#endif

namespace rw {

constexpr int DIMS = RW_DIMS, LEVELS = RW_LEVELS, FEATURES = RW_FEATURES, OCTAVES = RW_OCTAVES, WIDTH = RW_WIDTH, HIDDEN = RW_HIDDEN;
constexpr int SPACE = RW_SPACE, OUTPUTS = RW_FLOW_MAP ? SPACE : 1;
// Groups of rows per sample in a differentiated network: values, and their tangents along each axis.
constexpr int GROUPS = 1 + SPACE;
// Places of a sample.
constexpr int PLACES = DIMS > 3 ? DIMS : 3;
constexpr int ENCODED = LEVELS > 0 ? LEVELS * FEATURES : 2 * DIMS * OCTAVES;
constexpr int CORNERS = 1 << DIMS;
// Sizes in blocks of 16 for the matrix instruction. Padding is 0.
constexpr int ENCODED_BLOCKS = (ENCODED + 15) / 16, WIDTH_BLOCKS = (WIDTH + 15) / 16;
// Eight extra halves per row spread its columns over the banks of shared memory.
constexpr int SKEW = 8;
constexpr int STRIDE = 16 * WIDTH_BLOCKS + SKEW;
constexpr int HEAD_STRIDE = 8 + SKEW;

// First parameter of a layer in the flat vector: inputs * outputs weights, input-major, then biases (see Architecture::layers).
RW_FN constexpr int layer_start(int layer) {
    return layer == 0 ? 0 : (ENCODED + 1) * WIDTH + (layer - 1) * (WIDTH + 1) * WIDTH;
}

// One level of the hash grid, with room for three or four inputs.
constexpr int LEVEL_INPUTS = DIMS > 3 ? 4 : 3;
struct alignas(8) Level {
    float cells[LEVEL_INPUTS];
    uint32_t last_cell[LEVEL_INPUTS];
    uint32_t factor[LEVEL_INPUTS];  // multiplier of each input's node: a prime of the hash, or the stride of a dense level
    uint32_t mask;                  // entries - 1 of a hashed level
    uint32_t hashed;
    uint32_t entries;
    uint32_t offset;  // first entry in padded tables, a multiple of 64
    uint32_t start;   // first entry in burn's tables
};
static_assert(sizeof(Level) == (DIMS > 3 ? 72 : 56), "layout");

struct Grid {
    Level levels[LEVELS > 0 ? LEVELS : 1];
};

#if RW_LEVELS > 0

// Lower and upper node of the cell around a point, as summands of an entry's index, and their linear weights.
struct Sides {
    uint32_t node[DIMS][2];
    float share[DIMS][2];
};

RW_FN Sides sides(const Level& level, const float (&point)[DIMS]) {
    Sides at;
    RW_UNROLL for (int axis = 0; axis < DIMS; ++axis) {
        const float position = min_(max_(point[axis], 0.0f), 1.0f) * level.cells[axis];
        const uint32_t whole = uint32_t(position), cell = whole < level.last_cell[axis] ? whole : level.last_cell[axis];
        const float fraction = position - float(cell);
        at.node[axis][0] = cell * level.factor[axis];
        at.node[axis][1] = at.node[axis][0] + level.factor[axis];
        at.share[axis][0] = 1.0f - fraction;
        at.share[axis][1] = fraction;
    }
    return at;
}

// Entries of the corners in padded tables, and multilinear weights.
struct Cell {
    uint32_t index[CORNERS];
    float weight[CORNERS];
};

RW_FN Cell corners(const Level& level, const Sides& at) {
    Cell cell;
    RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) {
        uint32_t sum = at.node[0][corner & 1], hash = sum;
        float weight = at.share[0][corner & 1];
        RW_UNROLL for (int axis = 1; axis < DIMS; ++axis) {
            const uint32_t other = at.node[axis][corner >> axis & 1];
            sum += other;
            hash ^= other;
            weight *= at.share[axis][corner >> axis & 1];
        }
        cell.index[corner] = level.offset + (level.hashed ? hash & level.mask : sum);
        cell.weight[corner] = weight;
    }
    return cell;
}

RW_FN Cell locate(const Level& level, const float (&point)[DIMS]) { return corners(level, sides(level, point)); }

// Derivative of a corner's weight along an input.
RW_FN float weight_slope(const Level& level, const Sides& at, int corner, int along) {
    float slope = corner >> along & 1 ? level.cells[along] : -level.cells[along];
    RW_UNROLL for (int axis = 0; axis < DIMS; ++axis) slope *= axis == along ? 1.0f : at.share[axis][corner >> axis & 1];
    return slope;
}

#endif

RW_FN float2 unpack(uint32_t both) { return make_float2(from_half(uint16_t(both)), from_half(uint16_t(both >> 16))); }

// Reads two neighbouring features of an entry, or the only one if a level has a single feature.
struct Features {
    const uint16_t* tables;

    RW_FN float2 pair(uint32_t entry, int feature) const {
        return unpack(load(reinterpret_cast<const uint32_t*>(tables) + entry * uint32_t(FEATURES / 2) + uint32_t(feature / 2)));
    }
    RW_FN float single(uint32_t entry) const { return from_half(load(tables + entry)); }
};

#if RW_LEVELS == 0
// Argument of a column's sine, in half turns: (1/2) 2^octave p.
RW_FN float half_turns(const float (&point)[DIMS], int column) {
    const int axis = column / (2 * OCTAVES), octave = column / 2 % OCTAVES;
    float position = point[0];
    RW_UNROLL for (int k = 1; k < DIMS; ++k) position = axis == k ? point[k] : position;
    position = 2.0f * min_(max_(position, 0.0f), 1.0f) - 1.0f;
    // The product with a power of two is exact.
    return 0.5f * position * float(1u << octave);
}
#endif

// A group of rows: the encoded points themselves.
struct Values {
#if RW_LEVELS > 0
    RW_FN Cell cell(const Level& level, const float (&point)[DIMS]) const { return locate(level, point); }
#else
    RW_FN float2 wave(float sine, float cosine, int) const { return make_float2(sine, cosine); }
#endif
};

// A group of rows: tangents of the encoded points, `step` times their derivatives along an axis.
struct Tangents {
    int along;
    float step;

#if RW_LEVELS > 0
    RW_FN Cell cell(const Level& level, const float (&point)[DIMS]) const {
        const Sides at = sides(level, point);
        Cell cell = corners(level, at);
        RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) cell.weight[corner] = step * weight_slope(level, at, corner, along);
        return cell;
    }
#else
    RW_FN float2 wave(float sine, float cosine, int column) const {
        const int axis = column / (2 * OCTAVES), octave = column / 2 % OCTAVES;
        const float rate = axis == along ? 3.14159265f * step * float(1u << octave) : 0.0f;
        return make_float2(rate * cosine, -rate * sine);
    }
#endif
};

// Columns `column` and `column + 1` of an encoded point, or of its tangent.
template <class Group = Values>
RW_FN float2 encode([[maybe_unused]] const Level* levels, [[maybe_unused]] const Features& features, const float (&point)[DIMS], int column,
                    Group group = Group()) {
    if (column >= ENCODED) return make_float2(0.0f, 0.0f);
    float2 sum = make_float2(0.0f, 0.0f);
#if RW_LEVELS == 0
    float sine, cosine;
    sincospif(half_turns(point, column), &sine, &cosine);
    sum = group.wave(sine, cosine, column);
#elif RW_FEATURES == 1
    auto add_level = [&](int number, float& sum) {
        const Cell cell = group.cell(levels[number], point);
        RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) sum = fma_(cell.weight[corner], features.single(cell.index[corner]), sum);
    };
    add_level(column, sum.x);
    if (column + 1 < ENCODED) add_level(column + 1, sum.y);
#else
    const Cell cell = group.cell(levels[column / FEATURES], point);
    RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) {
        const float2 pair = features.pair(cell.index[corner], column % FEATURES);
        sum.x = fma_(cell.weight[corner], pair.x, sum.x);
        sum.y = fma_(cell.weight[corner], pair.y, sum.y);
    }
#endif
    return sum;
}

#if RW_FLOW_MAP

// As `encode`, with the tangents of the columns: `step` times their derivatives along each axis.
RW_FN void encode_tangents(float2 (&sums)[GROUPS], [[maybe_unused]] const Level* levels, [[maybe_unused]] const Features& features,
                           const float (&point)[DIMS], int column, float step) {
    RW_UNROLL for (int group = 0; group < GROUPS; ++group) sums[group] = make_float2(0.0f, 0.0f);
    if (column >= ENCODED) return;
#if RW_LEVELS == 0
    sincospif(half_turns(point, column), &sums[0].x, &sums[0].y);
    const int axis = column / (2 * OCTAVES), octave = column / 2 % OCTAVES;
    const float rate = 3.14159265f * step * float(1u << octave);
    RW_UNROLL for (int along = 0; along < SPACE; ++along) if (along == axis) sums[1 + along] = make_float2(rate * sums[0].y, -rate * sums[0].x);
#else
    auto add_level = [&](int number, auto add_corner) {
        const Level& level = levels[number];
        const Sides at = sides(level, point);
        const Cell cell = corners(level, at);
        RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) {
            float factors[GROUPS] = {cell.weight[corner]};
            RW_UNROLL for (int along = 0; along < SPACE; ++along) factors[1 + along] = step * weight_slope(level, at, corner, along);
            add_corner(cell.index[corner], factors);
        }
    };
#if RW_FEATURES == 1
    auto add_single = [&](int number, float float2::*member) {
        add_level(number, [&](uint32_t entry, const float (&factors)[GROUPS]) {
            const float value = features.single(entry);
            RW_UNROLL for (int group = 0; group < GROUPS; ++group) sums[group].*member = fma_(factors[group], value, sums[group].*member);
        });
    };
    add_single(column, &float2::x);
    if (column + 1 >= ENCODED) return;
    add_single(column + 1, &float2::y);
#else
    add_level(column / FEATURES, [&](uint32_t entry, const float (&factors)[GROUPS]) {
        const float2 pair = features.pair(entry, column % FEATURES);
        RW_UNROLL for (int group = 0; group < GROUPS; ++group) {
            sums[group].x = fma_(factors[group], pair.x, sums[group].x);
            sums[group].y = fma_(factors[group], pair.y, sums[group].y);
        }
    });
#endif
#endif
}

#endif

RW_FN void add(float* at, float x, float y) {
#if __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float2*>(at), make_float2(x, y));
#else
    atomicAdd(at, x);
    atomicAdd(at + 1, y);
#endif
}

#if RW_LEVELS > 0
// Adds the gradient of columns `column` and `column + 1` to the table entries from which they, or their tangents, were interpolated.
template <class Group = Values>
RW_FN void scatter(const Level* levels, const float (&point)[DIMS], int column, float x, float y, float* __restrict__ gradient,
                   Group group = Group()) {
    if (column >= ENCODED) return;
#if RW_FEATURES == 1
    auto add_level = [&](int number, float value) {
        const Cell cell = group.cell(levels[number], point);
        RW_UNROLL for (int corner = 0; corner < CORNERS; ++corner) atomicAdd(gradient + cell.index[corner], cell.weight[corner] * value);
    };
    add_level(column, x);
    if (column + 1 < ENCODED) add_level(column + 1, y);
#else
    const Cell cell = group.cell(levels[column / FEATURES], point);
    RW_UNROLL for (int corner = 0; corner < CORNERS; corner += 2) {
        const uint32_t index = cell.index[corner], next = cell.index[corner + 1];
        const float a = cell.weight[corner], b = cell.weight[corner + 1];
#if RW_FEATURES == 2 && __CUDA_ARCH__ >= 900
        // Both ends of an edge along the first axis are often adjacent in memory: one request instead of two.
        if ((index ^ next) == 1u) {
            const float low = index & 1u ? b : a, high = index & 1u ? a : b;
            atomicAdd(reinterpret_cast<float4*>(gradient + 2 * size_t(index & ~1u)), make_float4(low * x, low * y, high * x, high * y));
            continue;
        }
#endif
        add(gradient + size_t(index) * FEATURES + column % FEATURES, a * x, a * y);
        add(gradient + size_t(next) * FEATURES + column % FEATURES, b * x, b * y);
    }
#endif
}

#else
// Frequencies have no tables.
template <class Group = Values> RW_FN void scatter(const Level*, const float (&)[DIMS], int, float, float, float*, Group = Group()) {}
#endif

#if RW_DEVICE

RW_FN uint32_t pack(float low, float high) {
    uint32_t both;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
    return both;
}

// Packs ReLU values, max(0, x). NaN stays NaN, as on the CPU, so that a diverged network is detected (fmaxf would return 0).
RW_FN uint32_t pack_relu(float low, float high) {
    uint32_t both;
    asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
    return both;
}

// d += a b, with a of 16x16 and b of 16x8.
RW_FN void multiply(float (&d)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
    asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// Loads four 8x8 blocks from shared memory. Lane i passes the address of row i % 8 of block i / 8; lane 4g + q gets columns 2q, 2q + 1 of row g
// of each.
RW_FN void load_blocks(uint32_t (&to)[4], const uint16_t* row) {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
                 : "r"(uint32_t(__cvta_generic_to_shared(row)))
                 : "memory");
}
// As `load_blocks`, transposed.
RW_FN void load_transposed(uint32_t (&to)[4], const uint16_t* row) {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
                 : "r"(uint32_t(__cvta_generic_to_shared(row)))
                 : "memory");
}
RW_FN void load_transposed(uint32_t (&to)[2], const uint16_t* row) {
    asm volatile("ldmatrix.sync.aligned.m8n8.x2.trans.shared.b16 {%0, %1}, [%2];"
                 : "=r"(to[0]), "=r"(to[1])
                 : "r"(uint32_t(__cvta_generic_to_shared(row)))
                 : "memory");
}

RW_FN uint32_t lane() { return threadIdx.x & 31u; }

// Rows of 16 samples, `BLOCKS` times 16 columns.
template <int BLOCKS> struct Rows {
    uint32_t block[BLOCKS][4];
};
// Sums in the layout of the matrix instruction's result: `BLOCKS` times 8 columns.
template <int BLOCKS> struct Sums {
    float block[BLOCKS][4];
};

// The layers in shared memory, in half precision, one row per input.
struct alignas(16) Weights {
    uint16_t first[16 * ENCODED_BLOCKS][STRIDE];
    uint16_t hidden[HIDDEN > 1 ? HIDDEN - 1 : 1][16 * WIDTH_BLOCKS][STRIDE];
    uint16_t head[16 * WIDTH_BLOCKS][HEAD_STRIDE];
    float biases[HIDDEN][16 * WIDTH_BLOCKS];
    float head_bias[OUTPUTS];
};

// The whole block must call it; ends with a barrier.
RW_FN void read_layers(Weights& weights, const float* __restrict__ layers) {
    auto matrix = [&](uint16_t* to, int rows, int columns, int stride, const float* from, int inputs, int outputs) {
        for (int i = threadIdx.x; i < rows * columns; i += blockDim.x) {
            const int row = i / columns, column = i % columns;
            to[row * stride + column] = to_half(row < inputs && column < outputs ? from[row * outputs + column] : 0.0f);
        }
    };
    auto vector = [&](float* to, int padded, const float* from, int count) {
        for (int i = threadIdx.x; i < padded; i += blockDim.x) to[i] = i < count ? from[i] : 0.0f;
    };
    constexpr int PADDED = 16 * WIDTH_BLOCKS;
    matrix(&weights.first[0][0], 16 * ENCODED_BLOCKS, PADDED, STRIDE, layers, ENCODED, WIDTH);
    vector(weights.biases[0], PADDED, layers + ENCODED * WIDTH, WIDTH);
    for (int layer = 1; layer < HIDDEN; ++layer) {
        matrix(&weights.hidden[layer - 1][0][0], PADDED, PADDED, STRIDE, layers + layer_start(layer), WIDTH, WIDTH);
        vector(weights.biases[layer], PADDED, layers + layer_start(layer) + WIDTH * WIDTH, WIDTH);
    }
    matrix(&weights.head[0][0], PADDED, 8, HEAD_STRIDE, layers + layer_start(HIDDEN), WIDTH, OUTPUTS);
    vector(weights.head_bias, OUTPUTS, layers + layer_start(HIDDEN) + WIDTH * OUTPUTS, OUTPUTS);
    __syncthreads();
}

// Encodes the warp's 16 points, or their tangents; each lane passes the two points of its rows.
template <class Group = Values>
RW_FN void encode_rows(Rows<ENCODED_BLOCKS>& rows, const Level* levels, const Features& features, const float (&points)[2][DIMS],
                       Group group = Group()) {
    RW_UNROLL for (int block = 0; block < ENCODED_BLOCKS; ++block) {
        RW_UNROLL for (int part = 0; part < 4; ++part) {
            const float2 pair = encode(levels, features, points[part & 1], 16 * block + 8 * (part >> 1) + 2 * int(lane() & 3u), group);
            rows.block[block][part] = pack(pair.x, pair.y);
        }
    }
}

#if RW_FLOW_MAP
// As above, with tangents: one group each.
RW_FN void encode_rows(Rows<ENCODED_BLOCKS> (&rows)[GROUPS], const Level* levels, const Features& features, const float (&points)[2][DIMS],
                       float step) {
    RW_UNROLL for (int block = 0; block < ENCODED_BLOCKS; ++block) {
        RW_UNROLL for (int part = 0; part < 4; ++part) {
            float2 pairs[GROUPS];
            encode_tangents(pairs, levels, features, points[part & 1], 16 * block + 8 * (part >> 1) + 2 * int(lane() & 3u), step);
            RW_UNROLL for (int group = 0; group < GROUPS; ++group) rows[group].block[block][part] = pack(pairs[group].x, pairs[group].y);
        }
    }
}
#endif

// sums += rows * matrix, where matrix has 16 * IN rows and 16 * WIDTH_BLOCKS columns.
template <int IN> RW_FN void add_product(Sums<2 * WIDTH_BLOCKS>& sums, const Rows<IN>& rows, const uint16_t (*matrix)[STRIDE]) {
    const uint32_t row = (lane() >> 3 & 1u) * 8u + (lane() & 7u), column = (lane() >> 4) * 8u;
    RW_UNROLL for (int k = 0; k < IN; ++k) {
        RW_UNROLL for (int n = 0; n < WIDTH_BLOCKS; ++n) {
            uint32_t b[4];
            load_transposed(b, &matrix[16 * k + row][16 * n + column]);
            multiply(sums.block[2 * n], rows.block[k], b[0], b[1]);
            multiply(sums.block[2 * n + 1], rows.block[k], b[2], b[3]);
        }
    }
}

// sums = rows * matrix + biases.
template <int IN>
RW_FN void forward(Sums<2 * WIDTH_BLOCKS>& sums, const Rows<IN>& rows, const uint16_t (*matrix)[STRIDE], const float* biases) {
    RW_UNROLL for (int n = 0; n < 2 * WIDTH_BLOCKS; ++n)
        RW_UNROLL for (int k = 0; k < 2; ++k) sums.block[n][k] = sums.block[n][k + 2] = biases[8 * n + 2 * (lane() & 3u) + k];
    add_product(sums, rows, matrix);
}

template <int BLOCKS> RW_FN void clear(Sums<BLOCKS>& sums) {
    RW_UNROLL for (int n = 0; n < BLOCKS; ++n)
        RW_UNROLL for (int k = 0; k < 4; ++k) sums.block[n][k] = 0.0f;
}

// sums = rows * transposed matrix, where matrix has 8 * OUT rows.
template <int OUT> RW_FN void backward(Sums<OUT>& sums, const Rows<WIDTH_BLOCKS>& rows, const uint16_t (*matrix)[STRIDE]) {
    clear(sums);
    const uint32_t row = (lane() >> 4) * 8u + (lane() & 7u), column = (lane() >> 3 & 1u) * 8u;
    RW_UNROLL for (int k = 0; k < WIDTH_BLOCKS; ++k) {
        RW_UNROLL for (int n = 0; n < OUT / 2; ++n) {
            uint32_t b[4];
            load_blocks(b, &matrix[16 * n + row][16 * k + column]);
            multiply(sums.block[2 * n], rows.block[k], b[0], b[1]);
            multiply(sums.block[2 * n + 1], rows.block[k], b[2], b[3]);
        }
    }
}

// Rows of the next layer: ReLU of the sums.
RW_FN void activate(Rows<WIDTH_BLOCKS>& rows, const Sums<2 * WIDTH_BLOCKS>& sums) {
    RW_UNROLL for (int n = 0; n < WIDTH_BLOCKS; ++n) {
        RW_UNROLL for (int part = 0; part < 4; ++part) {
            const float(&from)[4] = sums.block[2 * n + (part >> 1)];
            rows.block[n][part] = pack_relu(from[2 * (part & 1)], from[2 * (part & 1) + 1]);
        }
    }
}

// Which values of a layer are not 0, in one bit each.
struct Passed {
    uint32_t words[(WIDTH_BLOCKS + 3) / 4];

    static RW_FN constexpr int bit(int n, int part) { return 8 * (n % 4) + 2 * part; }
    Passed() = default;
    RW_FN explicit Passed(const Rows<WIDTH_BLOCKS>& values) : words() {
        RW_UNROLL for (int n = 0; n < WIDTH_BLOCKS; ++n) {
            RW_UNROLL for (int part = 0; part < 4; ++part) {
                const uint32_t pair = values.block[n][part];
                words[n / 4] |= ((pair & 0x00007fffu ? 1u : 0u) | (pair & 0x7fff0000u ? 2u : 0u)) << bit(n, part);
            }
        }
    }
};

// Whether the ReLU passed the values of a pair: not 0 in the lower and in the upper half if it did.
RW_FN uint32_t passed_pair(const Rows<WIDTH_BLOCKS>& values, int n, int part) { return values.block[n][part] & 0x7fff7fffu; }
RW_FN uint32_t passed_pair(const Passed& passed, int n, int part) {
    const uint32_t both = passed.words[n / 4] >> Passed::bit(n, part);
    return (both & 1u) | (both & 2u) << 15;
}

// Backpropagation through the ReLU, and tangents through it: `from` where `passed` is not 0, else 0.
template <class Mask> RW_FN void relu_mask(Rows<WIDTH_BLOCKS>& delta, const Mask& passed, const Sums<2 * WIDTH_BLOCKS>& from) {
    RW_UNROLL for (int n = 0; n < WIDTH_BLOCKS; ++n) {
        RW_UNROLL for (int part = 0; part < 4; ++part) {
            const float(&sums)[4] = from.block[2 * n + (part >> 1)];
            const uint32_t active = passed_pair(passed, n, part);
            delta.block[n][part] = pack(active & 0x0000ffffu ? sums[2 * (part & 1)] : 0.0f, active & 0xffff0000u ? sums[2 * (part & 1) + 1] : 0.0f);
        }
    }
}

// sums += rows * last layer. Lane 4g + q has, of samples g and g + 8, outputs 2q and 2q + 1.
RW_FN void add_head(float (&sums)[4], const Rows<WIDTH_BLOCKS>& rows, const Weights& weights) {
    RW_UNROLL for (int k = 0; k < WIDTH_BLOCKS; ++k) {
        uint32_t b[2];
        load_transposed(b, &weights.head[16 * k + (lane() & 15u)][0]);
        multiply(sums, rows.block[k], b[0], b[1]);
    }
}

// Output `output` of the sample in row `g + 8 * row`, in all four lanes of the sample.
RW_FN float output_of(const float (&sums)[4], int row, int output) {
    return __shfl_sync(0xffffffffu, sums[2 * row + (output & 1)], (lane() & ~3u) + uint32_t(output >> 1));
}

// The hidden layers; `rows` keeps the values of each.
RW_FN void hidden_forward(const Rows<ENCODED_BLOCKS>& encoded, Rows<WIDTH_BLOCKS> (&rows)[HIDDEN], const Weights& weights) {
    {
        Sums<2 * WIDTH_BLOCKS> sums;
        forward(sums, encoded, weights.first, weights.biases[0]);
        activate(rows[0], sums);
    }
    RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer) {
        Sums<2 * WIDTH_BLOCKS> sums;
        forward(sums, rows[layer - 1], weights.hidden[layer - 1], weights.biases[layer]);
        activate(rows[layer], sums);
    }
}

// All layers.
RW_FN void layers_forward(float (&outputs)[4], const Rows<ENCODED_BLOCKS>& encoded, Rows<WIDTH_BLOCKS> (&rows)[HIDDEN], const Weights& weights) {
    hidden_forward(encoded, rows, weights);
    RW_UNROLL for (int k = 0; k < 4; ++k) {
        const int output = OUTPUTS == 1 ? k & 1 : 2 * int(lane() & 3u) + (k & 1);
        outputs[k] = output < OUTPUTS ? weights.head_bias[output] : 0.0f;
    }
    add_head(outputs, rows[HIDDEN - 1], weights);
}

// Propagates a tangent through all layers; the ReLU passes it where the value in `passed` is not 0. `rows` keeps the tangents of each layer.
template <class Mask>
RW_FN void tangent_forward(float (&outputs)[4], const Rows<ENCODED_BLOCKS>& encoded, Rows<WIDTH_BLOCKS> (&rows)[HIDDEN], const Mask& passed,
                           const Weights& weights) {
    {
        Sums<2 * WIDTH_BLOCKS> sums;
        clear(sums);
        add_product(sums, encoded, weights.first);
        relu_mask(rows[0], passed[0], sums);
    }
    RW_UNROLL for (int layer = 1; layer < HIDDEN; ++layer) {
        Sums<2 * WIDTH_BLOCKS> sums;
        clear(sums);
        add_product(sums, rows[layer - 1], weights.hidden[layer - 1]);
        relu_mask(rows[layer], passed[layer], sums);
    }
    RW_UNROLL for (int k = 0; k < 4; ++k) outputs[k] = 0.0f;
    add_head(outputs, rows[HIDDEN - 1], weights);
}

#endif

}  // namespace rw
