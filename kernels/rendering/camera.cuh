// Pinhole and orthographic cameras: the ray through a point of the film (see `render::camera`).
#pragma once
#include "rendering/space.cuh"

namespace rw {

struct Camera {
    double eye[3];
    double forward[3];  // look-at minus eye
    double right[3];    // half of the film's width, to the right
    double up[3];       // half of the film's height, upward
    int orthographic;
    int pad;
};

// Origin and unit direction of the ray through a point of the film: x from -1 (left) to 1, y from -1 (bottom) to 1.
RW_FN void camera_ray(const Camera& camera, double x, double y, double origin[3], double direction[3]) {
    for (int k = 0; k < 3; ++k) {
        const double offset = x * camera.right[k] + y * camera.up[k];
        origin[k] = camera.orthographic ? camera.eye[k] + offset : camera.eye[k];
        direction[k] = camera.orthographic ? camera.forward[k] : camera.forward[k] + offset;
    }
    const double inverse = 1.0 / length3(direction);
    for (int k = 0; k < 3; ++k) direction[k] *= inverse;
}

}  // namespace rw
