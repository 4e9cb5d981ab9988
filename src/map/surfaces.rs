//! Height-ridge surfaces of a field in space: points at which the field is largest across the surface (Eberly, Ridges in image and data analysis, 1996;
//! for the FTLE Sadlo and Peikert, Efficient visualization of Lagrangian coherent structures by filtered AMR ridge extraction, IEEE TVCG 13, 2007).
//!
//! With g the gradient, H the Hessian and e its unit eigenvector of the smallest eigenvalue: g . e = 0, and that eigenvalue is negative and the largest
//! one by magnitude. Cells are cut into six tetrahedra around a diagonal, whose corners agree on the sign of the direction across (Furst and Pizer, Marching
//! ridges, 2001), which on the flanks of a ridge is that of H squared with a share of the neighbours'. The crossing is that of the spline through the nodes,
//! where the eigenvalues are tested.
//! The place of a crossing depends on its edge alone, so that tetrahedra meet in shared vertices without gaps.

use super::pieces::pieces;
use super::ridges::{Strength, least_sharpness, percentile};
use super::volume::{Shape, Shapes, Volume};
use crate::progress::Work;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A vertex of a ridge surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Coordinates.
    pub place: [f64; 3],
    /// The (smoothed) field.
    pub value: f64,
    /// Minus the second derivative across the surface, per square of the unit of [`Volume::scale`].
    pub sharpness: f64,
}

/// Ridge surfaces as one triangle mesh with shared vertices.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Surfaces {
    /// Vertices.
    pub points: Vec<SurfacePoint>,
    /// Vertices of each triangle. Triangles of a surface lie together and turn the same way round, if the surface has two sides.
    pub triangles: Vec<[u32; 3]>,
    /// What each surface is, the largest first.
    pub surfaces: Vec<Surface>,
}

/// A connected surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Number of its triangles.
    pub triangles: usize,
    /// Area, in squares of nodes.
    pub area: f64,
    /// The part of the area on which the field reaches the percentile.
    pub strong_area: f64,
}

/// Corners of a cell, as bits of x, y and z, of the tetrahedra around its diagonal.
const TETRAHEDRA: [[usize; 4]; 6] = [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]];

/// Vertices and triangles before they are filtered.
#[derive(Default)]
struct Mesh {
    points: Vec<SurfacePoint>,
    triangles: Vec<[u32; 3]>,
    /// Numbers of the vertices on the edges that begin in the last layer of nodes and lie in it, eight places a node.
    last: Vec<u32>,
}

/// The mesh of some layers of cells.
struct Slab {
    /// Numbers of the vertices on the edges that begin in the layer of cells and in the one above, eight places a node.
    numbers: [Vec<u32>; 2],
    /// Those that begin in the first layer.
    first: Vec<u32>,
    points: Vec<SurfacePoint>,
    triangles: Vec<[u32; 3]>,
}

/// An edge whose crossing was not looked for yet, and one whose point is no ridge.
const NEW: u32 = u32::MAX;
const NONE: u32 = u32::MAX - 1;

impl Volume {
    /// Ridge surfaces.
    pub fn surfaces(&self, strength: &Strength) -> Surfaces {
        let shapes = self.shapes(strength.smoothing);
        let mut known: Vec<f64> = shapes.smooth.iter().copied().filter(|v| v.is_finite()).collect();
        if known.is_empty() || self.size.iter().any(|n| *n < 2) {
            return Surfaces::default();
        }
        known.par_sort_unstable_by(f64::total_cmp);
        let [least, faint] = [1.0, 0.75].map(|share| percentile(&known, share * strength.percentile));
        drop(known);
        let Mesh { points, mut triangles, .. } = self.mesh(&shapes, faint);
        let sharp = least_sharpness(points.iter().map(|point| point.sharpness), strength.sharpness);
        triangles.retain(|triangle| triangle.iter().all(|n| points[*n as usize].sharpness >= sharp));
        let mut kept: Vec<(Surface, Vec<[u32; 3]>)> = pieces(&triangles)
            .into_par_iter()
            .map(|piece| (self.measured(&points, &piece, least), piece))
            .filter(|(surface, _)| strength.suffices(surface.strong_area))
            .collect();
        kept.sort_by(|(a, _), (b, _)| b.area.total_cmp(&a.area));
        let mut found = Surfaces::default();
        let mut numbers = vec![u32::MAX; points.len()];
        for (surface, piece) in kept {
            found.surfaces.push(surface);
            found.triangles.extend(piece.into_iter().map(|triangle| {
                triangle.map(|old| {
                    let number = &mut numbers[old as usize];
                    if *number == u32::MAX {
                        *number = found.points.len() as u32;
                        found.points.push(points[old as usize]);
                    }
                    *number
                })
            }));
        }
        found
    }

    /// The mesh of all cells, by slabs on all threads.
    fn mesh(&self, shapes: &Shapes, faint: f64) -> Mesh {
        let layers: Vec<usize> = (0..self.size[2] - 1).collect();
        let at_once = layers.len().div_ceil(4 * rayon::current_num_threads()).max(4);
        let (work, done) = (Work::begin("finding ridges"), AtomicUsize::new(0));
        let slab = |some: &[usize]| {
            let slab = self.slab(some, shapes, faint);
            work.reached(done.fetch_add(some.len(), Ordering::Relaxed) + some.len(), layers.len());
            slab
        };
        let slabs: Vec<Slab> = layers.par_chunks(at_once).map(slab).collect();
        slabs.into_iter().fold(Mesh::default(), Mesh::and)
    }

