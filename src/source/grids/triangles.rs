//! Triangles between points on the sphere that lie in no rows (FESOM, FVCOM, ICON, SCHISM, UGRID), and interpolation in them.
//!
//! Algorithm: a value is the linear interpolation of the corners' values in the plane that touches the sphere at the place (gnomonic projection).
//! The triangles are the faces of the model's mesh if its nodes have the values. Otherwise they are those of the Delaunay triangulation: a
//! stereographic projection takes circles to circles, so that the triangulation of the plane is that of the sphere (Brown 1979,
//! doi:10.1016/0020-0190(79)90074-7); its centre is one of the points, which closes the rest.

use super::locator::{Mesh, NOWHERE, SLACK, Target, Vector, degrees, dot, vector};
use delaunator::{Point, triangulate};
use std::fmt;

/// Triangles between the points of a mesh.
#[derive(Debug)]
pub struct Triangles {
    corners: Vec<[u32; 3]>,
    /// Faces of the model's mesh, if the points stand for faces: elsewhere is land.
    faces: Option<Faces>,
}

/// Faces of a model's mesh.
#[derive(Debug)]
pub struct Faces {
    /// Longitudes and latitudes of the nodes, degrees.
    pub nodes: [Vec<f64>; 2],
    /// Nodes at the corners of parts of the faces.
    parts: Vec<[u32; 3]>,
    /// The face of each part.
    of: Vec<u32>,
    count: usize,
}

/// Longest side of a triangle between the points of no known mesh, as a multiple of the third shortest side at its corners: longer ones bridge land.
const LONGEST: f64 = 3.0;
/// Area of a triangle, as a share of the square of its longest side, below which it is none.
const FLAT: f64 = 1e-6;
/// Triangles that are asked how the hull turns: one may be flat.
const MOST_ASKED: usize = 16;
/// Half of the squared distance of two points on the unit sphere (0.9 mm on the globe) below which they count as one.
const ONE_POINT: f64 = 1e-20;

fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn between(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|k| b[k] - a[k])
}

impl Faces {
    /// From the nodes at the corners of each face: `width` numbers a face, in which those that are no number of a node fill up. Fewer than three corners
    /// make no face.
    pub fn new(nodes: [Vec<f64>; 2], corners: &[Option<u32>], width: usize) -> Self {
        let (mut parts, mut of) = (Vec::new(), Vec::new());
        let known = |node: &u32| nodes.iter().all(|angle| angle.get(*node as usize).is_some_and(|v| v.is_finite()));
        for (face, corners) in corners.chunks_exact(width).enumerate() {
            let corners: Vec<u32> = corners.iter().flatten().copied().collect();
            if corners.len() < 3 || !corners.iter().all(known) {
                continue;
            }
            for pair in corners[1..].windows(2) {
                parts.push([corners[0], pair[0], pair[1]]);
                of.push(face as u32);
            }
        }
        Self { nodes, parts, of, count: corners.len() / width }
    }

    /// Longitudes and latitudes of the middles of all faces; NaN for what is no face.
    pub fn middles(&self) -> [Vec<f64>; 2] {
        let mut sums = vec![[0.0; 3]; self.count];
        for (&face, corners) in self.of.iter().zip(&self.parts) {
            // By area, so that the middle of a face does not depend on how it is cut.
            let [a, b, c] = corners.map(|node| self.place(node)).map(|p| vector(p[0], p[1]));
            let normal = cross(between(a, b), between(a, c));
            let area = dot(normal, normal).sqrt();
            let sum = &mut sums[face as usize];
            *sum = std::array::from_fn(|k| sum[k] + area * (a[k] + b[k] + c[k]));
        }
        let places: Vec<[f64; 2]> = sums.into_iter().map(|sum| if sum == [0.0; 3] { [f64::NAN; 2] } else { degrees(sum) }).collect();
        [0, 1].map(|k| places.iter().map(|p| p[k]).collect())
    }

    fn place(&self, node: u32) -> [f64; 2] {
        [0, 1].map(|k| self.nodes[k][node as usize])
    }
}

/// How values are interpolated, as the end of a sentence about points.
impl fmt::Display for Triangles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.faces {
            None => write!(f, ", linearly in {} triangles,", self.corners.len()),
            Some(faces) => write!(f, " in {} faces, linearly in the triangles between them,", faces.count),
        }
    }
}

impl Triangles {
    /// The faces of a mesh whose nodes are the points.
    pub fn of_faces(faces: Faces) -> Self {
        Self { corners: faces.parts, faces: None }
    }

