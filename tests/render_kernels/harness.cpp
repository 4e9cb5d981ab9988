// The rendering kernels' numerics as host C++: reads one request from standard input, writes the answer to standard output.
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "gate.cuh"
#include "wavefront.cuh"

using namespace rw;

template <class T> std::vector<T> take(size_t count) {
    std::vector<T> values(count);
    if (count && fread(values.data(), sizeof(T), count, stdin) != count) exit(3);
    return values;
}
template <class T> T take_one() { return take<T>(1)[0]; }
template <class T> void give(const std::vector<T>& values) { fwrite(values.data(), sizeof(T), values.size(), stdout); }
template <class T> void give_one(const T& value) { fwrite(&value, sizeof(T), 1, stdout); }

// The field of `Waves` in the test, evaluated in f32 with the same operations.
static Answer waves(const float* p) {
    const float value = sinf(7.0f * p[0] + 3.0f * p[2]) * cosf(9.0f * p[1]);
    return {p[0] > 1.8f && p[1] < 0.3f ? NAN : value, p[1] > 0.5f};
}

static void frame() {
    const FrameScene scene = take_one<FrameScene>();
    const size_t cells = size_t(scene.box.cells[0]) * scene.box.cells[1] * scene.box.cells[2];
    const auto majorants = take<float>(cells);
    const auto may_miss = take<unsigned char>(cells);
    const Band band = take_one<Band>();
    const uint32_t ahead_camera = take_one<uint32_t>(), ahead_shadow = take_one<uint32_t>();

    const MajorantGrid grid = {majorants.data(), may_miss.data()};
    std::vector<uint32_t> count(cells), highest(cells), missing(cells);
    const Watch watch = {count.data(), highest.data(), missing.data()};
    const uint32_t slot_count = band.pixels * band.parts;
    std::vector<Four> place(slot_count), way(slot_count), colour(slot_count);
    std::vector<Words4> progress(slot_count);
    std::vector<Two> seen(slot_count);
    std::vector<uint32_t> first(slot_count);
    // Poisoned, so that what is read before it is written shows.
    std::vector<double> sums(size_t(slot_count) * PIXEL_SUM_FIELDS, NAN);
    const Slots slots = {place.data(), way.data(), colour.data(), progress.data(), seen.data(), first.data(), sums.data(), slot_count, 0};

    const size_t capacity = size_t(slot_count) * (ahead_camera > ahead_shadow ? ahead_camera : ahead_shadow);
    std::vector<float> points(3 * capacity), log_stretch(capacity);
    std::vector<unsigned char> traced(capacity);
    std::vector<Four> hits[2] = {std::vector<Four>(capacity), std::vector<Four>(capacity)};
    std::vector<uint32_t> live(slot_count), next;
    for (uint32_t i = 0; i < slot_count; ++i) live[i] = i;
    Counts counts = {};
    for (uint32_t wave = 0; !live.empty(); ++wave) {
        uint32_t length = 0;
        const Queue queue = {points.data(), hits[wave % 2].data(), &length, hits[1 - wave % 2].data(), log_stretch.data(), traced.data()};
        next.clear();
        // Backwards every other wave: the order in which slots come must not matter.
        for (size_t i = 0; i < live.size(); ++i) {
            const uint32_t slot = live[wave % 2 ? live.size() - 1 - i : i];
            if (advance(scene, grid, watch, band, slots, queue, slot, wave == 0, ahead_camera, ahead_shadow, counts)) next.push_back(slot);
        }
        for (uint32_t i = 0; i < length; ++i) {
            const Answer answer = waves(&points[3 * i]);
            log_stretch[i] = answer.log_stretch;
            traced[i] = answer.traced;
        }
        live.swap(next);
    }
    std::vector<PixelValue> film(band.pixels);
    for (uint32_t p = 0; p < band.pixels; ++p) film[p] = finished(band, slots, p);
    give_one(counts);
    give(film);
    give(count);
    give(highest);
    give(missing);
}

int main(int, char** arguments) {
    const std::string request = arguments[1];
    if (request == "words") {
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) {
            const auto c = take<uint32_t>(6);
            const FrameRandom random = {{c[0], c[1]}, c[2], 0};
            give_one(words(random, c[3], c[4], c[5]));
        }
    } else if (request == "scene") {
        // Rays, the light, and the transfer function of a scene, at random places.
        const FrameScene scene = take_one<FrameScene>();
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) {
            const auto x = take<double>(2);
            double origin[3], direction[3];
            camera_ray(scene.camera, x[0], x[1], origin, direction);
            for (double v : origin) give_one(v);
            for (double v : direction) give_one(v);
            const float ftle = take_one<float>();
            float colour[3];
            albedo(scene.transfer, ftle, colour);
            give_one(ramp(scene.transfer, ftle));
            give_one(extinction(scene.transfer, ftle));
            for (float v : colour) give_one(v);
        }
    } else if (request == "gate") {
        Gate gate = {};
        const auto shape = take<int>(3);
        for (int k = 0; k < 3; ++k) gate.shape[k] = shape[k];
        const auto trusted = take<unsigned char>(size_t(shape[0]) * shape[1] * shape[2]);
        gate.trusted = trusted.data();
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) give_one<unsigned char>(trusts(gate, take<float>(3).data()));
    } else if (request == "table") {
        Table table = {};
        const auto nodes = take<int>(3);
        for (int k = 0; k < 3; ++k) table.nodes[k] = nodes[k];
        table.dimensions = take_one<int>();
        const auto values = take<float>(size_t(nodes[0]) * nodes[1] * nodes[2]);
        table.values = values.data();
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) give_one(look_up(table, take<float>(3).data()));
    } else if (request == "frame") {
        frame();
    } else {
        return 2;
    }
    return 0;
}
