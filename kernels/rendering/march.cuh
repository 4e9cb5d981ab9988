// Marching through the nodes of a surrogate: the expected picture by quadrature along camera rays (emission and absorption, Max 1995), with the
// optical depth to the light from a table. Mirrors src/render/smooth/{march,light_volume,nodes}.rs.
#pragma once
#include "rendering/tracking.cuh"
#include "tracing/missing_cells.cuh"
#include "tracing/table.cuh"

// Kernels leave out what a scene does not need; 1: decided at run time.
#ifndef RW_HOLES
#define RW_HOLES 1  // cells may be missing
#endif
#ifndef RW_POINT_LIGHT
#define RW_POINT_LIGHT 1
#endif

namespace rw {

constexpr int BRICK = 8;                 // cells along the edge of a brick
constexpr float OPAQUE = 1e-4f;          // transmittance below which a ray ends
constexpr float MOST_POINTS = 65536.0f;  // of quadrature on a ray
constexpr uint32_t NET = 16;             // rays of a net of an audit
constexpr uint32_t FIRST_AUDIT_RAY = 0x80000000u;  // from here on rays are those of nets

// Threads of a block that work in phases on shared memory. As host C++ a phase is a loop.
struct Block {
    template <class F> RW_FN void each(int count, F f) const {
#if RW_DEVICE
        for (int i = int(threadIdx.x); i < count; i += int(blockDim.x)) f(i);
        __syncthreads();
#else
        for (int i = 0; i < count; ++i) f(i);
#endif
    }
};

// The largest node of each brick, faces included.
struct Bricks {
    const float* highest;  // x fastest
    int count[3];
    int usable;  // 0: cells may be missing, so that rays have to see every point
};
static_assert(sizeof(Bricks) == 24, "layout");

// Optical depth to the light. Planes lie across the axis `axes[0]` and are numbered away from the light. Columns cross them. For a directional
// light columns are light rays: they move by `shift` a plane, and each plane stores those columns that are in the box or within `margin` of it.
// For a point light columns are those of a plain grid.
struct LightVolume {
    float* depth;     // (plane * width[1] + c) * width[0] + b
    int nodes[3];     // of the grid along x, y, z, at least 2
    int axes[3];      // across the planes, and the two others
    int width[2];     // stored columns
    int margin;
    int reversed;     // 1: plane 0 is at the high end of its axis
    float shift[2];
    float last[2];    // largest column at which an interpolation may begin, below 2^22
    float step;       // directional: scene length from plane to plane; point: step of the quadrature
    int parts;        // directional: quadrature points from plane to plane
    int first[2];     // directional: first column that any plane stores, and their number
    int columns[2];
};
static_assert(sizeof(LightVolume) == 88, "layout");

struct March {
    Table nodes;
    MissingCells missing_cells;
    Bricks bricks;
    LightVolume light;
    float step;          // longest step, scene units
    uint32_t first_ray;  // rays of a pixel before this pass
    uint32_t rays;       // rays of a pixel in this pass
    int shifted;         // 1: a random shift for each pixel makes the places of rays and points unbiased; rays go on to their end
};
static_assert(sizeof(March) == 248, "layout");

// Sums over rays, in the order of the planes of the buffer.
struct RaySum {
    float radiance[3];
    float alpha;
    float ftle;  // sum of weight times FTLE
    float missing;
};
constexpr int RAY_FIELDS = 6;

// Largest whole number that is not above x, as a float and as an index, for |x| < 2^22. Conversions run at an eighth of the rate of additions.
RW_FN float floor_of(float x, int& index) {
#if RW_DEVICE
    const float shifted = __fadd_rd(x, 12582912.0f);  // 3 * 2^22, at which floats are 1 apart
    index = __float_as_int(shifted) - 0x4b400000;
    return shifted - 12582912.0f;
#else
    const float low = floor_(x);
    index = int(low);
    return low;
#endif
}

// As `look_up`, with 32-bit indices: tables have fewer than 2^32 nodes.
RW_FN float node_value(const Table& table, const float (&unit)[3]) {
    const uint32_t row = uint32_t(table.nodes[0]);
    float f[3];
    int cell[3];
    RW_UNROLL
    for (int k = 0; k < 3; ++k) {
        const int cells = table.nodes[k] - 1;
        const float position = min_(max_(unit[k], 0.0f), 1.0f) * float(cells);
        int low;
        f[k] = position - min_(floor_of(position, low), float(cells - 1));
        cell[k] = min_(low, cells - 1);
    }
    const bool flat = table.dimensions == 2;
    const uint32_t at = ((flat ? 0u : uint32_t(cell[2]) * uint32_t(table.nodes[1])) + uint32_t(cell[1])) * row + uint32_t(cell[0]);
    auto plane = [&](const float* near) {
        const float* far = near + row;
        const float a = load(near), b = load(near + 1), c = load(far), d = load(far + 1);
        const float low = fma_(b - a, f[0], a), high = fma_(d - c, f[0], c);
        return fma_(high - low, f[1], low);
    };
    const float* first = table.values + at;
    const float near = plane(first);
    if (flat) return near;
    return fma_(plane(first + size_t(row) * size_t(table.nodes[1])) - near, f[2], near);
}

RW_FN void unit_of_grid(const SceneBox& box, const float grid[3], float unit[3]) {
    for (int k = 0; k < 3; ++k) unit[k] = grid[k] / float(box.cells[k]);
}

// FTLE at a unit point. Returns false in missing cells.
RW_FN bool ftle_at(const FrameScene& scene, const March& march, const float (&unit)[3], float& ftle) {
    if (RW_HOLES && march.missing_cells.missing) {
        float grid[3], point[3];
        for (int k = 0; k < 3; ++k) grid[k] = unit[k] * float(scene.box.cells[k]);
        domain_point(scene.box, grid, point);
        if (is_missing(march.missing_cells, point)) return false;
    }
    ftle = node_value(march.nodes, unit) * scene.per_tau;
    return true;
}

// Extinction at a unit point, 0 in missing cells.
RW_FN float extinction_at(const FrameScene& scene, const March& march, const float (&unit)[3]) {
    float ftle;
    return ftle_at(scene, march, unit, ftle) ? extinction(scene.transfer, ftle) : 0.0f;
}

// Corner nodes of a brick: first, and one past the last.
RW_FN void brick_nodes(const Table& nodes, const Bricks& bricks, uint32_t brick, int (&from)[3], int (&to)[3]) {
    const uint32_t nx = uint32_t(bricks.count[0]), ny = uint32_t(bricks.count[1]);
    const uint32_t index[3] = {brick % nx, brick / nx % ny, brick / (nx * ny)};
    for (int k = 0; k < 3; ++k) {
        from[k] = int(index[k]) * BRICK;
        to[k] = min_(from[k] + BRICK + 1, nodes.nodes[k]);
    }
}

// Highest of every `stride`-th node of a brick, from the `first`-th on.
RW_FN float highest_node(const Table& nodes, const Bricks& bricks, uint32_t brick, int first, int stride) {
    int from[3], to[3];
    brick_nodes(nodes, bricks, brick, from, to);
    const int nx = to[0] - from[0], ny = to[1] - from[1], nz = to[2] - from[2];
    float highest = -infinity();
    for (int i = first; i < nx * ny * nz; i += stride) {
        const int x = from[0] + i % nx, y = from[1] + i / nx % ny, z = from[2] + i / (nx * ny);
        highest = max_(highest, load(nodes.values + (size_t(z) * nodes.nodes[1] + y) * nodes.nodes[0] + x));
    }
    return highest;
}

// A line in unit coordinates: start + t along. `inverse`: 1 / along.
struct UnitLine {
    float start[3];
    float along[3];
    float inverse[3];
};

// Returns true if the transfer function shows nothing of the brick around a unit point. `exit`: t at which the line leaves this brick.
RW_FN bool in_empty_brick(const FrameScene& scene, const March& march, const UnitLine& line, const float (&unit)[3], float& exit) {
    int index = 0, stride = 1;
    exit = infinity();
    RW_UNROLL
    for (int k = 0; k < 3; ++k) {
        const int cells = march.nodes.nodes[k] - 1;
        // A flow without z has one layer of bricks, and no walls across z.
        if (cells > 0) {
            int cell;
            floor_of(min_(max_(unit[k], 0.0f), 1.0f) * float(cells), cell);
            const int brick = int(uint32_t(min_(cell, cells - 1)) / uint32_t(BRICK));
            index += brick * stride;
            // The outermost bricks have no outer walls, so that rounding cannot leave the grid.
            const bool ahead = line.along[k] > 0.0f;
            const bool walled = line.along[k] != 0.0f && (ahead ? brick < march.bricks.count[k] - 1 : brick > 0);
            const float wall = float((brick + (ahead ? 1 : 0)) * BRICK) * (1.0f / float(cells));
            if (walled) exit = min_(exit, (wall - line.start[k]) * line.inverse[k]);
        }
        stride *= march.bricks.count[k];
    }
    return ramp(scene.transfer, load(march.bricks.highest + index) * scene.per_tau) <= 0.0f;
}

// Column offset of a plane: its stored columns begin at first column - margin - offset.
RW_FN int plane_offset(const LightVolume& volume, int side, float plane) {
    int offset;
    floor_of(plane * volume.shift[side], offset);
    return offset;
}

// Plane coordinate and columns along a line: values at t = 0 and their change with t.
struct LightLine {
    float plane[2];
    float column[2][2];
};

RW_FN float choose_axis(const float (&v)[3], int axis) { return axis == 0 ? v[0] : (axis == 1 ? v[1] : v[2]); }

RW_FN void light_place(const LightVolume& volume, const float (&unit)[3], float& plane, float (&column)[2]) {
    const int across = volume.axes[0];
    const float cells = float(volume.nodes[across] - 1), place = choose_axis(unit, across) * cells;
    plane = volume.reversed ? cells - place : place;
    RW_UNROLL
    for (int side = 0; side < 2; ++side) {
        const int k = volume.axes[1 + side];
        column[side] = choose_axis(unit, k) * float(volume.nodes[k] - 1) - plane * volume.shift[side];
    }
}

// The map to planes and columns is affine, so that a line maps to a line.
RW_FN LightLine light_line(const LightVolume& volume, const UnitLine& line) {
    LightLine out;
    const int across = volume.axes[0];
    const float cells = float(volume.nodes[across] - 1), turn = volume.reversed ? -1.0f : 1.0f;
    out.plane[0] = (volume.reversed ? cells : 0.0f) + turn * choose_axis(line.start, across) * cells;
    out.plane[1] = turn * choose_axis(line.along, across) * cells;
    RW_UNROLL
    for (int side = 0; side < 2; ++side) {
        const int k = volume.axes[1 + side];
        const float lateral = float(volume.nodes[k] - 1);
        out.column[side][0] = choose_axis(line.start, k) * lateral - out.plane[0] * volume.shift[side];
        out.column[side][1] = choose_axis(line.along, k) * lateral - out.plane[1] * volume.shift[side];
    }
    return out;
}

// Interpolated depth of the columns at a plane coordinate.
RW_FN float stored_depth(const LightVolume& volume, float plane, const float (&column)[2]) {
    const int planes = volume.nodes[volume.axes[0]];
    int near, first[2];
    float f[2];
    const float near_plane = max_(min_(floor_of(plane, near), float(planes - 2)), 0.0f);
    near = max_(min_(near, planes - 2), 0);
    RW_UNROLL
    for (int side = 0; side < 2; ++side) {
        // Rounding may put a column of a plain grid just outside.
        const float least = volume.margin ? -volume.last[side] : 0.0f, most = volume.last[side];
        const float low = floor_of(max_(min_(column[side], most), least), first[side]);
        first[side] += volume.margin;
        f[side] = column[side] - low;
    }
    auto at = [&](int i, float i_plane) {
        // The clamp guards against rounding at the outermost columns.
        const int b = max_(min_(first[0] + plane_offset(volume, 0, i_plane), volume.width[0] - 2), 0);
        const int c = max_(min_(first[1] + plane_offset(volume, 1, i_plane), volume.width[1] - 2), 0);
        const uint32_t start = (uint32_t(i) * uint32_t(volume.width[1]) + uint32_t(c)) * uint32_t(volume.width[0]) + uint32_t(b);
        const float *low = volume.depth + start, *high = low + volume.width[0];
        const float p = load(low), q = load(low + 1), r = load(high), s = load(high + 1);
        const float one = fma_(q - p, f[0], p), two = fma_(s - r, f[0], r);
        return fma_(two - one, f[1], one);
    };
    const float nearer = at(near, near_plane);
    return fma_(at(near + 1, near_plane + 1.0f) - nearer, plane - near_plane, nearer);
}

// Plane coordinate where the light of a column came in through a side wall; 0 or less if it came in through the first plane.
RW_FN float light_entry(const LightVolume& volume, const float (&column)[2]) {
    float entry = 0.0f;
    RW_UNROLL
    for (int side = 0; side < 2; ++side) {
        const float shift = volume.shift[side], wall = shift < 0.0f ? float(volume.nodes[volume.axes[1 + side]] - 1) : 0.0f;
        if (shift != 0.0f) entry = max_(entry, (wall - column[side]) / shift);
    }
    return entry;
}

// Optical depth to the light at a plane coordinate and columns.
RW_FN float light_depth(const LightVolume& volume, float plane, const float (&column)[2]) {
    const float depth = stored_depth(volume, plane, column), entry = min_(light_entry(volume, column), plane);
    return entry > 0.0f ? depth - stored_depth(volume, entry, column) : depth;
}

// Sums the depth along column (v, w) of a directional light and stores it plane by plane. The extinction is continued into the margin around the box,
// so that neighbouring columns agree at its walls.
RW_FN void fill_column(const FrameScene& scene, const March& march, int v, int w) {
    const LightVolume& volume = march.light;
    const int column[2] = {v, w}, planes = volume.nodes[volume.axes[0]];
    const float last = float(planes - 1), part = volume.step / float(volume.parts);
    const float per_plane = 1.0f / last, per_part = 1.0f / float(volume.parts);
    float cells_of[2], per_cell[2];
    // Planes between which the column may be near the box, with a plane to spare for rounding.
    float enter = 0.0f, leave = last;
    RW_UNROLL
    for (int side = 0; side < 2; ++side) {
        const float shift = volume.shift[side], cells = float(volume.nodes[volume.axes[1 + side]] - 1), begin = float(column[side]);
        cells_of[side] = cells;
        per_cell[side] = 1.0f / cells;
        const float margin = float(volume.margin), to_low = (-margin - begin) / shift, to_high = (cells + margin - begin) / shift;
        if (shift == 0.0f) leave = begin < -margin || begin > cells + margin ? -1.0f : leave;
        else enter = max_(enter, min_(to_low, to_high) - 1.0f), leave = min_(leave, max_(to_low, to_high) + 1.0f);
    }
    float depth = 0.0f;
    for (int plane = 0; plane < planes; ++plane) {
        if (plane > 0 && float(plane) >= enter && float(plane - 1) <= leave) {
            for (int m = 0; m < volume.parts; ++m) {
                const float x = float(plane - 1) + (float(m) + 0.5f) * per_part;
                const float across = (volume.reversed ? last - x : x) * per_plane;
                float lateral[2];
                bool near = true;
                RW_UNROLL
                for (int side = 0; side < 2; ++side) {
                    const float place = float(column[side]) + x * volume.shift[side];
                    near = near && place >= -float(volume.margin) && place <= cells_of[side] + float(volume.margin);
                    lateral[side] = min_(max_(place * per_cell[side], 0.0f), 1.0f);
                }
                if (!near) continue;
                float unit[3];
                RW_UNROLL
                for (int k = 0; k < 3; ++k) unit[k] = k == volume.axes[0] ? across : (k == volume.axes[1] ? lateral[0] : lateral[1]);
                depth += extinction_at(scene, march, unit) * part;
            }
        }
        const int b = v + volume.margin + plane_offset(volume, 0, float(plane)), c = w + volume.margin + plane_offset(volume, 1, float(plane));
        if (b >= 0 && b < volume.width[0] && c >= 0 && c < volume.width[1]) {
            volume.depth[(size_t(plane) * volume.width[1] + c) * volume.width[0] + b] = depth;
        }
    }
}

// Quadrature from a point (grid coordinates) to the light, by the midpoint rule.
struct ShadowRay {
    float point[3], direction[3];  // grid coordinates
    float part;                    // distance between its points, scene units
    int count;
};

RW_FN ShadowRay shadow_ray(const FrameScene& scene, const float (&point)[3], float step) {
    double from[3], toward[3], distance;
    float radiance[3];
    ShadowRay ray;
    scene_point(scene.box, point, from);
    light_seen_from(scene.light, from, toward, distance, radiance);
    grid_direction(scene.box, toward, ray.direction);
    for (int k = 0; k < 3; ++k) ray.point[k] = point[k];
    const float length = min_(exit_length(scene.box, point, ray.direction), float(distance));
    const float count = min_(max_(ceilf(length / step), 1.0f), MOST_POINTS);
    ray.part = length / count;
    ray.count = int(count);
    return ray;
}

// Sum of the extinction at every `stride`-th point, from the `first`-th on.
RW_FN float extinction_along(const FrameScene& scene, const March& march, const ShadowRay& ray, int first, int stride) {
    float sum = 0.0f, at[3], unit[3];
    for (int i = first; i < ray.count; i += stride) {
        for (int k = 0; k < 3; ++k) at[k] = ray.point[k] + (float(i) + 0.5f) * ray.part * ray.direction[k];
        unit_of_grid(scene.box, at, unit);
        sum += extinction_at(scene, march, unit);
    }
    return sum;
}

// Optical depth from a point (grid coordinates) to the light.
RW_FN float depth_to_light(const FrameScene& scene, const March& march, const float (&point)[3], float step) {
    const ShadowRay ray = shadow_ray(scene, point, step);
    return extinction_along(scene, march, ray, 0, 1) * ray.part;
}

// The depth at node `index` of a point light's grid.
RW_FN void fill_node(const FrameScene& scene, const March& march, uint32_t index) {
    const LightVolume& volume = march.light;
    const uint32_t nx = uint32_t(volume.nodes[0]), ny = uint32_t(volume.nodes[1]);
    const uint32_t node[3] = {index % nx, index / nx % ny, index / (nx * ny)};
    float point[3];
    for (int k = 0; k < 3; ++k) point[k] = float(node[k]) / float(volume.nodes[k] - 1) * float(scene.box.cells[k]);
    volume.depth[index] = depth_to_light(scene, march, point, volume.step);
}

// Offset of a ray across (axis 0) or down (1) its pixel: in fours, a point and its quarter turns around the centre. The first point is that of Gauss's
// rule, the others are those of an additive recurrence in two dimensions. A net of an audit has four points, one in each
// quarter of the rows and of the columns, shifted by `random`, and each is turned four times.
RW_FN float ray_offset(uint32_t ray, int axis, const float random[2]) {
    const double gauss = 0.2886751345948129, sqrt_2 = 1.4142135623730951, sqrt_3 = 1.7320508075688772;
    const uint32_t number = ray / 4;
    const bool turned = ray / 2 % 2 == 1;
    // A turn makes -y of x and x of y.
    const bool along_x = (axis == 0) != turned;
    double point = -gauss;
    if (ray >= FIRST_AUDIT_RAY) {
        const uint32_t column = number % (NET / 4);
        const double x = 0.25 * double(along_x ? column : column % 2 * 2 + column / 2) + double(random[along_x ? 0 : 1]);
        point = x - floor_(x) - 0.5;
    } else if (number > 0) {
        const double x = along_x ? 0.57 + double(number - 1) * sqrt_2 : 0.81 + double(number - 1) * sqrt_3;
        point = x - floor_(x) - 0.5;
    }
    if (turned && axis == 0) point = -point;
    return float(ray % 2 == 0 ? 0.5 + point : 0.5 - point);
}

// Colour of the light at a quadrature point, given the weight of the point times the transmittance to the light.
RW_FN void add_light(const FrameScene& scene, float ftle, const float radiance[3], float scattered, RaySum& sum) {
    float colour[3];
    albedo(scene.transfer, ftle, colour);
    for (int k = 0; k < 3; ++k) sum.radiance[k] += scattered * colour[k] * radiance[k];
}

// A camera ray and its quadrature points, at (i + offset) * step.
struct Ray {
    float origin[3], direction[3];  // grid coordinates
    UnitLine line;
    float step, per_step, offset;
    int points;
};

// Ray `number` of a pixel, with steps of at most `longest` scene units. Returns false if it misses the box.
RW_FN bool begin_ray(const FrameScene& scene, bool shifted, uint32_t pixel, uint32_t number, float longest, Ray& ray) {
    const bool of_audit = number >= FIRST_AUDIT_RAY;
    float drawn[3] = {0.0f, 0.0f, 0.0f};
    if (shifted || of_audit) {
        // No path draws in this dimension.
        const Words random = words(scene.random, pixel, of_audit ? number - number % NET : number, 0xFFFFFFFEu);
        for (int k = 0; k < 3; ++k) drawn[k] = unit(random.w[k]);
    }
    // Quadrature points are in the middle of their steps.
    float offset[3] = {ray_offset(number, 0, drawn), ray_offset(number, 1, drawn), 0.5f};
    for (int k = of_audit ? 2 : 0; shifted && k < 3; ++k) {
        const float moved = offset[k] + drawn[k];
        offset[k] = moved - floor_(moved);
    }
    const uint32_t column = pixel % scene.width, row = pixel / scene.width;
    const double x = ((double)column + (double)offset[0]) / (double)scene.width * 2.0 - 1.0;
    const double y = 1.0 - ((double)row + (double)offset[1]) / (double)scene.height * 2.0;
    double eye[3], toward[3], enter, leave, entry[3];
    camera_ray(scene.camera, x, y, eye, toward);
    if (!intersect(scene.box, eye, toward, enter, leave)) return false;
    for (int k = 0; k < 3; ++k) entry[k] = eye[k] + enter * toward[k];
    grid_point(scene.box, entry, ray.origin);
    grid_direction(scene.box, toward, ray.direction);
    unit_of_grid(scene.box, ray.origin, ray.line.start);
    unit_of_grid(scene.box, ray.direction, ray.line.along);
    for (int k = 0; k < 3; ++k) ray.line.inverse[k] = 1.0f / ray.line.along[k];
    const float length = float(leave - enter), count = min_(max_(ceilf(length / longest), 1.0f), MOST_POINTS);
    ray.step = length / count;
    ray.per_step = 1.0f / ray.step;
    ray.points = int(count);
    ray.offset = offset[2];
    return true;
}

// Unattenuated radiance at distance `t` along a ray.
RW_FN void light_along(const FrameScene& scene, const Ray& ray, float t, float radiance[3]) {
    if (!RW_POINT_LIGHT || !scene.light.is_point) {
        for (int k = 0; k < 3; ++k) radiance[k] = scene.light.radiance[k];
        return;
    }
    float grid[3];
    double from[3], unused[3], distance;
    for (int k = 0; k < 3; ++k) grid[k] = ray.origin[k] + t * ray.direction[k];
    scene_point(scene.box, grid, from);
    light_seen_from(scene.light, from, unused, distance, radiance);
}

constexpr float ISOTROPIC = 0.25f / 3.14159274f;

// What lies behind the marched points, of which `in_missing` of `passed` were in missing cells.
RW_FN void add_behind(const FrameScene& scene, float transmittance, int in_missing, int passed, RaySum& sum) {
    const float share = float(in_missing) / float(max_(passed, 1));
    sum.missing += transmittance * share;
    for (int k = 0; k < 3; ++k) sum.radiance[k] += transmittance * ((1.0f - share) * scene.background[k] + share * scene.missing[k]);
}

// Adds ray `number` of a pixel.
RW_FN void march_ray(const FrameScene& scene, const March& march, uint32_t pixel, uint32_t number, RaySum& sum) {
    Ray ray;
    if (!begin_ray(scene, march.shifted != 0, pixel, number, march.step, ray)) {
        for (int k = 0; k < 3; ++k) sum.radiance[k] += scene.background[k];
        return;
    }
    const LightLine lit = light_line(march.light, ray.line);
    float transmittance = 1.0f;
    int i = 0, in_missing = 0;
    const float opaque = march.shifted ? 0.0f : OPAQUE;
    while (i < ray.points && transmittance >= opaque) {
        // The points before `stop` share a brick. Neighbouring rays then look up bricks together.
        int stop = ray.points;
        if (march.bricks.usable) {
            const float t = (float(i) + ray.offset) * ray.step;
            float at[3], exit;
            for (int k = 0; k < 3; ++k) at[k] = ray.line.start[k] + t * ray.line.along[k];
            const bool empty = in_empty_brick(scene, march, ray.line, at, exit);
            stop = max_(i + 1, int(min_(max_(ceilf(exit * ray.per_step - ray.offset), 0.0f), float(ray.points))));
            if (empty) {
                i = stop;
                continue;
            }
        }
        for (; i < stop && transmittance >= opaque; ++i) {
            const float t = (float(i) + ray.offset) * ray.step;
            float at[3], ftle;
            for (int k = 0; k < 3; ++k) at[k] = ray.line.start[k] + t * ray.line.along[k];
            if (!ftle_at(scene, march, at, ftle)) {
                ++in_missing;
                continue;
            }
            const float sigma = extinction(scene.transfer, ftle);
            if (sigma <= 0.0f) continue;
            const float absorbed = 1.0f - expf(-sigma * ray.step), weight = transmittance * absorbed;
            const float columns[2] = {lit.column[0][0] + t * lit.column[0][1], lit.column[1][0] + t * lit.column[1][1]};
            const float depth = light_depth(march.light, lit.plane[0] + t * lit.plane[1], columns);
            float radiance[3];
            light_along(scene, ray, t, radiance);
            add_light(scene, ftle, radiance, weight * ISOTROPIC * expf(-depth), sum);
            sum.alpha += weight;
            sum.ftle += weight * ftle;
            transmittance *= 1.0f - absorbed;
        }
    }
    add_behind(scene, transmittance, in_missing, i, sum);
}

// A ray that is marched apart from the picture (see `check_ray`).
struct Check {
    uint32_t pixel;
    uint32_t ray;
    float step;
    float shadow_step;
};

constexpr int CHECK_POINTS = 1024;
constexpr int CHECK_MEMORY = 4 * CHECK_POINTS + 4;
constexpr float NO_DRAW = -1.0f;

// Radiance and opacity of one ray, with all threads of a block, as a check of the march: with steps of at most `step`, and the depth to the light
// marched with steps of `shadow_step`, or from the light volume if that is 0. With a `draw` in [0, 1) it is from the light volume, and what marching finds
// more is added at the point where the opacity in front passes `draw`, with the weight of a path that scatters there.
RW_FN void check_ray(const Block& block, const FrameScene& scene, const March& march, uint32_t pixel, uint32_t number, float step,
                     float shadow_step, float draw, float* found, float* memory) {
    float* absorbed = memory;                         // negative in missing cells
    float* scattered = memory + CHECK_POINTS;         // three planes
    float* state = memory + 4 * CHECK_POINTS;         // transmittance, missing points, points, the point that is drawn
    Ray ray;
    const bool hit = begin_ray(scene, march.shifted != 0, pixel, number, step, ray);
    block.each(1, [&](int) {
        state[0] = 1.0f, state[1] = state[2] = 0.0f, state[3] = NO_DRAW;
        for (int k = 0; k < 3; ++k) found[k] = hit ? 0.0f : scene.background[k];
        found[3] = 0.0f;
    });
    if (!hit) return;
    const float opaque = march.shifted ? 0.0f : OPAQUE;
    for (int first = 0; first < ray.points && state[0] >= opaque; first += CHECK_POINTS) {
        const int count = min_(ray.points - first, CHECK_POINTS);
        block.each(count, [&](int i) {
            const float t = (float(first + i) + ray.offset) * ray.step;
            float at[3], ftle;
            RaySum sum = {{0.0f, 0.0f, 0.0f}, 0.0f, 0.0f, 0.0f};
            for (int k = 0; k < 3; ++k) at[k] = ray.line.start[k] + t * ray.line.along[k];
            const bool known = ftle_at(scene, march, at, ftle);
            const float sigma = known ? extinction(scene.transfer, ftle) : 0.0f;
            absorbed[i] = known ? 1.0f - expf(-sigma * ray.step) : -1.0f;
            if (sigma > 0.0f) {
                float depth, plane, column[2], grid[3], arriving[3];
                if (shadow_step > 0.0f && draw == NO_DRAW) {
                    for (int k = 0; k < 3; ++k) grid[k] = ray.origin[k] + t * ray.direction[k];
                    depth = depth_to_light(scene, march, grid, shadow_step);
                } else {
                    light_place(march.light, at, plane, column);
                    depth = light_depth(march.light, plane, column);
                }
                light_along(scene, ray, t, arriving);
                add_light(scene, ftle, arriving, ISOTROPIC * expf(-depth), sum);
            }
            for (int k = 0; k < 3; ++k) scattered[k * CHECK_POINTS + i] = sum.radiance[k];
        });
        block.each(1, [&](int) {
            float transmittance = state[0];
            for (int i = 0; i < count && transmittance >= opaque; ++i) {
                state[2] += 1.0f;
                if (absorbed[i] < 0.0f) {
                    state[1] += 1.0f;
                    continue;
                }
                const float weight = transmittance * absorbed[i];
                if (found[3] <= draw && draw < found[3] + weight) state[3] = float(first + i);
                for (int k = 0; k < 3; ++k) found[k] += weight * scattered[k * CHECK_POINTS + i];
                found[3] += weight;
                transmittance *= 1.0f - absorbed[i];
            }
            state[0] = transmittance;
        });
    }
    if (state[3] >= 0.0f) {
        const float t = (state[3] + ray.offset) * ray.step;
        float at[3], grid[3];
        for (int k = 0; k < 3; ++k) at[k] = ray.line.start[k] + t * ray.line.along[k];
        for (int k = 0; k < 3; ++k) grid[k] = ray.origin[k] + t * ray.direction[k];
        const ShadowRay shadow = shadow_ray(scene, grid, shadow_step);
        const int parts = min_(shadow.count, CHECK_POINTS);
        block.each(parts, [&](int i) { absorbed[i] = extinction_along(scene, march, shadow, i, parts); });
        block.each(1, [&](int) {
            float depth = 0.0f, plane, column[2], ftle, arriving[3];
            if (!ftle_at(scene, march, at, ftle)) return;
            for (int i = 0; i < parts; ++i) depth += absorbed[i];
            light_place(march.light, at, plane, column);
            light_along(scene, ray, t, arriving);
            RaySum sum = {{found[0], found[1], found[2]}, 0.0f, 0.0f, 0.0f};
            add_light(scene, ftle, arriving, ISOTROPIC * (expf(-depth * shadow.part) - expf(-light_depth(march.light, plane, column))), sum);
            for (int k = 0; k < 3; ++k) found[k] = sum.radiance[k];
        });
    }
    block.each(1, [&](int) {
        RaySum sum = {{found[0], found[1], found[2]}, 0.0f, 0.0f, 0.0f};
        add_behind(scene, state[0], int(state[1]), int(state[2]), sum);
        for (int k = 0; k < 3; ++k) found[k] = sum.radiance[k];
    });
}

// The share of the rays whose steps are halved once, and that of those which are halved again; the largest number of halvings.
constexpr float HALVED = 0.25f, HALVED_AGAIN = 0.3535534f;
constexpr int MOST_HALVINGS = 8;
// Ray as it is, the same with finer steps, and their weighted differences, behind the memory of a check.
constexpr int MEND_MEMORY = CHECK_MEMORY + 11;

// Two random numbers of a ray: how often its steps are halved, and the opacity at which the light is checked. No path draws in this dimension.
RW_FN void mend_draws(const FrameScene& scene, uint32_t pixel, uint32_t number, float (&drawn)[2]) {
    const Words random = words(scene.random, pixel, number, 0xFFFFFFFCu);
    for (int k = 0; k < 2; ++k) drawn[k] = unit(random.w[k]);
}

// What makes ray `number` of a pixel, with steps of at most `step`, an unbiased estimate (`Medium::mended_ray`), with all threads of a block: the ray as it
// is to the first four values of `memory` behind CHECK_MEMORY, and what is to be added to its radiance to the last three.
RW_FN void mend_ray(const Block& block, const FrameScene& scene, const March& march, uint32_t pixel, uint32_t number, float step, float* memory) {
    float *coarse = memory + CHECK_MEMORY, *fine = coarse + 4, *added = fine + 4, drawn[2];
    mend_draws(scene, pixel, number, drawn);
    check_ray(block, scene, march, pixel, number, step, 0.0f, NO_DRAW, coarse, memory);
    block.each(3, [&](int k) { added[k] = 0.0f, fine[k] = coarse[k]; });
    float share = HALVED;
    for (int halvings = 0; halvings < MOST_HALVINGS && drawn[0] < share; ++halvings) {
        // Before the finer ray takes the place of the last one.
        block.each(3, [&](int k) { added[k] -= fine[k] / share; });
        step *= 0.5f;
        check_ray(block, scene, march, pixel, number, step, step, drawn[1], fine, memory);
        block.each(3, [&](int k) { added[k] += fine[k] / share; });
        share *= HALVED_AGAIN;
    }
}

// Sum of this pass's rays of a pixel: of every `stride`-th, from the `first`-th on.
RW_FN RaySum march_rays(const FrameScene& scene, const March& march, uint32_t pixel, uint32_t first, uint32_t stride) {
    RaySum sum = {{0.0f, 0.0f, 0.0f}, 0.0f, 0.0f, 0.0f};
    for (uint32_t ray = first; ray < march.rays; ray += stride) march_ray(scene, march, pixel, march.first_ray + ray, sum);
    return sum;
}

// Adds rays of a pixel to its sums: RAY_FIELDS planes of `pixels` values. `fresh`: the sums begin with these.
RW_FN void add_rays(const RaySum& sum, size_t pixels, uint32_t pixel, double* sums, bool fresh) {
    const float fields[RAY_FIELDS] = {sum.radiance[0], sum.radiance[1], sum.radiance[2], sum.alpha, sum.ftle, sum.missing};
    RW_UNROLL
    for (int k = 0; k < RAY_FIELDS; ++k) {
        double* at = sums + k * pixels + pixel;
        *at = fresh ? double(fields[k]) : *at + double(fields[k]);
    }
}

}  // namespace rw
