// The marching and combining kernels as host C++. Reads the input of one request from standard input and writes its results to standard output.
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "rendering/regression.cuh"

using namespace rw;

template <class T> std::vector<T> take(size_t count) {
    std::vector<T> values(count);
    if (count && fread(values.data(), sizeof(T), count, stdin) != count) exit(3);
    return values;
}
template <class T> T take_one() { return take<T>(1)[0]; }
template <class T> void give(const std::vector<T>& values) { fwrite(values.data(), sizeof(T), values.size(), stdout); }

// Missing cells from the input, with their memory. None if there are 0 dimensions.
struct TakenCells {
    std::vector<double> nodes[3];
    std::vector<unsigned char> missing;
    MissingCells cells = {};
    TakenCells() {
        cells.dimensions = take_one<int>();
        size_t count = cells.dimensions ? 1 : 0;
        for (int k = 0; k < cells.dimensions; ++k) {
            cells.axes[k].count = take_one<int>();
            nodes[k] = take<double>(cells.axes[k].count);
            cells.axes[k].nodes = nodes[k].data();
            cells.cells[k] = cells.axes[k].count - 1;
            count *= cells.cells[k];
        }
        missing = take<unsigned char>(count);
        cells.missing = count ? missing.data() : nullptr;
    }
};

// Nodes from the input, with their memory.
struct TakenNodes {
    Table table = {};
    std::vector<float> values;
    TakenNodes() {
        for (int& n : table.nodes) n = take_one<int>();
        table.dimensions = take_one<int>();
        values = take<float>(size_t(table.nodes[0]) * table.nodes[1] * table.nodes[2]);
        table.values = values.data();
    }
};

// Scene, nodes, missing cells and the layout of the light volume, as the host gives them; bricks and light volume as the kernels fill them.
struct Marched {
    FrameScene scene = take_one<FrameScene>();
    TakenNodes nodes;
    TakenCells cells;
    std::vector<float> highest, depth;
    March march = {};
    Marched() {
        const Table& table = march.nodes = nodes.table;
        march.missing_cells = cells.cells;
        size_t bricks = 1;
        for (int k = 0; k < 3; ++k) {
            march.bricks.count[k] = max_((table.nodes[k] + BRICK - 2) / BRICK, 1);
            bricks *= march.bricks.count[k];
        }
        highest.resize(bricks);
        for (uint32_t brick = 0; brick < bricks; ++brick) {
            highest[brick] = -INFINITY;
            for (int lane = 0; lane < 32; ++lane) highest[brick] = fmaxf(highest[brick], highest_node(table, march.bricks, brick, lane, 32));
        }
        march.bricks.highest = highest.data();
        march.bricks.usable = march.missing_cells.missing == nullptr;
        LightVolume& light = march.light;
        light = take_one<LightVolume>();
        // NaN shows values that no column stores.
        depth.assign(size_t(light.width[0]) * light.width[1] * light.nodes[light.axes[0]], NAN);
        light.depth = depth.data();
        if (scene.light.is_point) {
            for (uint32_t i = 0; i < depth.size(); ++i) fill_node(scene, march, i);
        } else {
            for (int w = 0; w < light.columns[1]; ++w) {
                for (int v = 0; v < light.columns[0]; ++v) fill_column(scene, march, light.first[0] + v, light.first[1] + w);
            }
        }
    }
};

