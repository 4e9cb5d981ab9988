//! Compares the kernels that march and combine, compiled as host C++, with this module. Needs no GPU but a C++ compiler (`c++`, or the one in CXX).

#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

use super::march::LightArgument;
use crate::cuda::SUM_PLANES;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use ridgewatch_render::rng::philox;
use ridgewatch_render::smooth::{
    Correction, FIRST_AUDIT_RAY, Guides, LightGrid, LightVolume, Medium, NET, Nodes, PairSums, RaySum, ToLight, ToneMap, combine, error_at,
};
use ridgewatch_render::{CameraSettings, Combine, LightSettings, RenderSettings, Renderer, Scene, TransferSettings};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, OnceLock};

/// Path of the compiled harness. Contraction to fused multiply-add is off, as in rustc.
fn harness() -> &'static Path {
    static BUILT: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    &BUILT
        .get_or_init(|| {
            let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
            let folder = tempfile::tempdir().unwrap();
            let out = folder.path().join("harness");
            let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".into());
            let mut command = Command::new(&compiler);
            command.args(["-std=c++17", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-I"]).arg(root.join("kernels"));
            command.arg(root.join("tests/smooth_kernels/harness.cpp")).arg("-o").arg(&out);
            assert!(command.status().unwrap().success(), "the kernels' headers do not compile as host C++");
            (folder, out)
        })
        .1
}

fn ask(request: &str, input: &[u8]) -> Vec<u8> {
    let mut child = Command::new(harness()).arg(request).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let output = std::thread::scope(|scope| {
        scope.spawn(move || stdin.write_all(input).unwrap());
        child.wait_with_output().unwrap()
    });
    assert!(output.status.success(), "{request}: {}", output.status);
    output.stdout
}

fn bytes<T: bytemuck::NoUninit>(values: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

/// Reads numbers off the front.
fn read<T: bytemuck::AnyBitPattern>(bytes: &mut &[u8], count: usize) -> Vec<T> {
    let (front, rest) = bytes.split_at(count * size_of::<T>());
    *bytes = rest;
    bytemuck::pod_collect_to_vec::<u8, u8>(front).chunks(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
}

/// Random numbers in [0, 1).
fn uniform(stream: u32) -> impl FnMut() -> f32 {
    let mut i = 0;
    move || {
        i += 1;
        (philox([i, stream, 0, 0], [17, 4])[0] >> 8) as f32 / 16_777_216.0
    }
}

/// Structure whose outer bricks along x and z, as the camera sees them first, are empty up to their last nodes.
fn some_nodes(shape: [usize; 3]) -> Nodes {
    let value = |i: usize| {
        let (UnitPoint([x, y, z]), empty) = (Nodes::unit(shape, i), i % shape[0] >= 24 || i / (shape[0] * shape[1]) >= 16);
        (9.0 * x + 2.0 * z).sin() * (7.0 * y).cos() + 0.4 * z - if empty { 2.0 } else { 0.0 }
    };
    Nodes::new(shape, Arc::new((0..shape.iter().product()).map(value).collect()))
}

struct Case {
    name: &'static str,
    domain: Domain,
    shape: [usize; 3],
    light: LightSettings,
    orthographic: bool,
    holes: bool,
    mended: bool,
    /// Limit on the values of the light volume.
    values: usize,
}

/// Axes of 5, 4 and 3 cells of a velocity grid over the domain.
fn cell_axes(domain: &Domain) -> [Vec<f64>; 3] {
    std::array::from_fn(|k| {
        let cells = [5, 4, 3][k];
        (0..=cells).map(|i| domain.min[k] + domain.extent()[k] * (f64::from(i) / f64::from(cells)).powf(1.2)).collect()
    })
}

/// A fifth of the cells is missing.
fn is_missing(axes: &[Vec<f64>; 3], dimensions: usize, point: DomainPoint) -> bool {
    let (mut index, mut pitch) = (0, 1);
    for (axis, p) in axes.iter().zip(point.0).take(dimensions) {
        let cells = axis.len() - 1;
        index += pitch * (axis.iter().filter(|node| **node <= f64::from(p)).count().clamp(1, cells) - 1);
        pitch *= cells;
    }
    index % 5 == 2
}

fn cases() -> Vec<Case> {
    let cube = Domain::cuboid([0.5, 0.0, -1.0], [2.5, 1.0, 0.0]);
    let flat = Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 0.25));
    let from = |direction| LightSettings { direction: Some(direction), position: None, radiance: [8.0, 9.0, 10.0] };
    let case = |name, light| Case {
        name,
        domain: cube.clone(),
        shape: [29, 17, 20],
        light,
        orthographic: false,
        holes: false,
        mended: false,
        values: 1 << 20,
    };
    vec![
        case("along -x", from([-1.0, -0.3, -0.2])),
        Case { mended: true, ..case("along +y", from([0.2, 1.0, -0.7])) },
        Case { orthographic: true, ..case("along -z", from([-0.1, 0.4, -1.0])) },
        Case { values: 3000, ..case("coarse, straight along +z", from([0.0, 0.0, 1.0])) },
        Case { holes: true, ..case("holes", from([-1.0, -1.0, -1.0])) },
        case("point", LightSettings { direction: None, position: Some([0.8, 2.0, 0.7]), radiance: [8.0, 9.0, 10.0] }),
        Case {
            mended: true,
            ..case("mended, point", LightSettings { direction: None, position: Some([0.8, 2.0, 0.7]), radiance: [8.0, 9.0, 10.0] })
        },
        Case { mended: true, holes: true, ..case("mended, holes", from([-0.2, 0.3, -1.0])) },
        case("point inside", LightSettings { direction: None, position: Some([1.3, 0.4, -0.6]), radiance: [1.0; 3] }),
        Case { domain: flat.clone(), shape: [33, 18, 1], orthographic: true, ..case("flat", from([-1.0, -1.0, -1.0])) },
        Case { domain: flat, shape: [33, 18, 1], holes: true, ..case("flat with holes", from([-0.2, 0.3, -1.0])) },
    ]
}

impl Case {
    fn renderer(&self) -> Renderer {
        let settings = RenderSettings {
            width: 37,
            height: 23,
            majorant_cells: Some([6, 5, 3]),
            background: [0.9, 0.8, 0.7],
            ..RenderSettings::default()
        };
        let d = &self.domain;
        let middle: [f64; 3] = std::array::from_fn(|k| 0.5 * (d.min[k] + d.max[k]));
        let eye = [middle[0] + 0.1, middle[1] - 0.2, d.max[2] + 1.3];
        let camera = CameraSettings { eye, look_at: middle, up: [0.1, 1.0, 0.0], field_of_view: 95.0, orthographic: self.orthographic };
        let transfer = TransferSettings { low: Some(-0.1), high: Some(0.9), extinction: Some(9.0), ..TransferSettings::default() };
        let scene = Scene::assemble(d, Some(camera), Some(self.light.clone()), Some(transfer), settings, 5);
        Renderer::new(scene, d, 0.8).unwrap()
    }

    /// The harness's input.
    fn input(&self, renderer: &mut Renderer, nodes: &Nodes, refine: usize) -> Vec<u8> {
        let mut input = renderer.frame_setup(3, 0..1).unwrap().parameters.as_bytes().to_vec();
        input.extend(bytes(&self.shape.map(|n| n as i32)));
        input.extend(bytes(&[self.domain.dimensions as i32]));
        input.extend(bytes(nodes.values()));
        let axes = cell_axes(&self.domain);
        if self.holes {
            input.extend(bytes(&[self.domain.dimensions as i32]));
            let axes = &axes[..self.domain.dimensions];
            for axis in axes {
                input.extend(bytes(&[axis.len() as i32]));
                input.extend(bytes(axis));
            }
            let cells: usize = axes.iter().map(|axis| axis.len() - 1).product();
            input.extend((0..cells).map(|index| u8::from(index % 5 == 2)));
        } else {
            input.extend(bytes(&[0_i32]));
        }
        let grid = renderer.light_grid(self.shape, self.values, refine);
        input.extend(bytes(&[LightArgument::new(&grid, 0)]));
        input
    }

    /// A ray of the picture.
    fn ray(&self, medium: &Medium<'_>, pixel: u32, number: u64, step: f32, volume: &LightVolume) -> RaySum {
        match self.mended {
            true => medium.mended_ray(pixel, number, step, volume),
            false => medium.ray(pixel, number, step, ToLight::Volume(volume), false),
        }
    }

    fn with<R>(&self, f: impl FnOnce(&mut Renderer, &Nodes, &dyn Fn(&Renderer, &mut dyn FnMut(&Medium<'_>))) -> R) -> R {
        let axes = cell_axes(&self.domain);
        let missing = |point| is_missing(&axes, self.domain.dimensions, point);
        let nodes = some_nodes(self.shape);
        f(&mut self.renderer(), &nodes, &|renderer, use_it| {
            let scene = renderer.frame_scene(3);
            use_it(&Medium { scene: &scene, nodes: &nodes, missing: self.holes.then_some(&missing) });
        })
    }
}

#[test]
fn depths_to_the_light_agree() {
    for case in cases() {
        case.with(|renderer, nodes, with_medium| {
            let mut random = uniform(2);
            let mut points: Vec<UnitPoint> = (0..3000).map(|_| UnitPoint(std::array::from_fn(|_| random()))).collect();
            points.extend((0..8).map(|corner| UnitPoint(std::array::from_fn(|k| (corner >> k & 1) as f32))));
            for refine in [1, 2] {
                let grid: LightGrid = renderer.light_grid(case.shape, case.values, refine);
                let mut input = case.input(renderer, nodes, refine);
                input.extend(bytes(&[0.02_f32]));
                input.extend(bytes(&[points.len() as u32]));
                input.extend(bytes(&points));
                let output = ask("depths", &input);
                let found = read::<[f32; 2]>(&mut &output[..], points.len());
                with_medium(renderer, &mut |medium| {
                    let volume = LightVolume::new(medium, case.values, refine);
                    let mut deepest = 0.0_f32;
                    for (point, found) in points.iter().zip(&found) {
                        let expected = [volume.at(*point), medium.depth_to_light(medium.scene.space.grid_of_unit(*point), 0.02)];
                        for (found, expected) in found.iter().zip(expected) {
                            // Positions are rounded in another order, and extinctions are up to 9.
                            let near = (found - expected).abs() <= 2e-4 * (1.0 + expected);
                            assert!(near, "{}, refined {refine}, {point:?}: {found} and {expected}; {grid:?}", case.name);
                        }
                        deepest = deepest.max(expected[0]);
                    }
                    assert!(deepest > 0.5, "{}: {deepest}", case.name);
                });
            }
        });
    }
}

#[test]
fn rays_agree() {
    for case in cases() {
        case.with(|renderer, nodes, with_medium| {
            let (step, passes, pixels) = (0.03_f32, [3_u32, 2], 37 * 23);
            let mut input = case.input(renderer, nodes, 1);
            let grid = renderer.light_grid(case.shape, case.values, 1);
            input.extend(bytes(&[step]));
            input.extend(bytes(&[i32::from(case.mended)]));
            input.extend(bytes(&passes));
            let output = ask("march", &input);
            let mut output = &output[..];
            let bricks: usize = case.shape.iter().map(|n| (n - 1).div_ceil(8).max(1)).product();
            let highest = read::<f32>(&mut output, bricks);
            let depth = read::<f32>(&mut output, grid.values());
            assert!(depth.iter().all(|d| d.is_finite()), "{}: every value of the light volume is written", case.name);
            let sums = read::<f64>(&mut output, 6 * pixels);
            assert!(output.is_empty());
            with_medium(renderer, &mut |medium| {
                assert_eq!(highest, nodes.brick_max(), "{}", case.name);
                let volume = LightVolume::new(medium, case.values, 1);
                let (mut lit, mut missing) = (0, 0);
                for pixel in 0..pixels {
                    let mut sum = RaySum::default();
                    (0..5).for_each(|j| sum.add(&case.ray(medium, pixel as u32, j, step, &volume)));
                    let [r, g, b] = sum.radiance;
                    for (k, expected) in [r, g, b, sum.alpha, sum.ftle, sum.missing].into_iter().enumerate() {
                        let found = sums[k * pixels + pixel];
                        // A point at the edge of a missing cell may fall on either side.
                        let allowed = if case.holes { 2e-2 } else { 3e-4 };
                        let near = (found - f64::from(expected)).abs() <= allowed * (1.0 + f64::from(expected).abs());
                        assert!(near, "{}, pixel {pixel}, field {k}: {found} and {expected}", case.name);
                    }
                    lit += usize::from(sum.alpha > 0.5);
                    missing += usize::from(sum.missing > 0.1);
                }
                assert!(lit > 100 && (missing > 50) == case.holes, "{}: {lit} lit, {missing} missing", case.name);
            });
        });
    }
}

/// Of check `i`: the first rays of the picture, and those of both nets of an audit.
fn ray_number(i: u32) -> u32 {
    if i % 5 < 3 { i % 3 } else { FIRST_AUDIT_RAY as u32 + 7 * i % (2 * NET as u32) }
}

fn with_alpha(ray: &RaySum) -> [f32; 4] {
    let [red, green, blue] = ray.radiance;
    [red, green, blue, ray.alpha]
}

#[test]
fn checked_rays_agree() {
    for case in cases() {
        case.with(|renderer, nodes, with_medium| {
            let mut input = case.input(renderer, nodes, 1);
            // By the light volume and by marching to the light.
            let checks: Vec<(u32, u32, f32, f32)> =
                (0..40).map(|i| (i * 20 + 7, ray_number(i), 0.02 + 0.001 * i as f32, if i % 2 == 0 { 0.0 } else { 0.03 })).collect();
            input.extend(bytes(&[i32::from(case.mended), checks.len() as i32]));
            for check in &checks {
                input.extend(bytes(&[check.0, check.1]));
                input.extend(bytes(&[check.2, check.3]));
            }
            let output = ask("checks", &input);
            let found = read::<[f32; 4]>(&mut &output[..], checks.len());
            with_medium(renderer, &mut |medium| {
                let volume = LightVolume::new(medium, case.values, 1);
                for (&(pixel, ray, step, shadow), found) in checks.iter().zip(&found) {
                    let light = if shadow > 0.0 { ToLight::March(shadow) } else { ToLight::Volume(&volume) };
                    let expected = with_alpha(&medium.ray(pixel, u64::from(ray), step, light, case.mended));
                    let allowed = if case.holes { 2e-2 } else { 3e-4 };
                    let near = (0..4).all(|k| (found[k] - expected[k]).abs() <= allowed * (1.0 + expected[k]));
                    assert!(near, "{}, pixel {pixel}, ray {ray}: {found:?} and {expected:?}", case.name);
                }
            });
        });
    }
}

/// Runs the kernels themselves on the device, in the cases without missing cells.
#[test]
#[ignore = "needs a GPU"]
fn a_device_agrees() {
    use crate::cuda::{
        CombineInput, DeviceNodes, DeviceTable, Filled, Gpu, GpuCombine, GpuMarch, GpuSettings, Medium as DeviceMedium, PinnedFilm,
        RayCheck,
    };
    use ridgewatch_render::smooth::errors_of_tiles;
    let gpu = Gpu::open(0, &GpuSettings { poison: true, ..GpuSettings::default() }).unwrap();
    let (laid, mut march, mut combine) = (DeviceNodes::new(&gpu).unwrap(), GpuMarch::new(&gpu).unwrap(), GpuCombine::new(&gpu).unwrap());
    for case in cases().iter().filter(|case| !case.holes) {
        case.with(|renderer, nodes, with_medium| {
            let (step, pixels) = (0.03, 37 * 23);
            let table = ridgewatch_surrogate::Table::from_values(case.shape, nodes.values().to_vec(), 0);
            let table = DeviceTable::upload(&gpu, &case.domain, &table).unwrap();
            let parameters = renderer.frame_setup(3, 0..1).unwrap().parameters;
            let grid = laid.grid(Some(&table)).unwrap();
            let medium = DeviceMedium { parameters: &parameters, nodes: grid, missing_cells: None };
            march.prepare(renderer, &medium, case.values, 1).unwrap();
            march.march(&medium, step, 3, case.mended).unwrap();
            march.march(&medium, step, 2, case.mended).unwrap();
            march.march(&medium, step, 4, case.mended).unwrap();
            assert_eq!(march.rays(), 9);
            let checks: Vec<RayCheck> = (0..40)
                .map(|i| RayCheck { pixel: i * 20 + 7, ray: ray_number(i), step: 0.02, shadow_step: if i % 2 == 0 { 0.0 } else { 0.03 } })
                .collect();
            let checked = march.check(&medium, &checks, case.mended).unwrap();
            // Without pairs the film is the marched picture.
            let pairs = gpu.upload("pairs", &vec![0.0_f32; SUM_PLANES * pixels]).unwrap();
            let input = CombineInput { size: [37, 23], pairs: &pairs, march: &march, how: None, tone_map: [1.85, 0.75, 1.4], lit: 0.01 };
            let tiles = combine.combine(&input, None).unwrap();
            assert!(tiles.len() == 6 && tiles.iter().all(|tile| tile.all.pixels == 0.0));
            let mut film = PinnedFilm::new(&gpu, Filled::Combined, 37, 23);
            combine.finish(&[[f32::NAN; 2]; 6], 0.0, &mut film, false).unwrap();
            let film = film.film();
            with_medium(renderer, &mut |medium| {
                let volume = LightVolume::new(medium, case.values, 1);
                let mut apart = 0;
                for pixel in 0..pixels {
                    let mut sum = RaySum::default();
                    (0..9).for_each(|j| sum.add(&case.ray(medium, pixel as u32, j, step, &volume)));
                    let [r, g, b] = sum.radiance;
                    for (found, expected) in film.rgba[pixel].iter().zip([r, g, b, sum.alpha]) {
                        apart += u32::from((found - expected / 9.0).abs() > 3e-4 * (1.0 + expected));
                        // Rounding may give a ray one step more or less, which is the error of a step.
                        assert!((found - expected / 9.0).abs() <= 0.02, "{}, pixel {pixel}: {found} and {}", case.name, expected / 9.0);
                    }
                }
                assert!(apart as usize <= pixels / 50, "{}: {apart} values of {pixels} pixels apart", case.name);
                for (check, found) in checks.iter().zip(&checked) {
                    let light = if check.shadow_step > 0.0 { ToLight::March(check.shadow_step) } else { ToLight::Volume(&volume) };
                    let number = u64::from(check.ray);
                    let expected = with_alpha(&match case.mended {
                        true => medium.mended_ray(check.pixel, number, check.step, &volume),
                        false => medium.ray(check.pixel, number, check.step, light, false),
                    });
                    let near = (0..4).all(|k| (found[k] - expected[k]).abs() <= 3e-4 * (1.0 + expected[k]));
                    assert!(near, "{}, {check:?}: {found:?} and {expected:?}", case.name);
                }
            });
        });
    }
    // The combination, with all three corrections, of the last picture's rays.
    let (width, height) = (150, 141);
    let sums = some_pairs(width, height);
    let mut planes = pair_planes(&sums);
    let case = &cases()[0];
    let nodes = some_nodes(case.shape);
    let mut renderer = case.renderer();
    let mut scene = renderer.scene().clone();
    (scene.settings.width, scene.settings.height) = (width, height);
    renderer.set_scene(scene).unwrap();
    let table = ridgewatch_surrogate::Table::from_values(case.shape, nodes.values().to_vec(), 0);
    let table = DeviceTable::upload(&gpu, &case.domain, &table).unwrap();
    let parameters = renderer.frame_setup(3, 0..1).unwrap().parameters;
    let medium = DeviceMedium { parameters: &parameters, nodes: laid.grid(Some(&table)).unwrap(), missing_cells: None };
    march.prepare(&renderer, &medium, case.values, 1).unwrap();
    march.march(&medium, 0.05, 2, false).unwrap();
    planes.resize(SUM_PLANES * width * height, 0.0);
    let pairs = gpu.upload("pairs", &planes).unwrap();
    let mut base = Vec::new();
    for (how, correction) in
        [(None, Correction::Left), (Some(Combine::Shrink), Correction::Shrunk), (Some(Combine::Sum), Correction::Summed)]
    {
        combine.poison().unwrap();
        let input = CombineInput { size: [width, height], pairs: &pairs, march: &march, how, tone_map: [1.85, 0.75, 1.4], lit: 0.01 };
        let tiles = combine.combine(&input, None).unwrap();
        let of_tiles = errors_of_tiles(tiles);
        assert!(of_tiles.iter().flatten().all(|error| *error > 0.0));
        let measured: f64 = tiles.iter().map(|tile| f64::from(tile.all.squared[0])).sum();
        let mut film = PinnedFilm::new(&gpu, Filled::Combined, width, height);
        combine.finish(&of_tiles, 2e-5, &mut film, false).unwrap();
        let film = film.film();
        if how.is_none() {
            let sum = |(&[red, green, blue, alpha], &ftle): (&[f32; 4], &f32)| {
                let ftle = if alpha > 0.0 { ftle * alpha } else { 0.0 };
                RaySum { radiance: [red, green, blue], alpha, ftle, missing: 0.0 }
            };
            base = film.rgba.iter().zip(&film.ftle_mean).map(sum).collect::<Vec<RaySum>>();
        }
        let combined = ridgewatch_render::smooth::combine(&sums, &Guides::new(&base, 1, width), correction);
        let mean: Vec<f32> = combined.squared.iter().map(|e| (e[0][0] + e[0][1] + e[0][2]) / 3.0).collect();
        let expected: f64 = mean.iter().filter(|e| e.is_finite()).map(|e| f64::from(*e)).sum();
        assert!((measured - expected).abs() <= 1e-3 * expected.abs() + 1e-2, "{correction:?}: {measured} and {expected}");
        for i in 0..width * height {
            for k in 0..3 {
                let (found, expected) = (film.rgba[i][k] - base[i].radiance[k], combined.correction[i][k]);
                assert!((found - expected).abs() <= 1e-4, "{correction:?}, pixel {i}: {found} and {expected}");
            }
            let is_lit = film.rgba[i][3] > 0.01;
            let expected = (error_at(&of_tiles, 10, [i % width, i / width], is_lit) + if is_lit { 2e-5 } else { 0.0 }).sqrt();
            assert!((film.error[i] - expected).abs() <= 1e-5 * (1.0 + expected), "{correction:?}, pixel {i}");
        }
    }
}

/// The planes of the sums over pairs.
fn pair_planes(sums: &[PairSums]) -> Vec<f32> {
    let mut planes: Vec<f32> =
        (0..12).flat_map(|plane| sums.iter().map(move |s| s.radiance[plane / 6][plane / 3 % 2][plane % 3])).collect();
    planes.extend((0..2).flat_map(|q| sums.iter().map(move |s| s.pairs[q] as f32)));
    planes.extend(sums.iter().map(|s| s.alpha));
    planes
}

/// Sums over pairs of a picture with structure, noise, and pixels with one quarter or none.
fn some_pairs(width: usize, height: usize) -> Vec<PairSums> {
    let mut random = uniform(21);
    (0..width * height)
        .map(|i| {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            let mut sums = PairSums::default();
            let pairs = (random() * 5.0) as u32 * u32::from(x > 20.0 || y < 9.0);
            for pair in 0..pairs {
                let quarter = ((pair + i as u32) & 1) as usize;
                for half in 0..2 {
                    let value = 0.4 * (-((x - 60.0).powi(2) + (y - 40.0).powi(2)) / 300.0).exp() + 0.3 * (random() - 0.5);
                    (0..3).for_each(|k| sums.radiance[half][quarter][k] += value * (1.0 - 0.2 * k as f32) + 0.05 * (random() - 0.5));
                    sums.alpha += 0.1 * (random() - 0.5);
                }
                sums.pairs[quarter] += 1;
            }
            sums
        })
        .collect()
}

#[test]
fn combined_pictures_agree() {
    // Larger than the blocks of the box filters along both axes in one of the sizes; narrower than the radii in another.
    for (width, height) in [(150, 141), (530, 24), (13, 150)] {
        for (how, number) in [(Correction::Left, 0), (Correction::Shrunk, 1), (Correction::Summed, 2)] {
            let (pixels, mut sums, rays) = (width * height, some_pairs(width, height), 3.0_f64);
            let ([contrast, brightness, gamma], lit, march) = ([1.85_f32, 0.75, 1.4], 0.01_f32, 0.2_f32);
            let mut random = uniform(22);
            let base: Vec<[f64; 6]> = (0..pixels)
                .map(|i| {
                    let alpha = if i % 7 == 0 { 0.0 } else { 3.0 * f64::from(random()) };
                    let colour = f64::from(random());
                    [2.0 * colour, colour, 3.0 * colour, alpha, f64::from(random()) * alpha, f64::from(random())]
                })
                .collect();
            // A part of the correction that the marched picture tells, by each of its details.
            for (sums, ray) in sums.iter_mut().zip(&base) {
                let [red, green, blue, alpha, ftle, _] = ray.map(|value| (value / rays) as f32);
                for (k, colour) in [red, green, blue].into_iter().enumerate() {
                    let told = 0.3 * colour - 0.2 * alpha + 0.25 * ftle - 0.15 * ftle * colour;
                    for half in 0..2 {
                        for quarter in 0..2 {
                            sums.radiance[half][quarter][k] += sums.pairs[quarter] as f32 * told;
                        }
                    }
                }
            }
            let mut input = bytes(&[width as i32, height as i32, number]);
            input.extend(bytes(&[contrast, brightness, gamma, lit]));
            input.extend(bytes(&[1.0 / rays]));
            input.extend(bytes(&[march]));
            input.extend(bytes(&pair_planes(&sums)));
            for k in 0..6 {
                input.extend(base.iter().flat_map(|b| b[k].to_ne_bytes()));
            }
            let across = width.div_ceil(16);
            let of_tiles: Vec<[f32; 2]> = (0..across * height.div_ceil(16)).map(|_| [random(), 1.0 + random()]).collect();
            input.extend(bytes(of_tiles.as_flattened()));
            let output = ask("combine", &input);
            let mut output = &output[..];
            let rgba = read::<[f32; 4]>(&mut output, pixels);
            let [ftle, error, missing, samples, traced] = [(); 5].map(|()| read::<f32>(&mut output, pixels));
            let tiles = read::<[f32; 23]>(&mut output, width.div_ceil(16) * height.div_ceil(16));

            let ray = |b: &[f64; 6]| {
                let [red, green, blue, alpha, ftle, missing] = b.map(|value| value as f32);
                RaySum { radiance: [red, green, blue], alpha, ftle, missing }
            };
            let combined = combine(&sums, &Guides::new(&base.iter().map(ray).collect::<Vec<_>>(), rays as u64, width), how);
            if how == Correction::Shrunk {
                let dark = combine(&sums, &Guides::new(&vec![RaySum::default(); pixels], 1, width), how);
                let apart = combined.correction.iter().zip(&dark.correction).map(|(a, b)| (a[0] - b[0]).abs()).sum::<f32>() / pixels as f32;
                assert!(apart > 0.02, "the regression is a part of what is compared: {apart}");
            }
            let what = format!("{width}x{height}, {how:?}");
            let same = |found: f32, expected: f32, size: f32| {
                (found.is_nan() && expected.is_nan()) || (found - expected).abs() <= 3e-5 * (size + expected.abs())
            };
            let mut expected_tiles = vec![[0.0_f64; 23]; tiles.len()];
            for i in 0..pixels {
                let (b, s) = (base[i], &sums[i]);
                let mut alpha = (b[3] / rays) as f32;
                if how == Correction::Summed {
                    alpha += s.alpha / (2 * s.pairs().max(1)) as f32;
                }
                let colour: [f32; 3] = std::array::from_fn(|k| (b[k] / rays) as f32 + combined.correction[i][k]);
                for k in 0..3 {
                    assert!(same(rgba[i][k], colour[k], 1.0), "{what}, pixel {i}: {:?} and {colour:?}", rgba[i]);
                }
                assert!(same(rgba[i][3], alpha, 1.0), "{what}, pixel {i}");
                let mean_ftle = if b[3] > 0.0 { (b[4] / b[3]) as f32 } else { f32::NAN };
                assert!(same(ftle[i], mean_ftle, 0.0) && same(missing[i], (b[5] / rays) as f32, 0.0), "{what}, pixel {i}");
                assert_eq!((samples[i], traced[i]), (2.0 * s.pairs() as f32, if s.pairs() > 0 { 1.0 } else { 0.0 }));
                let is_lit = rgba[i][3] > lit;
                let expected = (error_at(&of_tiles, across, [i % width, i / width], is_lit) + if is_lit { march } else { 0.0 }).sqrt();
                assert!(same(error[i], expected, 0.3), "{what}, pixel {i}: {} and {expected}", error[i]);
                let tile = &mut expected_tiles[i / width / 16 * across + i % width / 16];
                let tone_map = ToneMap::new([contrast, brightness, gamma].map(f64::from));
                let [squared, scatter] = combined.squared[i];
                let radiance: [f32; 3] = std::array::from_fn(|k| rgba[i][k].powi(2));
                let marched = std::array::from_fn(|k| (b[k] / rays) as f32);
                let [toned, toned_scatter] = combined.squared_in(Some(tone_map), i, s, marched);
                let toned_radiance = std::array::from_fn(|k| radiance[k] * tone_map.slope(rgba[i][k]).powi(2));
                for group in 0..(1 + usize::from(alpha > lit)) * usize::from(s.pairs() > 0) {
                    let pairs = [(squared, toned), (scatter, toned_scatter), (radiance, toned_radiance)];
                    for (which, (e, toned)) in pairs.into_iter().enumerate() {
                        for k in 0..3 {
                            let relative = e[k] / (rgba[i][k].powi(2) + 0.01);
                            for (weighting, value) in [e[k], relative, toned[k]].into_iter().enumerate() {
                                tile[11 * group + 3 * which + weighting] += f64::from(value) / 3.0;
                            }
                        }
                    }
                    tile[11 * group + 9] += 1.0;
                    tile[11 * group + 10] += f64::from(s.pairs());
                }
                if s.pairs() > 0 {
                    let apart = |k: usize| f64::from((0..2).map(|q| s.radiance[0][q][k] - s.radiance[1][q][k]).sum::<f32>());
                    tile[22] += (0..3).map(|k| apart(k).powi(2)).sum::<f64>() / (6.0 * f64::from(s.pairs()));
                }
            }
            for (tile, (found, expected)) in tiles.iter().zip(&expected_tiles).enumerate() {
                for field in 0..23 {
                    // Squared errors cancel: sizes of their terms are those of the weighted squares.
                    let near = (f64::from(found[field]) - expected[field]).abs() <= 2e-3 + 1e-3 * expected[field].abs();
                    assert!(near, "{what}, tile {tile}, field {field}: {} and {}", found[field], expected[field]);
                }
            }
        }
    }
}