    fn slab(&self, layers: &[usize], shapes: &Shapes, faint: f64) -> Slab {
        let [nx, ny, _] = self.size;
        let layer = || vec![NEW; 8 * nx * ny];
        let mut slab = Slab { numbers: [layer(), layer()], first: Vec::new(), points: Vec::new(), triangles: Vec::new() };
        for &k in layers {
            for cell in 0..(nx - 1) * (ny - 1) {
                self.cut([cell % (nx - 1), cell / (nx - 1), k], shapes, faint, &mut slab);
            }
            slab.numbers.swap(0, 1);
            let below = std::mem::replace(&mut slab.numbers[1], layer());
            if k == layers[0] {
                slab.first = below;
            }
        }
        slab
    }

    /// What a surface of these triangles is; `least` is the percentile.
    fn measured(&self, points: &[SurfacePoint], triangles: &[[u32; 3]], least: f64) -> Surface {
        let (mut area, mut strong_area) = (0.0, 0.0);
        for triangle in triangles {
            let [a, b, c] = triangle.map(|n| points[n as usize]);
            let side = |to: SurfacePoint| -> [f64; 3] { std::array::from_fn(|k| (to.place[k] - a.place[k]) / self.step[k]) };
            let ([ux, uy, uz], [vx, vy, vz]) = (side(b), side(c));
            let normal = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
            let part = normal.iter().map(|c| c * c).sum::<f64>().sqrt() / 2.0;
            area += part;
            if (a.value + b.value + c.value) / 3.0 >= least {
                strong_area += part;
            }
        }
        Surface { triangles: triangles.len(), area, strong_area }
    }

    /// Adds the triangles of a cell.
    fn cut(&self, [i, j, k]: [usize; 3], shapes: &Shapes, faint: f64, slab: &mut Slab) {
        let [nx, ny, _] = self.size;
        let node = |corner: usize| (i + (corner & 1)) + nx * ((j + (corner >> 1 & 1)) + ny * (k + (corner >> 2)));
        // All tetrahedra have both ends of the diagonal.
        let (Some(first), Some(_)) = (&shapes.at[node(0)], &shapes.at[node(7)]) else { return };
        for corners in TETRAHEDRA {
            let [Some(a), Some(b), Some(c), Some(d)] = corners.map(|corner| shapes.at[node(corner)]) else { continue };
            let all = [a, b, c, d];
            // Edges on which directions differ by 60 degrees or more belong to no common ridge. Below, the signs cannot contradict each other.
            let pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)];
            if pairs.iter().any(|(p, q)| dot(all[*p].across, all[*q].across).abs() <= 0.5) {
                continue;
            }
            let (mut below, mut above) = ([0; 4], [0; 4]);
            let mut count = [0; 2];
            for (corner, shape) in corners.into_iter().zip(&all) {
                let (side, list) = if slope(shape, first) < 0.0 { (0, &mut below) } else { (1, &mut above) };
                list[count[side]] = corner;
                count[side] += 1;
            }
            let mut vertex = |p: usize, q: usize| {
                let (from, to) = (p.min(q), p.max(q));
                let place = 8 * (node(from) % (nx * ny)) + (p ^ q);
                let number = slab.numbers[from >> 2][place];
                if number != NEW {
                    return (number != NONE).then_some(number);
                }
                let found = self.crossing(shapes, [node(from), node(to)], p ^ q).filter(|[_, value, _]| *value >= faint);
                let point = found.map(|[t, value, sharpness]| {
                    let along = |k: usize| self.place(node(from))[k] as f64 + if (p ^ q) >> k & 1 == 1 { t } else { 0.0 };
                    SurfacePoint { place: std::array::from_fn(|k| self.origin[k] + self.step[k] * along(k)), value, sharpness }
                });
                // Seven edges a node, of at most 2^25 nodes.
                slab.numbers[from >> 2][place] = if point.is_some() { slab.points.len() as u32 } else { NONE };
                slab.points.extend(point);
                point.map(|_| slab.points.len() as u32 - 1)
            };
            let ring = match count {
                [1, 3] => [vertex(below[0], above[0]), vertex(below[0], above[1]), vertex(below[0], above[2]), None],
                [3, 1] => [vertex(below[0], above[0]), vertex(below[1], above[0]), vertex(below[2], above[0]), None],
                [2, 2] => [vertex(below[0], above[0]), vertex(below[0], above[1]), vertex(below[1], above[1]), vertex(below[1], above[0])],
                _ => continue,
            };
            for triangle in [[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]] {
                if let [Some(p), Some(q), Some(r)] = triangle {
                    slab.triangles.push([p, q, r]);
                }
            }
        }
    }
}

impl Mesh {
    /// The mesh with the slab above, which shares the vertices on the layer of nodes between them.
    fn and(mut self, slab: Slab) -> Self {
        let mut numbers = vec![NEW; slab.points.len()];
        for (above, below) in slab.first.iter().zip(&self.last).filter(|(above, below)| **above < NONE && **below < NONE) {
            numbers[*above as usize] = *below;
        }
        for (number, point) in numbers.iter_mut().zip(slab.points).filter(|(number, _)| **number == NEW) {
            *number = self.points.len() as u32;
            self.points.push(point);
        }
        let [last, _] = slab.numbers;
        self.last = last.into_iter().map(|number| if number < NONE { numbers[number as usize] } else { number }).collect();
        self.triangles.extend(slab.triangles.into_iter().map(|triangle| triangle.map(|number| numbers[number as usize])));
        self
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Slope in the direction of another node.
fn slope(shape: &Shape, direction: &Shape) -> f64 {
    shape.slope * dot(shape.across, direction.across).signum()
}