    /// Between points of no known mesh: triangles with sides much longer than others at their corners are left out, as land.
    pub fn without_gaps(longitude: &[f64], latitude: &[f64]) -> Self {
        let (points, mut corners) = delaunay(longitude, latitude);
        let length = |a: u32, b: u32| {
            let way = between(points[a as usize], points[b as usize]);
            dot(way, way).sqrt()
        };
        let sides = |[a, b, c]: [u32; 3]| [(a, b), (b, c), (c, a)];
        // All triangles turn the same way, so that each point meets each of its neighbours once as the end of a side.
        let mut shortest = vec![[f64::INFINITY; 3]; points.len()];
        for (a, b) in corners.iter().copied().flat_map(sides) {
            let (near, new) = (&mut shortest[a as usize], length(a, b));
            if new < near[2] {
                near[2] = new;
                near.sort_by(f64::total_cmp);
            }
        }
        corners.retain(|&triangle| {
            let own = triangle.map(|p| shortest[p as usize][2]).into_iter().fold(0.0, f64::max);
            sides(triangle).iter().all(|&(a, b)| length(a, b) <= LONGEST * own)
        });
        keep_near_side(&points, &mut corners);
        Self { corners, faces: None }
    }

    /// Between the middles of faces, which tell where water is. Where no triangle is, beside the coast, the value is that of the face.
    pub fn between_faces(longitude: &[f64], latitude: &[f64], faces: Faces) -> Self {
        Self { faces: Some(faces), ..Self::without_gaps(longitude, latitude) }
    }

    /// Longitudes and latitudes of the nodes of the faces in which the points lie.
    pub fn nodes(&self) -> Option<&[Vec<f64>; 2]> {
        self.faces.as_ref().map(|faces| &faces.nodes)
    }

    #[cfg(test)]
    fn count(&self) -> usize {
        self.corners.len()
    }

    /// Degrees along the sides of all triangles.
    pub fn sides(&self, mesh: &Mesh) -> Vec<f64> {
        let ends = |&[a, b, c]: &[u32; 3]| [(a, b), (b, c), (c, a)];
        let length = |(a, b): (u32, u32)| {
            let [a, b] = [a, b].map(|n| at(mesh, n));
            let way = between(a, b);
            Some((0.5 * dot(way, way).sqrt()).asin().to_degrees() * 2.0).filter(|d| d.is_finite())
        };
        self.corners.iter().flat_map(ends).filter_map(length).collect()
    }

    /// Areas of all triangles, in square degrees of great circles.
    pub fn areas(&self, mesh: &Mesh) -> Vec<f64> {
        let area = |corners: &[u32; 3]| {
            let [a, b, c] = corners.map(|n| at(mesh, n));
            let normal = cross(between(a, b), between(a, c));
            Some(0.5 * dot(normal, normal).sqrt() * 1f64.to_degrees().powi(2)).filter(|a| a.is_finite())
        };
        self.corners.iter().filter_map(area).collect()
    }
}

fn at(mesh: &Mesh, point: u32) -> Vector {
    vector(mesh.longitude[point as usize], mesh.latitude[point as usize])
}

/// Directions of all points, and the triangles of the Delaunay triangulation of those that are known, turned the same way. Of points in one place, one has
/// triangles.
fn delaunay(longitude: &[f64], latitude: &[f64]) -> (Vec<Vector>, Vec<[u32; 3]>) {
    let points: Vec<Vector> = longitude.iter().zip(latitude).map(|(&lon, &lat)| vector(lon, lat)).collect();
    let mut known = (0..points.len() as u32).filter(|&n| points[n as usize].iter().all(|v| v.is_finite()));
    let Some(centre) = known.next() else { return (points, Vec::new()) };
    let pole = points[centre as usize];
    // A direction far from the pole, made perpendicular to it.
    let far = (0..3).min_by(|&i, &j| pole[i].abs().total_cmp(&pole[j].abs())).unwrap_or(0);
    let east = cross(pole, std::array::from_fn(|k| if k == far { 1.0 } else { 0.0 }));
    let east = east.map(|v| v / dot(east, east).sqrt());
    let north = cross(pole, east);
    let (mut numbers, mut plane) = (Vec::new(), Vec::new());
    for n in known {
        let point = points[n as usize];
        let way = between(pole, point);
        // Half of the squared distance is 1 less the product of the directions, without its rounding.
        let half = 0.5 * dot(way, way);
        if half > ONE_POINT {
            numbers.push(n);
            plane.push(Point { x: dot(way, east) / half, y: dot(way, north) / half });
        }
    }
    let found = triangulate(&plane);
    let mut triangles: Vec<[u32; 3]> = found.triangles.chunks_exact(3).map(|t| [numbers[t[0]], numbers[t[1]], numbers[t[2]]]).collect();
    // Outside of the hull lies the centre. Seen from there the hull turns the other way.
    for k in 0..if triangles.is_empty() { 0 } else { found.hull.len() } {
        let [here, next] = [found.hull[k], found.hull[(k + 1) % found.hull.len()]].map(|n| numbers[n]);
        triangles.push([next, here, centre]);
    }
    (points, triangles)
}

