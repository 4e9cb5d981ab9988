//! Frames of the method `map` in a projection: their pixels are those of the command `map`.

use crate::command::ocean;
use crate::kit::program::{config, json, records, ridgewatch, run, set, summary, text};
use ridgewatch::backend::Device;
use ridgewatch::field::{Axis, DomainPoint, EARTH_RADIUS, Geometry, Grid, Snapshot, Window};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Interpolation, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::map::{MapTracer, ProjectionKind, Raster, Sampling, View};
use ridgewatch::render::{CameraSettings, LogStretch, MapPicture, Method, RenderSettings, Renderer, Scene, TransferSettings};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const TAU: f64 = 86_400.0;
/// Eastward turn at the poles over tau, in radians.
const TURN: f64 = 0.5;

/// Air that turns about the axis of the globe, by TURN sin^2 of the latitude in tau, on a grid of half degrees.
fn turning([west, south, east, north]: [f64; 4]) -> VelocitySource {
    let nodes = |extent: f64| (2.0 * extent) as usize + 1;
    let is_round = east - west >= 360.0;
    let longitude = if is_round {
        Axis::uniform("lon", "degrees_east", west, east - 0.5, nodes(east - west) - 1).unwrap().with_period(360.0)
    } else {
        Axis::uniform("lon", "degrees_east", west, east, nodes(east - west)).unwrap()
    };
    let latitude = Axis::uniform("lat", "degrees_north", south, north, nodes(north - south)).unwrap();
    let (nx, rows) = (longitude.len(), latitude.coordinates().to_vec());
    let grid = Arc::new(Grid { axes: vec![longitude, latitude], geometry: Geometry::Sphere { radius: EARTH_RADIUS }, slab: (0.0, 1.0) });
    let eastward = |latitude: f64| EARTH_RADIUS * TURN / TAU * latitude.to_radians().sin().powi(2) * latitude.to_radians().cos();
    let u: Vec<f32> = rows.iter().flat_map(|&latitude| std::iter::repeat_n(eastward(latitude) as f32, nx)).collect();
    let none = vec![0.0; u.len()];
    let mut window = Window::new(TAU);
    for time in [0.0, TAU] {
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &none, &none))).unwrap();
    }
    VelocitySource::Window(Arc::new(window))
}

/// Log-stretch at a latitude: that of the shear cos(latitude) times the derivative of the turn.
fn stretch(latitude: f64) -> f64 {
    let angle = latitude.to_radians();
    (TURN * 2.0 * angle.sin().abs() * angle.cos().powi(2) / 2.0).asinh()
}

struct Traces<'a>(&'a dyn Tracer);

impl LogStretch for Traces<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        let mut found = Traced::default();
        self.0.trace(points, Extras::default(), &mut found);
        log_stretch.copy_from_slice(&found.log_stretch);
        traced.fill(true);
    }
}

