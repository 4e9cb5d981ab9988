// The rendering kernels' numerics as host C++. Reads the input of one request from standard input and writes its results to standard output.
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "rendering/answer.cuh"
#include "rendering/audit.cuh"
#include "rendering/wavefront.cuh"
#include "tracing/table.cuh"

using namespace rw;

template <class T> std::vector<T> take(size_t count) {
    std::vector<T> values(count);
    if (count && fread(values.data(), sizeof(T), count, stdin) != count) exit(3);
    return values;
}
template <class T> T take_one() { return take<T>(1)[0]; }
template <class T> void give(const std::vector<T>& values) { fwrite(values.data(), sizeof(T), values.size(), stdout); }
template <class T> void give_one(const T& value) { fwrite(&value, sizeof(T), 1, stdout); }

// The field `Waves` of the test, evaluated in f32 with the same operations.
static Answer waves(const float* p) {
    const float value = sinf(7.0f * p[0] + 3.0f * p[2]) * cosf(9.0f * p[1]);
    return {p[0] > 1.8f && p[1] < 0.3f ? NAN : value, (unsigned char)(p[1] > 0.5f ? TRACED : PREDICTED)};
}

// A table from the input, with its memory.
struct TakenTable {
    std::vector<float> values;
    Table table = {};
    TakenTable() {
        for (int& n : table.nodes) n = take_one<int>();
        table.dimensions = take_one<int>();
        values = take<float>(size_t(table.nodes[0]) * table.nodes[1] * table.nodes[2]);
        table.values = values.data();
    }
};

// Gate, missing cells and table from the input, with their memory.
struct AnswerSetup {
    std::vector<unsigned char> trusted, missing;
    std::vector<double> nodes[3];
    Choice choice = {};
    TakenTable table;

    static Choice take_choice(AnswerSetup& setup) {
        Choice choice = {};
        choice.domain = take_one<UnitBox>();
        choice.budget_spent = take_one<int>();
        for (int& n : choice.gate.shape) n = take_one<int>();
        setup.trusted = take<unsigned char>(size_t(choice.gate.shape[0]) * choice.gate.shape[1] * choice.gate.shape[2]);
        choice.gate.trusted = setup.trusted.empty() ? nullptr : setup.trusted.data();
        choice.missing_cells.dimensions = take_one<int>();
        size_t cells = choice.missing_cells.dimensions ? 1 : 0;
        for (int k = 0; k < choice.missing_cells.dimensions; ++k) {
            MissingCellsAxis& axis = choice.missing_cells.axes[k];
            axis.period = take_one<double>();
            axis.count = take_one<int>();
            setup.nodes[k] = take<double>(axis.count);
            axis.nodes = setup.nodes[k].data();
            choice.missing_cells.cells[k] = axis.period != 0.0 ? axis.count : axis.count - 1;
            cells *= choice.missing_cells.cells[k];
        }
        setup.missing = take<unsigned char>(cells);
        choice.missing_cells.missing = cells ? setup.missing.data() : nullptr;
        return choice;
    }
    AnswerSetup() : choice(take_choice(*this)), table() {}

    // As answer_split and answer_join do; traced points have the value of `waves`.
    Answer answer(const float* p) const {
        float unit_point[3];
        const Answerer who = choose(choice, p, unit_point);
        if (who == NOBODY) return {NAN, PREDICTED};
        if (who == RUNGE_KUTTA) return {sinf(7.0f * p[0] + 3.0f * p[2]) * cosf(9.0f * p[1]), TRACED};
        return {look_up(table.table, unit_point), (unsigned char)(who == SURROGATE ? PREDICTED : OVER_BUDGET)};
    }
};