/// Leaves out the triangles behind the points of a part of the globe, which close their hull: seen from the middle of the globe they turn the other way.
fn keep_near_side(points: &[Vector], triangles: &mut Vec<[u32; 3]>) {
    // The hull lies below each triangle that turns counter-clockwise, seen from outside.
    let above = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|n| points[n as usize]);
        let normal = cross(between(a, b), between(a, c));
        points.iter().map(|&p| dot(between(a, p), normal)).filter(|d| d.is_finite()).sum::<f64>()
    };
    let turn = triangles
        .iter()
        .step_by(triangles.len() / MOST_ASKED + 1)
        .map(above)
        .fold(0.0, |most: f64, sum| if sum.abs() > most.abs() { sum } else { most });
    triangles.retain(|triangle| {
        let [a, b, c] = triangle.map(|n| points[n as usize]);
        dot(a, cross(b, c)) * turn < 0.0
    });
}

/// Linear interpolation in triangles.
#[derive(Debug)]
pub struct InTriangles {
    /// Points of the mesh.
    pub points: usize,
    /// Points at the corners of the triangle of each node of the grid; [`NOWHERE`] on land.
    corners: Vec<[u32; 3]>,
    /// Weights of the first two corners.
    weights: Vec<[f32; 2]>,
}

impl InTriangles {
    pub fn new(mesh: &Mesh, triangles: &Triangles, target: &Target) -> Self {
        let nodes = target.nodes[0] * target.nodes[1];
        let points = mesh.longitude.len();
        let mut this = Self { points, corners: vec![[NOWHERE; 3]; nodes], weights: vec![[1.0, 0.0]; nodes] };
        for &corners in &triangles.corners {
            let places = corners.map(|n| [mesh.longitude[n as usize], mesh.latitude[n as usize]]);
            visit_inside(target, places, |node, weights| {
                if this.corners[node] == [NOWHERE; 3] {
                    (this.corners[node], this.weights[node]) = (corners, weights);
                }
            });
        }
        if let Some(faces) = &triangles.faces {
            let mut face = vec![NOWHERE; nodes];
            for (corners, &of) in faces.parts.iter().zip(&faces.of) {
                visit_inside(target, corners.map(|n| faces.place(n)), |node, _| face[node] = of);
            }
            for (corners, face) in this.corners.iter_mut().zip(face) {
                if face == NOWHERE {
                    *corners = [NOWHERE; 3];
                } else if *corners == [NOWHERE; 3] {
                    // Between the outermost middles and the coast: the value of the face.
                    *corners = [face; 3];
                }
            }
        }
        this
    }

    pub fn apply(&self, values: &[f32]) -> Vec<f32> {
        let one = |(&corners, &[a, b]): (&[u32; 3], &[f32; 2])| {
            if corners == [NOWHERE; 3] {
                return f32::NAN;
            }
            let [p, q, r] = corners.map(|n| values[n as usize]);
            a * p + b * q + (1.0 - a - b) * r
        };
        self.corners.iter().zip(&self.weights).map(one).collect()
    }
}