#[test]
fn pixels_of_a_frame_are_those_of_the_map() {
    for (region, kind) in [
        ([-25.0, 30.0, 45.0, 72.0], ProjectionKind::Lambert),
        ([0.0, 60.0, 360.0, 90.0], ProjectionKind::Polar),
        ([-60.0, -40.0, 60.0, 60.0], ProjectionKind::Mercator),
        ([14.0, -40.0, 34.0, -30.0], ProjectionKind::PlateCarree),
    ] {
        let velocity = turning(region);
        let VelocitySource::Window(window) = &velocity else { unreachable!() };
        let domain = window.grid().unwrap().domain();
        let map = FlowMap { boundary: Boundary::Stop, interpolation: Interpolation::Cubic, ..FlowMap::tangent(TAU, 40) };
        let middle = 0.5 * (domain.min[2] + domain.max[2]);
        let view = View::new(&domain, true, None, middle, 96).unwrap();
        assert_eq!(view.projection.kind(), kind);
        let sampling = Sampling { seeds: 8, seed: 5 };
        let mut tracer = MapTracer::new(&Device::CPU, &velocity, &map, 0.0).unwrap();
        let raster = Raster::trace(&view, &mut tracer, sampling, &mut |_| true).unwrap().unwrap();

        let [width, height] = view.size;
        let settings = RenderSettings { method: Method::Map, width, height, ..RenderSettings::default() };
        let transfer = TransferSettings { low: Some(0.0), high: Some(0.2 / TAU), ..TransferSettings::default() };
        let mut scene = Scene::assemble(&domain, None, None, Some(transfer), settings, sampling.seed);
        let plane = scene.plane.unwrap();
        // The raster begins in the upper left corner of the domain, and its height is a whole number of pixels.
        let [low, high] = plane.bounds(&domain);
        let pixel = (high[0] - low[0]).max(high[1] - low[1]) / 96.0;
        let seen = [[low[0], high[1] - pixel * height as f64], [low[0] + pixel * width as f64, high[1]]];
        let first = scene.camera.clone();
        scene.camera = CameraSettings::above(seen, domain.max[2] * scene.scale[2], width as f64 / height as f64);
        let near = (0..2).all(|k| (first.eye[k] - scene.camera.eye[k]).abs() < pixel);
        assert!(near && (first.eye[2] / scene.camera.eye[2] - 1.0).abs() < 0.02, "the first view is that of the map");
        let renderer = Renderer::new(scene, &domain, TAU).unwrap();
        let tracer = cpu_tracer(velocity.clone(), &map, 0.0).unwrap();
        let stop = AtomicBool::new(false);
        let (film, _, error) = MapPicture::default().refine(&renderer, 8.0, &mut Traces(&*tracer), None, &stop).unwrap();

        let (mut compared, mut in_closed_form) = (0, 0);
        for (index, (found, wanted)) in film.ftle_mean.iter().zip(&raster.mean).enumerate() {
            assert_eq!(found.is_nan(), wanted.is_nan(), "{kind:?}, pixel {index}");
            if found.is_nan() {
                assert_eq!(film.rgba[index][3], 0.0);
                continue;
            }
            compared += 1;
            // The same seeds, but for the rounding of their place and of what is traced to f32.
            assert!(((found - wanted) * TAU as f32).abs() < 5e-5, "{kind:?}, pixel {index}: {found} and {wanted}");
            let [x, y] = [(index % width) as f64 + 0.5, (index / width) as f64 + 0.5];
            let Some([longitude, latitude]) = view.place(x, y) else { continue };
            // Particles of the closed form do not leave the data in tau.
            let reach = 2.0 + (TURN * latitude.to_radians().sin().powi(2)).to_degrees();
            let stays = kind == ProjectionKind::Polar || longitude + reach < region[2];
            if stays && (region[1] + 2.0..region[3] - 2.0).contains(&latitude) {
                in_closed_form += 1;
                // Curvature over a pixel, the grid, and the mean of eight seeds.
                let difference = f64::from(*found) * TAU - stretch(latitude);
                assert!(difference.abs() < 0.003, "{kind:?}, {latitude}: {found} differs by {difference}");
            }
        }
        assert!(compared > 2000 && in_closed_form > 300, "{kind:?}: {compared} {in_closed_form}");
        let stated = raster.error.unwrap().rms * TAU / 0.2;
        assert!((error.rms.value / stated - 1.0).abs() < 0.01, "{kind:?}: {} and {stated}", error.rms.value);
    }
}

#[test]
fn a_run_draws_its_frames_in_the_projection_that_fits_or_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let data = ocean(folder.path());
    let replay = |name: &str, keys: &[&str]| {
        let out = folder.path().join(name);
        let sizes = ["render.width=48", "render.height=32", "render.samples=2", "flow.steps=20", "time.tau=\"1 day\"", "time.slides=1"];
        run(&mut ridgewatch(
            [&["replay", text(&data), "--device", "cpu", "--annotate", "--out", text(&out)][..], &set(&sizes), &set(keys)].concat(),
        ))
        .success();
        out
    };
    let fitting = replay("fitting", &[]);
    let decisions = summary(&fitting)["run"]["decisions"].clone();
    let of = |setting: &str| decisions.as_array().unwrap().iter().find(|decision| decision["setting"] == setting).cloned();
    assert_eq!(of("render.projection").unwrap()["chosen"], "plate_carree");
    let kind = |out: &std::path::Path| records(out)[0].projection.map(|plane| plane.projection.kind());
    assert_eq!(kind(&fitting), Some(ProjectionKind::PlateCarree));
    let named = replay("named", &["render.projection=lambert"]);
    assert_eq!(kind(&named), Some(ProjectionKind::Lambert));
    assert_eq!(json(&named.join("maps/slide_000000.json"))["projection"], "lambert", "the map of the slide has it too");
    // A page of a frame says so.
    let page = folder.path().join("page.svg");
    run(&mut ridgewatch(["figure", text(&named), "-o", text(&page)])).success();
    assert!(std::fs::read_to_string(page).unwrap().contains("Projection: Lambert conformal conic about 25.0°."));
    assert_eq!(kind(&replay("plain", &["render.projection=plain"])), None);
    let camera = "camera={eye=[25, -35, 4], look_at=[25, -35, 0], up=[0, 1, 0], field_of_view=90, orthographic=true}";
    assert_eq!(kind(&replay("camera", &["render.method=map", camera])), None, "a camera in degrees");

    let out = folder.path().join("refused");
    let refused = |arguments: &[&str], words: &[&str]| {
        run(&mut ridgewatch([&["replay", "--out", text(&out)][..], arguments].concat())).refused(2, words);
    };
    refused(&[&config("double_gyre.toml"), "--set", "render.projection=lambert"], &["`render.projection`", "accepted: auto, plain"]);
    refused(&[text(&data), "--set", "render.projection=conic"], &["render.projection", "plate_carree"]);
}
