// A network as host C++, for the test that compares it with the Rust reference. Places, encodings, tangents and the map from outputs to
// log-stretch are the device's; layers are multiplied in single precision. Compiled with the macros of network.cuh.
#include "network/network_data.cuh"

using namespace rw;

// Log-stretch at `n` unit points. `tables` are padded, `layers` the flat vector.
extern "C" void host_predict(const Grid* grid, const uint16_t* tables, const float* layers, const Reading* reading, const float* points, uint32_t n,
                             float* out) {
    for (uint32_t i = 0; i < n; ++i) {
        float unit[PLACES], point[DIMS];
        read_point(*reading, points, i, unit);
        place_times(*reading, unit);
        inputs(point, unit);
        // Values and, for a flow map, tangents.
        constexpr int ROWS = RW_FLOW_MAP ? GROUPS : 1;
        float rows[ROWS][ENCODED > WIDTH ? ENCODED + 1 : WIDTH] = {};
        for (int column = 0; column < ENCODED; column += 2) {
            float2 pairs[ROWS];
#if RW_FLOW_MAP
            encode_tangents(pairs, grid->levels, {tables}, point, column, reading->step);
            const float2 alone = encode(grid->levels, {tables}, point, column);
            if (alone.x != pairs[0].x || alone.y != pairs[0].y) return;
#else
            pairs[0] = encode(grid->levels, {tables}, point, column);
#endif
            for (int row = 0; row < ROWS; ++row) rows[row][column] = pairs[row].x, rows[row][column + 1] = pairs[row].y;
        }
        for (int layer = 0; layer <= HIDDEN; ++layer) {
            const float* weights = layers + layer_start(layer);
            const int in = layer == 0 ? ENCODED : WIDTH, many = layer == HIDDEN ? OUTPUTS : WIDTH;
            float next[ROWS][WIDTH > OUTPUTS ? WIDTH : OUTPUTS] = {};
            for (int neuron = 0; neuron < many; ++neuron) {
                for (int row = 0; row < ROWS; ++row) {
                    float sum = row == 0 ? weights[in * many + neuron] : 0.0f;
                    for (int k = 0; k < in; ++k) sum = fma_(rows[row][k], weights[k * many + neuron], sum);
                    next[row][neuron] = layer < HIDDEN && (row == 0 ? sum : next[0][neuron]) <= 0.0f ? 0.0f : sum;
                }
            }
            for (int row = 0; row < ROWS; ++row)
                for (int neuron = 0; neuron < many; ++neuron) rows[row][neuron] = next[row][neuron];
        }
#if RW_FLOW_MAP
        float tangents[OUTPUTS][SPACE];
        for (int output = 0; output < OUTPUTS; ++output)
            for (int along = 0; along < SPACE; ++along) tangents[output][along] = rows[1 + along][output];
        out[i] = read_tangents(*reading, tangents);
#else
        out[i] = read_output(*reading, rows[0][0], unit);
#endif
    }
}