/// Calls `visit` with the nodes of the grid in a triangle, and the weights there of its first two corners.
fn visit_inside(target: &Target, corners: [[f64; 2]; 3], mut visit: impl FnMut(usize, [f32; 2])) {
    let [a, b, c] = corners.map(|p| vector(p[0], p[1]));
    let sides = [cross(b, c), cross(c, a), cross(a, b)];
    let volume = dot(a, sides[0]);
    let longest = [between(a, b), between(b, c), between(c, a)].iter().map(|side| dot(*side, *side)).fold(0.0, f64::max);
    // Points on one line, up to rounding.
    if volume.abs() <= FLAT * longest {
        return;
    }
    let turn = volume.signum();
    target.around(&corners, |node, p| {
        let weights = sides.map(|side| turn * dot(p, side));
        let sum: f64 = weights.iter().sum();
        // A place on the far side of the globe has negative weights only.
        if sum > 0.0 && weights.iter().all(|w| *w >= -SLACK * sum) {
            visit(node, [0, 1].map(|k| (weights[k] / sum).clamp(0.0, 1.0) as f32));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::super::locator::{Locator, target};
    use super::*;
    use std::f64::consts::PI;

    /// Points spread evenly over the sphere, on a spiral.
    fn spiral(n: usize) -> [Vec<f64>; 2] {
        let golden = PI * (3.0 - 5f64.sqrt());
        let place = |k: usize| {
            let z: f64 = 1.0 - (2.0 * k as f64 + 1.0) / n as f64;
            let (r, turn) = ((1.0 - z * z).sqrt(), golden * k as f64);
            degrees([r * turn.cos(), r * turn.sin(), z])
        };
        let places: Vec<[f64; 2]> = (0..n).map(place).collect();
        [0, 1].map(|k| places.iter().map(|p| p[k]).collect())
    }

    fn mesh([longitude, latitude]: [Vec<f64>; 2], triangles: Triangles) -> Mesh {
        Mesh { shape: [longitude.len(), 1], longitude, latitude, triangles: Some(triangles) }
    }

    /// Largest error of a smooth field on the grid, and the share of nodes with a value.
    fn error(mesh: &Mesh, step: f64) -> (f64, f64) {
        let target = target(mesh, Some([step; 2]), None).unwrap();
        let field = |p: Vector| (3.0 * p[0] - p[2]).sin() + 2.0 * p[1];
        let values: Vec<f32> = (0..mesh.longitude.len()).map(|n| field(at(mesh, n as u32)) as f32).collect();
        let found = Locator::new(mesh, &target).apply(&values);
        let known = found.iter().filter(|v| v.is_finite()).count();
        let error = |(node, value): (usize, &f32)| {
            let [lon, lat] = target.place(node);
            (f64::from(*value) - field(vector(lon, lat))).abs()
        };
        let worst = found.iter().enumerate().filter(|(_, v)| v.is_finite()).map(error).fold(0.0, f64::max);
        (worst, known as f64 / found.len() as f64)
    }

    #[test]
    fn a_globe_of_points_has_no_hole_and_an_error_of_second_order() {
        let of = |n: usize| {
            let points = spiral(n);
            let triangles = Triangles::without_gaps(&points[0], &points[1]);
            // Euler: twice the points less four.
            assert_eq!(triangles.count(), 2 * n - 4);
            mesh(points, triangles)
        };
        let ((coarse, all), (fine, more)) = (error(&of(1000), 3.0), error(&of(4000), 3.0));
        assert_eq!((all, more), (1.0, 1.0));
        // Half the distance, a quarter of the error.
        assert!(fine < 0.35 * coarse && coarse < 0.1, "{coarse} {fine}");
    }

    #[test]
    fn triangles_turn_the_same_way() {
        let [longitude, latitude] = spiral(500);
        let (points, triangles) = delaunay(&longitude, &latitude);
        let turn = |t: &[u32; 3]| dot(points[t[0] as usize], cross(points[t[1] as usize], points[t[2] as usize])).signum();
        assert!(triangles.iter().all(|t| turn(t) == turn(&triangles[0])));
        let mut near = triangles.clone();
        keep_near_side(&points, &mut near);
        assert_eq!(near, triangles, "nothing lies behind the points of a globe");
        // No point lies in the circle of a triangle: beyond the plane of its corners.
        for t in &triangles {
            let [a, b, c] = t.map(|n| points[n as usize]);
            let normal = cross(between(a, b), between(a, c)).map(|v| v * turn(t));
            assert!(points.iter().all(|&p| dot(between(a, p), normal) <= 1e-12), "{t:?}");
        }
    }

    /// The triangles that close the hull of a part of the globe lie behind it, whichever point is the first.
    #[test]
    fn a_part_of_the_globe_has_no_triangles_behind_it() {
        let places: Vec<[f64; 2]> = (0..40 * 30)
            .map(|n| {
                [f64::from(n % 40) + 0.3 * f64::from(n * 7 % 11) / 11.0, f64::from(n / 40) - 15.0 + 0.3 * f64::from(n * 5 % 13) / 13.0]
            })
            .collect();
        for first in [0, 20, 615, 1199, 333] {
            let mut places = places.clone();
            places.swap(0, first);
            let points: [Vec<f64>; 2] = [0, 1].map(|k| places.iter().map(|p| p[k]).collect());
            let (all, triangles) = delaunay(&points[0], &points[1]);
            let mut near = triangles.clone();
            keep_near_side(&all, &mut near);
            // All but those beyond the rim.
            assert!((2200..2400).contains(&near.len()) && near.len() < triangles.len(), "{first}: {} of {}", near.len(), triangles.len());
            let (worst, _) = error(&mesh(points.clone(), Triangles::without_gaps(&points[0], &points[1])), 0.5);
            // Triangles at the rim are up to four degrees long: an eighth of the square, 6e-4, times the second derivative, 9.
            assert!(worst < 6e-3, "{first}: {worst}");
        }
    }

    #[test]
    fn land_between_points_is_left_out() {
        // A square basin with a square island, points a degree apart.
        let places: Vec<[f64; 2]> = (0..31 * 31)
            .map(|n| [f64::from(n % 31), f64::from(n / 31)])
            .filter(|p| p.iter().any(|v| (v - 15.0).abs() > 5.0))
            .map(|p| [p[0] - 15.0, p[1] - 15.0])
            .collect();
        let points: [Vec<f64>; 2] = [0, 1].map(|k| places.iter().map(|p| p[k]).collect());
        let mesh = mesh(points.clone(), Triangles::without_gaps(&points[0], &points[1]));
        // The island is 12 degrees wide from water to water.
        let (worst, known) = error(&mesh, 0.3);
        assert!(worst < 2e-3 && (known - (1.0 - 144.0 / 900.0)).abs() < 0.02, "{worst} {known}");
    }

    #[test]
    fn faces_tell_the_coast() {
        // A strip of quadrangles with a hole, and one triangle: `u32::MAX` fills up.
        let nodes: Vec<[f64; 2]> = (0..22 * 11).map(|n| [f64::from(n % 22), f64::from(n / 22) - 5.0]).collect();
        let nodes: [Vec<f64>; 2] = [0, 1].map(|k| nodes.iter().map(|p| p[k]).collect());
        let mut corners = Vec::new();
        for (i, j) in (0..10).flat_map(|j| (0..21).map(move |i| (i, j))).filter(|&(i, j)| !(8..12).contains(&i) || !(3..7).contains(&j)) {
            let first = j * 22 + i;
            let last = if (i, j) == (20, 9) { None } else { Some(first + 22) };
            corners.extend([Some(first), Some(first + 1), Some(first + 23), last]);
        }
        let faces = Faces::new(nodes, &corners, 4);
        let middles = faces.middles();
        assert_eq!(middles[0].len(), 194);
        assert!((middles[0][0] - 0.5).abs() < 1e-3 && (middles[1][0] + 4.5).abs() < 1e-3, "{middles:?}");
        let mesh = mesh(middles.clone(), Triangles::between_faces(&middles[0], &middles[1], faces));
        let grid = Target { first: [0.0, -5.0], step: [0.25; 2], nodes: [85, 41], round: false };
        let found = Locator::new(&mesh, &grid).apply(&middles[0].iter().map(|v| *v as f32).collect::<Vec<_>>());
        let value = |lon: f64, lat: f64| found[(((lat + 5.0) / 0.25) as usize) * 85 + (lon / 0.25) as usize];
        assert!((value(5.25, 0.25) - 5.25).abs() < 1e-3, "{}", value(5.25, 0.25));
        // The face beside the coast, the coast, the missing half of a quadrangle, and its other half.
        assert_eq!(value(0.25, 0.25), value(0.0, 0.25));
        assert!(value(10.0, 0.0).is_nan() && value(7.75, 0.0).is_finite() && value(20.25, 4.75).is_nan() && value(20.75, 4.25).is_finite());
    }

    #[test]
    fn points_in_one_place_and_missing_ones_are_passed_over() {
        let [mut longitude, mut latitude] = spiral(300);
        for k in 0..50 {
            longitude.push(longitude[3 * k]);
            latitude.push(latitude[3 * k]);
        }
        longitude.push(f64::NAN);
        latitude.push(10.0);
        let triangles = Triangles::without_gaps(&longitude, &latitude);
        assert_eq!(triangles.count(), 2 * 300 - 4);
        for few in 0..4 {
            let [longitude, latitude] = spiral(few);
            assert_eq!(Triangles::without_gaps(&longitude, &latitude).count(), 0, "{few}");
        }
        let line: Vec<f64> = (0..9).map(f64::from).collect();
        assert_eq!(Triangles::without_gaps(&line, &[0.0; 9]).count(), 0);
    }
}