int main(int, char** arguments) {
    const std::string request = arguments[1];
    if (request == "march") {
        // Rays in two passes, with the depths of the light volume first.
        Marched marched;
        give(marched.highest);
        give(marched.depth);
        March& march = marched.march;
        march.step = take_one<float>();
        march.shifted = take_one<int>();
        const size_t pixels = size_t(marched.scene.width) * marched.scene.height;
        std::vector<double> sums(RAY_FIELDS * pixels, NAN);
        for (int pass = 0; pass < 2; ++pass) {
            march.first_ray = march.rays;
            march.rays = take_one<uint32_t>();
            for (uint32_t pixel = 0; pixel < pixels; ++pixel) add_rays(march_rays(marched.scene, march, pixel, 0, 1), pixels, pixel, sums.data(), pass == 0);
        }
        // As mend_pixels does.
        std::vector<float> memory(MEND_MEMORY, NAN);
        for (uint32_t pixel = 0; march.shifted && pixel < pixels; ++pixel) {
            for (uint32_t ray = 0; ray < march.first_ray + march.rays; ++ray) {
                mend_ray(Block{}, marched.scene, march, pixel, ray, march.step, memory.data());
                for (int k = 0; k < 3; ++k) sums[k * pixels + pixel] += double(memory[MEND_MEMORY - 3 + k]);
            }
        }
        give(sums);
    } else if (request == "depths") {
        // Depths to the light at unit points: from the table, and marched with a given step.
        Marched marched;
        const float step = take_one<float>();
        const uint32_t n = take_one<uint32_t>();
        std::vector<float> out;
        for (uint32_t i = 0; i < n; ++i) {
            const auto p = take<float>(3);
            const float unit_point[3] = {p[0], p[1], p[2]};
            float plane, column[2], grid[3];
            light_place(marched.march.light, unit_point, plane, column);
            out.push_back(light_depth(marched.march.light, plane, column));
            for (int k = 0; k < 3; ++k) grid[k] = p[k] * float(marched.scene.box.cells[k]);
            out.push_back(depth_to_light(marched.scene, marched.march, grid, step));
        }
        give(out);
    } else if (request == "checks") {
        Marched marched;
        marched.march.shifted = take_one<int>();
        const int n = take_one<int>();
        std::vector<float> found(4 * n, NAN), memory(CHECK_MEMORY, NAN);
        for (int i = 0; i < n; ++i) {
            const auto which = take<uint32_t>(2);
            const auto steps = take<float>(2);
            check_ray(Block{}, marched.scene, marched.march, which[0], which[1], steps[0], steps[1], NO_DRAW, &found[4 * i], memory.data());
        }
        give(found);
    } else if (request == "combine") {
        Combine c = {};
        c.width = take_one<int>();
        c.height = take_one<int>();
        c.how = take_one<int>();
        const auto tone = take<float>(3);
        c.contrast = tone[0], c.brightness = tone[1], c.gamma = tone[2];
        c.lit = take_one<float>();
        c.per_ray = take_one<double>();
        const float marched = take_one<float>();
        const int width = c.width, height = c.height;
        const size_t pixels = size_t(width) * height;
        const auto sums = take<float>(15 * pixels);
        const auto base = take<double>(RAY_FIELDS * pixels);
        const int across = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE;
        const auto errors = take<float>(2 * size_t(across) * down);
        std::vector<float> coarse(8 * pixels), rows(8 * pixels), mean(3 * pixels), energy(2 * pixels), boxed(2 * pixels), halves(6 * pixels, NAN);
        std::vector<float> row_memory(BOX_ROW_MEMORY), column_memory(BOX_COLUMN_MEMORY), tile_memory(TILE_MEMORY);
        const Level level = {mean.data(), energy.data(), width, height};
        const Block block;
        const auto box_rows = [&](const float* from, int radius) {
            for (int plane = 0; plane < 2; ++plane) {
                for (int y = 0; y < height; ++y) {
                    for (int x = 0; x < width; x += BOX_ROW) {
                        box_row(block, from + plane * pixels, boxed.data() + plane * pixels, width, x, y, radius, row_memory.data());
                    }
                }
            }
        };
        const int blocks = 3;
        std::vector<float> guides(GUIDES * pixels, NAN), around(GUIDES * pixels, NAN), scratch(GUIDES * pixels, NAN), strip(STRIP_MEMORY, NAN);
        std::vector<double> partial(NORMAL_SUMS * blocks, NAN), coefficients(2 * FEATURES, NAN), normal(SOLVE_MEMORY, NAN);
        const Regression regression = {sums.data(),    base.data(),         guides.data(), around.data(), scratch.data(),
                                       partial.data(), coefficients.data(), c.per_ray,     width,         height,         blocks, 0};
        for (size_t at = 0; at < pixels; ++at) put_guides(regression, at);
        for (int spacing = 1; spacing < 3; ++spacing) {
            const float* from = spacing == 1 ? guides.data() : scratch.data();
            for (int y = 0; y < height; ++y) {
                for (int x = 0; x < width; ++x) filter_guides(from, spacing == 1 ? scratch.data() : around.data(), width, height, x, y, spacing);
            }
        }
        for (int number = 0; number < blocks; ++number) sum_normal(block, regression, number, strip.data());
        solve_normal(block, regression, normal.data());
        std::vector<float> rest(6 * pixels, NAN);
        for (int half = 0; half < 2; ++half) {
            for (size_t at = 0; at < pixels; ++at) put_rest(regression, half, at, rest.data(), halves.data() + 3 * half * pixels);
            Quarters fine = {}, filtered = {};
            for (int q = 0; q < 2; ++q) {
                for (int k = 0; k < 4; ++k) {
                    fine.planes[q][k] = k == 3 ? sums.data() + (PAIR_COUNTS + q) * pixels : rest.data() + (3 * q + k) * pixels;
                    filtered.planes[q][k] = coarse.data() + (4 * q + k) * pixels;
                }
            }
            for (int number = 0; number <= 5; ++number) {
                const int spacing = 1 << number, radius = 32;
                if (number == 5) {
                    for (size_t at = 0; at < pixels; ++at) last_level(fine, level, int(at));
                } else {
                    for (int y = 0; y < height; ++y) {
                        for (int x = 0; x < width; ++x) {
                            for (int k = 0; k < 8; ++k) {
                                rows[k * pixels + y * width + x] = b3(fine.planes[k / 4][k % 4] + y * width, taps(x, width, spacing, 1));
                            }
                        }
                    }
                    for (int y = 0; y < height; ++y) {
                        for (int x = 0; x < width; ++x) split_level(fine, rows.data(), coarse.data(), level, x, y, spacing);
                    }
                }
                box_rows(energy.data(), radius);
                for (int y = 0; y < height; y += BOX_COLUMN) {
                    for (int x = 0; x < width; x += BOX_LINES) {
                        add_level(block, level, boxed.data(), x, y, radius, halves.data() + 3 * half * pixels, column_memory.data());
                    }
                }
                fine = filtered;
            }
        }
        std::vector<float> film(9 * pixels, NAN), tiles(size_t(across) * down * TILE_FIELDS, NAN);
        c.sums = sums.data(), c.base = base.data(), c.halves = halves.data();
        c.film = film.data(), c.errors = errors.data(), c.tiles = tiles.data();
        for (int row = 0; row < down; ++row) {
            for (int column = 0; column < across; ++column) finish_tile(block, c, column, row, tile_memory.data());
        }
        for (int y = 0; y < height; ++y) {
            for (int x = 0; x < width; ++x) finish_error(c, x, y, marched);
        }
        give(film);
        give(tiles);
        give(halves);
    } else {
        return 2;
    }
    return 0;
}