template <class Answers> static void frame(const Answers& answers) {
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
    std::vector<Float4> place(slot_count), way(slot_count), colour(slot_count);
    std::vector<Uint4> progress(slot_count);
    std::vector<Float2> seen(slot_count);
    std::vector<uint32_t> first(slot_count);
    // NaN shows reads before the first write.
    std::vector<double> sums(size_t(slot_count) * PIXEL_SUM_FIELDS, NAN);
    const Slots slots = {place.data(), way.data(), colour.data(), progress.data(), seen.data(), first.data(), sums.data(), slot_count, 0};

    const size_t capacity = size_t(slot_count) * (ahead_camera > ahead_shadow ? ahead_camera : ahead_shadow);
    std::vector<float> points(3 * capacity), log_stretch(capacity);
    std::vector<unsigned char> by(capacity);
    std::vector<Float4> hits[2] = {std::vector<Float4>(capacity), std::vector<Float4>(capacity)};
    std::vector<uint32_t> live(slot_count), next;
    for (uint32_t i = 0; i < slot_count; ++i) live[i] = i;
    Counts counts = {};
    for (uint32_t wave = 0; !live.empty(); ++wave) {
        uint32_t length = 0;
        const Queue queue = {points.data(), hits[wave % 2].data(), &length, hits[1 - wave % 2].data(), log_stretch.data(), by.data()};
        next.clear();
        // Every other wave is in reverse order: the order of slots must not matter.
        for (size_t i = 0; i < live.size(); ++i) {
            const uint32_t slot = live[wave % 2 ? live.size() - 1 - i : i];
            if (advance(scene, grid, watch, band, slots, queue, slot, wave == 0, ahead_camera, ahead_shadow, counts)) next.push_back(slot);
        }
        for (uint32_t i = 0; i < length; ++i) {
            const Answer answer = answers(&points[3 * i]);
            log_stretch[i] = answer.log_stretch;
            by[i] = answer.by;
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

#include "coupled.hpp"

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
        // Rays and the transfer function of a scene at random points.
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
        const TakenTable taken;
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) {
            const auto p = take<float>(3);
            give_one(look_up(taken.table, {p[0], p[1], p[2]}));
        }
    } else if (request == "labels") {
        const uint32_t shift = take_one<uint32_t>(), n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) give_one<unsigned char>(keeps_label(take<float>(3).data(), shift));
    } else if (request == "audit") {
        // Points of every cell, and sums of given residuals.
        const AuditCells cells = take_one<AuditCells>();
        const auto ramp = take<float>(3);
        const uint32_t n = uint32_t(cells.shape[0] * cells.shape[1] * cells.shape[2]);
        uint32_t number = 0;
        for (uint32_t cell = 0; cell < n; ++cell) {
            const uint32_t drawn = take_one<uint32_t>();
            CellFindings sums = no_findings();
            std::vector<float> optical;
            for (uint32_t i = 0; i < drawn; ++i) {
                float point[3];
                audit_point(cells, cell, number++, point);
                for (float u : point) give_one(u);
                const auto x = take<float>(4);  // missing, lifetime_share, predicted, traced
                const bool missing = x[0] != 0.0f;
                const Residual found = missing ? Residual{not_a_number(), not_a_number()} : residual(ramp[0], ramp[1], ramp[2], x[2], x[3]);
                add_residual(sums, found);
                add_point(sums, missing, x[1], x[3]);
                optical.push_back(found.optical);
            }
            const double mean = sums.square / sums.count;
            for (float o : optical) add_deviation(sums, mean, o);
            give_one(sums);
        }
    } else if (request == "gated") {
        const AnswerSetup setup;
        frame([&](const float* p) { return setup.answer(p); });
    } else if (request == "choices") {
        // Answerer and prediction at each point.
        const AnswerSetup setup;
        const uint32_t n = take_one<uint32_t>();
        for (uint32_t i = 0; i < n; ++i) {
            const auto p = take<float>(3);
            float unit_point[3] = {0.0f, 0.0f, 0.0f};
            give_one<int>(choose(setup.choice, p.data(), unit_point));
            for (float u : unit_point) give_one(u);
            give_one(look_up(setup.table.table, unit_point));
        }
    } else if (request == "frame") {
        frame(waves);
    } else if (request == "coupled") {
        coupled_request();
    } else if (request == "listed") {
        listed_request();
    } else {
        return 2;
    }
    return 0;
}
