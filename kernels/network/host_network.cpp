// A network as host C++, for the tests that compare it with the Rust reference. Places, samples, encodings, tangents, the map from outputs to
// log-stretch and the gradient of the tables are the device's; layers are multiplied in single precision. Compiled with the macros of network.cuh.
#include "network/network_data.cuh"

using namespace rw;

// Values and, for a flow map, tangents of a sample.
constexpr int ROWS = RW_FLOW_MAP ? GROUPS : 1;
constexpr int MOST = ENCODED + 1 > WIDTH ? ENCODED + 1 : WIDTH;

// The encoded point, and what follows from it in each layer.
struct Layers {
    float rows[HIDDEN + 2][ROWS][MOST];
};

static int inputs_of(int layer) { return layer == 0 ? ENCODED : WIDTH; }
static int neurons_of(int layer) { return layer == HIDDEN ? OUTPUTS : WIDTH; }

// Calls `with(group)` for the group of a row.
template <class With> static void of_row(int row, [[maybe_unused]] float step, With with) {
    if (row == 0) with(Values());
    else with(Tangents{row - 1, step});
}

// Evaluates the network. Returns false if the encodings of prediction and of training differ.
static bool forward(Layers& to, const Grid& grid, const uint16_t* tables, const float* layers, const float (&point)[DIMS], float step) {
    bool alike = true;
    to = {};
    for (int column = 0; column < ENCODED; column += 2) {
        float2 pairs[ROWS];
#if RW_FLOW_MAP
        encode_tangents(pairs, grid.levels, {tables}, point, column, step);
#else
        pairs[0] = encode(grid.levels, {tables}, point, column);
#endif
        for (int row = 0; row < ROWS; ++row) {
            of_row(row, step, [&](auto group) {
                const float2 alone = encode(grid.levels, {tables}, point, column, group);
                alike = alike && alone.x == pairs[row].x && alone.y == pairs[row].y;
            });
            to.rows[0][row][column] = pairs[row].x, to.rows[0][row][column + 1] = pairs[row].y;
        }
    }
    for (int layer = 0; layer <= HIDDEN; ++layer) {
        const float* weights = layers + layer_start(layer);
        const int in = inputs_of(layer), many = neurons_of(layer);
        auto& next = to.rows[layer + 1];
        for (int neuron = 0; neuron < many; ++neuron) {
            for (int row = 0; row < ROWS; ++row) {
                float sum = row == 0 ? weights[in * many + neuron] : 0.0f;
                for (int k = 0; k < in; ++k) sum = fma_(to.rows[layer][row][k], weights[k * many + neuron], sum);
                next[row][neuron] = layer < HIDDEN && (row == 0 ? sum : next[0][neuron]) <= 0.0f ? 0.0f : sum;
            }
        }
    }
    return alike;
}

// Log-stretch at `n` unit points. `tables` are padded, `layers` the flat vector.
extern "C" void host_predict(const Grid* grid, const uint16_t* tables, const float* layers, const Reading* reading, const float* points, uint32_t n,
                             float* out) {
    for (uint32_t i = 0; i < n; ++i) {
        float unit[PLACES], point[DIMS];
        read_point(*reading, points, i, unit);
        place_times(*reading, unit);
        inputs(point, unit);
        Layers of;
        if (!forward(of, *grid, tables, layers, point, reading->step)) return;
        const auto& outputs = of.rows[HIDDEN + 1];
#if RW_FLOW_MAP
        float tangents[OUTPUTS][SPACE];
        for (int output = 0; output < OUTPUTS; ++output)
            for (int along = 0; along < SPACE; ++along) tangents[output][along] = outputs[1 + along][output];
        out[i] = read_tangents(*reading, tangents);
#else
        out[i] = read_output(*reading, outputs[0][0], unit);
#endif
    }
}

#if RW_DERIVATIVES
// Sum of the squared errors over `n` traced points, with `factor` times those of the tangents, and their gradients, which are added: of the padded
// tables, and of the flat vector of the layers.
extern "C" double host_gradient(const Grid* grid, const uint16_t* tables, const float* layers, const UnitBox* domain, const Reading* reading,
                                const float* points, const float* arrivals, const float* jacobians, uint32_t n, float factor,
                                float* table_gradient, float* layer_gradient) {
    double loss = 0.0;
    for (uint32_t i = 0; i < n; ++i) {
        Float4 stored[SAMPLE_FLOAT4S];
        write_sample(*domain, *reading, points, arrivals, jacobians, i, 0, stored - i * size_t(SAMPLE_FLOAT4S));
        const Sample sample = load_sample(stored);
        if (!is_usable(sample)) continue;
        float point[DIMS];
        inputs(point, sample.place);
        Layers of;
        if (!forward(of, *grid, tables, layers, point, reading->step)) return not_a_number();
        for (int row = 0; row < ROWS; ++row) {
            const float weight = row == 0 ? 1.0f : factor;
            float delta[MOST] = {};
            for (int output = 0; output < OUTPUTS; ++output) {
                const float found = of.rows[HIDDEN + 1][row][output];
                const float difference = row == 0 ? found - sample.target[output]
                                                  : tangent_difference(found, reading->step * load_slope(stored, row - 1, output));
                loss += double(weight * difference * difference);
                delta[output] = 2.0f * difference;
            }
            for (int layer = HIDDEN; layer >= 0; --layer) {
                const int in = inputs_of(layer), many = neurons_of(layer);
                const float* weights = layers + layer_start(layer);
                float* gradient = layer_gradient + layer_start(layer);
                float below[MOST] = {};
                for (int neuron = 0; neuron < many; ++neuron) {
                    for (int k = 0; k < in; ++k) {
                        gradient[k * many + neuron] += weight * of.rows[layer][row][k] * delta[neuron];
                        // The ReLU's mask is that of the values, also for tangents.
                        if (layer == 0 || of.rows[layer][0][k] > 0.0f) below[k] = fma_(weights[k * many + neuron], delta[neuron], below[k]);
                    }
                    if (row == 0) gradient[in * many + neuron] += delta[neuron];
                }
                for (int k = 0; k < MOST; ++k) delta[k] = below[k];
            }
            of_row(row, reading->step, [&](auto group) {
                for (int column = 0; column < ENCODED; column += 2)
                    scatter(grid->levels, point, column, weight * delta[column], weight * delta[column + 1], table_gradient, group);
            });
        }
    }
    return loss;
}
#endif
